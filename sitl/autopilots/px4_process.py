"""The process of a PX4 built for simulation, in lockstep, and what is alike whatever it feels.

Its sensors are said by its MAVLink simulator interface (its documentation, "Simulation":
HIL_SENSOR in, HIL_ACTUATOR_CONTROLS back, by TCP), step by step.

PX4 takes our timestamps once it has our clock, by 500 answers to its TIMESYNC. They are given for
the companion, whose clock is the recording's: it may not run yet, or while this clock stands still.
"""

from __future__ import annotations

import os
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.firmware_process import FirmwareProcess
from sitl.autopilots.hil_sensors import PERIOD_US
from sitl.autopilots.speaking import packed
from sitl.autopilots.wire import Wire
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.rotation import Array

STEP_NS = 1000 * PERIOD_US

_LOOK_S = 0.5
# Until it has started whatever answers a step, each is given so long.
_STARTS_S = 0.02
_HEARS_S = 0.05
_N_MOTORS = 4
_BYTES_PER_S = 4_000_000
_MAX_BYTES = 65536
# Of a MAVLink 2 frame: its first byte, and where its message's id is.
_HEADER, _ID_AT = b"\xfd", slice(7, 10)
_TIMESYNC_ID = dialect.MAVLINK_MSG_ID_TIMESYNC.to_bytes(3, "little")


class Px4Process(ABC):
    """One that runs, and the clockwork that moves it on; see ``flown.Firmware``.

    Args:
        options: what it is.
        model: name of its airframe.
        wire: where it talks to.
        stack: ends the process.
        tells_time: whether its questions for the time are answered in the companion's place.
    """

    estimator_message = dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS
    # Its LOCAL_POSITION_NED bears the instant at which it was made, this that of the estimate.
    position_message = dialect.MAVLINK_MSG_ID_ODOMETRY

    def __init__(
        self,
        options: FirmwareOptions,
        model: str,
        wire: Wire,
        stack: ExitStack,
        *,
        tells_time: bool = True,
    ) -> None:
        self._wire = wire
        self._tells_time = tells_time
        self.now_ns = options.boot_offset_ns
        # Its clock is what HIL_SENSOR says (SimulatorMavlink.cpp, handle_message_hil_sensor).
        self.clock_ahead_ns: int | None = -options.boot_offset_ns
        self._controls: Array = np.zeros(_N_MOTORS)  # what it last had its motors do, 0 to 1
        self._boot_ns = options.boot_offset_ns
        self._rng = np.random.default_rng(options.system_id)
        self._unread: deque[bytes] = deque()
        self._runs = False
        self._n_asked = self._n_answered = 0
        self._has_told = False  # what time it is, and it may not have read that yet
        self._answers = dialect.MAVLink(None)
        self._answers.robust_parsing = True
        self._simulator = dialect.MAVLink(None, options.system_id, 1)
        companion = dialect.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
        self._companion = dialect.MAVLink(None, options.system_id, companion)
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        listener.settimeout(_LOOK_S)
        port = int(listener.getsockname()[1])
        self._process = _started(options, model, port, wire.port, stack)
        self._sensors = stack.enter_context(_connected(listener, self._process))
        self._sensors.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._sensors.settimeout(_STARTS_S)

    def is_due(self, until_ns: int) -> bool:
        """Return whether one more whole step fits in until an instant."""
        return self.now_ns + STEP_NS <= until_ns

    def step(self) -> None:
        """Move it on by one step of its clock, and wait until it has done what is due in it."""
        while self._has_told:
            # What it reads a step later it takes for the time half a step earlier.
            self._has_told = False
            self.hear(())
        message = self._reading()
        asked_at_s = time.monotonic()
        try:
            self._sensors.sendall(packed(message, self._simulator))
            self.now_ns += STEP_NS
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

    @abstractmethod
    def _reading(self) -> Any:
        """Return what its sensors say one step on: pymavlink's HIL_SENSOR."""

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
                self._controls = np.array(message.controls[:_N_MOTORS])
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
            # It takes what it is told for the time halfway between its question and now.
            halfway_ns = (message.ts1 + self._boot_ns + self.now_ns) // 2
            self._write(dialect.MAVLink_timesync_message(max(1, halfway_ns), message.ts1))
            self._has_told = True
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
    options: FirmwareOptions, model: str, sensors_port: int, mavlink_port: int, stack: ExitStack
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
        "PX4_SIM_MODEL": model,
        "PX4_SIMULATOR": "mavlink",
        "PATH": os.pathsep.join((str(folder), os.environ.get("PATH", os.defpath))),
    }
    # Its number is the whole machine's: this port is ours.
    number = str(sensors_port)
    for leftover in (f"/tmp/px4-sock-{number}", f"/tmp/px4_lock-{number}"):
        stack.callback(Path(leftover).unlink, missing_ok=True)
    program, scripts = str(options.binary.resolve()), str(build / "etc")
    command = (program, "-d", "-i", number, "-w", str(folder), scripts)
    return FirmwareProcess(command, folder, environment, stack)
