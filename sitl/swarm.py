"""A flying swarm: per drone one real daemon, one stand-in autopilot, one camera server.

Between the daemons lies a relay, which is the radio.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import sitl
from sitl.daemon_config import daemon_config, key_path, toml_text
from sitl.frame_server import FrameServer
from sitl.network import Network
from sitl.network_log import write_network_log
from sitl.plan import FlightPlan, PlannedDrone
from sitl.processes import Child, FlightError, end_children, start_child, unless_one_ends
from sitl.relay import Relay
from sitl.stand_in_process import StandIn, start_stand_in
from vcl_companion.links.key_file import make_key_file

_END_TIMEOUT_S = 10.0
# A daemon asks ten times a second until it has enough answers.
_CLOCKS_TIMEOUT_S = 5.0
_N_EXCHANGES = 4
_LOOK_S = 0.02
_FROM_SYSTEMD = ("JOURNAL_STREAM", "NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")
# One core per drone at most: a companion board has few, and results must not hang on their number.
_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMBA_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
    ),
    "1",
)


@dataclass(frozen=True, eq=False)
class FlyingDrone:
    """One drone's three parts."""

    planned: PlannedDrone
    camera: FrameServer
    stand_in: StandIn


class Swarm:
    """Starts everything, holds it, ends it; ``end`` must be called whatever happens.

    Attributes:
        drones: in the plan's order, once started.
        daemons: their processes, in the same order.
    """

    def __init__(self, plan: FlightPlan, out: Path) -> None:
        self.drones: list[FlyingDrone] = []
        self.daemons: list[Child] = []
        self._plan = plan
        self._out = out.resolve()
        self._cameras: list[FrameServer] = []
        self._stand_ins: list[Child] = []
        self._relay: Relay | None = None

    @property
    def children(self) -> list[Child]:
        """Every process of the swarm."""
        return [*self._stand_ins, *self.daemons]

    async def start(self) -> None:
        """Start all processes and wait until every daemon has connected to its camera.

        Raises:
            FlightError: one does not start, or ends at once.
            ConfigError: the folder cannot be written.
        """
        make_key_file(key_path(self._out))
        for planned in self._plan.drones:
            camera = FrameServer(planned.name)
            self._cameras.append(camera)
            child = await start_stand_in(self._plan, planned, self._out, _environment())
            self._stand_ins.append(child)
            self.drones.append(FlyingDrone(planned, camera, await StandIn.of(child)))
        camera_ports = [await camera.start() for camera in self._cameras]
        # Its own ports first: they are held, so none of the daemons' can be the same.
        self._relay = self._open_relay()
        peer_ports = free_udp_ports(len(self.drones))
        names = [drone.planned.name for drone in self.drones]
        self._relay.start(dict(zip(names, peer_ports, strict=True)))
        for n, drone in enumerate(self.drones):
            config = daemon_config(
                self._plan, drone.planned, self._out, camera_ports[n], drone.stand_in.port,
                peer_ports[n], self._relay.ports(drone.planned.name),
            )  # fmt: skip
            path = self._run_folder(drone.planned) / "daemon.toml"
            path.write_text(toml_text(config), encoding="utf-8")
            command = (sys.executable, "-m", "vcl_companion.cli", "run", "--config", str(path))
            self.daemons.append(
                await start_child(
                    f"daemon of {drone.planned.name}",
                    command,
                    log_prefix=path.with_suffix(""),
                    environment=_environment(),
                )
            )
        await unless_one_ends(self.children, self._all_connected())

    async def advance_to(self, at_ns: int) -> None:
        """Move every autopilot's time on, and the network's."""
        if self._relay is not None:
            self._relay.flight_s = (at_ns - self._plan.starts_at_ns) * 1e-9
        await asyncio.gather(*(drone.stand_in.advance_to(at_ns) for drone in self.drones))

    async def clocks_related(self, at_ns: int) -> None:
        """Hold the time at an instant until every daemon knows its autopilot's clock.

        A question that is on its way while time steps on is answered too late,
        and the attitude of the first frames would depend on it. Not for ever:
        what a daemon makes of silence is its own matter.
        """
        deadline_s = time.monotonic() + _CLOCKS_TIMEOUT_S
        while time.monotonic() < deadline_s:
            told = [await drone.stand_in.advance_to(at_ns) for drone in self.drones]
            if min(told) >= _N_EXCHANGES:
                return
            await asyncio.sleep(_LOOK_S)

    async def finish(self) -> None:
        """End the daemons, then the stand-ins, in order: every log gets its last line.

        Raises:
            FlightError: one ended in another way than it should.
        """
        stubborn = await end_children(self.daemons, _END_TIMEOUT_S)
        if stubborn:
            names = ", ".join(child.name for child in stubborn)
            raise FlightError(f"{names} did not end within {_END_TIMEOUT_S:.0f} s of SIGTERM")
        for child in self.daemons:
            if child.process.returncode != 0:
                raise FlightError(child.obituary())
        for drone in self.drones:
            await drone.stand_in.finish()
        if self._relay is not None:
            write_network_log(self._out, self._relay)

    async def end(self) -> None:
        """End whatever of ours still runs."""
        await end_children(self.children, _END_TIMEOUT_S)
        for camera in self._cameras:
            await camera.close()
        if self._relay is not None:
            self._relay.close()

    def _open_relay(self) -> Relay:
        options = self._plan.options
        network = Network(options.network, options.seed)
        try:
            return Relay([drone.planned.name for drone in self.drones], network)
        except OSError as error:
            raise FlightError(f"no sockets between the drones: {error.strerror}") from error

    async def _all_connected(self) -> None:
        timeout_s = self._plan.options.start_timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                for camera in self._cameras:
                    await camera.connected()
        except TimeoutError:
            raise FlightError(
                f"{self._waiting()} not connected to the camera within {timeout_s:.0f} s"
            ) from None

    def _waiting(self) -> str:
        names = [c.drone for c in self._cameras if not c.is_connected]
        return "daemon of " + ", ".join(names)

    def _run_folder(self, planned: PlannedDrone) -> Path:
        return self._out / "run" / planned.name


def free_udp_ports(count: int) -> list[int]:
    """Return ports of 127.0.0.1 that are free now; whoever uses them should hurry."""
    held = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    try:
        for one in held:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in held]
    finally:
        for one in held:
            one.close()


def _environment() -> dict[str, str]:
    """Return the children's environment: ours, one thread each, and this checkout importable.

    What systemd told us of itself is not for them: they would report to it in our name.
    """
    root = str(Path(sitl.__file__).resolve().parent.parent)
    paths = [root, *filter(None, [os.environ.get("PYTHONPATH")])]
    inherited = {k: v for k, v in os.environ.items() if k not in _FROM_SYSTEMD}
    return {
        **inherited,
        **_ONE_THREAD,
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONUNBUFFERED": "1",
    }
