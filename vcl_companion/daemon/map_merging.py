"""Merging a map that went apart from ours into ours, beside the rounds that extend it."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Mapping
from contextlib import suppress

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_branches import MapBranches
from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import BadBytes, made_or_no_map
from vcl_companion.daemon.own_maps import OwnMaps
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap

_log = logging.getLogger(__name__)

_BETWEEN_MERGES_S = 0.5
# A round that ours is being updated in is let end before ours is merged, but not for longer.
_ROUND_S, _LOOK_S = 5.0, 0.05
# Ours changes while it is merged with another one, but hardly so often.
_MERGE_ATTEMPTS = 3
# After a map that brought nothing its peer's next one waits, longer each time: ours is not extended
# meanwhile. Honest drones run into it as well, who see another place: it speaks against nobody.
_FIRST_WAIT_S, _LONGEST_WAIT_S = 2.0, 32.0
# And of the time no more than a quarter goes by with such maps of one peer.
_WAIT_FOR_WORK = 3.0


class MapMerging:
    """Makes our next revision of ours and a peer's, one peer's at a time.

    Args:
        maps: the current map.
        log: told of every attempt.
        work: does the merging.
        branches: told what came of it.
        own_maps: flies on what was made.
        is_updating: whether a round of ours is under way that updates the map.
        bad_bytes: told of a peer's that are no map, and why.

    Attributes:
        is_under_way: whether another map is being merged into ours.
    """

    def __init__(
        self,
        maps: MapStore,
        log: FlightLog,
        work: MapWork,
        branches: MapBranches,
        own_maps: OwnMaps,
        is_updating: Callable[[], bool],
        bad_bytes: Callable[[int, str], None],
    ) -> None:
        self._maps = maps
        self._log = log
        self._work = work
        self._branches = branches
        self._own_maps = own_maps
        self._is_updating = is_updating
        self._bad_bytes = bad_bytes
        self.is_under_way = False
        self._in_vain: dict[int, int] = {}  # how often in a row, of each peer
        self._next_at_s: dict[int, float] = {}

    def wait_s(self, peer: int) -> float:
        """Return for how long no map of a peer is merged; not above 0 if one may be now."""
        return self._next_at_s.get(peer, -math.inf) - asyncio.get_running_loop().time()

    async def merge(self, peer: int, offer: MapOffer, held: Mapping[bytes, bytes]) -> bool:
        """Make our next revision of ours and a peer's that went apart; whether that was done.

        Args:
            peer: who offers it.
            offer: the map.
            held: images that it takes us to hold, by their names.
        """
        self.is_under_way = True
        loop = asyncio.get_running_loop()
        try:
            await self._round_is_over()
            began_s, before = loop.time(), self._images()
            is_merged = await self._merge_into_current(peer, offer, held)
            has_new = is_merged and not self._images() <= before
            self._note(peer, loop.time() - began_s, brought=has_new)
        finally:
            self.is_under_way = False
        # Whoever offers one after the other does not keep ours from being extended.
        await asyncio.sleep(_BETWEEN_MERGES_S)
        return is_merged

    def _note(self, peer: int, took_s: float, *, brought: bool) -> None:
        """Have a peer's next map wait, by what came of this one and what it took."""
        wait_s = took_s
        if brought:
            self._in_vain.pop(peer, None)
        else:
            n_before = self._in_vain.get(peer, 0)
            self._in_vain[peer] = n_before + 1
            longer_s = _FIRST_WAIT_S * 2.0 ** min(n_before, 30)
            wait_s = max(min(longer_s, _LONGEST_WAIT_S), _WAIT_FOR_WORK * took_s)
        self._next_at_s[peer] = asyncio.get_running_loop().time() + wait_s

    def _images(self) -> frozenset[bytes]:
        """Return the images of the map in use."""
        current = self._maps.current
        keyframes = () if current is None else current.index.landmark_map.keyframes
        return frozenset(keyframe.image_bytes for keyframe in keyframes)

    async def _round_is_over(self) -> None:
        """Wait for the round that is under way: merged with what it replaces, all would be in vain.

        Another one does not begin meanwhile.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(_ROUND_S):
                while self._is_updating():
                    await asyncio.sleep(_LOOK_S)

    async def _merge_into_current(
        self, peer: int, offer: MapOffer, held: Mapping[bytes, bytes]
    ) -> bool:
        """Merge a peer's map into whichever is in use, again where that changes meanwhile."""
        self._log.event("merge", f"map {offer.revision.hex()} of drone {peer} into ours")
        made: LandmarkMap | NoMap = NoMap("ours changed meanwhile, again and again")
        for _ in range(_MERGE_ATTEMPTS):
            current = self._maps.current
            if current is None:
                break
            made = await made_or_no_map(
                self._work.merged(current, offer, held), "a map cannot be merged", "merging failed"
            )
            if isinstance(made, LandmarkMap):
                made = await self._own_maps.adopt(made, current) or made
            if isinstance(made, NoMap):
                break
            now = self._maps.current
            if now is not None and now.parent == current.revision and now.has_in_it(offer.revision):
                now_s = asyncio.get_running_loop().time()
                self._branches.merged(peer, offer.revision, offer.images(), now_s)
                self._log.event("merged", f"map {offer.revision.hex()} of drone {peer}")
                _log.info("the map of drone %d is merged into ours", peer)
                return True
        if isinstance(made, BadBytes):
            self._bad_bytes(peer, made.reason)
        reason = made.reason if isinstance(made, NoMap) else "ours changed meanwhile"
        self._branches.refused(offer.revision)
        self._log.event("not merged", f"map of drone {peer}: {reason}")
        _log.warning("the map of drone %d is not merged into ours: %s", peer, reason)
        return False
