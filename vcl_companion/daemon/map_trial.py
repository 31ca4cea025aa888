"""A peer's map tried on frames of our own, before it is flown on.

What is compared with the map in use is named by whoever made the other one (``agreement``). What
our camera has seen is not: a frame whose place is known on the map in use must be found at the
same place on the other. Where the other does not show it, that says nothing against it, and
nothing for what it says of ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.map_offer import ReadyMap
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import fix_or_none
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.localization.filter_state import FilterState, carried
from vcl_companion.localization.fix import Localized, Prior
from vcl_companion.localization.pipeline import Effort
from vcl_companion.mapping.agreement import moved_frame

# Frames that are not older than this, and this far apart.
_LATEST_NS, _APART_NS = 2_000_000_000, 200_000_000
# One frame may be found at a place that looks alike: so many must say the same.
_N_FRAMES = 2


@dataclass(frozen=True)
class Tried:
    """What our frames say of a map.

    Attributes:
        contradicts: how they contradict it; empty if they do not.
        shows: whether one of them was found on it, where it was taken.
    """

    contradicts: str = ""
    shows: bool = False


class MapTrial:
    """Holds maps against what our own frames have shown.

    Args:
        frames: our own.
        maps: the map in use.
        estimator: which of them had a fix on it.
        work: looks for frames.
    """

    def __init__(
        self, frames: FrameHistory, maps: MapStore, estimator: Estimator, work: MapWork
    ) -> None:
        self._frames = frames
        self._maps = maps
        self._estimator = estimator
        self._work = work

    async def tried(self, ready: ReadyMap, other_from_world: Similarity | None) -> Tried:
        """Look for our frames on a map.

        Args:
            ready: the map.
            other_from_world: takes the world of the map in use to its; None where it is the same.
        """
        current, reason = self._maps.current, ""
        if current is None:
            return Tried()
        for frame, state in self._known():
            there = state if other_from_world is None else carried(state, other_from_world)
            moved = await self._moved(frame, there, ready.stored(), current, may_track=True)
            if not moved:
                return Tried(shows=moved == "")
            # We may be the one who is wrong: then ours, looked through, does not confirm it either.
            if await self._moved(frame, state, current, current, may_track=False) != "":
                return Tried()
            reason = moved
        return Tried(reason)

    async def _moved(
        self,
        frame: Frame,
        state: FilterState,
        on: StoredMap,
        current: StoredMap,
        *,
        may_track: bool,
    ) -> str | None:
        """Say how far off from where a frame is believed it is found; None where it is not."""
        pose, covariance = state.world_from_body, state.pose_covariance()
        effort = Effort(
            may_track=may_track,
            may_fall_back=False,
            has_heading=self._estimator.has_heading,
        )
        prior = Prior(pose, covariance) if may_track else None
        image = np.asarray(frame.image)
        fix = await fix_or_none(self._work.find(image, on, prior, state.ned_from_body, effort))
        if not isinstance(fix, Localized):
            return None
        landmark_map = current.index.landmark_map
        found, noise = fix.world_from_body, fix.noise_covariance
        return moved_frame(pose, covariance, found, noise, landmark_map)

    def _known(self) -> list[tuple[Frame, FilterState]]:
        """Return our latest frames that had a fix on the map, and what was believed there."""
        newest = self._frames.newest
        known: list[tuple[Frame, FilterState]] = []
        if newest is None:
            return known
        until_ns = newest.captured_at_ns
        for frame in reversed(self._frames.after(newest.captured_at_ns - _LATEST_NS)):
            state = self._estimator.own_fix_at(frame.captured_at_ns)
            if state is not None and frame.captured_at_ns <= until_ns:
                known.append((frame, state))
                until_ns = frame.captured_at_ns - _APART_NS
            if len(known) == _N_FRAMES:
                break
        return known
