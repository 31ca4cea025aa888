"""Who of the group is there: what follows here when a peer comes, is silent, or has forgotten."""

from __future__ import annotations

import asyncio
import logging

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.inter_target import InterTarget
from vcl_companion.daemon.map_handing import MapHanding
from vcl_companion.daemon.own_state import OwnState
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.swarm.group import Group, PeerJoined, PeerLost
from vcl_companion.wire.messages import MapState

_log = logging.getLogger(__name__)


class PeerPresence:
    """Tells those who deal with a peer that it came, is silent, or lost what it was sent.

    Args:
        group: says so.
        handing: hands a map once more to who has lost it.
        passed: likewise the images that were sent ahead.
        clocks: relates the clock of who came.
        own_state: is told to who came.
        inter: waits for no pose of who is silent.
        log: told of who came and who is silent.
    """

    def __init__(
        self,
        group: Group,
        handing: MapHanding,
        passed: PassedFrames,
        clocks: PeerClocks,
        own_state: OwnState,
        inter: InterTarget,
        log: FlightLog,
    ) -> None:
        self._group = group
        self._handing = handing
        self._passed = passed
        self._clocks = clocks
        self._own_state = own_state
        self._inter = inter
        self._log = log

    def heartbeat(self, peer: int) -> None:
        """Note a sign of life."""
        self._note(self._group.heartbeat(peer, self._now_s()))

    def map_state(self, peer: int, state: MapState) -> bool:
        """Note what a peer says of itself; who had a map and has none was restarted.

        Returns:
            Whether it is something else than what it said last.
        """
        before = self._group.state_of(peer)
        if before is not None and before.revision and not state.revision:
            self._forgot(peer)
        self._note(self._group.map_state(peer, state, self._now_s()))
        return before is None or state.is_news_after(before)

    def poll(self, now_s: float) -> None:
        """Note who is silent by now."""
        self._note(self._group.poll(now_s))

    def _note(self, events: list[PeerJoined | PeerLost]) -> None:
        for event in events:
            joined = isinstance(event, PeerJoined)
            self._log.event("peer", f"drone {event.peer} {'joined' if joined else 'lost'}")
            _log.info("drone %d %s", event.peer, "joined" if joined else "is silent")
            if joined:
                self._forgot(event.peer)
                self._own_state.joined()
            else:
                self._passed.forgot(event.peer)
                self._inter.lost(event.peer)

    def _forgot(self, peer: int) -> None:
        """Note that a peer may have lost what it was sent, and its clock: restarted, or away."""
        self._handing.forgot(peer)
        self._passed.forgot(peer)
        self._clocks.joined(peer)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
