"""What an autopilot says to its companion: whole frames, and those that a late one has missed."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

# What a companion that connects late is given of the stream it missed.
_BACKLOG_NS = 1_000_000_000


def packed(message: Any, sender: Any) -> bytes:
    """Return a message's frame, counted by pymavlink's sender."""
    frame = bytes(message.pack(sender))
    sender.seq = (sender.seq + 1) % 256
    return frame


class Backlog:
    """The frames of the last second."""

    def __init__(self) -> None:
        self._frames: deque[tuple[int, bytes]] = deque()

    def add(self, at_ns: int, frame: bytes) -> None:
        """Keep a frame that was said at an instant, and let those go that are too old by then."""
        self._frames.append((at_ns, frame))
        while at_ns - self._frames[0][0] > _BACKLOG_NS:
            self._frames.popleft()

    def __iter__(self) -> Iterator[bytes]:
        """Yield them, oldest first."""
        return (frame for _, frame in self._frames)
