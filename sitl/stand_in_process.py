"""The harness's end of a stand-in autopilot: its start, and its time told line by line."""

from __future__ import annotations

import asyncio
import json
import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import msgspec

from sitl.plan import FlightPlan, PlannedDrone
from sitl.processes import Child, FlightError, start_child
from vcl_companion.recording import Trajectory

# A firmware that is just started lives through a minute of its own time first.
_REPLY_TIMEOUT_S = 120.0
# Autopilots were switched on one after the other, well before the flight.
_BOOTED_BEFORE_NS = 60_000_000_000
_BOOTED_APART_NS = 7_000_000_000


@dataclass(eq=False)
class StandIn:
    """A running stand-in and the UDP port that it listens on.

    Attributes:
        child: its process.
        port: of 127.0.0.1.
        state: what it said last of the instant that it was moved on to (``steered``).
    """

    child: Child
    port: int
    state: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    async def of(cls, child: Child) -> Self:
        """Wait until a stand-in is ready."""
        port = (await _reply(child)).get("port")
        if not isinstance(port, int):
            raise FlightError(f"{child.name} does not say its port")
        return cls(child, port)

    async def advance_to(self, at_ns: int) -> int:
        """Have it send what is due until an instant, and wait until it has.

        Returns:
            How many of its daemon's questions for the time it has answered so far.
        """
        await _say(self.child, {"advance_to_ns": at_ns})
        answer = await _reply(self.child)
        self.state = answer
        told = answer.get("times_told")
        if answer.get("at_ns") != at_ns or not isinstance(told, int):
            raise FlightError(f"{self.child.name} was told {at_ns} ns and answers {answer}")
        return told

    async def finish(self) -> None:
        """Have it write down everything it heard, and end.

        Raises:
            FlightError: it does not, or says that something went wrong.
        """
        await _say(self.child, {"finish": True})
        try:
            async with asyncio.timeout(_REPLY_TIMEOUT_S):
                code = await self.child.process.wait()
        except TimeoutError:
            raise FlightError(f"{self.child.name} does not finish") from None
        if code != 0:
            raise FlightError(self.child.obituary())


async def start_stand_in(
    plan: FlightPlan, planned: PlannedDrone, out: Path, environment: Mapping[str, str]
) -> Child:
    """Start one drone's stand-in; see ``StandIn.of`` for when it is ready."""
    folder = out / "run" / planned.name
    path = folder / "stand_in.json"
    config = stand_in_config(plan, planned, out)
    path.write_text(json.dumps(config, indent=1) + "\n", encoding="utf-8")
    module = "stand_in" if plan.options.firmware is None else plan.options.firmware.kind
    return await start_child(
        f"autopilot of {planned.name}",
        (sys.executable, "-m", f"sitl.autopilots.{module}", str(path)),
        log_prefix=folder / "stand_in",
        environment=environment,
        piped=True,
    )


def stand_in_config(plan: FlightPlan, planned: PlannedDrone, out: Path) -> dict[str, Any]:
    """Return an autopilot's configuration; writes the truth it measures, if it does, to a file."""
    if planned.mission is not None:
        begins_ns = plan.starts_at_ns + round(planned.mission.begins_s * 1e9)
        flies = {"mission": msgspec.to_builtins(planned.mission), "begins_ns": begins_ns}
    elif planned.attitude_path is not None:
        flies = {"attitude": {"source": "replay", "file": str(planned.attitude_path)}}
    else:
        truth_path = out / "run" / planned.name / "truth.csv"
        truth = planned.drone.truth
        if truth is None:
            raise ValueError(f"{planned.name} was planned without attitude and without truth")
        truth_path.write_text(_trajectory_text(truth), encoding="utf-8")
        # Different errors for every drone, the same whoever else flies.
        seed = 256 * plan.options.seed + planned.system_id
        flies = {"attitude": {"source": "truth", "file": str(truth_path), "seed": seed}}
    booted_before_ns = _BOOTED_BEFORE_NS + planned.system_id * _BOOTED_APART_NS
    return {
        "system_id": planned.system_id,
        "boot_offset_ns": plan.starts_at_ns - booted_before_ns,
        **flies,
        **_firmware_config(plan, out / "run" / planned.name / "firmware"),
        # Whose daemon is killed is in the air, where the next one goes on with its map.
        "arms": any(a.drone == planned.name and not a.is_late for a in plan.options.absences),
        # An autopilot has a processor of its own.
        "realtime": not math.isinf(plan.options.speed),
        "out": str(out / planned.name),
    }


def _firmware_config(plan: FlightPlan, run: Path) -> dict[str, Any]:
    firmware, speed = plan.options.firmware, plan.options.speed
    if firmware is None:
        return {}
    return {
        "binary": str(firmware.path),
        "parameters": dict(firmware.parameters),
        "run": str(run),
        "speed": 0.0 if math.isinf(speed) else speed,
    }


def _trajectory_text(truth: Trajectory) -> str:
    lines = ["at_ns,x,y,z,qw,qx,qy,qz"]
    for at_ns, position, quaternion in zip(
        truth.at_ns.tolist(), truth.positions_m, truth.quaternions, strict=True
    ):
        lines.append(",".join([str(at_ns), *(repr(float(v)) for v in (*position, *quaternion))]))
    return "\n".join(lines) + "\n"


async def _say(child: Child, command: Mapping[str, object]) -> None:
    stdin = child.process.stdin
    if stdin is None:
        raise FlightError(f"{child.name} has no standard input")
    try:
        stdin.write(json.dumps(command).encode() + b"\n")
        await stdin.drain()
    except OSError as error:
        raise FlightError(f"{child.name} does not listen: {error.strerror}") from error


async def _reply(child: Child) -> dict[str, Any]:
    stdout = child.process.stdout
    if stdout is None:
        raise FlightError(f"{child.name} has no standard output")
    try:
        async with asyncio.timeout(_REPLY_TIMEOUT_S):
            line = await stdout.readline()
            if not line:
                await child.process.wait()
                raise FlightError(child.obituary())
    except TimeoutError:
        raise FlightError(f"{child.name} does not answer") from None
    try:
        value = json.loads(line)
    except ValueError:
        value = None
    if not isinstance(value, dict):
        raise FlightError(f"{child.name} answers {line[:60]!r}")
    return value
