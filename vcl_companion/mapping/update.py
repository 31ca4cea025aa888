"""The map grows with the flight: new views on the old map, adjusted together (IV-G).

Common points carry scale and frame over. Old keyframes and landmarks stay; they
are adjusted with the new ones, held by the known distances and by the first
keyframe, and may move by no more than their covariance explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.continuity import broken_continuity, pruned
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.growth import Growth, Pairs, grown
from vcl_companion.mapping.joining import Joined, join, join_nearby
from vcl_companion.mapping.known_features import FeaturesOf, KeyframeLibrary, detected
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.late_joining import join_together
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import accepted
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.mapping.visibility import match_features
from vcl_companion.vision.features import FeatureOptions

# Keyframes that a view is matched with before it is given up.
_TRIED = 6
# A registered view is matched with this many keyframes that overlap it most.
_PARTNERS = 2
# Overlap counts fully from this angle between two rays on, and hardly where they are parallel.
_WIDE_RAD = np.deg2rad(5.0)
_MIN_SEEN = 20
_DEG_PER_PLACE = 15.0


def extend_map(
    old: LandmarkMap,
    parent: bytes,
    views: list[DroneView],
    options: MapOptions,
    seed: int = 0,
    features: FeatureOptions | None = None,
) -> LandmarkMap | NoMap:
    """Make the next revision of a map from new views.

    Args:
        old: the map so far.
        parent: its revision.
        views: new ones; several of one drone, of different instants, where it
            could not be registered by one.
        options: thresholds; its detectors are the views'.
        seed: of the robust searches.
        features: how the views' features were found, so that the old keyframes'
            are found alike.

    Returns:
        The old map with the views that could be registered and what they see,
        or why there is none.
    """
    features_of = detected(options.detectors, features or FeatureOptions())
    return extended(old, parent, views, features_of, options, seed)


def extended(
    old: LandmarkMap,
    parent: bytes,
    views: list[DroneView],
    features_of: FeaturesOf,
    options: MapOptions,
    seed: int = 0,
) -> LandmarkMap | NoMap:
    """Do what ``extend_map`` does, with any source of the old keyframes' features."""
    known = {(k.drone_id, k.captured_at_ns) for k in old.keyframes}
    views = [v for v in views if (v.drone_id, v.captured_at_ns) not in known]
    if not views:
        return NoMap("there is no view that the map does not have already")
    try:
        sure = map_uncertainty(old)
    except ValueError as error:
        return NoMap(str(error))
    update = _Update(old, sure, views, KeyframeLibrary(old, features_of), options, seed)
    try:
        growth = update.run()
    except ValueError as error:  # of map_uncertainty: with the new views it is not fixed
        return NoMap(str(error))
    if isinstance(growth, NoMap):
        return growth
    reason = broken_continuity(old, sure, growth)
    if reason:
        return NoMap(reason)
    made = pruned(replace(growth.landmark_map, parent=parent), len(old.keyframes), options)
    return accepted(made, options)


