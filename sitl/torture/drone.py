"""The drone that is tortured: everything of a daemon that deals with peers, but for the socket.

Link, codec, exchange, group, transfers, map store, workshop and estimator are those of
a flight. The socket is never opened: what it would hand to the link is handed in here,
and what the link would send to it is counted as not sent and overheard.
"""

from __future__ import annotations

import asyncio
import math
from collections import Counter
from dataclasses import dataclass

import numpy as np

from sitl.drone_parts import DETECTORS, DroneParts
from sitl.torture.valid import Overheard
from sitl.wall import Scene
from vcl_companion.cameras.source import Frame
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.exchange import Exchange
from vcl_companion.daemon.inter_target import Asked
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.pose import Pose
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerLink, PeerOptions, open_signing
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized
from vcl_companion.mapping.options import MapOptions
from vcl_companion.swarm.group import SwarmOptions
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.swarm.quarantine import QuarantineOptions
from vcl_companion.swarm.transfer import (
    BlobReceived,
    Event,
    ReceptionAbandoned,
    TransferFailed,
    TransferOptions,
    Transfers,
)
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.header import PayloadKind
from vcl_companion.wire.messages import FrameRequest
from vcl_companion.wire.tunnel import decode_payload

MIB = 1 << 20
# A daemon's own limits hold thirty times what is sent here; these are reached.
TRANSFER = TransferOptions(max_blob_bytes=MIB, memory_quota_bytes=4 * MIB)
_FIX_SIGMA = 0.01
# Who is told to end has so many turns for it, and no time.
_TURNS_TO_END = 100


