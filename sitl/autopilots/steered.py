"""What stands for an autopilot in a flight: a process whose time is moved on by JSON lines.

    stdout {"port": P}              ready; the companion sends to 127.0.0.1:P
    stdin  {"advance_to_ns": t}     send what is due up to t
    stdout {"at_ns": t, "times_told": n}
                                    all of it has been handed to the kernel; n
                                    TIMESYNC questions answered so far; of one that
                                    flies by itself "pose" [x, y, z, qw, qx, qy, qz],
                                    ned_from_body then, "mission", how far it has come,
                                    "is_over" and "trouble" as well
    stdin  {"finish": true}         write what was heard and end

The end of stdin ends it as well.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from vcl_companion.errors import ConfigError

_MAX_LINE_BYTES = 65536
_RECEIVE_BUFFER_BYTES = 1 << 20


class Steered(Protocol):
    """An autopilot, or what stands for one, whose time is a recording's."""

    n_times_told: int

    def advance_to(self, until_ns: int) -> int:
        """Send what is due up to an instant of the recording; return the time it is then."""
        ...

    def state(self, at_ns: int) -> Mapping[str, object]:
        """Return what else there is to say of the instant that it was moved on to last."""
        ...

    def receive(self) -> None:
        """Take in every datagram that has arrived."""
        ...

    def heartbeat_if_due(self) -> float:
        """Say that the process lives when it is time to; return the seconds to the next time."""
        ...


def open_udp() -> socket.socket:
    """Return a socket of 127.0.0.1 that holds what comes while nobody looks."""
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
    udp.bind(("127.0.0.1", 0))
    return udp


def serve(autopilot: Steered, udp: socket.socket, *others: socket.socket) -> None:
    """Obey what comes on stdin until told to finish, or until that ends.

    Args:
        autopilot: what is steered.
        udp: the companion's end of it.
        others: sockets at which it takes in what arrives as well.

    Raises:
        ConfigError: a line is no command.
    """
    with selectors.DefaultSelector() as selector:
        for one in (udp, *others):
            selector.register(one, selectors.EVENT_READ)
        selector.register(sys.stdin.fileno(), selectors.EVENT_READ)
        _say({"port": udp.getsockname()[1]})
        unread = b""
        while True:
            ready = selector.select(autopilot.heartbeat_if_due())
            autopilot.receive()
            if not any(key.fileobj == sys.stdin.fileno() for key, _ in ready):
                continue
            read = os.read(sys.stdin.fileno(), _MAX_LINE_BYTES)
            if not read:
                return
            *lines, unread = (unread + read).split(b"\n")
            if len(unread) > _MAX_LINE_BYTES:
                raise ConfigError("control: a line is too long")
            for line in lines:
                answer = _obey(autopilot, _command(line))
                if answer is None:
                    autopilot.receive()
                    return
                _say(answer)


def run_steered(name: str, arguments: list[str], run: Callable[[Path], None]) -> int:
    """Run such a process from its command line; return the exit code."""
    if len(arguments) != 1:
        sys.stderr.write(f"usage: python -m sitl.autopilots.{name} CONFIG.json\n")
        return 2
    try:
        run(Path(arguments[0]))
    except ConfigError as error:
        sys.stderr.write(f"{name}: {error}\n")
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Whoever steered us is gone.
        return 1
    return 0


def _obey(autopilot: Steered, command: Mapping[str, object]) -> dict[str, object] | None:
    """Carry out one control line; return the answer, None at the end."""
    match command:
        case {"advance_to_ns": int(at_ns)}:
            now_ns = autopilot.advance_to(at_ns)
            told = {"at_ns": now_ns, "times_told": autopilot.n_times_told}
            return {**told, **autopilot.state(now_ns)}
        case {"finish": True}:
            return None
    raise ConfigError(f"control: unknown command {json.dumps(command)}")


def _command(line: bytes) -> Mapping[str, object]:
    try:
        command = json.loads(line)
    except ValueError as error:
        raise ConfigError(f"control: {error}") from error
    if not isinstance(command, dict):
        raise ConfigError(f"control: expected an object, got {command!r}")
    return command


def _say(answer: Mapping[str, object]) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()
