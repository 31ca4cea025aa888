"""The map in use for who has none that it was made from, but some of its images.

Who flew apart from us has those of the map from before, and of its own where that was merged into
ours; who has missed a revision, nearly all. Images are most of a map.
"""

from __future__ import annotations

import asyncio
import logging

from vcl_companion.daemon.map_offer import HandOut
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.wire.map_update import images_in_update, without_images

_log = logging.getLogger(__name__)


class StandaloneMap:
    """Has that form made, of one revision at a time.

    Args:
        maps: the current map.
        work: makes it.
    """

    def __init__(self, maps: MapStore, work: MapWork) -> None:
        self._maps = maps
        self._work = work
        self._made: tuple[bytes, bytes] = (b"", b"")  # a revision, and the form; empty: it has none
        self._images: frozenset[bytes] = frozenset()
        self._wanted = asyncio.Event()

    def without(self, stored: HandOut, held: frozenset[bytes]) -> bytes | None:
        """Return a map without some images; empty where it has none of them.

        None while it is being made; not before the map is in use, as it soon is.

        Args:
            stored: the map.
            held: names of the images.
        """
        if not held:
            return b""
        if self._made[0] != stored.revision:
            self._wanted.set()
            return None
        shorter = held & self._images
        return without_images(self._made[1], shorter) if shorter else b""

    async def run(self) -> None:
        """Make what is wanted until cancelled."""
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            stored = self._maps.current
            if stored is None or stored.part_of or stored.revision == self._made[0]:
                continue
            try:
                standalone = await self._work.standalone(stored)
                images = images_in_update(standalone)
            except Exception:
                # Peers' images and numbers went in: none of them may end the flight.
                _log.exception("no map for who has some of its images can be made")
                standalone, images = b"", frozenset()
            self._made, self._images = (stored.revision, standalone), images