class WatchedTransfers(Transfers):
    """Transfers that note what came of what was received.

    Attributes:
        blobs: those that came whole and were not looked at yet.
        ended: how transfers ended otherwise, counted.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        super().__init__(TRANSFER, rng)
        self.blobs: list[BlobReceived] = []
        self.ended: Counter[str] = Counter()

    def receive(
        self, peer: int, message: Chunk | TransferStatus, now_s: float, *, to_all: bool = False
    ) -> list[Event]:
        """Note what is returned."""
        events = super().receive(peer, message, now_s, to_all=to_all)
        for event in events:
            match event:
                case BlobReceived():
                    self.blobs.append(event)
                case ReceptionAbandoned() | TransferFailed():
                    self.ended[f"{type(event).__name__}: {event.reason}"] += 1
                case _:
                    self.ended[type(event).__name__] += 1
        return events


class OpenLink(PeerLink):
    """A peer link whose datagrams are handed in, and whose words are overheard.

    Args:
        own: this drone.
        exchange: takes what is for it.
        members: of the swarm.
        clock: its time.
        heard: what peers then know.
    """

    def __init__(
        self,
        own: int,
        exchange: Exchange,
        members: tuple[int, ...],
        clock: ManualClock,
        heard: Overheard,
    ) -> None:
        self.tunnels: list[Tunnel] = []
        self._heard = heard
        self._exchange = exchange
        # Who has no key is turned away before all that is tortured here.
        options = PeerOptions("127.0.0.1:0", timestamp_file="", allow_unsigned=True)
        super().__init__(
            options, own, frozenset(members), self._take, exchange.on_heartbeat,
            clock, exchange.clocks.answered, open_signing(options),
        )  # fmt: skip

    def hear(self, datagram: bytes) -> None:
        """Take one datagram, as the socket hands it over."""
        self._receive(datagram, None)

    def send(self, payload_type: int, payload: bytes, target_system: int = 0) -> None:
        """Send it nowhere, but let the peers know."""
        super().send(payload_type, payload, target_system)
        if payload[1] == PayloadKind.CHUNK:
            self._heard.tags.append(int.from_bytes(payload[2:6], "little"))
        elif payload[1] == PayloadKind.FRAME_REQUEST:
            message = decode_payload(payload_type, payload)
            assert isinstance(message, FrameRequest)
            self._heard.wanted.append(message.request_id)

    def _take(self, tunnel: Tunnel) -> None:
        self.tunnels.append(tunnel)
        self._exchange.on_tunnel(tunnel)


@dataclass(frozen=True)
class Role:
    """What the drone is among its peers.

    Attributes:
        own: its system id.
        members: of the swarm.
        leader: one of them, who coordinates.
    """

    own: int
    members: tuple[int, ...]
    leader: int

    @property
    def peers(self) -> tuple[int, ...]:
        """The others, who coordinates first."""
        others = [m for m in self.members if m != self.own]
        return tuple(sorted(others, key=lambda m: m != self.leader))


class TorturedDrone:
    """See the module; made, run and ended in one running event loop.

    Args:
        role: what it is.
        heard: filled with what it says.
        clock: its time.
        rng: numbers its requests.

    Attributes:
        link: where datagrams go in.
        transfers: its own.
        exchange: its own.
        done: what it was brought to do, counted.
    """

    def __init__(
        self, role: Role, heard: Overheard, clock: ManualClock, rng: np.random.Generator
    ) -> None:
        self.done: Counter[str] = Counter()
        self._heard = heard
        self._clock = clock
        first, second = role.members[:2]
        swarm = SwarmOptions(role.members, role.leader, ((first, second, 1.0),))
        inter = InterMavOptions(detector="akaze", least_interval_s=0.0)
        building = MapOptions(detectors=DETECTORS, member_wait_s=1.0, gather_timeout_s=10.0)
        self.transfers = WatchedTransfers(rng)
        self._parts = DroneParts(
            role.own, swarm, self.transfers, building, inter, clock, rng,
            # Who is tortured hears its tormentors to the end.
            QuarantineOptions(threshold=math.inf),
        )  # fmt: skip
        self.estimator, self.exchange = self._parts.estimator, self._parts.exchange
        self.link = OpenLink(role.own, self.exchange, role.members, clock, heard)
        self.exchange.attach(self.link)
        self._tasks = [asyncio.ensure_future(self.exchange.run())]
        self._n_frames = 0

    @property
    def stored(self) -> StoredMap | None:
        """The map that it flies on."""
        return self._parts.maps.current

    def failures(self) -> list[BaseException]:
        """Return what its tasks have ended with that must not end, and forget those that did."""
        over = [task for task in self._tasks if task.done()]
        self._tasks = [task for task in self._tasks if not task.done()]
        return [error for task in over if (error := task.exception()) is not None]

    def see(self, scene: Scene, *, knows_where: bool) -> None:
        """Have it take a frame, and either know where that was or ask its peers."""
        at_ns = self._clock.now_ns()
        place = scene.place()
        frame = Frame(scene.image(place), at_ns, self._n_frames, at_ns)
        self._n_frames += 1
        self.exchange.on_frame(frame)
        stored, before = self.stored, self._heard.stored
        self._heard.stored = stored
        if stored is None:
            return
        if before is None or before.revision != stored.revision:
            self.done["another map is in use"] += 1
        self.estimator.in_sight.seen_on = stored.revision
        predicted = self.estimator.predicted(at_ns, None)
        if knows_where:
            fix = _fix(scene.world_from_body(place))
            self.estimator.take_fix(predicted, fix, at_ns, None)
            return
        self.estimator.take_nothing(predicted, at_ns, None)
        asked = self.exchange.inter.begin(frame, None, stored.revision, np.inf)
        if asked is not None:
            self._heard.asked.append(asked.request_id)
            self._tasks.append(asyncio.ensure_future(self._fused(asked, stored)))

    async def _fused(self, asked: Asked, stored: StoredMap) -> None:
        """Ask, and fuse what is said, as a companion does."""
        proposals = await self.exchange.inter.ask(asked)
        for _, said in proposals + await self.exchange.inter.stragglers(asked):
            state = self.estimator.take_proposal(
                asked.frame.captured_at_ns, asked.ned_from_body, said.world_from_body,
                said.covariance, stored.index.landmark_map.points_world,
            )  # fmt: skip
            self.done[
                f"pose of a peer: {'' if isinstance(state, FilterState) else 'not '}fused"
            ] += 1
            if isinstance(state, FilterState):
                assert np.isfinite(state.pose_covariance()).all(), "a state that is not finite"

    async def end(self) -> None:
        """Stop all that it does.

        Raises:
            RuntimeError: something of it goes on; waiting for it would take for ever.
        """
        for task in self._tasks:
            task.cancel()
        for _ in range(_TURNS_TO_END):
            await asyncio.sleep(0)
        self._parts.end()
        going_on = asyncio.all_tasks() - {asyncio.current_task()}
        if going_on:
            names = sorted(repr(task.get_coro()) for task in going_on)
            raise RuntimeError(f"told to end, these go on: {', '.join(names)}")


def _fix(pose: Pose) -> Localized:
    return Localized(
        pose, _FIX_SIGMA**2 * np.eye(6), _FIX_SIGMA**2 * np.eye(6), np.zeros((6, 0)),
        np.zeros((0, 0)), 40, 40, False, 0.5, n_seen=40, covered=0.8,
    )  # fmt: skip
