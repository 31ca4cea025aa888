"""Maps of our own: made here, or saved in an earlier flight; flown on as peers will read them."""

from __future__ import annotations

import asyncio
from dataclasses import replace

from vcl_companion.daemon.map_branches import MapBranches, way_into
from vcl_companion.daemon.map_handing import MapHanding
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_use import MapUse
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import made_or_no_map
from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import BlobKind


class OwnMaps:
    """Has us fly on maps that no peer has given us.

    Args:
        group: who we are.
        maps: the current map.
        work: encodes what was made.
        branches: told that the map in use is of our own.
        handing: hands out what was made while it is made ready here.
        use: makes it ready, and flies on it.
    """

    def __init__(
        self,
        group: Group,
        maps: MapStore,
        work: MapWork,
        branches: MapBranches,
        handing: MapHanding,
        use: MapUse,
    ) -> None:
        self._group = group
        self._maps = maps
        self._work = work
        self._branches = branches
        self._handing = handing
        self._use = use
        # One goes to peers ahead at a time, and nobody is given what is late already.
        self._adopting = asyncio.Lock()

    async def adopt(self, built: LandmarkMap, instead_of: StoredMap | None) -> NoMap | None:
        """Fly on a map that was made here, exactly as peers will decode it, and hand it out.

        Args:
            built: a first map, or a revision of the one in use.
            instead_of: the map in use when it was begun; None for a first map.

        Returns:
            None, or why it cannot be used. A map that came meanwhile stays.
        """
        async with self._adopting:
            if not self._maps.is_in_use(instead_of):
                return None
            return await self._adopt(built, instead_of)

    async def _adopt(self, built: LandmarkMap, instead_of: StoredMap | None) -> NoMap | None:
        ahead = await made_or_no_map(
            self._work.encoded(built, instead_of), "a map cannot be encoded", "encoding it failed"
        )
        if isinstance(ahead, NoMap):
            return ahead
        self._handing.ahead = ahead
        try:
            offer = MapOffer.of(BlobKind.MAP, ahead.data)
            ready = await self._use.made_ready(replace(offer, update=ahead.update))
        finally:
            self._handing.ahead = None
        if isinstance(ready, NoMap):
            return ready
        if self._maps.is_in_use(instead_of):
            await self._fly_on(ready)
        return None

    async def go_back_to(self, data: bytes) -> str:
        """Fly on a map that was saved; return why it cannot be used, or nothing.

        Not on one of another world than ours, which poses that are under way are in.
        """
        try:
            offer = MapOffer.of(BlobKind.MAP, data)
        except WireError as error:
            return str(error)
        current = self._maps.current
        if current is not None and current.revision == offer.revision:
            return ""
        ready = await self._use.made_ready(offer)
        if isinstance(ready, NoMap):
            return ready.reason
        current = self._maps.current
        new = ready.index.landmark_map
        if current is not None and way_into(current, new, offer.revision) is not None:
            return "it is of another world than the map in use"
        await self._fly_on(ready)
        return ""

    async def _fly_on(self, ready: ReadyMap) -> None:
        self._branches.given_by(self._group.own_id)
        await self._use.fly_on(ready)
