"""A stand-in for an autopilot: ``python -m sitl.autopilots.stand_in CONFIG.json``.

It speaks MAVLink over UDP like an ArduPilot quadrotor's component 1, fuses the poses that it is
sent as that does (``fusing``), and keeps everything it hears. Its time is a recording's
(``steered``); only heartbeats go by the wall clock, since they say that a process lives while a
recording's time stands still.

Configuration: ``system_id``, ``boot_offset_ns`` (its boot clock is recording time minus
this), ``attitude`` {``source`` "truth" or "replay", ``file``, and for truth ``seed``,
``tilt_bias_deg``, ``heading_bias_deg``, ``white_deg``, ``rate_hz``}, ``parameters`` (name to
value, those that are not as they should be; may be absent), ``arms`` (whether it is armed from its
first position on; may be absent), ``out`` (directory for
``attitude.csv`` and ``received.jsonl``). It takes no encoding from the companion:
what it decodes is a second opinion.
"""

from __future__ import annotations

import json
import socket
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.ardupilot_parameters import VISION_ALONE
from sitl.autopilots.attitude_source import (
    AttitudeErrors,
    AttitudeSource,
    ReplayedAttitude,
    TruthAttitude,
)
from sitl.autopilots.fusing import Fusing, VisionPose
from sitl.autopilots.hearing import Hearing, datagrams
from sitl.autopilots.speaking import Backlog, packed
from sitl.autopilots.steered import open_udp, run_steered, serve
from sitl.autopilots.vision_north import VisionNorth
from vcl_companion.daemon.scheduling import run_before_others
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.rotation import (
    Array,
    euler_from_matrix,
    log_so3,
    matrix_from_quaternion,
)

# An ArduCopter's that flies on our poses.
PARAMETERS = {
    **VISION_ALONE,
    "EK3_ENABLE": 1.0,
    "VISO_ORIENT": 0.0,
    "VISO_SCALE": 1.0,
    "VISO_POS_X": 0.0,
    "VISO_POS_Y": 0.0,
    "VISO_POS_Z": 0.0,
    "VISO_POS_M_NSE": 0.05,
    "VISO_QUAL_MIN": 0.0,
}
_HEARTBEAT_S = 1.0
_TIMESYNC_PERIOD_NS = 100_000_000
# A recording's pause may be of hours. Nobody asks for what was said before its last minute, and all
# of it at once would take minutes to say, and more than a socket holds.
_LONGEST_SAID_NS = 60_000_000_000
_YAW_SOURCE, _BY_VISION = "EK3_SRC1_YAW", 6.0
_SET_GLOBAL_ORIGIN = 611  # not in pymavlink's dialects
_ACCEPTED: int = dialect.MAV_RESULT_ACCEPTED
_UNSUPPORTED: int = dialect.MAV_RESULT_UNSUPPORTED
_FAILED: int = dialect.MAV_RESULT_FAILED


@dataclass(frozen=True)
class StandInOptions:
    """The configuration file, read.

    Attributes:
        system_id: the vehicle's.
        boot_offset_ns: recording time at the autopilot's start.
        source: where attitudes come from.
        out: directory for what it writes.
        parameters: of its own, by name, besides those that fly on our poses.
        realtime: whether it goes before other programs on this machine, where that is permitted.
        arms: whether it is armed from its first position on. Not by itself: between photographs
            nobody flies, and of an armed one's jumps five a minute are followed.
    """

    system_id: int
    boot_offset_ns: int
    source: AttitudeSource
    out: Path
    realtime: bool = False
    parameters: Mapping[str, float] = field(default_factory=dict)
    arms: bool = False


