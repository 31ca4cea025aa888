"""When the map is to be updated (IV-G): each drone's vote, and the coordinator's patience.

No clock and no socket: the owner says what time it is. A drone votes for an
update when it sees too few landmarks; when the majority of the members alive
does, the coordinator makes one.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

from vcl_companion.swarm.group import Group

# One bad frame is no reason to vote: a vote is about the median of so long, s.
_WINDOW_S = 1.0
# A new map is not judged by less than this share of the window.
_JUDGED_SHARE = 0.5
# An update that did not help is followed by a longer pause, up to so many intervals.
_MAX_PAUSE = 8.0


@dataclass(frozen=True)
class UpdateOptions:
    """When a map is updated, and how.

    Attributes:
        tracked: a drone that sees fewer landmarks of the map wants it updated.
        share: so does one that sees less than this share of the most that it
            has seen of this revision; 0 for both of them: maps stay as they are.
        hold_s: how long the majority has to want it.
        interval_s: shortest time from the end of one round, or from a new revision,
            to the next round; up to eight times as long while rounds do not help.
        gather_timeout_s: how long a round waits for the members' frames.
        delivery_wait_s: how long a revision may take to reach everybody alive
            before the next round, and how long a peer that claims a map may take
            to deliver it before a first one is made without it.
        lost_s: a member that has not localized for so long sends several frames.
        joiner_frames: how many.
        joiner_spacing_s: time between them.
    """

    # A round takes seconds, and in fast flight landmarks halve in five: after two halvings
    # there must still be more than localization needs (15).
    tracked: int = 100
    # Beside its own keyframe a map is seen half as well again as from anywhere else, so half
    # of the most is two thirds of what is usual: it has to be early, for the same reason.
    share: float = 0.5
    hold_s: float = 0.5
    interval_s: float = 2.0
    gather_timeout_s: float = 5.0
    delivery_wait_s: float = 30.0
    lost_s: float = 3.0
    joiner_frames: int = 4
    joiner_spacing_s: float = 1.5

    def __post_init__(self) -> None:
        if self.tracked < 0:
            raise ValueError(f"tracked must not be negative, got {self.tracked}")
        if not 0 <= self.share < 1:
            raise ValueError(f"share must lie in [0, 1), got {self.share}")
        for name in (
            "hold_s",
            "interval_s",
            "gather_timeout_s",
            "delivery_wait_s",
            "lost_s",
            "joiner_spacing_s",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value}")
        if not 1 <= self.joiner_frames <= 8:
            raise ValueError(f"joiner_frames must lie in 1..8, got {self.joiner_frames}")


class OwnVote:
    """Whether this drone wants its map updated, by what it has seen of it lately."""

    def __init__(self, options: UpdateOptions) -> None:
        self._options = options
        self._revision = b""
        self._seen: deque[tuple[float, int]] = deque()
        self._since_s = 0.0
        self._most = 0.0
        self._wants = False

    def look(self, revision: bytes, tracked: int, now_s: float) -> bool:
        """Take in what is seen now; call it several times a second.

        Args:
            revision: of the map in use; empty for none.
            tracked: landmarks that agreed on the last frame's pose, 0 without a pose.
            now_s: not before the last call's.

        Returns:
            The vote. It stands through a change of map until the new one has
            been seen for a while: what was wanted may not have come of it.
        """
        if revision != self._revision:
            self._revision = revision
            self._seen.clear()
            self._since_s = now_s
            self._most = 0.0
        self._seen.append((now_s, tracked))
        while self._seen[0][0] < now_s - _WINDOW_S:
            self._seen.popleft()
        if not revision:
            self._wants = False
        elif now_s - self._since_s >= _JUDGED_SHARE * _WINDOW_S:
            lately = statistics.median(n for _, n in self._seen)
            self._most = max(self._most, lately)
            self._wants = lately < max(self._options.tracked, self._options.share * self._most)
        return self._wants


class UpdateTrigger:
    """When the coordinator is to make a round; every member keeps one, its turn may come.

    Args:
        options: the same on every drone.
        group: who votes for what; the trigger only looks.
    """

    def __init__(self, options: UpdateOptions, group: Group) -> None:
        self._options = options
        self._group = group
        self._wanted_since_s: float | None = None
        self._revision = b""
        self._revision_since_s = 0.0
        self._lost_since_s: dict[int, float] = {}
        self._ended_at_s = -math.inf
        self._n_in_vain = 0

    def poll(self, now_s: float) -> None:
        """Look at the group; call it several times a second."""
        group = self._group
        if group.newest_revision != self._revision:
            self._revision, self._revision_since_s = group.newest_revision, now_s
        if not group.majority_wants_update:
            self._wanted_since_s = None
            if not group.lacking():
                self._n_in_vain = 0  # the last one has helped
        elif self._wanted_since_s is None:
            self._wanted_since_s = now_s
        lost = [m for m in group.holders(self._revision) if self._revision and self._is_lost(m)]
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
        return not group.lacking() or now_s >= self._revision_since_s + options.delivery_wait_s

    def lost(self, now_s: float) -> tuple[int, ...]:
        """Return the members that hold the map and have not localized in it for a while."""
        lost_s = self._options.lost_s
        return tuple(m for m, since_s in self._lost_since_s.items() if now_s >= since_s + lost_s)

    def ended(self, now_s: float) -> None:
        """Note the end of a round, whatever came of it; pauses grow until one has helped."""
        self._n_in_vain += 1
        self._ended_at_s = now_s
        self._wanted_since_s = None

    def _is_lost(self, member: int) -> bool:
        state = self._group.state_of(member)
        return state is not None and not state.localized
