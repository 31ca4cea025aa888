"""A real ArduCopter in a recorded flight: ``python -m sitl.autopilots.ardupilot CONFIG.json``.

Its simulated IMU gets the recording's true motion by ArduPilot's JSON simulator interface
(libraries/SITL/examples/JSON/readme.md); see ``flown``, and ``firmware_options`` for the
configuration, whose ``binary`` is an ``arducopter`` built for SITL.
"""

from __future__ import annotations

import os
import struct
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import FirmwareOptions, read_options
from sitl.autopilots.firmware_process import FirmwareProcess
from sitl.autopilots.flown import run_flown
from sitl.autopilots.motion import Motion
from sitl.autopilots.steered import open_udp
from sitl.autopilots.vision_parameters import VISION_ALONE
from sitl.autopilots.wire import Wire

PARAMETERS = {
    **VISION_ALONE,
    # What it hears is as late as we are quick: nothing on the way is to be made up for.
    "VISO_DELAY_MS": 0.0,
    "ARMING_SKIPCHK": -1.0,
    "LOG_BACKEND_TYPE": 0.0,
    "FRAME_CLASS": 1.0,
}

_RATE_HZ = 400
_CHUNK = 4000
_LOOK_S = 0.5
# pwm of 16 or of 32 servos after magic, frame rate and frame count
_SERVOS = struct.Struct("<HHI")
_MAGIC = {18458, 29569}


class ArduCopter:
    """The firmware's process, and the clockwork that moves it on; see ``flown.Firmware``.

    Args:
        options: what it is.
        wire: where it talks to.
        stack: ends the process.
    """

    step_ns = 1_000_000_000 // _RATE_HZ
    estimator_message = dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT

    def __init__(self, options: FirmwareOptions, wire: Wire, stack: ExitStack) -> None:
        self._motion = options.motion
        self._wire = wire
        self._sensors = stack.enter_context(open_udp())
        self._sensors.settimeout(_LOOK_S)
        self.now_ns = options.boot_offset_ns
        self._boot_ns = options.boot_offset_ns
        self._chunk: list[bytes] = []  # lines of steps to come, the next one last
        folder = options.run
        folder.mkdir(parents=True, exist_ok=True)
        defaults = folder / "vcl.parm"
        values = {**options.parameters, "MAV_SYSID": float(options.system_id)}
        defaults.write_text("".join(f"{name} {value:g}\n" for name, value in values.items()))
        command = (
            str(options.binary.resolve()),
            *("--model", "JSON", "--wipe", "--speedup", "1000", "--home", "47,8,500,0"),
            *("--sim-address", "127.0.0.1"),
            *("--sim-port-out", str(self._sensors.getsockname()[1])),
            *("--serial0", f"udpclient:127.0.0.1:{wire.port}"),
            # The ports that it would listen on are one machine's, not one drone's.
            *("--serial1", "none:1", "--serial2", "none:2", "--rc-in-port", "0"),
            *("--defaults", str(defaults.resolve()), "--sysid", str(options.system_id)),
        )
        self._process = FirmwareProcess(command, folder, os.environ, stack)
        self._count = -1
        self._sim = self._await_servos()

    def step(self) -> None:
        """Move it on by one step of its clock, and wait until it has done what is due in it."""
        if not self._chunk:
            at_ns = self.now_ns + self.step_ns * np.arange(1, _CHUNK + 1)
            self._chunk = _sensor_lines(self._motion.at(at_ns), (at_ns - self._boot_ns) * 1e-9)
            self._chunk.reverse()
        self._sensors.sendto(self._chunk.pop(), self._sim)
        self.now_ns += self.step_ns
        self._await_servos()

    def hear(self, frames: Iterable[bytes]) -> None:
        """Have it take in what reaches it now: it looks at its port in its next step."""
        for frame in frames:
            self._wire.write(frame)

    def said(self) -> Iterator[bytes]:
        """Yield what it has said to its companion."""
        return self._wire.read()

    def _await_servos(self) -> tuple[str, int]:
        """Wait until it has done a step, and return whence it says so."""
        asked_at_s = time.monotonic()
        while True:
            try:
                data, sender = self._sensors.recvfrom(1024)
            except TimeoutError:
                self._process.still_there(asked_at_s)
                continue
            if len(data) <= _SERVOS.size:
                continue
            magic, _, count = _SERVOS.unpack_from(data)
            # It says the same again while it waits: only what follows a step is its answer.
            if magic in _MAGIC and count > self._count:
                self._count = count
                return str(sender[0]), int(sender[1])


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


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""

    def read(path: Path) -> FirmwareOptions:
        return read_options(path, PARAMETERS)

    return run_flown("ardupilot", arguments, read, ArduCopter)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
