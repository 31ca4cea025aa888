"""The peers' clocks beside ours: who is asked for the time when, and what is known of each."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable
from contextlib import suppress

from vcl_companion.clock import Clock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.peer_time import Instant, PeerTime

_log = logging.getLogger(__name__)

_QUICK_S = 0.5
_SLOW_S = 8.0
# Question and answer are 43 bytes each when signed: of many peers fewer are asked at a time, so
# that all of it stays below 90 B/s.
_LEAST_BETWEEN_S = 1.0
# Of many that have joined so many are asked at a time, of those that are asked rarely one: in a
# large group everybody asking everybody at once would leave the air for nothing else.
_MOST_QUICK_AT_ONCE = 2
# More than so many peers are not all asked: the coordinator, whom everybody deals with, and whoever
# has spoken of an instant in so long, s. What a drone says does not grow with the swarm then.
_FEW_PEERS, _DEALT_WITH_S = 8, 120.0
# Who has been asked so many without a relation that holds is asked rarely from then on.
_MOST_QUICK = 8
_LOG_EVERY_S = 5.0
_LONGEST_PAUSE_S = 0.5


class PeerClocks:
    """Asks members alive for their time: a few at a time quickly after they joined, then rarely.

    In a small group all of them, in a large one those that this drone deals with.

    Args:
        group: whom to ask.
        ask: sends a question: its ``ts1``, to whom.
        clock: time base of frames.
        log: told of every relation, and of a clock that began anew.
        refuse: counts what a peer sent in vain: peer, kind, detail.
        resolution_ns: of everybody's clock (``PeerTime``).
    """

    def __init__(
        self,
        group: Group,
        ask: Callable[[int, int], None],
        clock: Clock,
        log: FlightLog,
        refuse: Callable[[int, str, str], None],
        resolution_ns: int,
    ) -> None:
        self._group = group
        self._ask = ask
        self._clock = clock
        self._log = log
        self._refuse = refuse
        self._times = {peer: PeerTime(resolution_ns) for peer in group.peers}
        self._asked_at_s: dict[int, float] = {}
        self._dealt_with_at_s: dict[int, float] = {}
        self._n_quick: Counter[int] = Counter()
        self._logged_at_s: dict[int, float] = {}
        self._wake = asyncio.Event()

    def joined(self, peer: int) -> None:
        """Note that a peer is there, or back: it may have been restarted."""
        self._times[peer].rejoined()
        self._asked_at_s.pop(peer, None)
        self._n_quick[peer] = 0
        self._logged_at_s.pop(peer, None)
        self._wake.set()

    def answered(self, peer: int, ts1_ns: int, tc1_ns: int) -> None:
        """Take a peer's answer; whatever is wrong with it is counted, never raised."""
        time = self._times.get(peer)
        if time is None:
            return
        n_epochs = time.n_epochs
        refusal = time.answered(ts1_ns, tc1_ns, self._clock.now_ns())
        if refusal is not None:
            self._refuse(peer, "time", refusal)
            return
        if 0 < n_epochs < time.n_epochs:
            self._log.event("clock", f"drone {peer} has another clock than before")
            _log.warning("drone %d has another clock than before", peer)
            self._logged_at_s.pop(peer, None)
        self._tell(peer, time)

    def instant(self, peer: int, theirs_ns: int, age_s: float, came_at_ns: int) -> Instant:
        """Return an instant that a peer speaks of in our time; see ``PeerTime.instant``."""
        self._dealt_with_at_s[peer] = self._now_s()
        return self._times[peer].instant(theirs_ns, age_s, came_at_ns)

    async def run(self) -> None:
        """Ask until cancelled."""
        while True:
            # A clock that has not been told the time yet has nothing to compare.
            if self._clock.now_ns() > 0:
                for peer in self._whose_turn():
                    self._ask_for_time(peer)
            self._wake.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(_LONGEST_PAUSE_S):
                    await self._wake.wait()

    def _whose_turn(self) -> list[int]:
        """Return whom to ask now: who coordinates, which everybody deals with, then by age."""
        coordinator = self._group.coordinator
        due = [
            p
            for p in self._group.alive
            if p in self._times and (p == coordinator or self._is_dealt_with(p)) and self._is_due(p)
        ]
        due.sort(key=lambda p: (p != coordinator, self._asked_at_s.get(p, float("-inf"))))
        rare = [peer for peer in due if self._is_rare(peer)]
        quick = [peer for peer in due if not self._is_rare(peer)]
        # Those who have been asked a moment ago count: everybody who joins makes a turn.
        lately_s = self._now_s() - _LONGEST_PAUSE_S / 2
        n_lately = sum(at_s > lately_s for at_s in self._asked_at_s.values())
        return quick[: max(_MOST_QUICK_AT_ONCE - n_lately, 0)] + rare[: not n_lately]

    def _ask_for_time(self, peer: int) -> None:
        time = self._times[peer]
        self._asked_at_s[peer] = self._now_s()
        self._n_quick[peer] = 0 if time.is_settled else self._n_quick[peer] + 1
        self._ask(time.ask(self._clock.now_ns()), peer)

    def _is_due(self, peer: int) -> bool:
        slow_s = max(_SLOW_S, _LEAST_BETWEEN_S * len(self._times))
        every_s = slow_s if self._is_rare(peer) else _QUICK_S
        # A turn comes a little early or late: due is what the next one would be too late for.
        since_s = self._now_s() - self._asked_at_s.get(peer, float("-inf"))
        return since_s >= every_s - _LONGEST_PAUSE_S / 2

    def _is_dealt_with(self, peer: int) -> bool:
        if len(self._times) <= _FEW_PEERS:
            return True
        at_s = self._dealt_with_at_s.get(peer)
        return at_s is not None and self._now_s() < at_s + _DEALT_WITH_S

    def _is_rare(self, peer: int) -> bool:
        return self._times[peer].is_settled or self._n_quick[peer] >= _MOST_QUICK

    def _tell(self, peer: int, time: PeerTime) -> None:
        """Write what is known now, unless that was done a moment ago."""
        relation = time.relation(self._clock.now_ns())
        is_due = self._now_s() - self._logged_at_s.get(peer, float("-inf")) >= _LOG_EVERY_S
        if relation is None or not is_due:
            return
        self._logged_at_s[peer] = self._now_s()
        self._log.peer_clock(peer, relation)
        _log.debug("drone %d: %s", peer, relation)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
