"""Where things wait for the one who takes them: fresh beats complete, nothing piles up."""

from __future__ import annotations

import asyncio
from typing import Generic, TypeVar

from vcl_companion.cameras.source import Frame

_Item = TypeVar("_Item")


class Mailbox:
    """Holds the newest frame until somebody takes it."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._newest: Frame | None = None
        self._filled = asyncio.Event()

    def put(self, frame: Frame) -> Frame | None:
        """Leave a frame; return the older one whose place it took, if one was still there."""
        replaced, self._frame = self._frame, frame
        self._newest = frame
        self._filled.set()
        return replaced

    def has_had_newer(self, frame: Frame) -> bool:
        """Whether a frame has come after one that was here, taken since or not."""
        return self._newest is not frame

    async def newer_than(self, frame: Frame) -> None:
        """Wait until a frame has come after one that was here; leave it."""
        while not self.has_had_newer(frame):
            self._filled.clear()
            await self._filled.wait()

    async def take(self) -> Frame:
        """Wait for a frame and take it out; of several takers one gets it."""
        while self._frame is None:
            self._filled.clear()
            await self._filled.wait()
        frame, self._frame = self._frame, None
        return frame


class FramesBehind(Generic[_Item]):
    """Holds frames that came while an older one is looked for, in their order.

    From where that one is found they are followed to the newest one. Of too many every second
    is let go: what is left is still not far apart.

    Args:
        at_most: so many.
    """

    def __init__(self, at_most: int) -> None:
        self._at_most = at_most
        self._frames: list[tuple[Frame, _Item]] = []

    def keep(self, frame: Frame, why: _Item) -> list[tuple[Frame, _Item]]:
        """Keep a frame and why it waits; return those that were let go for it."""
        self._frames.append((frame, why))
        self._frames.sort(key=lambda kept: kept[0].captured_at_ns)
        if len(self._frames) <= self._at_most:
            return []
        let_go, self._frames = self._frames[1::2], self._frames[::2]
        return let_go

    def take(self) -> tuple[Frame, _Item] | None:
        """Take the oldest one out; None when there is none."""
        return self._frames.pop(0) if self._frames else None


class PeerMailbox(Generic[_Item]):
    """Holds the newest thing of each peer; peers are served in turn.

    However much a peer sends, one item of it waits: the work that peers can
    cause is bounded by how fast it is taken.
    """

    def __init__(self) -> None:
        self._items: dict[int, _Item] = {}
        self._later: dict[int, asyncio.TimerHandle] = {}
        self._filled = asyncio.Event()

    def put(self, peer: int, item: _Item) -> None:
        """Leave something of a peer, in the place of what it had left before."""
        if peer in self._later:
            self._later.pop(peer).cancel()
        self._items[peer] = item
        self._filled.set()

    def put_later(self, peer: int, item: _Item, in_s: float) -> None:
        """Leave it when so long has passed, unless the peer has left something newer by then."""
        if peer not in self._items:
            loop = asyncio.get_running_loop()
            self._later[peer] = loop.call_later(in_s, self.put, peer, item)

    async def take(self) -> tuple[int, _Item]:
        """Wait for something, and take out what came from the peer that waits longest."""
        while not self._items:
            self._filled.clear()
            await self._filled.wait()
        peer = next(iter(self._items))
        return peer, self._items.pop(peer)