def read_options(path: Path) -> StandInOptions:
    """Read the configuration file.

    Raises:
        ConfigError: it or the attitude file is wrong, in one line.
    """
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        attitude = config["attitude"]
        source: AttitudeSource
        if attitude["source"] == "replay":
            source = ReplayedAttitude(Path(attitude["file"]))
        elif attitude["source"] == "truth":
            names = ("tilt_bias_deg", "heading_bias_deg", "white_deg")
            errors = AttitudeErrors(**{n: float(attitude[n]) for n in names if n in attitude})
            rate_hz = float(attitude.get("rate_hz", 50.0))
            if not 1.0 <= rate_hz <= 1000.0:
                raise ConfigError(f"{path}: attitude.rate_hz must be in 1..1000, got {rate_hz}")
            seed = int(attitude.get("seed", 0))
            source = TruthAttitude(Path(attitude["file"]), rate_hz, errors, seed)
        else:
            raise ConfigError(f'{path}: attitude.source must be "truth" or "replay"')
        return StandInOptions(
            int(config["system_id"]),
            int(config["boot_offset_ns"]),
            source,
            Path(config["out"]),
            bool(config.get("realtime", False)),
            {str(name): float(value) for name, value in config.get("parameters", {}).items()},
            bool(config.get("arms", False)),
        )
    except KeyError as error:
        raise ConfigError(f"{path}: key {error} is missing") from error
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: {error}") from error


