"""A stand-in for an autopilot: ``python -m sitl.autopilots.stand_in CONFIG.json``.

It speaks MAVLink over UDP like an ArduPilot quadrotor's component 1 and keeps
everything it hears. Its time is a recording's, moved on by JSON lines:

    stdout {"port": P}              ready; the companion sends to 127.0.0.1:P
    stdin  {"advance_to_ns": t}     send what is due up to t
    stdout {"at_ns": t, "times_told": n}
                                    all of it has been handed to the kernel; n
                                    TIMESYNC questions answered so far
    stdin  {"finish": true}         write what was heard and end

The end of stdin ends it as well. Only heartbeats go by the wall clock, since
they say that a process lives while a recording's time stands still.

Configuration: ``system_id``, ``boot_offset_ns`` (its boot clock is recording time minus
this), ``attitude`` {``source`` "truth" or "replay", ``file``, and for truth ``seed``,
``tilt_bias_deg``, ``heading_bias_deg``, ``white_deg``, ``rate_hz``}, ``out`` (directory for
``attitude.csv`` and ``received.jsonl``). It takes no encoding from the companion:
what it decodes is a second opinion.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import sys
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.attitude_source import (
    AttitudeErrors,
    AttitudeSource,
    ReplayedAttitude,
    TruthAttitude,
)
from vcl_companion.daemon.scheduling import run_before_others
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.rotation import Array, euler_from_matrix, matrix_from_quaternion

_HEARTBEAT_S = 1.0
_TIMESYNC_PERIOD_NS = 100_000_000
# What a companion that connects late is given of the stream it missed.
_BACKLOG_NS = 1_000_000_000
_MAX_DATAGRAM_BYTES = 65535
_MAX_LINE_BYTES = 65536


@dataclass(frozen=True)
class StandInOptions:
    """The configuration file, read.

    Attributes:
        system_id: the vehicle's.
        boot_offset_ns: recording time at the autopilot's start.
        source: where attitudes come from.
        out: directory for what it writes.
        realtime: whether it goes before other programs on this machine, where that is permitted.
    """

    system_id: int
    boot_offset_ns: int
    source: AttitudeSource
    out: Path
    realtime: bool = False


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
        self._received = received
        self._mav = dialect.MAVLink(None, srcSystem=options.system_id, srcComponent=1)
        self._now_ns: int | None = None
        self._companion: tuple[str, int] | None = None
        self._backlog: deque[tuple[int, bytes]] = deque()
        self._next_heartbeat_s = 0.0
        self.n_times_told = 0

    def advance_to(self, until_ns: int) -> int:
        """Send what is due up to an instant of the recording; return the time it is then."""
        self.receive()
        if self._now_ns is not None and until_ns <= self._now_ns:
            return self._now_ns
        due: list[tuple[int, Array | None]] = [
            (at_ns, quaternion)
            for at_ns, quaternion in self._options.source.between(self._now_ns, until_ns)
        ]
        if self._now_ns is not None:
            first = self._now_ns // _TIMESYNC_PERIOD_NS + 1
            last = until_ns // _TIMESYNC_PERIOD_NS
            due += [(k * _TIMESYNC_PERIOD_NS, None) for k in range(first, last + 1)]
        for at_ns, quaternion in sorted(due, key=lambda item: item[0]):
            self._now_ns = max(at_ns, self._now_ns or at_ns)
            if quaternion is None:
                self._ask_for_time()
            else:
                self._send_attitude(at_ns, quaternion)
        self._now_ns = until_ns
        return until_ns

    def receive(self) -> None:
        """Take in every datagram that has arrived."""
        while True:
            try:
                data, sender = self._udp.recvfrom(_MAX_DATAGRAM_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            # A parser of its own for each datagram: no rest of one can spoil the next.
            parser = dialect.MAVLink(None)
            parser.robust_parsing = True
            for message in parser.parse_buffer(data) or []:
                self._hear(message, sender)

    def heartbeat_if_due(self) -> float:
        """Send HEARTBEAT when a second has passed; return the seconds to the next."""
        now_s = time.monotonic()
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + _HEARTBEAT_S
            self._send(
                dialect.MAVLink_heartbeat_message(
                    dialect.MAV_TYPE_QUADROTOR,
                    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
                    dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                    4,  # ArduCopter's GUIDED
                    dialect.MAV_STATE_ACTIVE,
                    3,
                )
            )
        return max(0.0, self._next_heartbeat_s - now_s)

    def _hear(self, message: Any, sender: tuple[str, int]) -> None:
        kind = message.get_type()
        fields = {key: value for key, value in message.to_dict().items() if key != "mavpackettype"}
        if kind in ("BAD_DATA",) or kind.startswith("UNKNOWN"):
            fields = {"bytes": bytes(message.data).hex(), "reason": str(fields.get("reason", ""))}
        line = {
            "arrived_at_ns": self._now_ns,
            "arrived_monotonic_ns": time.monotonic_ns(),
            "system": message.get_srcSystem(),
            "component": message.get_srcComponent(),
            "type": kind,
            "fields": fields,
        }
        self._received.write(json.dumps(line) + "\n")
        if kind == "BAD_DATA" or message.get_srcSystem() != self._options.system_id:
            return
        if sender != self._companion:
            self._greet(sender)
        self._answer(message, kind)

    def _greet(self, companion: tuple[str, int]) -> None:
        """Talk to a companion from now on, and give it the newest of what it missed."""
        self._companion = companion
        for _, frame in self._backlog:
            self._udp.sendto(frame, companion)

    def _answer(self, message: Any, kind: str) -> None:
        if kind == "TIMESYNC" and message.tc1 == 0 and self._now_ns is not None:
            self._send(dialect.MAVLink_timesync_message(max(1, self._boot_ns()), message.ts1))
            self.n_times_told += 1
        elif kind == "COMMAND_LONG" and message.target_system == self._options.system_id:
            known = message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
            self._send(
                dialect.MAVLink_command_ack_message(
                    message.command,
                    dialect.MAV_RESULT_ACCEPTED if known else dialect.MAV_RESULT_UNSUPPORTED,
                    0,
                    0,
                    message.get_srcSystem(),
                    message.get_srcComponent(),
                )
            )

    def _boot_ns(self) -> int:
        assert self._now_ns is not None
        return self._now_ns - self._options.boot_offset_ns

    def _ask_for_time(self) -> None:
        # Like ArduPilot, which tells its own questions from others by its system id in them.
        ts1_ns = self._boot_ns() + self._options.system_id
        self._send(dialect.MAVLink_timesync_message(0, ts1_ns))

    def _send_attitude(self, at_ns: int, quaternion: Array) -> None:
        boot_ms = (at_ns - self._options.boot_offset_ns) // 1_000_000
        if not 0 <= boot_ms < 2**32:
            raise ConfigError(f"boot_offset_ns: {at_ns} is {boot_ms} ms after the start")
        # The wire has float32: what is kept is what was sent.
        sent = [float(value) for value in quaternion.astype(np.float32)]
        self._attitudes.write(f"{at_ns},{','.join(map(repr, sent))}\n")
        angles = euler_from_matrix(matrix_from_quaternion(np.array(sent)))
        for message in (
            dialect.MAVLink_attitude_quaternion_message(boot_ms, *sent, 0.0, 0.0, 0.0),
            dialect.MAVLink_attitude_message(boot_ms, *angles, 0.0, 0.0, 0.0),
        ):
            self._backlog.append((at_ns, self._send(message)))
        while at_ns - self._backlog[0][0] > _BACKLOG_NS:
            self._backlog.popleft()

    def _send(self, message: Any) -> bytes:
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        if self._companion is not None:
            self._udp.sendto(frame, self._companion)
        return frame


def obey(stand_in: StandIn, command: Mapping[str, object]) -> dict[str, int] | None:
    """Carry out one control line; return the answer, None at the end.

    Raises:
        ConfigError: the command is not known.
    """
    match command:
        case {"advance_to_ns": int(at_ns)}:
            now_ns = stand_in.advance_to(at_ns)
            return {"at_ns": now_ns, "times_told": stand_in.n_times_told}
        case {"finish": True}:
            return None
    raise ConfigError(f"control: unknown command {json.dumps(command)}")


def run(options: StandInOptions) -> None:
    """Serve until told to finish, or until stdin ends."""
    options.out.mkdir(parents=True, exist_ok=True)
    if options.realtime:
        run_before_others()
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
        (options.out / "attitude.csv").open("w", buffering=1) as attitudes,
        (options.out / "received.jsonl").open("w", buffering=1) as received,
        selectors.DefaultSelector() as selector,
    ):
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        udp.bind(("127.0.0.1", 0))
        attitudes.write("at_ns,qw,qx,qy,qz\n")
        stand_in = StandIn(options, udp, attitudes, received)
        selector.register(udp, selectors.EVENT_READ)
        selector.register(sys.stdin.fileno(), selectors.EVENT_READ)
        _say({"port": udp.getsockname()[1]})
        unread = b""
        while True:
            ready = selector.select(stand_in.heartbeat_if_due())
            stand_in.receive()
            if not any(key.fileobj == sys.stdin.fileno() for key, _ in ready):
                continue
            read = os.read(sys.stdin.fileno(), _MAX_LINE_BYTES)
            if not read:
                return
            *lines, unread = (unread + read).split(b"\n")
            if len(unread) > _MAX_LINE_BYTES:
                raise ConfigError("control: a line is too long")
            for line in lines:
                answer = obey(stand_in, _command(line))
                if answer is None:
                    stand_in.receive()
                    return
                _say(answer)


def _command(line: bytes) -> Mapping[str, object]:
    try:
        command = json.loads(line)
    except ValueError as error:
        raise ConfigError(f"control: {error}") from error
    if not isinstance(command, dict):
        raise ConfigError(f"control: expected an object, got {command!r}")
    return command


def _say(answer: Mapping[str, int]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def main(arguments: list[str]) -> int:
    """Run from the command line; return the exit code."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m sitl.autopilots.stand_in CONFIG.json\n")
        return 2
    try:
        run(read_options(Path(arguments[0])))
    except ConfigError as error:
        sys.stderr.write(f"stand_in: {error}\n")
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Whoever steered us is gone.
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
