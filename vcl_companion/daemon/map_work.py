"""The workshop as the event loop sees it: in a process of its own, and never waited for."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from typing import Any

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.forked import Forked, ProcessLostError
from vcl_companion.daemon.map_offer import HandOut, MapOffer, ReadyMap
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.worker import Worker
from vcl_companion.daemon.workshop import NotHereError, OwnImage, Workshop
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.detail import Detail
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.inter import NoProposal, Proposal
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.localization.pipeline import Effort
from vcl_companion.mapping.given_depths import SceneDepth
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.local_map import LocalMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.mapping.seen_landmarks import SeenLandmarks
from vcl_companion.vision.features import Image
from vcl_companion.wire.frame_codec import FrameAnswer

_log = logging.getLogger(__name__)

_FIRST, _MAPS, _IMAGES, _FRAMES, _PEERS = "first", "maps", "images", "frames", "peers"
_OWN, _SPARE = "own", "spare"
# Niceness of each above the frames that are followed. Who leaves the map's sight goes on by what is
# made of the last frames, in a thirtieth of a second: at once. Who is lost leaves the map that will
# show where as much time as it takes; with half of these peers would get half of the machine's.
# Without the whole of a map nothing goes before it; for others who have none ours goes as our
# images do. An index of another kind, five seconds' work that only who is lost waits for, comes
# last, but is no nicer than that: a thread that gets no processor while it holds the
# interpreter's lock holds up all others (of 19, for a hundred milliseconds at a time).
_LANES = {_FIRST: 2, _OWN: 2, _MAPS: 8, _IMAGES: 4, _FRAMES: 8, _PEERS: 12, _SPARE: 12}


class MapWork:
    """Has a workshop do things; each method waits for what its namesake returns or raises.

    Args:
        workshop: what does it.
        forks: whether in a process of its own, which begins now: no other thread may be at
            work. Should it be lost, or with False, threads of this process do the work.
        realtime: whether the frames beside go before other programs; see ``Forked``.
    """

    def __init__(self, workshop: Workshop, *, forks: bool, realtime: bool = False) -> None:
        self._workshop = workshop
        self._process = Forked(workshop, _LANES, realtime=realtime) if forks else None
        self._threads: dict[str, Worker] = {}

    async def encode(self, image: Image, quality: int, most_bytes: int) -> bytes:
        """See ``Workshop``."""
        data: bytes = await self._do(_IMAGES, "encode", image, quality, most_bytes)
        return data

    async def encode_keyframe(self, image: Image, most_bytes: int, detail: Detail) -> bytes:
        """See ``Workshop``."""
        data: bytes = await self._do(_IMAGES, "encode_keyframe", image, most_bytes, detail)
        return data

    async def seen(self, image: Image, stored: StoredMap, where: Prior) -> SeenLandmarks | None:
        """See ``Workshop``."""
        seen: SeenLandmarks | None = await self._do_with(
            stored, _IMAGES, "seen", image, stored.revision, where
        )
        return seen

    async def signature(self, image: Image) -> bytes:
        """See ``Workshop``."""
        signature: bytes = await self._do(_PEERS, "signature", image)
        return signature

    async def local_map(
        self, views: list[OwnImage], covariance: Array, drone_id: int, scene: SceneDepth
    ) -> LocalMap | NoMap:
        """See ``Workshop``."""
        made: LocalMap | NoMap = await self._do(
            _OWN, "local_map", views, covariance, drone_id, scene
        )
        return made

    async def look_at(self, frame: FrameAnswer) -> None:
        """See ``Workshop``."""
        await self._do(_MAPS, "look_at", frame)

    async def first_map(self, frames: list[FrameAnswer], leader: int) -> LandmarkMap | NoMap:
        """See ``Workshop``."""
        built: LandmarkMap | NoMap = await self._do(_MAPS, "first_map", frames, leader)
        return built

    async def next_revision(
        self, stored: StoredMap, frames: list[FrameAnswer], *, at_once: bool
    ) -> LandmarkMap | NoMap:
        """See ``Workshop``."""
        built: LandmarkMap | NoMap = await self._do_with(
            stored, _MAPS, "next_revision", stored.revision, frames, at_once
        )
        return built

    async def merged(
        self, stored: StoredMap, offer: MapOffer, held: Mapping[bytes, bytes]
    ) -> LandmarkMap | NoMap:
        """See ``Workshop``."""
        built: LandmarkMap | NoMap = await self._do_with(
            stored, _MAPS, "merged", stored.revision, offer, held
        )
        return built

    async def encoded(self, built: LandmarkMap, parent: StoredMap | None) -> HandOut:
        """See ``Workshop``."""
        name = b"" if parent is None else parent.revision
        encoded: HandOut = await self._do_with(parent, _MAPS, "encoded", built, name)
        return encoded

    async def part(self, stored: StoredMap, most_bytes: int) -> bytes:
        """See ``Workshop``."""
        part: bytes = await self._do_with(stored, _IMAGES, "part", stored.revision, most_bytes)
        return part

    async def rest(self, stored: StoredMap, part: bytes) -> bytes:
        """See ``Workshop``."""
        rest: bytes = await self._do_with(stored, _IMAGES, "rest", stored.revision, part)
        return rest

    async def standalone(self, stored: StoredMap) -> bytes:
        """See ``Workshop``."""
        made: bytes = await self._do_with(stored, _IMAGES, "standalone", stored.revision)
        return made

    async def ready(
        self, offer: MapOffer, current: StoredMap | None, held: Mapping[bytes, bytes]
    ) -> ReadyMap:
        """See ``Workshop``."""
        name = b"" if current is None else current.revision
        lane = _FIRST if current is None or current.part_of else _MAPS
        ready: ReadyMap = await self._do_with(current, lane, "ready", offer, name, held)
        return ready

    async def keep_only(self, stored: StoredMap) -> None:
        """See ``Workshop``."""
        await self._do(_MAPS, "keep_only", stored.revision)

    async def look_further(self, stored: StoredMap, number: int) -> None:
        """See ``Workshop``."""
        await self._do_with(stored, _SPARE, "look_further", stored.revision, number)

    async def more_indexed(self, stored: StoredMap) -> MapIndex:
        """See ``Workshop``."""
        index: MapIndex = await self._do_with(stored, _SPARE, "more_indexed", stored.revision)
        return index.of_the_same_map(stored.index)

    async def find(
        self,
        image: Image,
        stored: StoredMap,
        prior: Prior | None,
        ned_from_body: Array | None,
        effort: Effort,
    ) -> Localized | NotLocalized:
        """See ``Workshop``."""
        found: Localized | NotLocalized = await self._do_with(
            stored, _FRAMES, "find", image, stored.revision, prior, ned_from_body, effort
        )
        return found

    async def place_of_peer(
        self, frame: Frame, state: FilterState, stored: StoredMap, seen: FrameAnswer
    ) -> Proposal | NoProposal:
        """See ``Workshop``."""
        said: Proposal | NoProposal = await self._do_with(
            stored, _PEERS, "place_of_peer", frame, state, stored.revision, seen
        )
        return said

    def pid(self) -> int | None:
        """Return the process's id; None where there is none, or it was lost."""
        return None if self._process is None else self._process.pid

    def end(self) -> float:
        """Stop working, whatever is under way; return the process's time of a processor, s."""
        for thread in self._threads.values():
            thread.shutdown(wait=False, cancel_futures=True)
        if self._process is None:
            return 0.0
        cpu_s = self._process.cpu_s()
        self._process.end()
        return cpu_s

    def ends_with(self, exit_status: int) -> None:
        """Say what a process ends with whose threads still work; see ``Worker``."""
        for thread in self._threads.values():
            thread.exit_status = exit_status

    async def _do_with(
        self, stored: StoredMap | None, lane: str, method: str, *args: object
    ) -> Any:
        """Have something done with a map, which is handed over if it is not there."""
        while True:
            try:
                return await self._do(lane, method, *args)
            except NotHereError:
                # It may have had to go again by then, for a newer one.
                await self._do(lane, "learn", stored)

    async def _do(self, lane: str, method: str, *args: object) -> Any:
        process = self._process
        if process is not None:
            try:
                return await asyncio.wrap_future(process.call(lane, method, *args))
            except ProcessLostError:
                if self._process is process:
                    _log.error("the process that makes maps was lost; threads go on with it")
                    self._process = None
                    process.end()
        if lane not in self._threads:
            self._threads[lane] = Worker(lane, _LANES[lane])
        do = getattr(self._workshop, method)
        return await asyncio.get_running_loop().run_in_executor(self._threads[lane], do, *args)
