"""A flying swarm: per drone one real daemon, one stand-in autopilot, one camera server.

Between the daemons lies a relay, which is the radio. A daemon may be started late, or killed and
started again (``absences``): its autopilot, its camera and its place on the radio stay.
"""

from __future__ import annotations

import asyncio
import math
import os
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import sitl
from sitl.absences import seconds_late
from sitl.daemon_config import daemon_config, key_path, toml_text
from sitl.frame_server import FrameServer
from sitl.lives import Life, Lives, log_path, write_lives
from sitl.network import Network
from sitl.network_log import write_network_log
from sitl.plan import FlightPlan, PlannedDrone
from sitl.processes import (
    Child,
    FlightError,
    end_children,
    kill_child,
    start_child,
    unless_one_ends,
)
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
        children: every process of the swarm that should be running.
    """

    def __init__(self, plan: FlightPlan, out: Path) -> None:
        self.drones: list[FlyingDrone] = []
        self.children: list[Child] = []
        self._plan = plan
        self._out = out.resolve()
        self._cameras: list[FrameServer] = []
        self._daemons: dict[str, Child] = {}
        self._lives = {planned.name: Lives() for planned in plan.drones}
        absences = plan.options.absences
        self._kills = sorted((a.from_s, a.drone) for a in absences if a.from_s > 0.0)
        self._starts = sorted((a.until_s, a.drone) for a in absences if a.until_s < math.inf)
        self._relay: Relay | None = None

    async def start(self) -> None:
        """Start all processes and wait until every daemon has connected to its camera.

        Daemons that are late are not among them.

        Raises:
            FlightError: one does not start, or ends at once.
            ConfigError: the folder cannot be written.
        """
        make_key_file(key_path(self._out))
        for planned in self._plan.drones:
            camera = FrameServer(planned.name)
            self._cameras.append(camera)
            child = await start_stand_in(self._plan, planned, self._out, _environment())
            self.children.append(child)
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
        late = seconds_late(self._plan.options.absences)
        there = [drone for drone in self.drones if drone.planned.name not in late]
        for drone in there:
            await self._start_daemon(drone, self._plan.starts_at_ns)
        await unless_one_ends(self.children, self._all_connected(there))
        for drone in there:
            self._life(drone).ready_at_ns = self._plan.starts_at_ns

    async def kill_and_start(self, at_ns: int) -> None:
        """Kill and start the daemons whose time it is; note who is ready by now.

        Where the daemons set the pace, the recording stands still until one that is started
        is ready; else it goes on, as flight does.

        Raises:
            FlightError: one is not ready within the time, where that is waited for.
        """
        flight_s = (at_ns - self._plan.starts_at_ns) * 1e-9
        started: list[FlyingDrone] = []
        while True:
            kill_s = self._kills[0][0] if self._kills else math.inf
            start_s = self._starts[0][0] if self._starts else math.inf
            if min(kill_s, start_s) > flight_s:
                break
            if kill_s <= start_s:
                drone = self._named(self._kills.pop(0)[1])
                started = [other for other in started if other is not drone]
                await self._kill(drone, at_ns)
            else:
                started.append(self._named(self._starts.pop(0)[1]))
                await self._start_daemon(started[-1], at_ns)
        if started and math.isinf(self._plan.options.speed):
            await self._all_connected(started)
            for drone in started:
                drone.camera.tell_time(at_ns)
            await self.clocks_related(at_ns, started)
        for drone in self.drones:
            if drone.camera.is_connected and self._life(drone).ready_at_ns is None:
                self._life(drone).ready_at_ns = at_ns

    async def advance_to(self, at_ns: int) -> None:
        """Move every autopilot's time on, and the network's."""
        if self._relay is not None:
            self._relay.flight_s = (at_ns - self._plan.starts_at_ns) * 1e-9
        await asyncio.gather(*(drone.stand_in.advance_to(at_ns) for drone in self.drones))

    async def clocks_related(self, at_ns: int, drones: Sequence[FlyingDrone] = ()) -> None:
        """Hold the time at an instant until every daemon knows its autopilot's clock.

        A question that is on its way while time steps on is answered too late,
        and the attitude of the first frames would depend on it. Not for ever:
        what a daemon makes of silence is its own matter.

        Args:
            at_ns: the instant.
            drones: whose daemons were just started; all that are connected if not given.
        """
        asking = drones or [drone for drone in self.drones if drone.camera.is_connected]
        before = [await drone.stand_in.advance_to(at_ns) if drones else 0 for drone in asking]
        deadline_s = time.monotonic() + _CLOCKS_TIMEOUT_S
        while time.monotonic() < deadline_s:
            told = [await drone.stand_in.advance_to(at_ns) for drone in asking]
            if min(now - then for now, then in zip(told, before, strict=True)) >= _N_EXCHANGES:
                return
            await asyncio.sleep(_LOOK_S)

    async def finish(self) -> None:
        """End the daemons, then the stand-ins, in order: every log gets its last line.

        Raises:
            FlightError: one ended in another way than it should.
        """
        for drone in self.drones:
            if drone.planned.name in self._daemons and not drone.camera.is_connected:
                await self._kill(drone, self._plan.ends_at_ns)  # it is still starting
        daemons = [*self._daemons.values()]
        stubborn = await end_children(daemons, _END_TIMEOUT_S)
        if stubborn:
            names = ", ".join(child.name for child in stubborn)
            raise FlightError(f"{names} did not end within {_END_TIMEOUT_S:.0f} s of SIGTERM")
        for child in daemons:
            if child.process.returncode != 0:
                raise FlightError(child.obituary())
        for drone in self.drones:
            await drone.stand_in.finish()
        if self._relay is not None:
            write_network_log(self._out, self._relay)
        for drone in self.drones:
            self._lives[drone.planned.name].frames = drone.camera.given
        write_lives(self._out, self._lives)

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
            names = [drone.planned.name for drone in self.drones]
            return Relay(names, network, addressed=options.network.addressed)
        except OSError as error:
            raise FlightError(f"no sockets between the drones: {error.strerror}") from error

    async def _all_connected(self, drones: Sequence[FlyingDrone]) -> None:
        timeout_s = self._plan.options.start_timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                for drone in drones:
                    await drone.camera.connected()
        except TimeoutError:
            names = [d.planned.name for d in drones if not d.camera.is_connected]
            raise FlightError(
                f"daemon of {', '.join(names)} not connected to the camera within {timeout_s:.0f} s"
            ) from None

    async def _start_daemon(self, drone: FlyingDrone, at_ns: int) -> None:
        """Start a daemon, or start it again: with all the files that its last run has left."""
        name = drone.planned.name
        lives = self._lives[name].lives
        path = self._run_folder(drone.planned) / "daemon.toml"
        child = await start_child(
            f"daemon of {name}",
            (sys.executable, "-m", "vcl_companion", "run", "--config", str(path)),
            log_prefix=path.with_name(f"daemon-{len(lives)}" if lives else "daemon"),
            environment=_environment(),
        )
        lives.append(Life(at_ns))
        self._daemons[name] = child
        self.children.append(child)

    async def _kill(self, drone: FlyingDrone, at_ns: int) -> None:
        child = self._daemons.pop(drone.planned.name)
        self.children.remove(child)
        await kill_child(child)
        await drone.camera.was_killed()
        self._life(drone).killed_at_ns = at_ns
        run = self._run_folder(drone.planned)
        with suppress(FileNotFoundError):
            n_before = len(self._lives[drone.planned.name].lives) - 1
            (run / "flight.jsonl").rename(log_path(run, n_before))

    def _life(self, drone: FlyingDrone) -> Life:
        """Return the last life of a drone's daemon; one that has not begun is of no account."""
        lives = self._lives[drone.planned.name].lives
        return lives[-1] if lives else Life(0)

    def _named(self, name: str) -> FlyingDrone:
        return next(drone for drone in self.drones if drone.planned.name == name)

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
