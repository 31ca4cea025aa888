"""One number of drones: they start, rest, get a first map and then its update, and are measured."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from sitl.peer_traffic import PeerTraffic, Traffic
from sitl.scale.air import Air, channel
from sitl.scale.drone import ScaledDrone
from sitl.scale.meter import MeteredLoop
from sitl.wall import Scene
from vcl_companion.links.key_file import make_key_file
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.wire.map_codec import encode_map, revision_of
from vcl_companion.wire.map_update import encode_map_update
from vcl_companion.wire.warm_up import warm_up

_N_KEYFRAMES = 24
_LOOK_S = 0.02
# Nobody waits for longer for a map, or for the others to be there.
_PATIENCE_S = 120.0
# A map is over only when everybody has said, and heard, that it is.
_AFTER_S = 2.0

Told = Callable[[str], None]


@dataclass(frozen=True)
class ScaleTimes:
    """How long what is measured without an end of its own is measured.

    Attributes:
        start_s: from the first drone's start on.
        rest_s: later, when drones know each other and their clocks, and no map is about; and
            again at the end, when all hold one.
    """

    start_s: float = 10.0
    settle_s: float = 10.0
    rest_s: float = 20.0


@dataclass(frozen=True)
class Phase:
    """What was measured while one thing happened.

    Attributes:
        name: of what.
        seconds: that it took, of the drones' time.
        sent_bytes: by each drone, the coordinator first; whole MAVLink frames, signed.
        heard_bytes: by each drone.
        cpu_s: of each drone.
        by_message: what all drones sent, by message.
        held_s: when each drone but the coordinator flew on the map; infinite: never.
        blob_bytes: what was handed out; 0 where nothing was.
    """

    name: str
    seconds: float
    sent_bytes: tuple[int, ...]
    heard_bytes: tuple[int, ...]
    cpu_s: tuple[float, ...]
    by_message: dict[str, Traffic]
    held_s: tuple[float, ...] = ()
    blob_bytes: int = 0


@dataclass(frozen=True)
class SwarmResult:
    """What one number of drones comes to.

    Attributes:
        drones: how many.
        phases: in their order.
        known_s: when all had heard of all; infinite: not in time.
        dropped: share of the datagrams for which the channel was too busy.
        refused: what drones did not take, counted by reason.
    """

    drones: int
    phases: tuple[Phase, ...]
    known_s: float
    dropped: float
    refused: dict[str, int] = field(default_factory=dict)


def run_swarm(n_drones: int, loss: float, seed: int, times: ScaleTimes, told: Told) -> SwarmResult:
    """Have so many drones live through it all; the same figures every time, but for the processor.

    Args:
        n_drones: two or more.
        loss: share of the datagrams that each receiver loses.
        seed: of everything.
        times: of the parts that have no end of their own.
        told: what is measured now.
    """
    cv2.setNumThreads(1)
    warm_up()
    with tempfile.TemporaryDirectory() as folder:
        key = Path(folder) / "key"
        make_key_file(key)
        # A runner ends every task before it closes the loop, on Ctrl-C too.
        with asyncio.Runner(loop_factory=MeteredLoop) as runner:
            return runner.run(_lived(n_drones, loss, seed, times, str(key), told))


async def _lived(
    n_drones: int, loss: float, seed: int, times: ScaleTimes, key_file: str, told: Told
) -> SwarmResult:
    swarm = _Swarm(n_drones, loss, seed, key_file, told)
    scene = Scene(np.random.default_rng((seed, 2)))
    first = scene.first_map((1, 2) * (_N_KEYFRAMES // 2))
    revision = revision_of(encode_map(first))
    try:
        knowing = asyncio.ensure_future(swarm.known_s())
        start = await swarm.phase("start", times.start_s)
        known_s = await knowing
        await swarm.phase("settle", times.settle_s)
        rest = await swarm.phase("rest", times.rest_s)
        handed = await swarm.handed_out("first map", first, len(encode_map(first)))
        update = scene.next_map(first, revision, drone=2)
        n_bytes = len(encode_map_update(encode_map(update), first))
        updated = await swarm.handed_out("update", update, n_bytes)
        mapped = await swarm.phase("rest, mapped", times.rest_s)
        phases = start, rest, handed, updated, mapped
        return SwarmResult(n_drones, phases, known_s, swarm.air.dropped(), swarm.refused())
    finally:
        await swarm.end()


class _Swarm:
    """So many drones and their air; see ``run_swarm``."""

    def __init__(self, n_drones: int, loss: float, seed: int, key_file: str, told: Told) -> None:
        self.air = Air(channel(loss), seed)
        members = tuple(range(1, n_drones + 1))
        self._drones = [
            ScaledDrone(own, members, key_file, self.air, np.random.default_rng((seed, 1, own)))
            for own in members
        ]
        self._loop = asyncio.get_running_loop()
        self._began_s = self._loop.time()
        self._told = told

    async def phase(self, name: str, seconds: float) -> Phase:
        """Let time pass, and measure."""
        begin = self._begin(name)
        await asyncio.sleep(seconds)
        return begin()

    async def known_s(self) -> float:
        """Wait until every drone knows every other one; return when that was."""
        return await self._until(lambda: all(d.knows_everybody for d in self._drones))

    async def handed_out(self, name: str, built: LandmarkMap, blob_bytes: int) -> Phase:
        """Have the coordinator fly on a map, and measure until everybody does."""
        end = self._begin(name)
        began_s = self._loop.time()
        coordinator, *others = self._drones
        await coordinator.fly_on(built)
        held_s = dict.fromkeys(others, float("inf"))

        def all_hold() -> bool:
            for drone in others:
                if held_s[drone] == float("inf") and drone.revision == coordinator.revision:
                    held_s[drone] = self._loop.time() - began_s
            return float("inf") not in held_s.values()

        await self._until(all_hold)
        await asyncio.sleep(_AFTER_S)
        return end(tuple(held_s.values()), blob_bytes)

    def refused(self) -> dict[str, int]:
        """Return what drones did not take, counted by reason."""
        out: dict[str, int] = {}
        for drone in self._drones:
            for reason, times in drone.refused.items():
                out[reason] = out.get(reason, 0) + times
        return dict(sorted(out.items()))

    async def end(self) -> None:
        """Stop them all."""
        for drone in self._drones:
            await drone.end()

    async def _until(self, is_so: Callable[[], bool]) -> float:
        """Wait until it is so; return for how long the drones have been there, or infinity."""
        until_s = self._loop.time() + _PATIENCE_S
        while not is_so():
            if self._loop.time() >= until_s:
                return float("inf")
            await asyncio.sleep(_LOOK_S)
        return self._loop.time() - self._began_s

    def _begin(self, name: str) -> Callable[..., Phase]:
        """Begin to measure; what is returned ends it."""
        self._told(name)
        self.air.traffic = PeerTraffic()
        began_s, drones = self._loop.time(), self._drones
        heard = [drone.counters.bytes_in for drone in drones]
        cpu_s = [drone.meter.spent_s for drone in drones]

        def end(held_s: tuple[float, ...] = (), blob_bytes: int = 0) -> Phase:
            for drone in drones:
                drone.check()
            sent = [self.air.traffic.sent.get(drone.name, {}) for drone in drones]
            return Phase(
                name,
                self._loop.time() - began_s,
                tuple(sum(t.wire_bytes for t in traffic.values()) for traffic in sent),
                tuple(d.counters.bytes_in - b for d, b in zip(drones, heard, strict=True)),
                tuple(d.meter.spent_s - b for d, b in zip(drones, cpu_s, strict=True)),
                _together(sent),
                held_s,
                blob_bytes,
            )

        return end


def _together(sent: list[dict[str, Traffic]]) -> dict[str, Traffic]:
    """Return what all drones sent by message, the most first."""
    out: dict[str, Traffic] = {}
    for traffic in sent:
        for name, part in traffic.items():
            whole = out.setdefault(name, Traffic())
            whole.messages += part.messages
            whole.payload_bytes += part.payload_bytes
            whole.wire_bytes += part.wire_bytes
    return dict(sorted(out.items(), key=lambda item: (-item[1].wire_bytes, item[0])))
