"""Who is waited for to have the newest map: not for ever the same one, which may never take any.

A drone that cannot take a map, or does not want to, would have every other wait for as long as a
delivery may take, for each update anew. Who has lacked one revision for all of that time is not
waited for any more until it has a newest one; and once more after a while, for it may be that its
link is slow, and each map was followed by the next before it was there.
"""

from __future__ import annotations

from vcl_companion.swarm.group import Group

# So many times the patience later it is waited for once more.
_ONCE_MORE = 4.0


class Awaited:
    """Looks who lacks the newest revision, and for how long.

    Args:
        group: who lacks it.
        patience_s: how long a revision may be on its way.
    """

    def __init__(self, group: Group, patience_s: float) -> None:
        self._group = group
        self._patience_s = patience_s
        self._revision = b""
        self._lacks_since_s: dict[int, float] = {}
        self._late_since_s: dict[int, float] = {}

    def look(self, now_s: float) -> tuple[int, ...]:
        """Return who lacks the newest revision and is waited for.

        Args:
            now_s: not before the last call's.
        """
        group = self._group
        if group.maps.newest_revision != self._revision:
            self._revision = group.maps.newest_revision
            self._lacks_since_s.clear()
        lacking = group.maps.lacking()
        alive = set(group.alive)
        # Who may be lost (``Group.is_silent``) lacks it yet, if it comes back.
        kept = alive.difference(group.maps.holders(self._revision))
        self._lacks_since_s = {m: s for m, s in self._lacks_since_s.items() if m in kept}
        until_s = now_s - _ONCE_MORE * self._patience_s
        self._late_since_s = {
            m: since_s
            for m, since_s in self._late_since_s.items()
            if m in kept and since_s > until_s
        }
        for member in lacking:
            since_s = self._lacks_since_s.setdefault(member, now_s)
            if now_s >= since_s + self._patience_s:
                self._late_since_s.setdefault(member, now_s)
                self._lacks_since_s[member] = now_s
        return tuple(m for m in lacking if m not in self._late_since_s)
