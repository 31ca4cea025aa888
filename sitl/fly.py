"""One flight from a recording to its report: real processes, real sockets, the recording's time."""

from __future__ import annotations

import asyncio
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sitl.absences import seconds_late
from sitl.daemon_config import check_settings
from sitl.gathered import gather
from sitl.out_folder import files_in_one_line, prepare_folder
from sitl.pacing import Instant, Pace, gate, instants
from sitl.plan import FlightPlan, FlyOptions, plan_flight
from sitl.processes import FlightError, unless_one_ends
from sitl.report import write_report
from sitl.result import Event
from sitl.shots import RecordedShots, Shots
from sitl.swarm import Swarm
from sitl.trajectory_files import write_trajectories
from vcl_companion.daemon.scheduling import run_among_others, run_before_others
from vcl_companion.mapping.options import MapOptions
from vcl_companion.recording import read_recording
from vcl_companion.wire.warm_up import warm_up

_ANSWER_TIMEOUT_S = 60.0
_MAP_TIMEOUT_S = 30.0
_LOOK_S = 0.03

Progress = Callable[[str, int, int], None]
"""Is told what is being done, how many frames are through, and of how many."""


@dataclass
class Conduct:
    """How the harness itself did.

    Attributes:
        start_s: wall time from the first frame to the first map.
        flight_s: wall time of everything after.
        late_ms: by how much each frame was handed out later than it was due.
        ended_at_ns: recording time when the last frame was answered.
        events: what should be known.
    """

    start_s: float = 0.0
    flight_s: float = 0.0
    late_ms: list[float] = field(default_factory=list)
    ended_at_ns: int = 0
    events: list[Event] = field(default_factory=list)


def fly(recording_path: Path, out: Path, options: FlyOptions, progress: Progress) -> dict[str, Any]:
    """Fly a recording, leave everything about it in ``out``, and return what report.json says.

    Raises:
        VclError: the recording or an option cannot be used.
        FlightError: a process ended or hung; all others have been ended too.
        KeyboardInterrupt: likewise, on Ctrl-C.
    """
    progress("reading the recording", 0, 0)
    plan = plan_flight(read_recording(recording_path), options)
    check_settings(plan)
    prepare_folder(out, plan)
    return reported(plan, out, flown(plan, out, RecordedShots(), progress), progress)


def flown(plan: FlightPlan, out: Path, shots: Shots, progress: Progress) -> Conduct:
    """Fly what is planned; what became of it is in ``out``.

    Raises:
        FlightError, KeyboardInterrupt: see ``fly``.
    """
    # Daemons that start together would all compile the same.
    progress("compiling, once on this machine", 0, 0)
    with files_in_one_line():
        warm_up()
        return asyncio.run(_flown(plan, out, shots, progress))


def reported(plan: FlightPlan, out: Path, conduct: Conduct, progress: Progress) -> dict[str, Any]:
    """Compare a flight with the truth, write its report, and return what report.json says.

    Raises:
        FlightError: a file is missing or broken, or cannot be written.
    """
    progress("writing the report", 0, 0)
    with files_in_one_line():
        result = gather(plan, out, conduct.events)
        write_trajectories(result, out)
        return write_report(
            result,
            out,
            start_s=conduct.start_s,
            flight_s=conduct.flight_s,
            late_ms=float(np.percentile(conduct.late_ms, 99.0)) if conduct.late_ms else None,
        )


async def _flown(plan: FlightPlan, out: Path, shots: Shots, progress: Progress) -> Conduct:
    swarm = Swarm(plan, out)
    conduct = Conduct()
    with _ended_by_sigterm(), _in_time(plan):
        try:
            progress("starting the daemons", 0, 0)
            await swarm.start()
            await unless_one_ends(swarm.children, _play(plan, swarm, shots, conduct, progress))
            progress("ending the daemons", 0, 0)
            for drone in swarm.drones:
                if drone.camera.is_connected:
                    drone.camera.say_end(conduct.ended_at_ns)
            await swarm.finish()
        finally:
            await swarm.end()
    return conduct


