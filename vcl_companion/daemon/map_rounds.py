"""The coordinator's rounds: gather frames of every drone, build, decide; first map and updates.

A round begins with a frame of its own, asks every member for its frame of the
same instant, and ends with a map or with the reason why there is none; the
next one begins with a newer frame. Without a map it makes a first one; with
one, the next revision as soon as the majority wants it (IV-G).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.gathering import Gathering, Wanted
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.localization.detail import Detail
from vcl_companion.localization.outlook import novelty_from
from vcl_companion.mapping.contributing import without_alike
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.novelty import NEAR_DEG
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import lacks
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.pace import look_s
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.swarm.update_trigger import UpdateTrigger
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.messages import FrameRequest

_log = logging.getLogger(__name__)

# Percent of an update.
_GATHERING, _BUILDING, _NO_UPDATE = 20, 60, 255
# A camera that delivers nothing new has nothing for a map either.
_STALE_NS = 60 * 1_000_000_000

# Who has less than this share of our landmarks in sight looks elsewhere by now, or soon: its word
# is a second old (more in a large swarm), and one that turns away fast needs its view in this
# update, not in the next.
_LEAST_SEEN = 0.65
# Whoever has been heard by us is heard by all a moment later, and is sent what all are sent.
_ACQUAINTED_S = 0.5
# Nobody needs longer than so many times the patience to hand over a map, whatever trickles in.
_MAX_DELIVERIES = 10.0

Decide = Callable[[LandmarkMap | NoMap, StoredMap | None, int], Awaitable[None]]
"""Takes what became of a round, the map in use when it began (None: a first one), its id."""


@dataclass(frozen=True)
class RoundOptions:
    """What rounds are tuned by.

    Attributes:
        map: thresholds of the building.
        update: when and how maps are updated.
    """

    map: MapOptions
    update: UpdateOptions


class MapRounds:
    """Makes rounds while this drone coordinates; see the module.

    Args:
        group: who is there, and who wants what.
        frames: our own.
        maps: where the result goes, by ``decide``.
        describe: makes the answer that a peer would give of one of our frames.
        detail: says how much of one of our frames the map is extended by.
        ask: sends a request to a peer.
        decide: takes what became of a round.
        passed: sends the frames of an update on while it is built.
        carried_in_s: how long so many frames take on the link.
        is_receiving_map: whether a peer's map has been coming in lately.
        is_merging: whether one is being merged into ours: an update would have to wait for that,
            and one of the two would be in vain.
        log: told of every update that is begun.
        clock: time base of frames.
        clocks: whose instants are when.
        work: does the building.
        options: of the steps.
        rng: numbers the requests.
    """

    def __init__(
        self,
        group: Group,
        frames: FrameHistory,
        maps: MapStore,
        describe: Callable[[Frame, int], Awaitable[FrameAnswer]],
        detail: Callable[[Frame], Awaitable[Detail]],
        ask: Callable[[FrameRequest, int], None],
        decide: Decide,
        passed: PassedFrames,
        carried_in_s: Callable[[int], float],
        is_receiving_map: Callable[[], bool],
        is_merging: Callable[[], bool],
        log: FlightLog,
        clock: Clock,
        clocks: PeerClocks,
        work: MapWork,
        options: RoundOptions,
        rng: np.random.Generator,
    ) -> None:
        self._group = group
        self._frames = frames
        self._maps = maps
        self._describe = describe
        self._detail = detail
        self._decide = decide
        self._passed = passed
        self._is_updating = False
        self._is_from_new_places = False
        self._is_second_look = False
        self._carried_in_s = carried_in_s
        self._is_receiving_map = is_receiving_map
        self._is_merging = is_merging
        self._log = log
        self._clock = clock
        self._work = work
        self._options = options
        self._gathering = Gathering(group, ask, clock, clocks, rng)
        self._trigger = UpdateTrigger(options.update, group)
        self._tried: Frame | None = None
        self._claimed_since_s: float | None = None
        self._complete_since_s: float | None = None
        self.is_asked = False
        """Whether the ground wants an update: whoever coordinates makes it at once."""
        self.progress = _NO_UPDATE
        """How far the update is that is being made, percent; 255: none is."""

    @property
    def is_under_way(self) -> bool:
        """Whether an update is being made, from its first frame to what is decided of it."""
        return self.progress != _NO_UPDATE

    @property
    def is_coming(self) -> bool:
        """Whether an update is under way, or about to begin with the newest frame."""
        return self.is_under_way or (self._untried() is not None and self._trigger.is_coming)

    def _untried(self) -> Frame | None:
        """Return our newest frame, if it may begin a round."""
        frame = self._frames.newest
        return None if frame is None or frame is self._tried or self._is_stale(frame) else frame

    def take(self, peer: int, frame: FrameAnswer) -> str | None:
        """Take a peer's frame; return why it is refused, if it is."""
        refusal = self._gathering.take(peer, frame)
        if refusal is None and self._is_updating:
            self._passed.pass_on_answer(frame)
        return refusal

    async def run(self) -> None:
        """Make rounds until cancelled; each needs a frame that was not tried before."""
        began_at_s = self._now_s()
        while True:
            self._trigger.poll(self._now_s())
            stored, frame = self._maps.current, self._untried()
            pause_s = look_s(self._group.stretch)
            if frame is None:
                await asyncio.sleep(pause_s)
            elif stored is None and self._is_first_due(began_at_s):
                self._tried = frame
                await self._first_map(frame)
            elif stored is not None and self._is_due():
                self._tried = frame
                try:
                    await self._next_revision(stored, frame)
                finally:
                    self.progress, self.is_asked = _NO_UPDATE, False
                self._trigger.ended(self._now_s(), from_new_places=self._is_from_new_places)
            else:
                await asyncio.sleep(pause_s)

    def _is_due(self) -> bool:
        if self._is_merging():
            return False
        asked = self.is_asked and self._group.is_coordinator and not self._group.lacking()
        return asked or self._trigger.is_due(self._now_s())

    def _is_stale(self, frame: Frame) -> bool:
        return self._clock.now_ns() - frame.captured_at_ns > _STALE_NS

    def _is_first_due(self, began_at_s: float) -> bool:
        """Whether a first map is ours to make, and everybody is there or was waited for."""
        if self._has_map() or not self._group.is_coordinator:
            return False
        if self._now_s() - began_at_s >= self._options.map.member_wait_s:
            return True
        # Who is heard but has not said yet what it flies on may well have a map.
        told = all(self._group.state_of(peer) is not None for peer in self._group.peers)
        if not (self._group.is_complete and told):
            self._complete_since_s = None
            return False
        if self._complete_since_s is None:
            self._complete_since_s = self._now_s()
        return self._now_s() >= self._complete_since_s + _ACQUAINTED_S

    def _has_map(self) -> bool:
        """Whether there is a map: ours, or of a peer, which will send it (we are late, or back).

        Not for ever: a peer that has said so for long and sends none has none to give.
        """
        states = map(self._group.state_of, self._group.peers)
        if not any(state is not None and state.revision for state in states):
            self._claimed_since_s = None
        elif self._claimed_since_s is None:
            self._claimed_since_s = self._now_s()
        if self._maps.current is not None or self._claimed_since_s is None:
            return self._maps.current is not None
        waited = (self._now_s() - self._claimed_since_s) / self._options.update.delivery_wait_s
        return waited < (_MAX_DELIVERIES if self._is_receiving_map() else 1.0)

    async def _first_map(self, frame: Frame) -> None:
        request_id = self._gathering.begin()
        group = self._group
        # The leader's body is the world's origin, ours where there is none; without a known
        # distance there is no scale.
        origin = group.leader if group.leader in group.teammates else group.own_id
        contributors = group.contributors(
            (origin, *group.measured), self._options.update.contributors
        )
        wanted = Wanted(
            frame.captured_at_ns, contributors, timeout_s=self._options.map.gather_timeout_s
        )
        frames = await self._gathered(frame, wanted, self._has_map)
        lacking = ""
        if isinstance(frames, list):
            lacking = lacks({f.drone_id: f.ned_from_body for f in frames}, origin)
            frames = NoMap(lacking) if lacking else frames
        built = await self._built(frames, lambda frames: self._work.first_map(frames, origin))
        if not self._has_map():
            await self._decide(built, None, request_id)
        if lacking:  # and will for a while: before take-off, for minutes
            await asyncio.sleep(self._options.update.interval_s)

    async def _next_revision(self, stored: StoredMap, frame: Frame) -> None:
        update = self._options.update
        lost = self._trigger.lost(self._now_s())
        reason = f"wanted by drones {_listed(self._group.wanting_update)}"
        reason += " and the ground" if self.is_asked else ""
        reason += f"; {_listed(lost)} lost" if lost else ""
        self._log.event("update", reason)
        _log.info("the map is updated, %s", reason)

        self._is_from_new_places = False
        request_id = self._gathering.begin()
        contributors = await self._contributors(stored, frame, lost)
        earlier = dict.fromkeys(lost, update.joiner_frames - 1)
        n_frames = len(contributors) - 1 + sum(earlier.values())
        wanted = Wanted(
            frame.captured_at_ns,
            contributors,
            earlier,
            update.joiner_spacing_s,
            update.gather_timeout_s + self._carried_in_s(n_frames),
        )
        self._passed.over()
        self._is_updating = True
        self.progress = _GATHERING
        try:
            frames = await self._gathered(frame, wanted, lambda: self._is_past(stored))
        finally:
            self._is_updating = False
        self.progress = _BUILDING
        await self._extend(stored, frames, lost, request_id)

    async def _contributors(
        self, stored: StoredMap, frame: Frame, lost: tuple[int, ...]
    ) -> tuple[int, ...]:
        """Return whose frames an update is made of.

        All views count where frame and scale are carried on. Where a coarse image of ours does,
        they are held by what is known, and of views that are alike two suffice.
        """
        group, most = self._group, self._options.update.contributors
        members = group.contributors((*lost, *group.wanting_update), len(group.members))
        if len(members) > 2 and await self._detail(frame) == "coarse":
            blind = [m for m in members if not self._sees_enough(m)]
            members = without_alike(members, stored.index.landmark_map, (*lost, *blind))
        return members[:most]

    def _sees_enough(self, member: int) -> bool:
        """Whether a member still sees the map about as well as we do."""
        state, own = self._group.state_of(member), self._group.state_of(self._group.own_id)
        if state is None or own is None or not state.localized:
            return False
        return state.tracked >= _LEAST_SEEN * own.tracked

    async def _extend(
        self,
        stored: StoredMap,
        frames: list[FrameAnswer] | NoMap,
        lost: tuple[int, ...],
        request_id: int,
    ) -> None:
        """Make the next revision of what shows the map; then one of what is lost or far from it.

        The latter takes long, for features are looked for all over the map: who flies on has
        its revision before.
        """
        if isinstance(frames, list) and self._options.map.patches:
            is_second_look, self._is_second_look = self._is_second_look, False
            built = await self._updated(stored, frames, at_once=True)
            if isinstance(built, LandmarkMap):
                # Who is no more the coordinator has no say any more, and a map that came is newer.
                if self._is_past(stored):
                    return
                await self._decide(built, stored, request_id)
                self._note_places(built, stored)
                shown = {(k.drone_id, k.captured_at_ns) for k in built.keyframes}
                left_out = [f for f in frames if (f.drone_id, f.captured_at_ns) not in shown]
                frames = [f for f in left_out if f.drone_id in lost or _is_far(f, stored)]
                current = self._maps.current
                if not frames or current is None:
                    return
                stored = current
                await self._delivered(stored)
            elif not (is_second_look or lost or any(f.world_from_body is None for f in frames)):
                # Newer frames first: single views that do not join are followed by ones that do,
                # and features take seconds, in which who is on the move comes to where the map
                # has nothing. They come soon, as if this one had helped.
                self._is_second_look = self._is_from_new_places = True
                await self._decide(built, stored, request_id)
                return
        if self._is_past(stored):
            return
        built = await self._updated(stored, frames, at_once=False)
        if isinstance(built, NoMap):
            self._passed.over()
        if not self._is_past(stored):
            await self._decide(built, stored, request_id)
            if isinstance(built, LandmarkMap):
                self._note_places(built, stored)

    def _note_places(self, built: LandmarkMap, stored: StoredMap) -> None:
        """Note whether a map, if it is in use now, was extended from places that were new to it."""
        current, old = self._maps.current, stored.index.landmark_map
        if current is None or current.parent != stored.revision:
            return
        known = {(k.drone_id, k.captured_at_ns) for k in old.keyframes}
        for k in built.keyframes:
            if (k.drone_id, k.captured_at_ns) not in known:
                newness = novelty_from(old, k.world_from_body @ k.body_from_cam, k.camera)
                if newness is None or newness > self._options.update.novelty_deg:
                    self._is_from_new_places = True

    async def _delivered(self, stored: StoredMap) -> None:
        """Wait until everybody alive has a revision, as long as a round would."""
        until_s = self._now_s() + self._options.update.delivery_wait_s
        while self._group.lacking() and not self._is_past(stored) and self._now_s() < until_s:
            await asyncio.sleep(look_s(self._group.stretch))

    async def _updated(
        self, stored: StoredMap, frames: list[FrameAnswer] | NoMap, *, at_once: bool
    ) -> LandmarkMap | NoMap:
        def build(frames: list[FrameAnswer]) -> Awaitable[LandmarkMap | NoMap]:
            return self._work.next_revision(stored, frames, at_once=at_once)

        return await self._built(frames, build)

    def _is_past(self, stored: StoredMap) -> bool:
        """Whether a round that began with a map has come too late."""
        return not self._maps.is_in_use(stored) or not self._group.is_coordinator

    async def _gathered(
        self, newest: Frame, wanted: Wanted, is_over: Callable[[], bool]
    ) -> list[FrameAnswer] | NoMap:
        """Return our own frames and those of the others, or why ours cannot be used."""
        began_s = self._now_s()
        async with asyncio.TaskGroup() as both:  # ours are encoded while the others' come
            ours = both.create_task(self._own(newest, wanted))
            theirs = both.create_task(self._gathering.gather(wanted, is_over))
        described = ours.result()
        if isinstance(described, NoMap):
            return described
        if self._is_updating:
            # Not before the others' have come: on a radio they would come too late beside it.
            for answer in described:
                self._passed.pass_on(answer)
        gathered = described + theirs.result()
        alone = self._maps.current is None and len(gathered) < 2
        level = logging.DEBUG if alone else logging.INFO
        _log.log(level, "%d frames gathered in %.1f s", len(gathered), self._now_s() - began_s)
        return gathered

    async def _own(self, newest: Frame, wanted: Wanted) -> list[FrameAnswer] | NoMap:
        own = [newest]
        for n in range(1, 1 + wanted.earlier.get(self._group.own_id, 0)):
            earlier = self._frames.nearest(wanted.instant_ns(n))
            if earlier is not None:
                own.append(earlier)
        try:
            return [await self._describe(f, self._gathering.request_id) for f in own]
        except ValueError as error:
            return NoMap(f"our own frame: {error}")

    async def _built(
        self,
        frames: list[FrameAnswer] | NoMap,
        build: Callable[[list[FrameAnswer]], Awaitable[LandmarkMap | NoMap]],
    ) -> LandmarkMap | NoMap:
        if isinstance(frames, NoMap):
            return frames
        began_s = self._now_s()
        try:
            built = await build(frames)
            _log.info("%d frames built into a map in %.1f s", len(frames), self._now_s() - began_s)
            return built
        except Exception as error:
            # Peers' images and numbers went in: none of them may end the flight.
            _log.exception("a map cannot be built")
            return NoMap(f"building failed: {type(error).__name__}")

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()


def _is_far(frame: FrameAnswer, stored: StoredMap) -> bool:
    """Whether a frame shows a map so differently that only features may join it, if at all."""
    if frame.world_from_body is None:
        return True
    world_from_cam = frame.world_from_body @ frame.body_from_cam
    novelty_deg = novelty_from(stored.index.landmark_map, world_from_cam, frame.camera)
    return novelty_deg is None or novelty_deg > NEAR_DEG


def _listed(drones: tuple[int, ...]) -> str:
    return ", ".join(map(str, drones))
