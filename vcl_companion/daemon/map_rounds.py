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
from vcl_companion.daemon.first_map_turn import FirstMapTurn
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_choice import FURTHEST_BACK_NS, FrameChoice
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.gathering import Gathering, Wanted
from vcl_companion.daemon.map_extension import Decide, MapExtension
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import survived
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.daemon.round_building import RoundBuilding
from vcl_companion.daemon.round_frames import RoundFrames
from vcl_companion.localization.detail import Detail
from vcl_companion.mapping.contributing import without_alike
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import lacks
from vcl_companion.swarm.awaited import Awaited
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
# What has failed for a reason that nobody has foreseen may fail again at once.
_AFTER_MISHAP_S = 1.0

# Who has less than this share of our landmarks in sight looks elsewhere by now, or soon: its word
# is a second old (more in a large swarm), and one that turns away fast needs its view in this
# update, not in the next.
_LEAST_SEEN = 0.65


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
        choice: which of them an update is made of.
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
        choice: FrameChoice,
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
        self._choice = choice
        self._maps = maps
        self._detail = detail
        self._decide = decide
        self._carried_in_s = carried_in_s
        self._is_merging = is_merging
        self._log = log
        self._clock = clock
        self._options = options
        self._turn = FirstMapTurn(
            group,
            maps,
            is_receiving_map,
            options.map.member_wait_s,
            options.update.delivery_wait_s,
        )
        gathering = Gathering(group, ask, clock, clocks, rng)
        self._round_frames = RoundFrames(group, frames, describe, gathering, passed)
        self._building = RoundBuilding(work)
        self._awaited = Awaited(group, options.update.delivery_wait_s)
        self._extension = MapExtension(
            group,
            self._awaited,
            maps,
            self._building,
            decide,
            passed,
            options.update,
            options.map.patches,
        )
        self._trigger = UpdateTrigger(options.update, group, self._awaited)
        self._tried: Frame | None = None
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
        return self._round_frames.take(peer, frame)

    async def run(self) -> None:
        """Make rounds until cancelled; each needs a frame that was not tried before."""
        began_at_s = self._now_s()
        while True:
            with survived("making maps"):
                while True:
                    await self._turn_of(began_at_s)
            await asyncio.sleep(_AFTER_MISHAP_S)

    async def _turn_of(self, began_at_s: float) -> None:
        """Make a round if one is due; else wait a moment."""
        self._trigger.poll(self._now_s())
        stored, frame = self._maps.current, self._untried()
        if frame is not None and stored is None and self._turn.is_due(began_at_s):
            self._tried = frame
            await self._first_map(frame)
        elif frame is not None and stored is not None and self._is_due():
            self._tried = frame
            try:
                is_from_new_places = await self._next_revision(stored, frame)
            finally:
                self.progress, self.is_asked = _NO_UPDATE, False
            self._trigger.ended(self._now_s(), from_new_places=is_from_new_places)
        else:
            await asyncio.sleep(look_s(self._group.stretch))

    def _is_due(self) -> bool:
        if self._is_merging():
            return False
        now_s = self._now_s()
        asked = self.is_asked and self._group.is_coordinator and not self._awaited.look(now_s)
        return asked or self._trigger.is_due(now_s)

    def _is_stale(self, frame: Frame) -> bool:
        return self._clock.now_ns() - frame.captured_at_ns > _STALE_NS

    async def _first_map(self, frame: Frame) -> None:
        request_id = self._round_frames.begin()
        group = self._group
        # The leader's body is the world's origin, ours where there is none; without a known
        # distance there is no scale.
        origin = group.leader if group.leader in group.teammates else group.own_id
        contributors = group.maps.contributors(
            (origin, *group.measured), self._options.update.contributors
        )
        wanted = Wanted(
            frame.captured_at_ns,
            contributors,
            timeout_s=self._options.map.gather_timeout_s,
            needs_others=True,
        )
        frames = await self._round_frames.gathered(
            frame, wanted, self._turn.has_map, passes_on=False
        )
        lacking = ""
        if isinstance(frames, list):
            lacking = lacks({f.drone_id: f.ned_from_body for f in frames}, origin)
            frames = NoMap(lacking) if lacking else frames
        built = await self._building.first_map(frames, origin)
        if not self._turn.has_map():
            await self._decide(built, None, request_id)
        if lacking:  # and will for a while: before take-off, for minutes
            await asyncio.sleep(self._options.update.interval_s)

    async def _next_revision(self, stored: StoredMap, frame: Frame) -> bool:
        """Make an update; return whether it was made of places that are new to the map."""
        update = self._options.update
        lost = self._trigger.lost(self._now_s())
        reason = f"wanted by drones {_listed(self._group.maps.wanting_update)}"
        reason += " and the ground" if self.is_asked else ""
        reason += f"; {_listed(lost)} lost" if lost else ""
        self._log.event("update", reason)
        _log.info("the map is updated, %s", reason)

        request_id = self._round_frames.begin()
        own = await self._choice.of(frame.captured_at_ns) or frame
        contributors = await self._contributors(stored, own, lost)
        earlier = dict.fromkeys(lost, update.joiner_frames - 1)
        n_frames = len(contributors) - 1 + sum(earlier.values())
        wanted = Wanted(
            frame.captured_at_ns,
            contributors,
            earlier,
            update.joiner_spacing_s,
            update.gather_timeout_s + self._carried_in_s(n_frames),
            FURTHEST_BACK_NS,
        )
        self.progress = _GATHERING
        frames = await self._round_frames.gathered(
            own, wanted, lambda: self._extension.is_past(stored), passes_on=True
        )
        self.progress = _BUILDING
        return await self._extension.extend(stored, frames, lost, request_id)

    async def _contributors(
        self, stored: StoredMap, frame: Frame, lost: tuple[int, ...]
    ) -> tuple[int, ...]:
        """Return whose frames an update is made of.

        All views count where frame and scale are carried on. Where a coarse image of ours does,
        they are held by what is known, and of views that are alike two suffice.
        """
        group, most = self._group, self._options.update.contributors
        members = group.maps.contributors((*lost, *group.maps.wanting_update), len(group.members))
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

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()


def _listed(drones: tuple[int, ...]) -> str:
    return ", ".join(map(str, drones))
