"""A real ArduCopter in a flight: ``python -m sitl.autopilots.ardupilot CONFIG.json``.

In a recorded flight its simulated IMU gets the recording's true motion by ArduPilot's JSON
simulator interface (libraries/SITL/examples/JSON/readme.md); in a live one its own model flies
(``ardupilot_quad``). See ``flown``, and ``firmware_options`` for the configuration, whose
``binary`` is an ``arducopter`` built for SITL.
"""

from __future__ import annotations

import struct
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from sitl.autopilots.ardupilot_parameters import RECORDED, of_a_mission
from sitl.autopilots.ardupilot_process import ArduCopterProcess
from sitl.autopilots.ardupilot_quad import ArduCopterQuad
from sitl.autopilots.firmware_options import FirmwareOptions, Orders, read_options
from sitl.autopilots.flown import Firmware, run_flown
from sitl.autopilots.motion import Motion, RecordedMotion
from sitl.autopilots.wire import Wire

_RATE_HZ = 400
_STEP_NS = 1_000_000_000 // _RATE_HZ
_CHUNK = 4000
# pwm of 16 or of 32 servos after magic, frame rate and frame count
_SERVOS = struct.Struct("<HHI")
_MAGIC = {18458, 29569}


class ArduCopter(ArduCopterProcess):
    """One that feels a recorded motion; see ``flown.Firmware``.

    Args:
        options: what it is.
        motion: what it feels.
        wire: where it talks to.
        stack: ends the process.
    """

    def __init__(
        self, options: FirmwareOptions, motion: RecordedMotion, wire: Wire, stack: ExitStack
    ) -> None:
        super().__init__(options, wire, stack)
        self._motion = motion
        self._chunk: list[bytes] = []  # lines of steps to come, the next one last
        port = str(self._sim.getsockname()[1])
        self._start(("--model", "JSON", "--sim-address", "127.0.0.1", "--sim-port-out", port))
        self._count = -1
        self._at = self._await_servos()

    def is_due(self, until_ns: int) -> bool:
        """Return whether one more whole step fits in until an instant."""
        return self.now_ns + _STEP_NS <= until_ns

    def step(self) -> None:
        """Move it on by one step of its clock, and wait until it has done what is due in it."""
        if not self._chunk:
            at_ns = self.now_ns + _STEP_NS * np.arange(1, _CHUNK + 1)
            since_s = (at_ns - self._options.boot_offset_ns) * 1e-9
            self._chunk = _sensor_lines(self._motion.at(at_ns), since_s)
            self._chunk.reverse()
        self._sim.sendto(self._chunk.pop(), self._at)
        self.now_ns += _STEP_NS
        self._await_servos()

    def _await_servos(self) -> tuple[str, int]:
        """Wait until it has done a step, and return whence it says so."""
        asked_at_s = time.monotonic()
        while True:
            data, sender = self._heard(asked_at_s)
            if len(data) <= _SERVOS.size:
                continue
            magic, _, count = _SERVOS.unpack_from(data)
            # It says the same again while it waits: only what follows a step is its answer.
            if magic in _MAGIC and count > self._count:
                self._count = count
                return sender


def _sensor_lines(motion: Motion, since_s: Any) -> list[bytes]:
    """Return one line of JSON for each instant, as the simulator interface wants them."""
    out = []
    rows = zip(
        since_s.tolist(),
        motion.angular_rates_rad_s.tolist(),
        motion.specific_forces_m_s2.tolist(),
        motion.positions_m.tolist(),
        motion.quaternions.tolist(),
        motion.velocities_m_s.tolist(),
        strict=True,
    )
    for at_s, gyro, force, position, quaternion, velocity in rows:
        # Its reader looks for keys in a fixed order and takes no exponents of Python's apart.
        text = (
            f'\n{{"timestamp":{at_s:.6f},"imu":{{"gyro":{_numbers(gyro)},'
            f'"accel_body":{_numbers(force)}}},"position":{_numbers(position)},'
            f'"quaternion":{_numbers(quaternion)},"velocity":{_numbers(velocity)}}}\n'
        )
        out.append(text.encode())
    return out


def _numbers(values: list[float]) -> str:
    return "[" + ",".join(f"{value:.9f}" for value in values) + "]"


def start(options: FirmwareOptions, wire: Wire, stack: ExitStack) -> Firmware:
    """Start the one that a configuration is of."""
    if isinstance(options.flies, Orders):
        return ArduCopterQuad(options, options.flies.mission, wire, stack)
    return ArduCopter(options, options.flies, wire, stack)


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""

    def read(path: Path) -> FirmwareOptions:
        options = read_options(path)
        own = RECORDED
        if isinstance(options.flies, Orders):
            own = of_a_mission(options.flies.mission.speed_m_s)
        return options.over(own)

    return run_flown("ardupilot", arguments, read, start, has_fixed_ports=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
