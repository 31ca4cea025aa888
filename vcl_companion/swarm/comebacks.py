"""Who may lead at once, and who is passed over for a while: it goes and comes back again and again.

A leader that restarts in a loop is there half of the time, and makes no map in it. Anybody may be
lost, or restart, once: it leads again as soon as it is back. Whom that happens to once more leads
only when it has been there without a break for a while, each time longer; who has taken its place
goes on until then.

Drones do not lose each other at one time, and may hear each other badly. So who took the place
of one that was lost is kept only if most of those who know of any successor tell that it is he.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from vcl_companion.swarm.epochs import FIRST, VACANT, taken_by

_FIRST_WAIT_S, _MOST_WAIT_S = 5.0, 30.0
# Who was there for so long begins anew.
_FORGIVEN_S = 300.0


class Comebacks:
    """How often members have gone and come back, and since when they are there."""

    def __init__(self) -> None:
        self._n_gone: dict[int, int] = {}
        self._since_s: dict[int, float] = {}  # of members alive
        self._restarted: set[int] = set()  # who was not lost, the last time

    def came(self, member: int, now_s: float) -> None:
        """Note that a member is there from now on."""
        self._since_s[member] = now_s

    def lost(self, member: int, now_s: float) -> None:
        """Note that a member is not there any more."""
        self._gone(member, now_s)
        self._since_s.pop(member, None)
        self._restarted.discard(member)

    def restarted(self, member: int, now_s: float) -> None:
        """Note that a member was restarted so fast that it was not lost."""
        self._gone(member, now_s)
        self._since_s[member] = now_s
        self._restarted.add(member)

    def has_restarted(self, member: int) -> bool:
        """Return whether a member went by a restart: nobody had to take its place meanwhile."""
        return member in self._restarted

    def is_settled(self, member: int, now_s: float) -> bool:
        """Return whether a member has been there for long enough to lead."""
        n_gone = self._n_gone.get(member, 0)
        if n_gone < 2:
            return True
        # No more doublings than it takes to get to the most.
        wait_s = min(_FIRST_WAIT_S * 2.0 ** min(n_gone - 2, 8), _MOST_WAIT_S)
        return now_s >= self._since_s.get(member, now_s) + wait_s

    def _gone(self, member: int, now_s: float) -> None:
        was_there_s = now_s - self._since_s.get(member, now_s)
        before = 0 if was_there_s >= _FORGIVEN_S else self._n_gone.get(member, 0)
        self._n_gone[member] = before + 1


def successor(told: Mapping[int, int]) -> int | None:
    """Return who leads by what most tell who know of any successor; it must say so itself.

    Args:
        told: the highest epoch that each knows, without whose place it is about.
    """
    takers = Counter(taken_by(epoch) for epoch in told.values() if epoch > VACANT)
    for taker, n in takers.most_common(1):
        if 2 * n > takers.total() and taken_by(told.get(taker, FIRST)) == taker:
            return taker
    return None
