"""What is built of a round's frames: a map, or the reason why there is none."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable

from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.wire.frame_codec import FrameAnswer

_log = logging.getLogger(__name__)


class RoundBuilding:
    """Has maps built of frames that were gathered; where they were not, the reason stays.

    Args:
        work: does the building.
    """

    def __init__(self, work: MapWork) -> None:
        self._work = work

    async def first_map(
        self, frames: list[FrameAnswer] | NoMap, origin: int
    ) -> LandmarkMap | NoMap:
        """Build a first map, whose world begins at the body of the drone ``origin``."""
        if isinstance(frames, NoMap):
            return frames
        return await _built(len(frames), self._work.first_map(frames, origin))

    async def next_revision(
        self, stored: StoredMap, frames: list[FrameAnswer] | NoMap, *, at_once: bool
    ) -> LandmarkMap | NoMap:
        """Extend a map; ``at_once`` by its patches alone, else by features as well."""
        if isinstance(frames, NoMap):
            return frames
        building = self._work.next_revision(stored, frames, at_once=at_once)
        return await _built(len(frames), building)


async def _built(n_frames: int, building: Awaitable[LandmarkMap | NoMap]) -> LandmarkMap | NoMap:
    began_s = asyncio.get_running_loop().time()
    try:
        built = await building
        took_s = asyncio.get_running_loop().time() - began_s
        _log.info("%d frames built into a map in %.1f s", n_frames, took_s)
        return built
    except Exception as error:
        # Peers' images and numbers went in: none of them may end the flight.
        _log.exception("a map cannot be built")
        return NoMap(f"building failed: {type(error).__name__}")