@contextmanager
def _in_time(plan: FlightPlan) -> Iterator[None]:
    """Cameras wait for no processor: nor does who stands for them in real time, if it may not."""
    if math.isinf(plan.options.speed):
        yield
        return
    run_before_others()
    try:
        yield
    finally:
        run_among_others()


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Let SIGTERM end the flight as Ctrl-C does: through every ``finally``."""
    loop = asyncio.get_running_loop()
    task = asyncio.current_task()
    asked = False

    def end() -> None:
        nonlocal asked
        # `timeout` sends it to the process and once more to its group: what is put in order by
        # then is not interrupted.
        if task is not None and not asked:
            task.cancel()
        asked = True

    loop.add_signal_handler(signal.SIGTERM, end)
    try:
        yield
    except asyncio.CancelledError:
        if asked:
            raise SystemExit(128 + signal.SIGTERM) from None
        raise
    finally:
        loop.remove_signal_handler(signal.SIGTERM)


async def _play(
    plan: FlightPlan, swarm: Swarm, shots: Shots, conduct: Conduct, progress: Progress
) -> None:
    """Hand out every frame at its time, after the attitude of that instant."""
    speed = plan.options.speed
    flat_out = math.isinf(speed)
    frames_at_ns = [drone.frames_at_ns for drone in plan.drones]
    moments = instants(frames_at_ns, flat_out)
    holds_after = gate(
        moments, {n for n, drone in enumerate(plan.drones) if drone.name in plan.waited_for}
    )
    n_frames = sum(map(len, frames_at_ns))
    n_given = 0
    begun_s = time.monotonic()
    maps = _Maps(conduct)
    pace = Pace(speed, moments[0].at_ns, begun_s)
    for k, moment in enumerate(moments):
        if shots.is_over(swarm):
            break
        if flat_out and moment.frames and k > holds_after:
            await _all_answered(swarm)
            await maps.come_into_use(swarm, (moment.at_ns - plan.starts_at_ns) * 1e-9)
        await asyncio.sleep(max(0.0, pace.wait_s(moment.at_ns, time.monotonic())))
        await swarm.kill_and_start(moment.at_ns)
        held_before_s = shots.held_s
        await _hand_out(moment, plan, swarm, shots)
        pace = pace.held(shots.held_s - held_before_s)
        conduct.ended_at_ns = moment.at_ns
        if k == 0:
            await swarm.clocks_related(moment.at_ns)
            pace = Pace(speed, moment.at_ns, time.monotonic())
        n_given += len(moment.frames)
        if not flat_out and k > holds_after:
            late_s = -pace.wait_s(moment.at_ns, time.monotonic())
            conduct.late_ms += [late_s * 1e3] * len(moment.frames)
        if k == holds_after:
            progress("making the first map", n_given, n_frames)
            await _first_map(plan, swarm, conduct)
            conduct.start_s = time.monotonic() - begun_s
            pace = Pace(speed, moment.at_ns, time.monotonic())
        elif moment.frames and k > holds_after:
            progress("flying", n_given, n_frames)
    await _all_answered(swarm)
    conduct.flight_s = time.monotonic() - begun_s - conduct.start_s


async def _hand_out(moment: Instant, plan: FlightPlan, swarm: Swarm, shots: Shots) -> None:
    await swarm.advance_to(moment.at_ns)
    at_s = (moment.at_ns - plan.starts_at_ns) * 1e-9
    given = {
        due.drone: due
        for due in moment.frames
        if not any(b.has(plan.drones[due.drone].name, at_s) for b in plan.options.blind)
    }
    images = await shots.taken(moment, swarm)
    for n, drone in enumerate(swarm.drones):
        if not drone.camera.is_connected:
            continue  # nobody is there to see it
        if n in given:
            drone.camera.give(given[n].sequence, moment.at_ns, images[n])
        else:
            drone.camera.tell_time(moment.at_ns)


async def _first_map(plan: FlightPlan, swarm: Swarm, conduct: Conduct) -> None:
    """Hold the recording until the first frames given so far are answered, or the time is up.

    A swarm without a map is still flown: what it says about it is the result.
    """
    timeout_s = first_map_timeout_s(plan)
    try:
        async with asyncio.timeout(timeout_s):
            for drone in swarm.drones:
                await drone.camera.answered()
    except TimeoutError:
        for drone in swarm.drones:
            if drone.camera.unanswered():
                why = f"first frame not answered within {timeout_s:.0f} s; flown on without"
                conduct.events.append(Event(0.0, drone.planned.name, "harness", why))


def first_map_timeout_s(plan: FlightPlan) -> float:
    """Return for how long the recording stands still for the first map at most, wall clock."""
    timeout_s = plan.options.start_timeout_s
    late = seconds_late(plan.options.absences).keys()
    if plan.waited_for | late != {drone.name for drone in plan.drones}:
        # The daemon of who begins later is there, and is asked for a frame that it has not.
        timeout_s += MapOptions().gather_timeout_s
    return timeout_s


class _Maps:
    """Where the daemons set the pace, maps are made in no time, however slow the machine is."""

    def __init__(self, conduct: Conduct) -> None:
        self._conduct = conduct
        self._is_waited_for = True

    async def come_into_use(self, swarm: Swarm, flight_s: float) -> None:
        """Wait until no daemon has anything to do with a map; not again for one that does not come.

        Raises:
            FlightError: a daemon hung up, or does not answer.
        """
        until_s = time.monotonic() + _MAP_TIMEOUT_S
        while busy := await _busy(swarm):
            if not self._is_waited_for:
                return
            if time.monotonic() >= until_s:
                self._is_waited_for = False
                why = f"still busy with a map after {_MAP_TIMEOUT_S:.0f} s; flown on without it"
                self._conduct.events += [Event(flight_s, name, "harness", why) for name in busy]
                return
            await asyncio.sleep(_LOOK_S)
        self._is_waited_for = True


async def _busy(swarm: Swarm) -> list[str]:
    """Return the names of the drones that have to do with a map."""
    asked = [drone for drone in swarm.drones if drone.camera.is_connected]
    try:
        async with asyncio.timeout(_ANSWER_TIMEOUT_S):
            answers = await asyncio.gather(*(drone.camera.is_busy() for drone in asked))
    except TimeoutError:
        raise FlightError(
            f"a daemon has not said within {_ANSWER_TIMEOUT_S:.0f} s whether it makes a map"
        ) from None
    return [drone.planned.name for drone, busy in zip(asked, answers, strict=True) if busy]


async def _all_answered(swarm: Swarm) -> None:
    try:
        async with asyncio.timeout(_ANSWER_TIMEOUT_S):
            for drone in swarm.drones:
                await drone.camera.answered()
    except TimeoutError:
        late = next(drone for drone in swarm.drones if drone.camera.unanswered())
        frame = late.camera.unanswered()[0]
        raise FlightError(
            f"daemon of {late.planned.name} has not answered frame {frame} "
            f"within {_ANSWER_TIMEOUT_S:.0f} s"
        ) from None