class StandIn:
    """The autopilot: its clock, its socket, and its two files."""

    def __init__(
        self, options: StandInOptions, udp: socket.socket, attitudes: TextIO, received: TextIO
    ) -> None:
        self._options = options
        self._udp = udp
        self._attitudes = attitudes
        self._hearing = Hearing(received)
        self._mav = dialect.MAVLink(None, srcSystem=options.system_id, srcComponent=1)
        self._now_ns: int | None = None
        self._companion: tuple[str, int] | None = None
        self._fusing = Fusing()
        self._interval_ns: dict[int, int] = {}
        self._backlog = Backlog()
        self._next_heartbeat_s = 0.0
        self._parameters = {**PARAMETERS, **options.parameters}
        # What an earlier flight's autopilot said had its north already.
        self._is_measured = isinstance(options.source, TruthAttitude)
        by_vision = self._parameters[_YAW_SOURCE] == _BY_VISION
        self._north = VisionNorth() if self._is_measured and by_vision else None
        self._turned: tuple[int, Array] | None = None
        # latitude and longitude, 1e-7 degrees, altitude, mm: as ArduPilot it keeps its first
        self._origin: tuple[int, int, int] | None = None
        self._streams = {
            dialect.MAVLINK_MSG_ID_EKF_STATUS_REPORT: self._send_estimator,
            dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: self._send_position,
        }
        self.n_times_told = 0

    def state(self, at_ns: int) -> dict[str, object]:
        """Return nothing: it does not fly by itself."""
        return {}

    def advance_to(self, until_ns: int) -> int:
        """Send what is due up to an instant of the recording; return the time it is then.

        After a pause of more than a minute it is the last minute's.
        """
        self.receive()
        if self._now_ns is not None and until_ns <= self._now_ns:
            return self._now_ns
        since_ns = self._now_ns
        if since_ns is not None:
            since_ns = max(since_ns, until_ns - _LONGEST_SAID_NS)
        due: list[tuple[int, Callable[[], None]]] = [
            (at_ns, partial(self._send_attitude, at_ns, quaternion))
            for at_ns, quaternion in self._options.source.between(since_ns, until_ns)
        ]
        if since_ns is not None:
            due += _every(_TIMESYNC_PERIOD_NS, since_ns, until_ns, self._ask_for_time)
            for message_id, interval_ns in self._interval_ns.items():
                due += _every(interval_ns, since_ns, until_ns, self._streams[message_id])
        for at_ns, send in sorted(due, key=lambda item: item[0]):
            self._now_ns = max(at_ns, self._now_ns or at_ns)
            send()
        self._now_ns = until_ns
        return until_ns

    def receive(self) -> None:
        """Take in every datagram that has arrived."""
        for data, sender in datagrams(self._udp):
            for message in self._hearing.of(data, self._now_ns):
                if message.get_srcSystem() != self._options.system_id:
                    continue
                if sender != self._companion:
                    self._greet(sender)
                self._answer(message, message.get_type())

    def heartbeat_if_due(self) -> float:
        """Send HEARTBEAT when a second has passed; return the seconds to the next."""
        now_s = time.monotonic()
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + _HEARTBEAT_S
            self._beat()
        return max(0.0, self._next_heartbeat_s - now_s)

    def _beat(self) -> None:
        # Without a position ArduCopter is not armed in GUIDED; in the air it stays so without one.
        is_armed = self._options.arms and self._fusing.at(self._now_ns or 0) is not None
        self._send(
            dialect.MAVLink_heartbeat_message(
                dialect.MAV_TYPE_QUADROTOR,
                dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
                dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
                | (dialect.MAV_MODE_FLAG_SAFETY_ARMED if is_armed else 0),
                4,  # ArduCopter's GUIDED
                dialect.MAV_STATE_ACTIVE,
                3,
            )
        )

    def _greet(self, companion: tuple[str, int]) -> None:
        """Talk to a companion from now on, and give it the newest of what it missed."""
        self._companion = companion
        self._beat()
        for frame in self._backlog:
            self._udp.sendto(frame, companion)

    def _answer(self, message: Any, kind: str) -> None:
        if kind == "TIMESYNC" and message.tc1 == 0 and self._now_ns is not None:
            self._send(dialect.MAVLink_timesync_message(max(1, self._boot_ns()), message.ts1))
            self.n_times_told += 1
        elif kind in ("PARAM_REQUEST_READ", "PARAM_SET") and message.param_id in self._parameters:
            if kind == "PARAM_SET":
                self._parameters[message.param_id] = message.param_value
            self._send(
                dialect.MAVLink_param_value_message(
                    message.param_id.encode(),
                    self._parameters[message.param_id],
                    dialect.MAV_PARAM_TYPE_REAL32,
                    len(self._parameters),
                    0xFFFF,
                )
            )
        elif kind == "VISION_POSITION_ESTIMATE":
            self._fuse(message)
        elif (
            kind in ("COMMAND_LONG", "COMMAND_INT", "SET_GPS_GLOBAL_ORIGIN")
            and message.target_system == self._options.system_id
        ):
            if kind == "SET_GPS_GLOBAL_ORIGIN":
                self._take_origin(message.latitude, message.longitude, message.altitude)
                return
            result = self._obey_int(message) if kind == "COMMAND_INT" else self._obey(message)
            self._send(
                dialect.MAVLink_command_ack_message(
                    message.command, result, 0, 0, message.get_srcSystem(),
                    message.get_srcComponent(),
                )
            )  # fmt: skip

    def _fuse(self, message: Any) -> None:
        """Take a VISION_POSITION_ESTIMATE in."""
        at_ns = 1000 * message.usec
        position = np.array([message.x, message.y, message.z])
        pose = VisionPose(at_ns, position, message.covariance, message.reset_counter)
        if self._fusing.take(pose) and self._north is not None:
            self._north.reset(at_ns, message.yaw)

    def _obey(self, message: Any) -> int:
        """Obey a COMMAND_LONG; return its MAV_RESULT."""
        wanted = int(message.param1)
        if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            if wanted in self._streams and message.param2 >= 1000.0:
                self._interval_ns[wanted] = round(1000.0 * message.param2)
            return _ACCEPTED
        if message.command == dialect.MAV_CMD_REQUEST_MESSAGE:
            if wanted != dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
                return _FAILED
            self._say_origin()
            return _ACCEPTED
        return _UNSUPPORTED

    def _obey_int(self, message: Any) -> int:
        """Obey a COMMAND_INT; return its MAV_RESULT."""
        if message.command != _SET_GLOBAL_ORIGIN:
            return _UNSUPPORTED
        is_taken = self._take_origin(message.x, message.y, round(1e3 * message.z))
        return _ACCEPTED if is_taken else _FAILED

    def _take_origin(self, latitude: int, longitude: int, altitude: int) -> bool:
        """Keep an origin, unless there is one; whether it is kept."""
        if self._origin is not None:
            return False
        self._origin = (latitude, longitude, altitude)
        self._say_origin()
        return True

    def _say_origin(self) -> None:
        if self._origin is not None:
            self._send(dialect.MAVLink_gps_global_origin_message(*self._origin))

    def _boot_ns(self) -> int:
        assert self._now_ns is not None
        return self._now_ns - self._options.boot_offset_ns

    def _send_estimator(self) -> None:
        assert self._now_ns is not None
        self._send(
            dialect.MAVLink_ekf_status_report_message(
                self._fusing.flags(self._now_ns), 0.0, self._fusing.test_ratio, 0.0, 0.0, 0.0
            )
        )

    def _send_position(self) -> None:
        assert self._now_ns is not None
        believed = self._fusing.at(self._now_ns)
        if believed is not None:
            boot_ms = self._boot_ns() // 1_000_000
            self._send(
                dialect.MAVLink_local_position_ned_message(boot_ms, *believed[0], *believed[1])
            )

    def _ask_for_time(self) -> None:
        # Like ArduPilot, which tells its own questions from others by its system id in them.
        ts1_ns = self._boot_ns() + self._options.system_id
        self._send(dialect.MAVLink_timesync_message(0, ts1_ns))

    def _send_attitude(self, at_ns: int, quaternion: Array) -> None:
        boot_ms = (at_ns - self._options.boot_offset_ns) // 1_000_000
        if not 0 <= boot_ms < 2**32:
            raise ConfigError(f"boot_offset_ns: {at_ns} is {boot_ms} ms after the start")
        rates = self._felt(at_ns, matrix_from_quaternion(quaternion))
        if self._north is not None:
            quaternion = self._north.of(at_ns, quaternion)
        # The wire has float32: what is kept is what was sent.
        sent = [float(value) for value in quaternion.astype(np.float32)]
        self._attitudes.write(f"{at_ns},{','.join(map(repr, sent))}\n")
        angles = euler_from_matrix(matrix_from_quaternion(np.array(sent)))
        for message in (
            dialect.MAVLink_attitude_quaternion_message(boot_ms, *sent, *rates),
            dialect.MAVLink_attitude_message(boot_ms, *angles, *rates),
        ):
            self._backlog.add(at_ns, self._send(message))

    def _felt(self, at_ns: int, ned_from_body: Array) -> list[float]:
        """Return what its gyros feel, body rates since the last attitude, rad/s.

        Of an earlier flight's autopilot only the attitudes are known, turns of its north in them.
        """
        last, self._turned = self._turned, (at_ns, ned_from_body)
        if last is None or at_ns <= last[0] or not self._is_measured:
            return [0.0, 0.0, 0.0]
        turn = log_so3(last[1].T @ ned_from_body)
        return [float(angle) * 1e9 / (at_ns - last[0]) for angle in turn]

    def _send(self, message: Any) -> bytes:
        frame = packed(message, self._mav)
        if self._companion is not None:
            self._udp.sendto(frame, self._companion)
        return frame


def _every(
    period_ns: int, after_ns: int, until_ns: int, send: Callable[[], None]
) -> list[tuple[int, Callable[[], None]]]:
    """Return what is due at the multiples of a period in (after_ns, until_ns]."""
    steps = range(after_ns // period_ns + 1, until_ns // period_ns + 1)
    return [(k * period_ns, send) for k in steps]


def run(options: StandInOptions) -> None:
    """Serve until told to finish, or until stdin ends."""
    options.out.mkdir(parents=True, exist_ok=True)
    if options.realtime:
        run_before_others()
    with (
        open_udp() as udp,
        (options.out / "attitude.csv").open("w", buffering=1) as attitudes,
        (options.out / "received.jsonl").open("w", buffering=1) as received,
    ):
        attitudes.write("at_ns,qw,qx,qy,qz\n")
        serve(StandIn(options, udp, attitudes, received), udp)


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""
    return run_steered("stand_in", arguments, lambda path: run(read_options(path)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
