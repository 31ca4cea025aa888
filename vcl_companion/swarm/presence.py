"""Who is there: when members were last heard, who may be lost by now, and who is.

Who has said nothing for the time-out is lost; in a large swarm, whose members show themselves more
rarely (``pace``), for as many times as long. But who coordinates shows itself at full pace, and is
to be replaced soon: it is lost after the time-out itself, if it knows that it coordinates.
"""

from __future__ import annotations

import math

from vcl_companion.swarm.pace import FULL_PACE_S, stretch_of

# Who has said nothing for this share of the time-out, and for so long, s, is not waited for any
# more; it speaks once a second, in a large swarm more rarely (``pace``).
_SILENT, _SILENT_S = 0.5, 2.5


class Presence:
    """When one drone last heard the others; only what it is told and time change it.

    Args:
        members: all there may be, ascending.
        own_id: this drone.
        timeout_s: who is silent for so long is lost, in a small swarm.
    """

    def __init__(self, members: tuple[int, ...], own_id: int, timeout_s: float) -> None:
        self._members = members
        self._own_id = own_id
        self._timeout_s = timeout_s
        self._stretch = stretch_of(len(members))
        self._heard_at_s: dict[int, float] = {}  # members alive
        self._ever_heard: set[int] = set()
        self._hasty_until_s = -math.inf  # at full pace until then
        self._began_at_s = math.inf
        self._now_s = -math.inf
        # Who coordinated when that was last looked at, and since when: it shows itself at full
        # pace from then on.
        self._led_by, self._led_since_s = own_id, -math.inf

    @property
    def now_s(self) -> float:
        """The latest time that was told."""
        return self._now_s

    @property
    def alive(self) -> tuple[int, ...]:
        """Members that are there as far as known, this drone among them, ascending."""
        return tuple(m for m in self._members if m == self._own_id or m in self._heard_at_s)

    @property
    def led_by(self) -> int:
        """Who coordinated when that was last noted; this drone before that."""
        return self._led_by

    @property
    def stretch(self) -> float:
        """How many times as rarely as in a small swarm who does not coordinate shows itself.

        1 for who did until now and may be waited for as that yet, and while those who have just
        come may not have heard everybody.
        """
        return 1.0 if self._now_s < self._hasty_until_s else self._stretch

    @property
    def has_listened(self) -> bool:
        """Whether everybody who is there has been heard by now."""
        return self.has_lasted(self._timeout_s)

    def has_lasted(self, wait_s: float) -> bool:
        """Return whether so much time has passed since the first that was told."""
        return self._now_s >= self._began_at_s + wait_s

    def has_heard(self, member: int) -> bool:
        """Return whether another member was ever heard, lost since or not."""
        return member in self._ever_heard

    def is_heard(self, member: int) -> bool:
        """Return whether another member is there as far as known."""
        return member in self._heard_at_s

    def is_silent(self, member: int) -> bool:
        """Return whether a member may be lost, which is known later."""
        heard_at_s = self._heard_at_s.get(member)
        silent_s = max(_SILENT * self._timeout_s, _SILENT_S) + self._longer_s
        return heard_at_s is not None and self._now_s >= heard_at_s + silent_s

    def note_time(self, now_s: float) -> None:
        """Note what time it is; one before the last is passed over."""
        self._began_at_s = min(self._began_at_s, now_s)
        self._now_s = max(self._now_s, now_s)

    def hear(self, peer: int, now_s: float) -> bool:
        """Note that a peer is heard; who is no member is ignored.

        Returns:
            Whether it is there since now: it was never heard, or lost.
        """
        self.note_time(now_s)
        if peer == self._own_id or peer not in self._members:
            return False
        is_new = peer not in self._heard_at_s
        self._heard_at_s[peer] = max(now_s, self._heard_at_s.get(peer, now_s))
        self._ever_heard.add(peer)
        if is_new:
            self._hasty_until_s = now_s + self._timeout_s
        return is_new

    def note_lead(self, member: int, now_s: float) -> None:
        """Note who coordinates, this drone or another."""
        if member != self._led_by:
            self._led_by, self._led_since_s = member, now_s
        if member == self._own_id:
            self._hasty_until_s = now_s + self._timeout_s

    def take_lost(self, now_s: float, *, knows_lead: bool) -> list[int]:
        """Return who is lost by now, and hold them for away.

        Args:
            now_s: not before the last call's.
            knows_lead: whether who coordinates (``led_by``) says that it does.
        """
        self.note_time(now_s)
        lost = [m for m in self._heard_at_s if now_s >= self._lost_at_s(m, knows_lead)]
        for member in lost:
            del self._heard_at_s[member]
        return lost

    def next_lost_s(self, *, knows_lead: bool) -> float | None:
        """Return when somebody is lost if nothing is heard until then; None for nobody."""
        times_s = (self._lost_at_s(member, knows_lead) for member in self._heard_at_s)
        return min(times_s, default=None)

    @property
    def _longer_s(self) -> float:
        """By how much longer than in a small swarm the next sign of life of others may take."""
        return (self._stretch - 1.0) * FULL_PACE_S

    def _lost_at_s(self, member: int, knows_lead: bool) -> float:
        """Return when a member is lost if nothing is heard of it until then."""
        heard_at_s = self._heard_at_s[member]
        lost_at_s = heard_at_s + self._timeout_s * self._stretch
        if member != self._led_by:
            return lost_at_s
        # It shows itself at full pace if it knows that it coordinates.
        if heard_at_s < self._led_since_s:
            return min(lost_at_s, self._led_since_s + self._timeout_s + self._longer_s)
        return heard_at_s + self._timeout_s if knows_lead else lost_at_s
