"""The next revision of a map, of a round's frames: by patches at once, by features after that."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.round_building import RoundBuilding
from vcl_companion.localization.outlook import novelty_from
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.novelty import NEAR_DEG
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.awaited import Awaited
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.pace import look_s
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.wire.frame_codec import FrameAnswer

# By then a new map has been seen for long enough to be voted on.
_JUDGED_S = 0.6

Decide = Callable[[LandmarkMap | NoMap, StoredMap | None, int], Awaitable[None]]
"""Takes what became of a round, the map in use when it began (None: a first one), its id."""


class MapExtension:
    """Extends the map in use by the frames of a round, in up to two revisions.

    Args:
        group: whether we are still the ones to make it.
        awaited: who is waited for to have it.
        maps: the map in use.
        building: of the revisions.
        decide: takes each of them.
        passed: the frames that were sent on for it.
        options: what places are new, and how long a revision may be on its way.
        by_patches: whether maps are extended by their patches.
    """

    def __init__(
        self,
        group: Group,
        awaited: Awaited,
        maps: MapStore,
        building: RoundBuilding,
        decide: Decide,
        passed: PassedFrames,
        options: UpdateOptions,
        by_patches: bool,
    ) -> None:
        self._group = group
        self._awaited = awaited
        self._maps = maps
        self._building = building
        self._decide = decide
        self._passed = passed
        self._options = options
        self._by_patches = by_patches
        self._is_second_look = False

    def is_past(self, stored: StoredMap) -> bool:
        """Whether a round that began with a map has come too late.

        Who is no more the coordinator has no say any more, and a map that came is newer.
        """
        return not self._maps.is_in_use(stored) or not self._group.is_coordinator

    async def extend(
        self,
        stored: StoredMap,
        frames: list[FrameAnswer] | NoMap,
        lost: tuple[int, ...],
        request_id: int,
    ) -> bool:
        """Make the next revision of what shows the map; then one of what is lost or far from it.

        The latter takes long, for features are looked for all over the map: who flies on has
        its revision before.

        Args:
            stored: the map in use when the round began.
            frames: what was gathered, or why it cannot be used.
            lost: drones that are.
            request_id: the round's.

        Returns:
            Whether it was made of places that are new to the map, or the next round's may be:
            that one is to come soon.
        """
        if isinstance(frames, NoMap) or not self._by_patches:
            return await self._extend_by_features(stored, frames, request_id)
        is_second_look, self._is_second_look = self._is_second_look, False
        built = await self._building.next_revision(stored, frames, at_once=True)
        if isinstance(built, LandmarkMap):
            if self.is_past(stored):
                return False
            is_from_new_places = await self._decided(built, stored, request_id)
            left_out = _left_out(frames, built, stored, lost)
            current = self._maps.current
            if not left_out or current is None:
                return is_from_new_places
            await self._delivered(current)
            of_lost = [frame for frame in left_out if frame.drone_id in lost]
            if len(of_lost) < len(left_out) and await self._is_wanted_again(current):
                left_out = of_lost
            if not left_out:
                return is_from_new_places
            return await self._extend_by_features(current, left_out, request_id) or (
                is_from_new_places
            )
        if not (is_second_look or lost or any(f.world_from_body is None for f in frames)):
            # Newer frames first: single views that do not join are followed by ones that do,
            # and features take seconds, in which who is on the move comes to where the map
            # has nothing. They come soon, as if this one had helped.
            self._is_second_look = True
            await self._decide(built, stored, request_id)
            return True
        return await self._extend_by_features(stored, frames, request_id)

    async def _extend_by_features(
        self, stored: StoredMap, frames: list[FrameAnswer] | NoMap, request_id: int
    ) -> bool:
        """Make the revision that takes long; whether it was made of new places."""
        if self.is_past(stored):
            return False
        built = await self._building.next_revision(stored, frames, at_once=False)
        if isinstance(built, NoMap):
            self._passed.over()
        if self.is_past(stored):
            return False
        return await self._decided(built, stored, request_id)

    async def _decided(
        self, built: LandmarkMap | NoMap, stored: StoredMap, request_id: int
    ) -> bool:
        """Have it decided what was built; whether a map that is in use now is of new places."""
        await self._decide(built, stored, request_id)
        current = self._maps.current
        if isinstance(built, NoMap) or current is None or current.parent != stored.revision:
            return False
        return _has_new_places(built, stored.index.landmark_map, self._options.novelty_deg)

    async def _delivered(self, stored: StoredMap) -> None:
        """Wait until everybody who is waited for has a revision, as long as a round would."""
        until_s = self._now_s() + self._options.delivery_wait_s
        while (now_s := self._now_s()) < until_s and not self.is_past(stored):
            if not self._awaited.look(now_s):
                break
            await asyncio.sleep(look_s(self._group.stretch))

    async def _is_wanted_again(self, stored: StoredMap) -> bool:
        """Whether the majority wants a revision replaced as soon as it has seen something of it.

        Then newer frames go first: features take seconds, in which who is on the move comes to
        where the map has nothing.
        """
        until_s = self._now_s() + _JUDGED_S
        while not (is_wanted := self._group.maps.majority_wants_update) and self._now_s() < until_s:
            if self.is_past(stored):
                break
            await asyncio.sleep(look_s(self._group.stretch))
        return is_wanted

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()


def _has_new_places(built: LandmarkMap, old: LandmarkMap, novelty_deg: float) -> bool:
    """Whether a map was extended from places that were new to it, by so many degrees."""
    known = {(k.drone_id, k.captured_at_ns) for k in old.keyframes}
    for k in built.keyframes:
        if (k.drone_id, k.captured_at_ns) not in known:
            newness = novelty_from(old, k.world_from_body @ k.body_from_cam, k.camera)
            if newness is None or newness > novelty_deg:
                return True
    return False


def _left_out(
    frames: list[FrameAnswer], built: LandmarkMap, stored: StoredMap, lost: tuple[int, ...]
) -> list[FrameAnswer]:
    """Return the frames that did not get into a map, but may by their features.

    Not those of a drone that another one of is in it: it follows the map from there.
    """
    shown = {(k.drone_id, k.captured_at_ns) for k in built.keyframes}
    joined = {f.drone_id for f in frames if (f.drone_id, f.captured_at_ns) in shown}
    left_out = [f for f in frames if f.drone_id not in joined]
    return [f for f in left_out if f.drone_id in lost or _is_far(f, stored)]


def _is_far(frame: FrameAnswer, stored: StoredMap) -> bool:
    """Whether a frame shows a map so differently that only features may join it, if at all."""
    if frame.world_from_body is None:
        return True
    world_from_cam = frame.world_from_body @ frame.body_from_cam
    novelty_deg = novelty_from(stored.index.landmark_map, world_from_cam, frame.camera)
    return novelty_deg is None or novelty_deg > NEAR_DEG
