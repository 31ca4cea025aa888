"""Maps put to use: made ready beside the event loop, flown on, written down, indexed further."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import made_or_no_map
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.usage import give_back_freed
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.pace import look_s

_log = logging.getLogger(__name__)

# A map that has stayed for so long is likely to stay: it is indexed by all detectors, before
# somebody is lost in it. In fast flight the next one comes sooner.
_STAYS_S = 3.0


class MapUse:
    """Makes maps ready, and has the drone fly on them.

    Args:
        group: whether somebody wants the map replaced.
        maps: the current map.
        log: told of every map flown on.
        work: does decoding and indexing.
        disk: runs the writing.
        passed: holds images that were sent ahead of their map.
        tell_state: tells peers which map we fly on.
        falls_back: whether maps are indexed by other detectors too, sooner or later.
    """

    def __init__(
        self,
        group: Group,
        maps: MapStore,
        log: FlightLog,
        work: MapWork,
        disk: Executor,
        passed: PassedFrames,
        tell_state: Callable[[], None],
        falls_back: bool,
    ) -> None:
        self._group = group
        self._maps = maps
        self._log = log
        self._work = work
        self._disk = disk
        self._passed = passed
        self._tell_state = tell_state
        self._falls_back = falls_back

    async def made_ready(self, offer: MapOffer) -> ReadyMap | NoMap:
        """Make a map ready for use, beside the event loop; or say why it cannot be used."""
        return await made_or_no_map(self._decoded(offer), "a map cannot be used", "using it failed")

    async def _decoded(self, offer: MapOffer) -> ReadyMap:
        """Make a map ready with those of its images that are here.

        Raises:
            WireError: the bytes are no map, or what they need is not here.
            ValueError: an image cannot be used, or the map is not determined.
        """
        current = self._maps.current
        return await self._work.ready(offer, current, offer.images_here(self._passed.held, current))

    async def fly_on(self, ready: ReadyMap) -> None:
        """Fly on a map from the next frame on; return when it is written down."""
        stored = self._maps.replace(
            ready.data, ready.index, ready.update, ready.templates, ready.part_of
        )
        n_keyframes = len(ready.index.landmark_map.keyframes)
        n_bytes = len(ready.data)
        self._log.map(stored.revision, stored.parent, stored.n_landmarks, n_bytes, n_keyframes)
        self._log.event("map", f"{stored.n_landmarks} landmarks in {n_keyframes} keyframes")
        _log.info("map %s: %d landmarks", stored.revision.hex(), stored.n_landmarks)
        self._tell_state()
        loop = asyncio.get_running_loop()
        loop.call_later(_STAYS_S, self._want_more_of, stored.revision)
        await loop.run_in_executor(self._disk, self._maps.keep, stored)
        await self._work.keep_only(stored)
        await loop.run_in_executor(self._disk, give_back_freed)

    def _want_more_of(self, revision: bytes) -> None:
        """Ask for the other detectors' indexes of a map that has stayed, now or a little later."""
        current = self._maps.current
        if current is None or current.revision != revision:
            return
        if self._group.maps.wanting_update:
            # It is about to be replaced, and the next one wants the processor now.
            asyncio.get_running_loop().call_later(_STAYS_S, self._want_more_of, revision)
            return
        self._maps.want_more()

    async def index_more(self) -> None:
        """Index the map in use by the other detectors when that is asked for, until cancelled.

        Once each: it takes as long as the map itself, and most revisions are never asked about.
        """
        while True:
            await self._maps.more_wanted()
            if self._falls_back:
                try:
                    await self._index_current()
                except Exception:
                    # Peers' images went in: none of them may end the flight.
                    _log.exception("the map cannot be indexed further")

    async def _index_current(self) -> None:
        # Not in the loop above, which would keep a map that was left until the next is asked for.
        stored = self._maps.current
        if stored is None or self._maps.is_improved:
            return
        # Image after image: who begins a map meanwhile waits for one of them at most.
        for number in range(len(stored.index.landmark_map.keyframes)):
            while self._maps_go_first():
                await asyncio.sleep(look_s(self._group.stretch))
                if not self._maps.is_in_use(stored):
                    return
            await self._work.look_further(stored, number)
            if not self._maps.is_in_use(stored):
                return  # what was found of its images the next one's index has as well
        self._maps.improve(stored, await self._work.more_indexed(stored))

    def _maps_go_first(self) -> bool:
        """Whether the next map, being made or about to be, wants the processor for itself.

        Where somebody is lost, ourselves or who wants it, the index may be what finds them.
        """
        group = self._group
        members = {group.own_id, *group.maps.wanting_update}
        states = [state for m in members if (state := group.state_of(m)) is not None]
        is_coming = bool(group.maps.wanting_update) or group.maps.is_map_coming
        return is_coming and all(state.localized for state in states)
