"""What a frame that cannot be placed yet waits for, and that no newer frame has to wait with it."""

from __future__ import annotations

import asyncio
import weakref
from collections.abc import Coroutine

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.mailbox import Mailbox
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.localization.fix import NotLocalized


class FrameWaits:
    """Waits for maps and else on behalf of a frame, as long as it is the newest.

    Args:
        mailbox: knows of newer frames.
        maps: the current map.
        health: told while a frame waits for a map.
        frame_wait_s: how long a frame that the map does not know waits for the next
            map, which it may have gone into itself.
    """

    def __init__(
        self, mailbox: Mailbox, maps: MapStore, health: Health, frame_wait_s: float
    ) -> None:
        self._mailbox = mailbox
        self._maps = maps
        self._health = health
        self._frame_wait_s = frame_wait_s
        self._over = asyncio.Event()
        # A map that may have been left since, which is not to be kept in memory for that.
        self._vain: weakref.ref[StoredMap] | None = None

    def stream_is_over(self) -> None:
        """Wait no more: no frame is to come that could be placed by what is waited for."""
        self._over.set()

    async def first_map(self, frame: Frame) -> None:
        """Wait for a first map as long as no newer frame comes."""
        with self._health.waiting_for_map():
            await self.unless_newer(frame, self._maps.decided())

    def no_map(self) -> NotLocalized:
        """Return why a frame is refused that there was no map for."""
        ended = "the camera's stream is over" if self._over.is_set() else "none yet"
        return NotLocalized(f"no map: {self._maps.refusal or ended}")

    async def next_map(self, frame: Frame, stored: StoredMap | None) -> StoredMap | None:
        """Wait for a map that may know a place which this one does not, while no frame comes.

        A frame that is not recognised shows where the map has a gap, and is among those that
        fill it. Where none came in time for one frame the next ones do not wait.

        Args:
            frame: which.
            stored: the map that does not know it; None for one that has been left since.
        """
        if stored is None or self._maps.current is not stored:
            return self._maps.current
        if self._vain is None or self._vain() is not stored:
            with self._health.waiting_for_map():
                await self.unless_newer(frame, self._maps.newer_than(stored), self._frame_wait_s)
            if self._maps.current is stored and not self._mailbox.has_had_newer(frame):
                self._vain = weakref.ref(stored)
        return None if self._maps.current is stored else self._maps.current

    async def unless_newer(
        self,
        frame: Frame,
        awaited: Coroutine[None, None, object],
        within_s: float | None = None,
    ) -> None:
        """Wait for something, until a newer frame comes or the stream is over."""
        waiting = [
            asyncio.ensure_future(one)
            for one in (awaited, self._mailbox.newer_than(frame), self._over.wait())
        ]
        try:
            await asyncio.wait(waiting, timeout=within_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for one in waiting:
                one.cancel()
