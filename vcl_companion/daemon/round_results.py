"""What a round ends with: a map that is flown on and handed out, or why there is none."""

from __future__ import annotations

import logging
from collections.abc import Callable

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.own_maps import OwnMaps
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.wire.messages import MapRefused

_log = logging.getLogger(__name__)


class RoundResults:
    """Takes what was built of a round.

    Args:
        group: who is told that there is no map.
        maps: the current map.
        own_maps: flies on what was built.
        send: sends a message to a peer.
        log: told of what was not.
    """

    def __init__(
        self,
        group: Group,
        maps: MapStore,
        own_maps: OwnMaps,
        send: Callable[[MapRefused, int], None],
        log: FlightLog,
    ) -> None:
        self._group = group
        self._maps = maps
        self._own_maps = own_maps
        self._send = send
        self._log = log

    async def decide(
        self, built: LandmarkMap | NoMap, instead_of: StoredMap | None, request_id: int
    ) -> None:
        """Fly on a map that was built and hand it out, or tell everybody why there is none.

        Args:
            built: what became of a round.
            instead_of: the map in use when it began; None for a first map.
            request_id: the round's.
        """
        if isinstance(built, LandmarkMap):
            refused = await self._own_maps.adopt(built, instead_of)
            if refused is None:
                return
            built = refused
        refusal = MapRefused.because(request_id, built.reason)
        for peer in self._group.peers:
            self._send(refusal, peer)
        self._note_no_map(built.reason)

    def _note_no_map(self, reason: str) -> None:
        """Note that a round gave no map; the one in use stays, if there is one."""
        if self._maps.current is not None:
            self._log.event("no update", reason)
            _log.warning("no update of the map: %s", reason)
            return
        if reason != self._maps.refusal:
            self._log.event("no map", reason)
            _log.warning("no map: %s", reason)
        self._maps.refuse(reason)
