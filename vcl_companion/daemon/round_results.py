"""What a round ends with: a map that is flown on and handed out, or why there is none."""

from __future__ import annotations

import logging
from collections.abc import Callable

from vcl_companion.clock import Clock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.own_maps import OwnMaps
from vcl_companion.links.texts import Severity
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.wire.messages import MapRefused

_log = logging.getLogger(__name__)

# Who hovers where distances are known stays there for a while; whoever took off meanwhile did not.
_LONG_TRIED_NS = 10_000_000_000


class RoundResults:
    """Takes what was built of a round.

    Args:
        group: who is told that there is no map.
        maps: the current map.
        own_maps: flies on what was built.
        send: sends a message to a peer.
        log: told of what was not.
        announce: tells the ground.
        clock: how long a first map has been tried.
    """

    def __init__(
        self,
        group: Group,
        maps: MapStore,
        own_maps: OwnMaps,
        send: Callable[[MapRefused, int], None],
        log: FlightLog,
        announce: Callable[[Severity, str], None],
        clock: Clock,
    ) -> None:
        self._group = group
        self._maps = maps
        self._own_maps = own_maps
        self._send = send
        self._log = log
        self._announce = announce
        self._clock = clock
        self._tried_since_ns: int | None = None  # a first map, in vain

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
                if instead_of is None:
                    self._note_first_map()
                return
            built = refused
        refusal = MapRefused.because(request_id, built.reason)
        for peer in self._group.peers:
            self._send(refusal, peer)
        self._note_no_map(built.reason)

    def _note_first_map(self) -> None:
        """Warn where a first map came late: its scale is of distances that may be over by now."""
        if self._tried_since_ns is None:
            return
        waited_ns = self._clock.now_ns() - self._tried_since_ns
        if waited_ns < _LONG_TRIED_NS:
            return
        waited = f"{waited_ns / 1e9:.0f} s"
        reason = (
            f"tried for {waited}, and its scale is of swarm.known_distances: if the drones were "
            "not at these any more, put them there and restart the service"
        )
        self._log.event("late first map", reason)
        _log.warning("a first map, late: %s", reason)
        self._announce(Severity.WARNING, f"VCL scale unsure: first map tried for {waited}")

    def _note_no_map(self, reason: str) -> None:
        """Note that a round gave no map; the one in use stays, if there is one."""
        if self._maps.current is not None:
            self._log.event("no update", reason)
            _log.warning("no update of the map: %s", reason)
            return
        # Known distances are those of drones that are there.
        if self._tried_since_ns is None and set(self._group.measured) <= set(self._group.teammates):
            self._tried_since_ns = self._clock.now_ns()
        if reason != self._maps.refusal:
            self._log.event("no map", reason)
            _log.warning("no map: %s", reason)
        self._maps.refuse(reason)
