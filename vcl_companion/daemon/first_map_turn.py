"""Whose turn a first map is, and when: ours, once all are there or were waited for."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from vcl_companion.daemon.map_store import MapStore
from vcl_companion.swarm.group import Group

# Whoever has been heard by us is heard by all a moment later, and is sent what all are sent.
_ACQUAINTED_S = 0.5
# Nobody needs longer than so many times the patience to hand over a map, whatever trickles in.
_MAX_DELIVERIES = 10.0
# Who says so anew was away, or is wrong: it uses up so much of the patience each time.
_NEW_CLAIM = 0.1


class FirstMapTurn:
    """Says whether a first map is to be made here now.

    Args:
        group: who is there, and who says that it has a map.
        maps: ours.
        is_receiving_map: whether a peer's map has been coming in lately.
        member_wait_s: how long members that are not there yet are waited for.
        delivery_wait_s: how long who says that it has a map may take to send us some of it.
    """

    def __init__(
        self,
        group: Group,
        maps: MapStore,
        is_receiving_map: Callable[[], bool],
        member_wait_s: float,
        delivery_wait_s: float,
    ) -> None:
        self._group = group
        self._maps = maps
        self._is_receiving_map = is_receiving_map
        self._member_wait_s = member_wait_s
        self._delivery_wait_s = delivery_wait_s
        # For how long each has said in all that it has a map, and who did at the last look.
        self._claimed_s: dict[int, float] = {}
        self._claiming: frozenset[int] = frozenset()
        self._looked_at_s = 0.0
        self._complete_since_s: float | None = None

    def is_due(self, began_at_s: float) -> bool:
        """Whether a first map is ours to make, and everybody is there or was waited for.

        Args:
            began_at_s: since when they are waited for, by the loop's time.
        """
        if self.has_map() or not self._group.is_coordinator:
            return False
        now_s = asyncio.get_running_loop().time()
        if now_s - began_at_s >= self._member_wait_s:
            return True
        # Who is heard but has not said yet what it flies on may well have a map.
        told = all(self._group.state_of(peer) is not None for peer in self._group.peers)
        if not (self._group.is_complete and told):
            self._complete_since_s = None
            return False
        if self._complete_since_s is None:
            self._complete_since_s = now_s
        return now_s >= self._complete_since_s + _ACQUAINTED_S

    def has_map(self) -> bool:
        """Whether there is a map: ours, or of a peer, which will send it (we are late, or back).

        Not for ever: a peer that has said so for long and sends none has none to give, though it
        said nothing of the kind now and then.
        """
        if self._maps.current is not None:
            return True
        now_s = asyncio.get_running_loop().time()
        group = self._group
        claiming = frozenset(
            p for p in group.trusted if p != group.own_id and group.maps.has_map(p)
        )
        for peer in claiming & self._claiming:
            self._claimed_s[peer] += now_s - self._looked_at_s
        for peer in claiming - self._claiming:
            anew_s = _NEW_CLAIM * self._delivery_wait_s
            self._claimed_s[peer] = self._claimed_s.get(peer, -anew_s) + anew_s
        self._claiming, self._looked_at_s = claiming, now_s
        patience_s = self._delivery_wait_s * (_MAX_DELIVERIES if self._is_receiving_map() else 1.0)
        return any(self._claimed_s[peer] < patience_s for peer in claiming)
