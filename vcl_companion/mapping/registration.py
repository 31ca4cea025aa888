"""New views registered on a map by their features, one after the other, or several at once (IV-G).

By landmarks of the old map; by those that came with views registered before; by what is shared
with one keyframe; by all views of one drone together. Old and new are adjusted each time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.chaining import join_to_keyframe
from vcl_companion.mapping.correspondences import Correspondences, unique
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.growth import Growth, grown
from vcl_companion.mapping.joining import Joined, join, join_nearby
from vcl_companion.mapping.known_features import KeyframeLibrary
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.late_joining import join_together
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.tracks import PairMatches
from vcl_companion.mapping.uncertainty import MapUncertainty, map_uncertainty
from vcl_companion.mapping.visibility import MutualMatches

# Keyframes that a view is matched with before it is given up.
_TRIED = 6
# Of these so many, of most matches, are tried by themselves.
_PAIRED = 2
MIN_SEEN = 20
"""A view that joins, or a keyframe that is brought along, has to see as many in the end."""


class Registration:
    """One extension by features under way: who has joined, what was matched.

    Args:
        old: the map so far.
        sure: its uncertainty.
        views: new ones, with their features.
        library: the features of the map's keyframes.
        options: thresholds.
        seed: of the robust searches.
        matches: remembers those of earlier attempts.
    """

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
        self._paired: set[tuple[int, tuple[str, int]]] = set()

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
            if self._join_pairs(growth):
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

    def _join_pairs(self, growth: Growth | None) -> bool:
        """Register waiting views by what each shares with one other; whether any was."""
        some = False
        for i in self._waiting():
            others = self._matches.neighbours(self._old, growth, i)
            for other in [o for o in others if (i, o.name) not in self._paired][:_PAIRED]:
                self._paired.add((i, other.name))
                known = self._old if other.growth is None else other.growth.landmark_map
                found = join_to_keyframe(
                    self._views[i], other.keyframe, other.shown, other.matches,
                    known, self._options, self._seed,
                )  # fmt: skip
                if isinstance(found, Joined):
                    self._take(other.growth, {i: found})
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
            if n_seen < MIN_SEEN:
                self._reasons[i] = f"{n_seen} landmarks agree, {MIN_SEEN} needed"
                del self._joined[i]
                self._refuted.add(i)
                some = True
        return some
