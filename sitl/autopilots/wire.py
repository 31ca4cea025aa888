"""Our end of a firmware's MAVLink port: UDP on 127.0.0.1, to wherever it speaks from."""

from __future__ import annotations

import select
import socket
from collections.abc import Iterator
from contextlib import ExitStack

from sitl.autopilots.hearing import datagrams
from sitl.autopilots.steered import open_udp


class Wire:
    """What a firmware says to, and is told from."""

    def __init__(self, stack: ExitStack) -> None:
        self.socket: socket.socket = stack.enter_context(open_udp())
        self.port = int(self.socket.getsockname()[1])
        self._firmware_at: tuple[str, int] | None = None

    @property
    def is_open(self) -> bool:
        """Whether it has spoken."""
        return self._firmware_at is not None

    def wait(self, seconds: float) -> None:
        """Wait until it says something, for so long at most."""
        select.select([self.socket], [], [], seconds)

    def write(self, frame: bytes) -> None:
        """Send a frame to the firmware; one that has not spoken yet cannot be reached."""
        if self._firmware_at is not None:
            self.socket.sendto(frame, self._firmware_at)

    def read(self) -> Iterator[bytes]:
        """Yield what it has said by now; waits for nothing."""
        for data, sender in datagrams(self.socket):
            self._firmware_at = sender
            yield data
