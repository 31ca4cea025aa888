"""What an autopilot hears of its companion, written down: a second opinion on every message."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from typing import Any, TextIO

from pymavlink.dialects.v20 import ardupilotmega as dialect

_MAX_DATAGRAM_BYTES = 65535


def datagrams(udp: socket.socket) -> Iterator[tuple[bytes, tuple[str, int]]]:
    """Yield what has arrived at a socket, and from where; waits for nothing."""
    while True:
        try:
            data, sender = udp.recvfrom(_MAX_DATAGRAM_BYTES, socket.MSG_DONTWAIT)
        except BlockingIOError:
            return
        yield data, sender


class Hearing:
    """Decodes a companion's datagrams and keeps them, one JSON line a message.

    Args:
        received: where the lines go.
    """

    def __init__(self, received: TextIO) -> None:
        self._received = received

    def of(self, data: bytes, at_ns: int | None) -> list[Any]:
        """Return pymavlink's messages of a datagram that came at an instant of the recording."""
        # A parser of its own for each datagram: no rest of one can spoil the next.
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        messages = parser.parse_buffer(data) or []
        for message in messages:
            self._write(message, at_ns)
        return [message for message in messages if message.get_type() != "BAD_DATA"]

    def _write(self, message: Any, at_ns: int | None) -> None:
        kind = message.get_type()
        fields = {key: value for key, value in message.to_dict().items() if key != "mavpackettype"}
        if kind == "BAD_DATA" or kind.startswith("UNKNOWN"):
            fields = {"bytes": bytes(message.data).hex(), "reason": str(fields.get("reason", ""))}
        line = {
            "arrived_at_ns": at_ns,
            "arrived_monotonic_ns": time.monotonic_ns(),
            "system": message.get_srcSystem(),
            "component": message.get_srcComponent(),
            "type": kind,
            "fields": fields,
        }
        self._received.write(json.dumps(line) + "\n")
