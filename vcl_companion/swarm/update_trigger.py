"""When the map is to be updated (IV-G): the coordinator's patience with the members' votes.

No clock and no socket: the owner says what time it is. When the majority of the teammates that
are heard votes for an update (``own_vote``), the coordinator makes one. A drone alone is the
majority. Rounds that do not help come ever more rarely.
"""

from __future__ import annotations

import math

from vcl_companion.swarm.awaited import Awaited
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.update_options import UpdateOptions

# An update that did not help is followed by a longer pause, up to so many intervals.
_MAX_PAUSE = 8.0
# An update has helped when the majority sees so many times what it saw before, or wants none
# for so long, s: a new map that is no better is found out in 0.5 s, and in fast flight the
# next one is wanted after two.
_SEES_MORE = 1.3
_CONTENT_S = 1.0
# Who makes no map that helps of so many rounds is not about to.
_TRIES = 2


class _MembersSights:
    """What members see of the map that they fly on, and saw last of the one before it.

    Args:
        group: whose they are.
    """

    def __init__(self, group: Group) -> None:
        self._group = group
        self._told: dict[int, tuple[bytes, int]] = {}
        self._before: dict[int, int] = {}

    def note(self) -> None:
        """Remember what every member saw last on the map that it has left."""
        for member in self._group.teammates:
            state = self._group.state_of(member)
            if state is None:
                continue
            revision, tracked = self._told.get(member, (state.revision, 0))
            if revision != state.revision:
                self._before[member] = tracked
            self._told[member] = (state.revision, state.tracked)

    def most_see_more(self, revision: bytes, least: int) -> bool:
        """Return whether most teammates see clearly more of a revision than of the one before.

        Args:
            revision: the new one; who does not fly on it sees no more.
            least: so many landmarks are not more, whatever was seen before.
        """
        teammates = set(self._group.teammates)
        more = [
            member
            for member, (flown_on, tracked) in self._told.items()
            if flown_on == revision
            and member in self._before
            and member in teammates
            and tracked > max(_SEES_MORE * self._before[member], least)
        ]
        return 2 * len(more) > len(teammates)


class UpdateTrigger:
    """When the coordinator is to make a round; every member keeps one, its turn may come.

    Args:
        options: the same on every drone.
        group: who votes for what; the trigger only looks.
        awaited: who is waited for to have the last one.
    """

    def __init__(self, options: UpdateOptions, group: Group, awaited: Awaited) -> None:
        self._options = options
        self._group = group
        self._awaited = awaited
        self._wanted_since_s: float | None = None
        self._revision = b""
        self._revision_since_s = 0.0
        self._lost_since_s: dict[int, float] = {}
        self._ended_at_s = -math.inf
        self._n_in_vain = 0
        self._n_on_this = 0  # rounds since the newest revision
        self._content_since_s = math.inf
        self._sights = _MembersSights(group)
        self._helped = b""  # the last revision that most see more of than of the one before

    def poll(self, now_s: float) -> None:
        """Look at the group; call it several times a second."""
        group = self._group
        if group.maps.newest_revision != self._revision:
            self._revision, self._revision_since_s = group.maps.newest_revision, now_s
            self._n_on_this = 0
        if not group.maps.majority_wants_update:
            self._wanted_since_s = None
        elif self._wanted_since_s is None:
            self._wanted_since_s = now_s
        # Who does not have the newest revision has not judged it.
        awaited = self._awaited.look(now_s)  # at every look: it counts for how long
        if group.maps.majority_wants_update or awaited:
            self._content_since_s = math.inf
        else:
            self._content_since_s = min(self._content_since_s, now_s)
        self._sights.note()
        if now_s >= self._content_since_s + _CONTENT_S:
            self._n_in_vain = 0  # the last one has helped
        elif self._helped != self._revision and self._sights.most_see_more(
            self._revision, self._options.tracked
        ):
            self._n_in_vain, self._helped = 0, self._revision
        lost = [
            m for m in group.maps.holders(self._revision) if self._revision and self._is_lost(m)
        ]
        self._lost_since_s = {m: self._lost_since_s.get(m, now_s) for m in lost}

    def is_due(self, now_s: float) -> bool:
        """Whether to begin a round now, by what was polled."""
        options, group = self._options, self._group
        if not group.is_coordinator or self._wanted_since_s is None:
            return False
        if now_s < self._wanted_since_s + options.hold_s:
            return False
        in_vain = max(self._n_in_vain - 1, 0)
        pause_s = options.interval_s * min(2.0**in_vain, _MAX_PAUSE)
        if now_s < max(self._ended_at_s, self._revision_since_s) + pause_s:
            return False
        has_waited = now_s >= self._revision_since_s + options.delivery_wait_s
        return has_waited or not self._awaited.look(now_s)

    @property
    def is_coming(self) -> bool:
        """Whether a round of ours is wanted and soon begun, and the last ones have helped."""
        is_wanted = self._group.is_coordinator and self._wanted_since_s is not None
        return is_wanted and max(self._n_on_this, self._n_in_vain) < _TRIES

    def lost(self, now_s: float) -> tuple[int, ...]:
        """Return the members that hold the map and have not localized in it for a while."""
        lost_s = self._options.lost_s
        return tuple(m for m, since_s in self._lost_since_s.items() if now_s >= since_s + lost_s)

    def ended(self, now_s: float, *, from_new_places: bool) -> None:
        """Note the end of a round, whatever came of it; pauses grow until one has helped.

        Args:
            now_s: not before the last call's.
            from_new_places: whether the map was extended by views that were new to it: whoever
                is on the move needs the next one as much, however little each brings.
        """
        self._n_in_vain = 0 if from_new_places else self._n_in_vain + 1
        self._n_on_this += 1
        self._ended_at_s = now_s
        self._wanted_since_s = None

    def _is_lost(self, member: int) -> bool:
        state = self._group.state_of(member)
        return state is not None and not state.localized
