"""A real PX4 in a recorded flight: ``python -m sitl.autopilots.px4 CONFIG.json``.

Its simulated sensors get the recording's true motion by PX4's MAVLink simulator interface, in
lockstep (its documentation, "Simulation": HIL_SENSOR in, HIL_ACTUATOR_CONTROLS back, by TCP); see
``flown``, and ``firmware_options`` for the configuration, whose ``binary`` is ``bin/px4`` in the
folder of a build for ``px4_sitl_default``.

PX4 takes our timestamps once it has our clock, by 500 answers to its TIMESYNC. They are given for
the companion, whose clock is the recording's: it may not run yet, or while this clock stands still.
"""

from __future__ import annotations

import os
import socket
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import FirmwareOptions, read_options
from sitl.autopilots.firmware_process import FirmwareProcess
from sitl.autopilots.flown import run_flown
from sitl.autopilots.hil_sensors import hil_sensors
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.speaking import packed
from sitl.autopilots.wire import Wire
from vcl_companion.errors import ConfigError

PARAMETERS = {
    # Position, height and heading by vision (its documentation, "Visual Inertial Odometry").
    "EKF2_EV_CTRL": 11.0,
    "EKF2_GPS_CTRL": 0.0,
    "SYS_HAS_GPS": 0.0,
    "EKF2_HGT_REF": 1.0,
    # What it hears is as late as we are quick: nothing on the way is to be made up for.
    "EKF2_EV_DELAY": 0.0,
    "SDLOG_MODE": -1.0,
}

_RATE_HZ = 250
_STEP_NS = 1_000_000_000 // _RATE_HZ
_CHUNK = 2500
_LOOK_S = 0.5
# Until it has started whatever answers a step, each is given so long.
_STARTS_S = 0.02
_HEARS_S = 0.05
# Its propellers turn so long before the recording begins.
_TAKEN_OFF_BEFORE_NS = 5_000_000_000
_MODEL = "none_iris"
_BYTES_PER_S = 4_000_000
_MAX_BYTES = 65536
# Of a MAVLink 2 frame: its first byte, and where its message's id is.
_HEADER, _ID_AT = b"\xfd", slice(7, 10)
_TIMESYNC_ID = dialect.MAVLINK_MSG_ID_TIMESYNC.to_bytes(3, "little")


