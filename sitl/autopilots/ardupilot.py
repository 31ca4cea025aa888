"""A real ArduCopter in a recorded flight: ``python -m sitl.autopilots.ardupilot CONFIG.json``.

The firmware runs in software beside this process, which gives its simulated IMU the recording's
true motion (ArduPilot's JSON simulator interface: libraries/SITL/examples/JSON/readme.md) and
stands between it and the companion. It runs in lockstep: its time is the recording's
(``steered``), and what its own estimator makes of the companion's poses is written down.

Configuration: ``binary`` (an ``arducopter`` built for SITL), ``system_id``, ``boot_offset_ns``
(it is started when recording time is this), ``attitude`` {``file``} (a trajectory: its motion),
``parameters`` (name to value, set before it starts; may be absent), ``speed`` (of the recording;
0 or absent: as fast as it goes), ``out``, ``run`` (where it runs). It writes ``received.jsonl``
and ``attitude.csv`` like the stand-in, ``fused.csv``, where the firmware believes to be
(``at_ns,x,y,z`` of LOCAL_POSITION_NED), and ``said.csv``, its texts and its estimator's flags.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.attitude_source import read_table
from sitl.autopilots.hearing import Hearing, datagrams
from sitl.autopilots.motion import Motion, RecordedMotion
from sitl.autopilots.speaking import Backlog, packed
from sitl.autopilots.steered import open_udp, run_steered, serve
from sitl.autopilots.vision_parameters import VISION_ALONE
from sitl.pacing import ATTITUDE_PERIOD_NS
from vcl_companion.errors import ConfigError

PARAMETERS = {
    **VISION_ALONE,
    # What it hears is as late as we are quick: nothing on the way is to be made up for.
    "VISO_DELAY_MS": 0.0,
    "ARMING_SKIPCHK": -1.0,
    "LOG_BACKEND_TYPE": 0.0,
    "FRAME_CLASS": 1.0,
}

_LEASH = Path(__file__).parents[1] / "leash.py"
_RATE_HZ = 400
_STEP_NS = 1_000_000_000 // _RATE_HZ
_CHUNK = 4000
_ANSWERS_WITHIN_S = 20.0
_LOOK_S = 0.5
_HEARTBEAT_S = 1.0
_GROUND_SYSTEM, _GROUND_COMPONENT = 255, 190
# Attitude is asked for by the companion as well, but not before the recording begins.
_WANTED_US = {
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20_000,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 20_000,
    dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 200_000,
}
# pwm of 16 or of 32 servos after magic, frame rate and frame count
_SERVOS = struct.Struct("<HHI")
_MAGIC = {18458, 29569}


@dataclass(frozen=True)
class ArduPilotOptions:
    """The configuration file, read.

    Attributes:
        binary: the firmware.
        system_id: the vehicle's.
        boot_offset_ns: recording time at its start.
        motion: what its sensors feel.
        parameters: set before it starts.
        speed: seconds of the recording per second; 0: as fast as it goes.
        out: directory for what is written.
        run: directory of its own.
    """

    binary: Path
    system_id: int
    boot_offset_ns: int
    motion: RecordedMotion
    parameters: dict[str, float]
    speed: float
    out: Path
    run: Path


def read_options(path: Path) -> ArduPilotOptions:
    """Read the configuration file.

    Raises:
        ConfigError: it, the binary or the truth is wrong, in one line.
    """
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        at_ns, rows = read_table(Path(config["attitude"]["file"]), 8)
        binary = Path(config["binary"])
        parameters = {str(k): float(v) for k, v in config.get("parameters", {}).items()}
        options = ArduPilotOptions(
            binary,
            int(config["system_id"]),
            int(config["boot_offset_ns"]),
            RecordedMotion(at_ns, rows[:, :3], rows[:, 3:]),
            {**PARAMETERS, **parameters},
            float(config.get("speed", 0.0)),
            Path(config["out"]),
            Path(config["run"]),
        )
    except KeyError as error:
        raise ConfigError(f"{path}: key {error} is missing") from error
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    if not os.access(binary, os.X_OK) or binary.is_dir():
        raise ConfigError(
            f"{binary}: is no program; it takes ArduPilot's build/sitl/bin/arducopter"
        )
    return options


class Firmware:
    """The firmware's process, and the clockwork that moves it on.

    Args:
        options: what it is.
        mavlink_port: of 127.0.0.1, where it talks to.
        stack: ends the process.
    """

    def __init__(self, options: ArduPilotOptions, mavlink_port: int, stack: ExitStack) -> None:
        self._motion = options.motion
        self._sensors = stack.enter_context(open_udp())
        self._sensors.settimeout(_LOOK_S)
        self.now_ns = options.boot_offset_ns
        self._boot_ns = options.boot_offset_ns
        self._chunk: list[bytes] = []  # lines of steps to come, the next one last
        self._log = options.run.with_name("firmware.log")
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
            *("--serial0", f"udpclient:127.0.0.1:{mavlink_port}"),
            # The ports that it would listen on are one machine's, not one drone's.
            *("--serial1", "none:1", "--serial2", "none:2", "--rc-in-port", "0"),
            *("--defaults", str(defaults.resolve()), "--sysid", str(options.system_id)),
        )
        leash = (sys.executable, "-I", "-S", str(_LEASH), str(os.getpid()))
        log = stack.enter_context(self._log.open("wb"))
        self._process = subprocess.Popen(
            (*leash, *command), cwd=folder, stdin=subprocess.DEVNULL, stdout=log, stderr=log
        )
        stack.callback(_end, self._process)
        self._count = -1
        self._sim = self._await_servos()

    def step(self) -> None:
        """Move it on by one step of its clock, and wait until it has done what is due in it."""
        if not self._chunk:
            at_ns = self.now_ns + _STEP_NS * np.arange(1, _CHUNK + 1)
            self._chunk = _sensor_lines(self._motion.at(at_ns), (at_ns - self._boot_ns) * 1e-9)
            self._chunk.reverse()
        self._sensors.sendto(self._chunk.pop(), self._sim)
        self.now_ns += _STEP_NS
        self._await_servos()

    def _await_servos(self) -> tuple[str, int]:
        """Wait until it has done a step, and return whence it says so."""
        deadline_s = time.monotonic() + _ANSWERS_WITHIN_S
        while True:
            try:
                data, sender = self._sensors.recvfrom(1024)
            except TimeoutError:
                self._still_there(deadline_s)
                continue
            if len(data) <= _SERVOS.size:
                continue
            magic, _, count = _SERVOS.unpack_from(data)
            # It says the same again while it waits: only what follows a step is its answer.
            if magic in _MAGIC and count > self._count:
                self._count = count
                return str(sender[0]), int(sender[1])

    def _still_there(self, deadline_s: float) -> None:
        code = self._process.poll()
        if code is not None:
            raise ConfigError(f"the firmware ended with exit code {code}; see {self._log}")
        if time.monotonic() > deadline_s:
            raise ConfigError(f"the firmware does not answer; see {self._log}")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


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


class ArduPilot:
    """The firmware with its companion on the other side; see ``Steered``."""

    def __init__(
        self,
        options: ArduPilotOptions,
        udp: socket.socket,
        stack: ExitStack,
        attitudes: TextIO,
        fused: TextIO,
        received: TextIO,
        texts: TextIO,
    ) -> None:
        self._options = options
        self._udp = udp
        self._attitudes, self._fused, self._texts = attitudes, fused, texts
        self._hearing = Hearing(received)
        self._wire = stack.enter_context(open_udp())
        self._firmware = Firmware(options, self._wire.getsockname()[1], stack)
        self._parser = dialect.MAVLink(None)
        self._parser.robust_parsing = True
        self._ground = dialect.MAVLink(None, _GROUND_SYSTEM, _GROUND_COMPONENT)
        self._as_firmware = dialect.MAVLink(None, options.system_id, 1)
        self._firmware_at: tuple[str, int] | None = None
        self._companion: tuple[str, int] | None = None
        self._backlog = Backlog()
        # What the companion has sent, and when that arrives.
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._stopped_at_s = time.monotonic()
        self._clock_ahead_ns: int | None = None
        self._asked = False
        self._flags = -1
        self.n_times_told = 0

    def advance_to(self, until_ns: int) -> int:
        """Move the firmware on to an instant; return the one asked for."""
        self.receive()
        while self._firmware.now_ns + _STEP_NS <= until_ns:
            self._hand_over()
            self._firmware.step()
            for data, sender in datagrams(self._wire):
                self._firmware_at = sender
                self._said(data)
        self._stopped_at_s = time.monotonic()
        return until_ns

    def receive(self) -> None:
        """Take in what the companion has sent: it arrives as much later as that took it.

        The firmware's clock has stood still meanwhile, but for longer than from one stop to the
        next only because the recording was held. Flat out the companion's work takes no time.
        """
        took_s = (time.monotonic() - self._stopped_at_s) * self._options.speed
        arrives_ns = self._firmware.now_ns + min(round(took_s * 1e9), ATTITUDE_PERIOD_NS)
        for data, sender in datagrams(self._udp):
            if sender != self._companion:
                self._companion = sender
                for frame in self._backlog:
                    self._udp.sendto(frame, sender)
            for message in self._hearing.of(data, self._firmware.now_ns):
                if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                    self._tell_time(message.ts1)
                else:
                    self._under_way.append((arrives_ns, bytes(message.get_msgbuf())))

    def _hand_over(self) -> None:
        """Give the firmware what has arrived by now."""
        while self._under_way and self._under_way[0][0] <= self._firmware.now_ns:
            _, frame = self._under_way.popleft()
            if self._firmware_at is not None:
                self._wire.sendto(frame, self._firmware_at)

    def heartbeat_if_due(self) -> float:
        """Return the seconds to the next look: the firmware's heartbeats go by its own time."""
        return _HEARTBEAT_S

    def _tell_time(self, asked_ns: int) -> None:
        """Say for the firmware what its clock shows: while it stands still, it cannot itself."""
        if self._clock_ahead_ns is None:
            return
        now_ns = max(1, self._firmware.now_ns + self._clock_ahead_ns)
        if self._companion is not None:
            answer = dialect.MAVLink_timesync_message(now_ns, asked_ns)
            self._udp.sendto(packed(answer, self._as_firmware), self._companion)
        self.n_times_told += 1

    def _said(self, data: bytes) -> None:
        """Hand on what the firmware has said, and note what it says of itself."""
        now_ns = self._firmware.now_ns
        self._backlog.add(now_ns, data)
        if self._companion is not None:
            self._udp.sendto(data, self._companion)
        for message in self._parser.parse_buffer(data) or []:
            self._note(message, now_ns)

    def _note(self, message: Any, now_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            self._beat()
        elif kind == "TIMESYNC" and message.tc1 != 0:
            # It answers within a step or a few: the longest lead is the truest.
            ahead_ns = message.tc1 - now_ns
            if self._clock_ahead_ns is None or ahead_ns > self._clock_ahead_ns:
                self._clock_ahead_ns = ahead_ns
        elif kind == "STATUSTEXT":
            self._texts.write(f"{now_ns},{message.severity},{json.dumps(message.text)}\n")
        elif kind == "EKF_STATUS_REPORT" and message.flags != self._flags:
            self._flags = message.flags
            self._texts.write(f'{now_ns},6,"estimator flags {message.flags:#x}"\n')
        elif self._clock_ahead_ns is None:
            return
        elif kind == "ATTITUDE_QUATERNION":
            at_ns = message.time_boot_ms * 1_000_000 - self._clock_ahead_ns
            quaternion = (message.q1, message.q2, message.q3, message.q4)
            self._attitudes.write(f"{at_ns},{','.join(map(repr, quaternion))}\n")
        elif kind == "LOCAL_POSITION_NED":
            at_ns = message.time_boot_ms * 1_000_000 - self._clock_ahead_ns
            self._fused.write(f"{at_ns},{message.x!r},{message.y!r},{message.z!r}\n")

    def _beat(self) -> None:
        """Answer a heartbeat as a ground station does: with one, and what it wants to hear."""
        self._to_firmware(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
            )
        )
        self._to_firmware(dialect.MAVLink_timesync_message(0, self._firmware.now_ns))
        if not self._asked:
            self._asked = True
            for wanted, interval_us in _WANTED_US.items():
                self._to_firmware(
                    dialect.MAVLink_command_long_message(
                        self._options.system_id, 1, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
                        wanted, interval_us, 0, 0, 0, 0, 0,
                    )
                )  # fmt: skip

    def _to_firmware(self, message: Any) -> None:
        if self._firmware_at is not None:
            self._wire.sendto(packed(message, self._ground), self._firmware_at)


def run(options: ArduPilotOptions) -> None:
    """Serve until told to finish, or until stdin ends."""
    options.out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        udp = stack.enter_context(open_udp())
        files = [
            stack.enter_context((options.out / name).open("w", buffering=1))
            for name in ("attitude.csv", "fused.csv", "received.jsonl", "said.csv")
        ]
        files[0].write("at_ns,qw,qx,qy,qz\n")
        files[1].write("at_ns,x,y,z\n")
        files[3].write("at_ns,severity,text\n")
        serve(ArduPilot(options, udp, stack, *files), udp)


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""
    return run_steered("ardupilot", arguments, lambda path: run(read_options(path)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
