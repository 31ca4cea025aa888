"""The map grows with the flight: new views on the old map, adjusted together (IV-G).

Common points carry scale and frame over. Old keyframes and landmarks stay; they
are adjusted with the new ones, held by the known distances and by the first
keyframe, and may move by no more than their covariance explains.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.chaining import join_to_keyframe
from vcl_companion.mapping.continuity import broken_continuity, pruned
from vcl_companion.mapping.correspondences import Correspondences, unique
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.extension import Extension, ImageFeatures
from vcl_companion.mapping.growth import Growth, grown
from vcl_companion.mapping.joining import Joined, join, join_nearby
from vcl_companion.mapping.keyframe_image import decode_image
from vcl_companion.mapping.known_features import KeyframeLibrary, of_keyframes
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.late_joining import join_together
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.patch_table import PyramidOf, decoded_pyramid
from vcl_companion.mapping.reconstruction import accepted
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.mapping.visibility import MutualMatches
from vcl_companion.vision.features import Detector, FeatureOptions, Features, detect

# Keyframes that a view is matched with before it is given up.
_TRIED = 6
# Of these so many, of most matches, are tried by themselves.
_PAIRED = 2
# A new view has to see this many landmarks in the end.
_MIN_SEEN = 20


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
    chosen = features or FeatureOptions()

    def features_of(image_bytes: bytes, camera: Camera, detector: Detector) -> Features:
        return detect(decode_image(image_bytes, camera), detector, chosen)

    return extended(old, parent, views, features_of, options, seed)


def extended(
    old: LandmarkMap,
    parent: bytes,
    views: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int = 0,
    pyramid_of: PyramidOf = decoded_pyramid,
    sure: MapUncertainty | None = None,
    *,
    at_once: bool = False,
) -> LandmarkMap | NoMap:
    """Do what ``extend_map`` does, with any source of features, images and uncertainty.

    Views that say where they are are joined by patches. Those that do not, or are not
    there, are registered by their features, on what the others have made of the map:
    that takes many times as long, and ``at_once`` does without it.
    """
    known = {(k.drone_id, k.captured_at_ns) for k in old.keyframes}
    views = [v for v in views if (v.drone_id, v.captured_at_ns) not in known]
    if at_once:
        views = [v for v in views if v.world_from_body is not None]
    if not views:
        return NoMap("there is no view that the map does not have already")
    try:
        sure = sure or map_uncertainty(old, options.calibration_px)
        growth = _grown(
            old, sure, views, features_of, options, seed, pyramid_of, MutualMatches(), at_once
        )
    except ValueError as error:
        return NoMap(str(error))
    if isinstance(growth, NoMap):
        return growth
    reason = broken_continuity(old, sure, growth)
    if reason:
        return NoMap(reason)
    try:
        child = replace(
            growth.landmark_map, parent=parent, world=old.world_of(parent), joined=old.joined
        )
        made = pruned(child, len(old.keyframes), options)
    except ValueError as error:
        return NoMap(str(error))
    return accepted(made, options)


def _grown(
    old: LandmarkMap,
    sure: MapUncertainty,
    views: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    pyramid_of: PyramidOf,
    matches: MutualMatches,
    at_once: bool,
) -> Growth | NoMap:
    """Join views by patches, then the others by features on what came of it.

    Raises:
        ValueError: the map grown by patches is not fixed by what is seen.
    """
    growth: Growth | None = None
    if options.patches:
        views = _guessed(old, sure, views, features_of, options, seed, matches)
        growth = Extension(old, sure, views, features_of, pyramid_of, options).run()
    if at_once:
        return growth or NoMap("no view joins the map by its patches")
    if growth is None:
        return _by_features(old, sure, views, features_of, options, seed, pyramid_of, matches)
    # What they tell is of the landmarks of the old map, whose rows are others by now.
    waiting = [replace(v, told_px=None) for i, v in enumerate(views) if i not in growth.views]
    if not waiting:
        return growth
    known = growth.landmark_map
    late = _by_features(
        known,
        map_uncertainty(known, options.calibration_px),
        waiting,
        features_of,
        options,
        seed,
        pyramid_of,
        matches,
    )
    if isinstance(late, NoMap):
        return growth
    return replace(late, old=np.where(late.old >= 0, growth.old[late.old], -1))


def _guessed(
    old: LandmarkMap,
    sure: MapUncertainty,
    views: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    matches: MutualMatches,
) -> list[DroneView]:
    """Return the views, with poses by features for those that do not say where they are."""
    out = list(views)
    # The second detector costs as much again, and sees from farther apart.
    for detectors in dict.fromkeys((options.detectors[:1], options.detectors)):
        library = KeyframeLibrary(old, of_keyframes(features_of, detectors))
        for i, view in enumerate(out):
            if view.world_from_body is not None:
                continue
            try:
                found = tuple(features_of(view.image_bytes, view.camera, d) for d in detectors)
            except ValueError:
                continue
            shown = replace(view, features=found)
            pose = _Update(old, sure, [shown], library, options, seed, matches).pose_on_old()
            out[i] = replace(view, world_from_body=pose)
    return out


def _by_features(
    known: LandmarkMap,
    sure: MapUncertainty,
    waiting: list[DroneView],
    features_of: ImageFeatures,
    options: MapOptions,
    seed: int,
    pyramid_of: PyramidOf,
    matches: MutualMatches,
) -> Growth | NoMap:
    """Register views by their features; that done, by patches if they can be seen from there."""
    usable = []
    for view in waiting:
        try:
            found = tuple(features_of(view.image_bytes, view.camera, d) for d in options.detectors)
        except ValueError:
            continue
        usable.append(replace(view, features=found))
    if not usable:
        return NoMap("no frame has come that can be used")
    library = KeyframeLibrary(known, of_keyframes(features_of, options.detectors))
    late = _Update(known, sure, usable, library, options, seed, matches).run()
    if isinstance(late, NoMap) or not options.patches:
        return late
    found_at = late.landmark_map.keyframes[len(known.keyframes) :]
    guessed = [
        replace(usable[i], world_from_body=k.world_from_body)
        for i, k in zip(late.views, found_at, strict=True)
    ]
    sharper = Extension(known, sure, guessed, features_of, pyramid_of, options).run()
    return sharper if sharper and len(sharper.views) == len(late.views) else late


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
        matches: MutualMatches,
    ) -> None:
        self._old, self._sure, self._views = old, sure, views
        self._library, self._options, self._seed = library, options, seed
        self._matches = Correspondences(library, views, matches)
        self._joined: dict[int, Joined] = {}
        self._reasons: dict[int, str] = {}
        self._refuted: set[int] = set()
        self._grouped: set[int] = set()
        self._paired: set[int] = set()

    def run(self) -> Growth | NoMap:
        """Register view after view until no more can be; drop those that the whole refutes."""
        for i in range(len(self._views)):
            self._join_old(i)
        growth: Growth | None = None
        while True:
            if self._joined:
                self._matches.match_joined(self._old, self._joined)
                growth = grown(
                    self._old,
                    self._library,
                    self._views,
                    self._joined,
                    self._matches.pairs,
                    self._options,
                )
                if self._drop_unsupported(growth):
                    growth = None
                    continue
            if not self._waiting():
                break
            known, sure = self._old, self._sure
            if growth is not None:
                known = growth.landmark_map
                try:
                    sure = map_uncertainty(known, self._options.calibration_px)
                except ValueError as error:
                    return NoMap(str(error))
            if growth is not None and self._join_new(growth, known, sure):
                continue
            if self._join_pairs():
                continue
            if not self._join_groups(growth, known, sure):
                break
        if growth is None:
            return NoMap("no new view fits the map: " + "; ".join(self._told()))
        return growth

    def pose_on_old(self) -> Pose | None:
        """Return where the only view is by old landmarks; None where these do not say."""
        self._join_old(0)
        return self._joined[0].world_from_body if self._joined else None

    def _told(self) -> list[str]:
        told = (f"drone {self._views[i].drone_id}: {r}" for i, r in sorted(self._reasons.items()))
        return list(dict.fromkeys(told))

    def _join_old(self, i: int) -> None:
        """Register a view by landmarks of the old map."""
        view, links = self._views[i], PairMatches(np.zeros(0, np.intp), np.zeros(0, np.intp))
        for k in self._matches.likely(self._old, view)[:_TRIED]:
            matches = self._matches.with_keyframe(k, i)
            landmark = self._library.of(k).landmark[matches.a]
            of_map = landmark >= 0
            links = PairMatches(
                np.concatenate([links.a, landmark[of_map]]),
                np.concatenate([links.b, matches.b[of_map]]),
            )
            found = join(view, unique(links), self._old, self._sure, self._options)
            if isinstance(found, Joined):
                found = join_nearby(
                    view, found.world_from_body, self._library, self._old, self._sure, self._options
                )
            if isinstance(found, Joined):
                self._joined[i] = found
                return
            self._reasons[i] = found.reason

    def _waiting(self) -> list[int]:
        return [
            i for i in range(len(self._views)) if i not in self._joined and i not in self._refuted
        ]

    def _join_new(self, growth: Growth, known: LandmarkMap, sure: MapUncertainty) -> bool:
        """Register waiting views by landmarks that came with others; whether any was."""
        n_old = len(self._old.points_world)
        found = {}
        for i in self._waiting():
            one = join(
                self._views[i], self._matches.links(n_old, growth, i), known, sure, self._options
            )
            if isinstance(one, Joined):
                found[i] = one
            else:
                self._reasons[i] = one.reason
        self._take(growth, found)
        return bool(found)

    def _join_pairs(self) -> bool:
        """Register waiting views by one keyframe each, each view once; whether any was."""
        some = False
        for i in self._waiting():
            if i in self._paired:
                continue
            self._paired.add(i)
            tried = [k for k, mine in self._matches.pairs.with_keyframes if mine == i]
            tried.sort(key=lambda k: -len(self._matches.with_keyframe(k, i).a))
            for k in tried[:_PAIRED]:
                found = join_to_keyframe(
                    self._views[i], k, self._library.of(k), self._matches.with_keyframe(k, i),
                    self._old, self._options, self._seed,
                )  # fmt: skip
                if isinstance(found, Joined):
                    self._joined[i] = found
                    some = True
                    break
                self._reasons[i] = found.reason
        return some

    def _join_groups(self, growth: Growth | None, known: LandmarkMap, sure: MapUncertainty) -> bool:
        """Register waiting views of one drone jointly, each drone once; whether any was."""
        waiting = self._waiting()
        for drone_id in sorted({self._views[i].drone_id for i in waiting} - self._grouped):
            group = [i for i in waiting if self._views[i].drone_id == drone_id]
            self._grouped.add(drone_id)
            if len(group) < 2:
                continue
            self._matches.match_views(self._old, self._joined)
            n_old = len(self._old.points_world)
            found = join_together(
                [self._views[i] for i in group],
                [self._matches.links(n_old, growth, i) for i in group],
                {
                    (group.index(i), group.index(k)): m
                    for (i, k), m in self._matches.pairs.with_views.items()
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