class _Update:
    """One extension under way: who has joined, what was matched."""

    def __init__(
        self,
        old: LandmarkMap,
        sure: MapUncertainty,
        views: list[DroneView],
        library: KeyframeLibrary,
        options: MapOptions,
        seed: int,
    ) -> None:
        self._old, self._sure, self._views = old, sure, views
        self._library, self._options, self._seed = library, options, seed
        self._pairs = Pairs({}, {})
        self._joined: dict[int, Joined] = {}
        self._reasons: dict[int, str] = {}
        self._refuted: set[int] = set()
        self._grouped: set[int] = set()

    def run(self) -> Growth | NoMap:
        """Register view after view until no more can be; drop those that the whole refutes."""
        for i in range(len(self._views)):
            self._join_old(i)
        growth: Growth | None = None
        while True:
            if self._joined:
                self._match_joined()
                growth = grown(
                    self._old, self._library, self._views, self._joined, self._pairs, self._options
                )
                if self._drop_unsupported(growth):
                    growth = None
                    continue
                if self._join_new(growth):
                    continue
            if not self._join_groups(growth):
                break
        if growth is None:
            return NoMap("no new view fits the map: " + "; ".join(self._told()))
        return growth

    def _told(self) -> list[str]:
        return [f"drone {self._views[i].drone_id}: {r}" for i, r in sorted(self._reasons.items())]

    def _join_old(self, i: int) -> None:
        """Register a view by landmarks of the old map."""
        view, links = self._views[i], PairMatches(np.zeros(0, np.intp), np.zeros(0, np.intp))
        for k in self._likely(view)[:_TRIED]:
            matches = self._match_keyframe(k, i)
            landmark = self._library.of(k).landmark[matches.a]
            of_map = landmark >= 0
            links = PairMatches(
                np.concatenate([links.a, landmark[of_map]]),
                np.concatenate([links.b, matches.b[of_map]]),
            )
            found = join(view, _unique(links), self._old, self._sure, self._options)
            if isinstance(found, Joined):
                found = join_nearby(
                    view, found.world_from_body, self._library, self._old, self._sure, self._options
                )
            if isinstance(found, Joined):
                self._joined[i] = found
                return
            self._reasons[i] = found.reason

    def _likely(self, view: DroneView) -> list[int]:
        """Return keyframes, newest first, those first that look where the view looks."""
        keyframes = self._old.keyframes
        places = []
        for k, keyframe in enumerate(keyframes):
            place = float(len(keyframes) - k) + (keyframe.drone_id != view.drone_id)
            if view.ned_from_body is not None:
                axis = (view.ned_from_body @ view.body_from_cam.rotation)[:, 2]
                then = (keyframe.world_from_body.rotation @ keyframe.body_from_cam.rotation)[:, 2]
                angle_deg = np.rad2deg(np.arccos(np.clip(axis @ then, -1.0, 1.0)))
                place += float(angle_deg) / _DEG_PER_PLACE
            places.append(place)
        return [int(k) for k in np.argsort(places, kind="stable")]

    def _match_keyframe(self, k: int, i: int) -> PairMatches:
        if (k, i) not in self._pairs.with_keyframes:
            self._pairs.with_keyframes[k, i] = match_features(
                self._library.of(k).features, self._views[i].features
            )
        return self._pairs.with_keyframes[k, i]

    def _match_joined(self) -> None:
        """Match views with the keyframes that overlap them most, and with each other."""
        origins = [k.world_from_body @ k.body_from_cam for k in self._old.keyframes]
        for i, joined in self._joined.items():
            cam = joined.world_from_body @ self._views[i].body_from_cam
            visible = self._visible(i, cam)
            overlap = [
                _overlap(self._old.points_world[visible & self._old.seen[:, k]], cam, origin)
                for k, origin in enumerate(origins)
            ]
            for k in np.argsort(overlap)[::-1][:_PARTNERS]:
                if overlap[k] > 0.0:
                    self._match_keyframe(int(k), i)
        self._match_views()

    def _match_views(self) -> None:
        for i, k in self._view_pairs():
            if (i, k) not in self._pairs.with_views:
                self._pairs.with_views[i, k] = match_features(
                    self._views[i].features, self._views[k].features
                )

    def _view_pairs(self) -> list[tuple[int, int]]:
        """Return which new views are matched: neighbours in time of one drone, and the joined."""
        pairs = set()
        for i, view in enumerate(self._views):
            mine = [k for k, v in enumerate(self._views) if v.drone_id == view.drone_id]
            later = sorted(mine, key=lambda k: self._views[k].captured_at_ns)
            at = later.index(i)
            pairs |= {(min(i, k), max(i, k)) for k in later[at + 1 : at + 1 + _PARTNERS]}
        cams = {
            i: j.world_from_body @ self._views[i].body_from_cam for i, j in self._joined.items()
        }
        visible = {i: self._visible(i, cam) for i, cam in cams.items()}
        for i in cams:
            overlap = {
                k: _overlap(self._old.points_world[visible[i] & visible[k]], cams[i], cams[k])
                for k in cams
                if k != i
            }
            best = sorted(overlap, key=lambda k: -overlap[k])[:_PARTNERS]
            pairs |= {(min(i, k), max(i, k)) for k in best}
        return sorted(pairs)

    def _visible(self, i: int, world_from_cam: Pose) -> NDArray[np.bool_]:
        """Return (N,) old landmarks that lie within a view."""
        camera = self._views[i].camera
        pixels = camera.project(world_from_cam.inverse().apply(self._old.points_world))
        with np.errstate(invalid="ignore"):
            inside = (pixels > 0) & (pixels < (camera.width_px, camera.height_px))
        return np.asarray(inside.all(axis=1))

    def _waiting(self) -> list[int]:
        return [
            i for i in range(len(self._views)) if i not in self._joined and i not in self._refuted
        ]

    def _join_new(self, growth: Growth) -> bool:
        """Register waiting views by landmarks that came with others; whether any was."""
        known, sure = self._known(growth)
        found = {}
        for i in self._waiting():
            one = join(self._views[i], self._links(growth, i), known, sure, self._options)
            if isinstance(one, Joined):
                found[i] = one
            else:
                self._reasons[i] = one.reason
        self._take(growth, found)
        return bool(found)

    def _join_groups(self, growth: Growth | None) -> bool:
        """Register waiting views of one drone jointly, each drone once; whether any was."""
        waiting = self._waiting()
        for drone_id in sorted({self._views[i].drone_id for i in waiting} - self._grouped):
            group = [i for i in waiting if self._views[i].drone_id == drone_id]
            self._grouped.add(drone_id)
            if len(group) < 2:
                continue
            self._match_views()
            known, sure = self._known(growth)
            found = join_together(
                [self._views[i] for i in group],
                [self._links(growth, i) for i in group],
                {
                    (group.index(i), group.index(k)): m
                    for (i, k), m in self._pairs.with_views.items()
                    if i in group and k in group
                },
                known,
                sure,
                self._options,
                self._seed,
            )
            if isinstance(found, NoMap):
                self._reasons |= dict.fromkeys(group, found.reason)
                continue
            self._take(growth, {group[n]: one for n, one in found.items()})
            return True
        return False

    def _known(self, growth: Growth | None) -> tuple[LandmarkMap, MapUncertainty]:
        """Return the map so far and how well it is known."""
        if growth is None:
            return self._old, self._sure
        return growth.landmark_map, map_uncertainty(growth.landmark_map)

    def _links(self, growth: Growth | None, i: int) -> PairMatches:
        """Return the landmarks that a waiting view's matches with all others lead to."""
        none = np.zeros(0, np.intp)
        landmarks, features = [none], [none]
        # Of the old map's landmarks to those of the map so far.
        place = np.arange(len(self._old.points_world))
        if growth is not None:
            place = np.full(len(place), -1, dtype=np.intp)
            place[growth.old[growth.old >= 0]] = np.flatnonzero(growth.old >= 0)
        for (k, mine), matches in self._pairs.with_keyframes.items():
            if mine == i:
                old = self._library.of(k).landmark[matches.a]
                landmarks.append(np.where(old >= 0, place[old], -1))
                features.append(matches.b)
        for (a, b), matches in self._pairs.with_views.items():
            for other, mine, of_other, of_mine in (
                (a, b, matches.a, matches.b),
                (b, a, matches.b, matches.a),
            ):
                if growth is not None and mine == i and other in growth.rows:
                    landmarks.append(growth.rows[other][of_other])
                    features.append(of_mine)
        links = PairMatches(np.concatenate(landmarks), np.concatenate(features))
        return _unique(PairMatches(links.a[links.a >= 0], links.b[links.a >= 0]))

    def _take(self, growth: Growth | None, found: dict[int, Joined]) -> None:
        """Go on from adjusted poses and landmarks, with views registered on them."""
        if not found:
            return
        if growth is None:
            self._joined |= found
            return
        n = len(self._old.keyframes)
        keyframes = growth.landmark_map.keyframes
        points = self._old.points_world.copy()
        stays = growth.old >= 0
        points[growth.old[stays]] = growth.landmark_map.points_world[stays]
        self._old = replace(self._old, keyframes=keyframes[:n], points_world=points)
        for i, keyframe in zip(growth.views, keyframes[n:], strict=True):
            self._joined[i] = replace(self._joined[i], world_from_body=keyframe.world_from_body)
        for i, one in found.items():
            # Links to new landmarks come again with the matches that led to them.
            old = growth.old[one.links.a]
            links = PairMatches(old[old >= 0], one.links.b[old >= 0])
            self._joined[i] = Joined(one.world_from_body, links)

    def _drop_unsupported(self, growth: Growth) -> bool:
        """Leave out views that hardly anything is left to see of; whether any was."""
        n = len(self._old.keyframes)
        some = False
        for column, i in enumerate(growth.views):
            n_seen = int(growth.landmark_map.seen[:, n + column].sum())
            if n_seen < _MIN_SEEN:
                self._reasons[i] = f"{n_seen} landmarks agree, {_MIN_SEEN} needed"
                del self._joined[i]
                self._refuted.add(i)
                some = True
        return some


def _unique(links: PairMatches) -> PairMatches:
    pairs = np.unique(np.stack([links.a, links.b], axis=1), axis=0)
    return PairMatches(pairs[:, 0], pairs[:, 1])


def _overlap(points: Array, one: Pose, other: Pose) -> float:
    """Return how many points two cameras share, counted by the angle they are seen under."""
    a, b = points - one.translation, points - other.translation
    lengths = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    cosine = np.einsum("ni,ni->n", a, b) / np.maximum(lengths, 1e-9)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return float(np.minimum(angle / _WIDE_RAD, 1.0).sum())
