"""Who is matched with whom when a map grows, and what that says of its landmarks (IV-G).

Every view with every keyframe would be quadratic over a flight: a view is
matched with the few keyframes that look where it looks, then with those that
overlap it most.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.growth import Growth, Pairs
from vcl_companion.mapping.joining import Joined
from vcl_companion.mapping.known_features import KeyframeLibrary, KnownFeatures
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.partners import overlap
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.visibility import MutualMatches, match_features

# A registered view is matched with this many keyframes that overlap it most.
_PARTNERS = 2
# A keyframe that looks so much elsewhere is as good as one keyframe older.
_DEG_PER_PLACE = 15.0


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A view with a place, and what a waiting one shares with it.

    Attributes:
        name: of a keyframe of the old map, or of a view that has joined.
        keyframe: where it is.
        shown: its features, and whose landmarks they are.
        matches: features of it (``a``) and of the waiting view (``b``).
        growth: the map that its landmarks are of; None for the old one.
    """

    name: tuple[Literal["old", "joined"], int]
    keyframe: Keyframe
    shown: KnownFeatures
    matches: PairMatches
    growth: Growth | None


class Correspondences:
    """Matches between a map's keyframes and new views, made as they are needed.

    Args:
        library: the features of the keyframes.
        views: the new views.
        matches: remembers those of earlier attempts.
    """

    def __init__(
        self, library: KeyframeLibrary, views: list[DroneView], matches: MutualMatches
    ) -> None:
        self._library, self._views, self._matches = library, views, matches
        self.pairs = Pairs({}, {})

    def likely(self, known: LandmarkMap, view: DroneView) -> list[int]:
        """Return keyframes, newest first, those first that look where the view looks."""
        keyframes = known.keyframes
        places = []
        for k, keyframe in enumerate(keyframes):
            place = float(len(keyframes) - k) + (keyframe.drone_id != view.drone_id)
            if view.ned_from_body is not None and view.has_heading:
                axis = (view.ned_from_body @ view.body_from_cam.rotation)[:, 2]
                then = (keyframe.world_from_body.rotation @ keyframe.body_from_cam.rotation)[:, 2]
                angle_deg = np.rad2deg(np.arccos(np.clip(axis @ then, -1.0, 1.0)))
                place += float(angle_deg) / _DEG_PER_PLACE
            places.append(place)
        return [int(k) for k in np.argsort(places, kind="stable")]

    def with_keyframe(self, k: int, i: int) -> PairMatches:
        """Return the matches of a keyframe with a view."""
        if (k, i) not in self.pairs.with_keyframes:
            self.pairs.with_keyframes[k, i] = match_features(
                self._library.of(k).features, self._views[i].features, self._matches
            )
        return self.pairs.with_keyframes[k, i]

    def match_joined(self, known: LandmarkMap, joined: dict[int, Joined]) -> None:
        """Match views with the keyframes that overlap them most, and with each other."""
        origins = [k.world_from_body @ k.body_from_cam for k in known.keyframes]
        for i, one in joined.items():
            cam = one.world_from_body @ self._views[i].body_from_cam
            visible = self._visible(known, i, cam)
            overlaps = [
                overlap(known.points_world[visible & known.seen[:, k]], cam, origin)
                for k, origin in enumerate(origins)
            ]
            for k in np.argsort(overlaps)[::-1][:_PARTNERS]:
                if overlaps[k] > 0.0:
                    self.with_keyframe(int(k), i)
        self.match_views(known, joined)

    def match_views(self, known: LandmarkMap, joined: dict[int, Joined]) -> None:
        """Match neighbours in time of one drone, and the joined views that overlap most."""
        for i, k in self._view_pairs(known, joined):
            if (i, k) not in self.pairs.with_views:
                self.pairs.with_views[i, k] = match_features(
                    self._views[i].features, self._views[k].features, self._matches
                )

    def _view_pairs(self, known: LandmarkMap, joined: dict[int, Joined]) -> list[tuple[int, int]]:
        """Return which new views are matched: neighbours of one drone, and those that overlap."""
        pairs = set()
        for i, view in enumerate(self._views):
            mine = [k for k, v in enumerate(self._views) if v.drone_id == view.drone_id]
            later = sorted(mine, key=lambda k: self._views[k].captured_at_ns)
            at = later.index(i)
            pairs |= {(min(i, k), max(i, k)) for k in later[at + 1 : at + 1 + _PARTNERS]}
            if i not in joined:
                # Where it is is not known: whoever has joined may show the same, one of each drone.
                newest = {self._views[k].drone_id: k for k in sorted(joined)}
                pairs |= {(min(i, k), max(i, k)) for k in newest.values()}
        cams = {i: one.world_from_body @ self._views[i].body_from_cam for i, one in joined.items()}
        visible = {i: self._visible(known, i, cam) for i, cam in cams.items()}
        for i in cams:
            overlaps = {
                k: overlap(known.points_world[visible[i] & visible[k]], cams[i], cams[k])
                for k in cams
                if k != i
            }
            best = sorted(overlaps, key=lambda k: -overlaps[k])[:_PARTNERS]
            pairs |= {(min(i, k), max(i, k)) for k in best}
        return sorted(pairs)

    def _visible(self, known: LandmarkMap, i: int, world_from_cam: Pose) -> NDArray[np.bool_]:
        """Return (N,) landmarks that lie within a view."""
        camera = self._views[i].camera
        pixels = camera.project(world_from_cam.inverse().apply(known.points_world))
        with np.errstate(invalid="ignore"):
            inside = (pixels > 0) & (pixels < (camera.width_px, camera.height_px))
        return np.asarray(inside.all(axis=1))

    def neighbours(self, known: LandmarkMap, growth: Growth | None, i: int) -> list[Neighbour]:
        """Return those that a waiting view is matched with already, most matches first.

        Args:
            known: the old map.
            growth: the map so far; None for the old one.
            i: the view.
        """
        found = [
            Neighbour(("old", k), known.keyframes[k], self._library.of(k), matches, None)
            for (k, mine), matches in self.pairs.with_keyframes.items()
            if mine == i
        ]
        if growth is not None:
            keyframes = growth.landmark_map.keyframes[len(known.keyframes) :]
            for k, keyframe in zip(growth.views, keyframes, strict=True):
                m = self.pairs.with_views.get((min(i, k), max(i, k)))
                if m is not None:
                    view = self._views[k]
                    shown = KnownFeatures(view.features, view.pixels, growth.rows[k])
                    matches = m if k < i else PairMatches(m.b, m.a)
                    found.append(Neighbour(("joined", k), keyframe, shown, matches, growth))
        return sorted(found, key=lambda one: -len(one.matches.a))

    def links(self, n_old: int, growth: Growth | None, i: int) -> PairMatches:
        """Return the landmarks that a waiting view's matches with all others lead to.

        Args:
            n_old: how many landmarks the old map has.
            growth: the map so far; None for the old one.
            i: the view.
        """
        none = np.zeros(0, np.intp)
        landmarks, features = [none], [none]
        # Of the old map's landmarks to those of the map so far.
        place = np.arange(n_old)
        if growth is not None:
            place = np.full(len(place), -1, dtype=np.intp)
            place[growth.old[growth.old >= 0]] = np.flatnonzero(growth.old >= 0)
        for (k, mine), matches in self.pairs.with_keyframes.items():
            if mine == i:
                old = self._library.of(k).landmark[matches.a]
                landmarks.append(np.where(old >= 0, place[old], -1))
                features.append(matches.b)
        for (a, b), matches in self.pairs.with_views.items():
            for other, mine, of_other, of_mine in (
                (a, b, matches.a, matches.b),
                (b, a, matches.b, matches.a),
            ):
                if growth is not None and mine == i and other in growth.rows:
                    landmarks.append(growth.rows[other][of_other])
                    features.append(of_mine)
        links = PairMatches(np.concatenate(landmarks), np.concatenate(features))
        return unique(PairMatches(links.a[links.a >= 0], links.b[links.a >= 0]))


def unique(links: PairMatches) -> PairMatches:
    """Return each pair once."""
    pairs = np.unique(np.stack([links.a, links.b], axis=1), axis=0)
    return PairMatches(pairs[:, 0], pairs[:, 1])