class Px4:
    """The firmware's process, and the clockwork that moves it on; see ``flown.Firmware``.

    Args:
        options: what it is.
        wire: where it talks to.
        stack: ends the process.
        tells_time: whether its questions for the time are answered in the companion's place.
    """

    estimator_message = dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS

    def __init__(
        self, options: FirmwareOptions, wire: Wire, stack: ExitStack, *, tells_time: bool = True
    ) -> None:
        if not isinstance(options.flies, RecordedMotion):
            raise ConfigError("a PX4 flies recordings alone, and no missions")
        self._motion = options.flies
        self._wire = wire
        self._tells_time = tells_time
        self.now_ns = options.boot_offset_ns
        self._boot_ns = options.boot_offset_ns
        self._rng = np.random.default_rng(options.system_id)
        self._chunk: list[Any] = []  # of steps to come, the next one last
        self._unread: deque[bytes] = deque()
        self._runs = False
        self._n_asked = self._n_answered = 0
        self._answers = dialect.MAVLink(None)
        self._answers.robust_parsing = True
        self._simulator = dialect.MAVLink(None, options.system_id, 1)
        companion = dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        self._companion = dialect.MAVLink(None, options.system_id, companion)
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        listener.settimeout(_LOOK_S)
        port = int(listener.getsockname()[1])
        self._process = _started(options, port, wire.port, stack)
        self._sensors = stack.enter_context(_connected(listener, self._process))
        self._sensors.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sensors.settimeout(_STARTS_S)

    def is_due(self, until_ns: int) -> bool:
        """Return whether one more whole step fits in until an instant."""
        return self.now_ns + _STEP_NS <= until_ns

    def step(self) -> None:
        """Move it on by one step of its clock, and wait until it has done what is due in it."""
        if not self._chunk:
            self._chunk = self._readings()
        message = self._chunk.pop()
        asked_at_s = time.monotonic()
        try:
            self._sensors.sendall(packed(message, self._simulator))
            self.now_ns += _STEP_NS
            while not self._has_done(message.time_usec):
                self._process.still_there(asked_at_s)
                if not self._runs:
                    return
        except ConnectionError as error:
            raise ConfigError(self._process.obituary()) from error

    def hear(self, frames: Iterable[bytes]) -> None:
        """Have it take in what reaches it now, before its clock goes on.

        Its port is read by a thread of its own, which has read all once it has answered what it
        was asked last. Commands make that wait for the clock: then it answers in a later step.
        """
        if not self._wire.is_open:
            return
        for frame in frames:
            self._wire.write(frame)
        self._n_asked += 1
        self._write(dialect.MAVLink_timesync_message(0, -self._n_asked))
        deadline_s = time.monotonic() + _HEARS_S
        while self._n_answered < self._n_asked and time.monotonic() < deadline_s:
            self._wire.wait(_HEARS_S)
            self._sort()

    def said(self) -> Iterator[bytes]:
        """Yield what it has said to its companion."""
        self._sort()
        while self._unread:
            yield self._unread.popleft()

    def _readings(self) -> list[Any]:
        at_ns = self.now_ns + _STEP_NS * np.arange(1, _CHUNK + 1)
        shaken = at_ns > self._motion.starts_ns - _TAKEN_OFF_BEFORE_NS
        since_us = (at_ns - self._boot_ns) // 1000
        return hil_sensors(self._motion.at(at_ns), since_us, shaken, self._rng)[::-1]

    def _has_done(self, time_us: int) -> bool:
        """Wait a moment for its answer to the readings of an instant of its clock."""
        try:
            data = self._sensors.recv(_MAX_BYTES)
        except TimeoutError:
            return False
        if not data:
            raise ConnectionResetError
        for message in self._answers.parse_buffer(data) or []:
            if message.get_type() == "HIL_ACTUATOR_CONTROLS" and message.time_usec >= time_us:
                self._runs = True
                return True
        return False

    def _sort(self) -> None:
        """Take what it has said apart: what is for its companion, and what is between us."""
        for data in self._wire.read():
            if not self._is_between_us(data):
                self._unread.append(data)

    def _is_between_us(self, data: bytes) -> bool:
        # It sends each message in a datagram of its own.
        if data[:1] != _HEADER or data[_ID_AT] != _TIMESYNC_ID:
            return False
        try:
            message = dialect.MAVLink(None).decode(bytearray(data))
        except dialect.MAVError:
            return False
        if message.tc1 == 0 and self._tells_time:
            answer_ns = max(1, message.ts1 + self._boot_ns)
            self._write(dialect.MAVLink_timesync_message(answer_ns, message.ts1))
            return True
        if message.tc1 != 0 and message.ts1 < 0:
            self._n_answered = max(self._n_answered, -message.ts1)
            return True
        return False

    def _write(self, message: Any) -> None:
        self._wire.write(packed(message, self._companion))


def _connected(listener: socket.socket, process: FirmwareProcess) -> socket.socket:
    """Return the connection of a firmware that has just been started."""
    asked_at_s = time.monotonic()
    while True:
        try:
            return listener.accept()[0]
        except TimeoutError:
            process.still_there(asked_at_s)


def _started(
    options: FirmwareOptions, sensors_port: int, mavlink_port: int, stack: ExitStack
) -> FirmwareProcess:
    """Start the firmware by its own script, but for where it looks for its simulator and us."""
    build = options.binary.resolve().parent.parent
    if not (build / "etc" / "init.d-posix" / "rcS").is_file():
        raise ConfigError(
            f"{build}: has no etc/init.d-posix/rcS; is it a build of px4_sitl_default?"
        )
    folder = options.run.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    # Its script looks for these in PATH.
    (folder / "px4-rc.mavlinksim").write_text(
        f"param set MAV_SYS_ID {options.system_id}\n"
        f"simulator_mavlink start -t 127.0.0.1 {sensors_port}\n"
    )
    (folder / "px4-rc.mavlink").write_text(
        f"mavlink start -u 0 -o {mavlink_port} -t 127.0.0.1 -m onboard -r {_BYTES_PER_S}\n"
    )
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("PX4_")},
        **{f"PX4_PARAM_{name}": f"{value:.9g}" for name, value in options.parameters.items()},
        "PX4_SIM_MODEL": _MODEL,
        "PATH": os.pathsep.join((str(folder), os.environ.get("PATH", os.defpath))),
    }
    # Its number is the whole machine's: this port is ours.
    number = str(sensors_port)
    for leftover in (f"/tmp/px4-sock-{number}", f"/tmp/px4_lock-{number}"):
        stack.callback(Path(leftover).unlink, missing_ok=True)
    program, scripts = str(options.binary.resolve()), str(build / "etc")
    command = (program, "-d", "-i", number, "-w", str(folder), scripts)
    return FirmwareProcess(command, folder, environment, stack)


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""

    def read(path: Path) -> FirmwareOptions:
        return read_options(path).over(PARAMETERS)

    return run_flown("px4", arguments, read, Px4)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
