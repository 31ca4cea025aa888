"""One place for one frame: fresh beats complete."""

from __future__ import annotations

import asyncio

from vcl_companion.cameras.source import Frame


class Mailbox:
    """Holds the newest frame until somebody takes it."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._filled = asyncio.Event()

    def put(self, frame: Frame) -> Frame | None:
        """Leave a frame; return the older one whose place it took, if one was still there."""
        replaced, self._frame = self._frame, frame
        self._filled.set()
        return replaced

    async def filled(self) -> None:
        """Wait until a frame is here; leave it."""
        while self._frame is None:
            self._filled.clear()
            await self._filled.wait()

    async def take(self) -> Frame:
        """Wait for a frame and take it out; one taker at a time."""
        await self.filled()
        if self._frame is None:
            raise RuntimeError("two takers at one mailbox")
        frame, self._frame = self._frame, None
        return frame
