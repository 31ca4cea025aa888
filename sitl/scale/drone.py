"""One of many drones: all of a daemon that deals with peers, on the air that they share."""

from __future__ import annotations

import asyncio

import numpy as np

from sitl.drone_parts import DETECTORS, DroneParts
from sitl.scale.air import Air, AirSocket
from sitl.scale.meter import Meter, metered
from vcl_companion.clock import Moment
from vcl_companion.links.counters import LinkCounters
from vcl_companion.links.peers import PeerLink, PeerOptions, open_signing
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.swarm.group import SwarmOptions
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.swarm.transfer import TransferOptions, Transfers

_STARTED_WITHIN_S = 1.0
_UPTIME_S, _DRIFT = 1000.0, 50e-6
_WALL_NS = 1_750_000_000 * 10**9


class LoopClock:
    """A drone's own clock: begun at another time than the others', and a little fast or slow.

    Args:
        loop: whose time passes.
        rng: of when it began, and how fast it is.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, rng: np.random.Generator) -> None:
        self._loop = loop
        self._began_s = float(rng.uniform(0.0, _UPTIME_S))
        self._rate = 1.0 + float(rng.uniform(-_DRIFT, _DRIFT))

    def now_ns(self) -> int:
        """Return the present instant, ns."""
        return round((self._loop.time() - self._began_s) * self._rate * 1e9)

    def moment(self) -> Moment:
        """Return it beside the time of day, which all drones know alike."""
        return Moment(_WALL_NS + round(self._loop.time() * 1e9), self.now_ns())


class AirLink(PeerLink):
    """A peer link over the shared air instead of a socket.

    Args:
        name: of this drone, on the air.
        own: its system id.
        members: of the swarm.
        parts: of the drone: take what is for it, and say how often it shows itself.
        clock: its time.
        key_file: what all sign with.
        air: carries what it sends.
    """

    def __init__(
        self,
        name: str,
        own: int,
        members: tuple[int, ...],
        parts: DroneParts,
        clock: LoopClock,
        key_file: str,
        air: Air,
    ) -> None:
        options, exchange = PeerOptions(key_file=key_file, timestamp_file=""), parts.exchange
        super().__init__(
            options, own, frozenset(members), exchange.on_tunnel, exchange.on_heartbeat,
            clock, exchange.clocks.answered, open_signing(options, clock.moment),
            stretch=lambda: parts.group.stretch,
        )  # fmt: skip
        air_socket = AirSocket(self._tally, lambda data: air.transmit(name, data))
        self._socket = air_socket
        self.hear = air_socket.hear


class ScaledDrone:
    """See the module; made, run and ended in one running event loop.

    Args:
        own: its system id.
        members: of the swarm; the first coordinates.
        key_file: what all sign with.
        air: that they share.
        rng: its own.

    Attributes:
        name: on the air.
        meter: of the processor time that it takes.
    """

    def __init__(
        self,
        own: int,
        members: tuple[int, ...],
        key_file: str,
        air: Air,
        rng: np.random.Generator,
    ) -> None:
        self.name = f"drone{own}"
        self.meter = Meter()
        self._context = metered(self.meter)
        self._begins_after_s = float(rng.uniform(0.0, _STARTED_WITHIN_S))
        clock = LoopClock(asyncio.get_running_loop(), rng)
        transfers = Transfers(TransferOptions(), rng)
        building, inter = MapOptions(detectors=DETECTORS), InterMavOptions(detector=DETECTORS[0])
        self._parts = DroneParts(own, SwarmOptions(members), transfers, building, inter, clock, rng)
        self._link = AirLink(self.name, own, members, self._parts, clock, key_file, air)
        self._parts.exchange.attach(self._link)
        air.join(self.name, self._link.hear, self._context)
        self._task = asyncio.get_running_loop().create_task(self._run(), context=self._context)

    @property
    def revision(self) -> bytes:
        """Of the map that it flies on; empty for none."""
        current = self._parts.maps.current
        return b"" if current is None else current.revision

    @property
    def counters(self) -> LinkCounters:
        """What went over its link."""
        return self._link.counters

    @property
    def refused(self) -> dict[str, int]:
        """What it did not take from its peers, counted by kind: of frames and of what they say."""
        return {**self._link.counters.refused, **self._parts.exchange.refused}

    @property
    def knows_everybody(self) -> bool:
        """Whether it has heard every other drone, and what each flies on."""
        group = self._parts.group
        return group.is_complete and all(group.state_of(peer) for peer in group.peers)

    async def fly_on(self, built: LandmarkMap) -> None:
        """Fly on a map as its coordinator does on one that it has built, and hand it out."""
        exchange, current = self._parts.exchange, self._parts.maps.current
        deciding = exchange.results.decide(built, current, request_id=0)
        await asyncio.get_running_loop().create_task(deciding, context=self._context)

    def check(self) -> None:
        """Raise what has ended its tasks, which must not end."""
        if self._task.done():
            self._task.result()

    async def end(self) -> None:
        """Stop all that it does."""
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        self._parts.end()

    async def _run(self) -> None:
        await asyncio.sleep(self._begins_after_s)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._parts.exchange.run())
            tasks.create_task(self._link.run())
