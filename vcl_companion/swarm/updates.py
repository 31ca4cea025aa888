"""When the map is to be updated (IV-G): each drone's vote, and the coordinator's patience.

No clock and no socket: the owner says what time it is. A drone votes for an
update when one of these holds for the median of its last second, or, of the
first three, will hold ``ahead_s`` from now if the second goes on as it went (or
as long from now as the last update took, from the majority's wish to the map):

* landmarks in sight < max(``tracked``, ``share`` x most since this revision, of which no more
  than ``enough`` count: a pose is found by a few hundred, and is hardly better by more);
* covered share of the image < min(``covered``, 0.8 x most since this revision), the former
  less by the root of how many times ``enough`` landmarks are in sight: these make up for it.
  Sky is never covered, and no reason to update again and again;
* median novelty of what is seen > ``novelty_deg``: from a new place the map is still
  recognised, and soon no more, and here it can be joined to what comes; foreseen where it will be
  more than 1.6 times that, and only where the map, asked about the place that the drone is on its
  way to, does not know that either;
* 1-sigma of the position > max(``sigma_m``, ``sigma_growth`` x least since this
  revision): what is known no better than that only gets worse, and is
  inherited by whatever is added to the map later.

A vote stands for half a second after its reason, so that those of a majority meet. When the
majority of the teammates that are heard votes so, the coordinator makes one. A drone alone is the
majority.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from vcl_companion.swarm.group import Group

# One bad frame is no reason to vote: a vote is about the median of so long, s.
_WINDOW_S = 1.0
# Looks that come sooner after each other are one: who is told much at a time would look a hundred
# times at one frame, and these would outvote all others of the window.
_LOOKS_APART_S = 0.04
# What is seen hovers about the bounds: a vote stands for so long after its reason, or those of a
# majority hardly meet.
_STANDS_S = 0.5
# A new map is not judged by less than this share of the window, nor where it leads by less
# than nearly all of it.
_JUDGED_SHARE = 0.5
_FORESEEN_SHARE = 0.85
# A flight comes step by step to where a view will be so many times as new as one that is here
# already: of photographs metres apart the next one may be lost.
_NEWER_AHEAD = 1.6
# A view that is never covered more, by sky perhaps, is no reason to update.
_STILL_COVERED = 0.8
# An update that did not help is followed by a longer pause, up to so many intervals.
_MAX_PAUSE = 8.0
# An update has helped when the majority sees so many times what it saw before, or wants none
# for so long, s: a new map that is no better is found out in 0.5 s, and in fast flight the
# next one is wanted after two.
_SEES_MORE = 1.3
# Who makes no map that helps of so many rounds is not about to.
_TRIES = 2
# So many times ``ahead_s`` at most: what is further ahead is not foreseen by a second's course.
_FURTHEST = 2.0
_CONTENT_S = 1.0


@dataclass(frozen=True)
class UpdateOptions:
    """When a map is updated, and how.

    Attributes:
        tracked: a drone that sees fewer landmarks of the map wants it updated.
        share: so does one that sees less than this share of the most that it
            has seen of this revision; 0 for both of them: maps stay as they are.
        enough: of the most that was seen no more are counted: what is lost of more is no loss.
        covered: share of the image that the map has to fill with ``enough`` landmarks or fewer;
            with four times as many, half of that.
        novelty_deg: landmarks are seen from so far aside of where they are remembered, or as
            much nearer or farther (``mapping.novelty``), before the map is extended;
            1.6 times that where it is only foreseen.
        ahead_s: a map is judged by what will be seen of it when an update, begun now, is there;
            where the last one took longer, by so much, up to twice as long.
        sigma_m: positions better than this are good enough.
        sigma_growth: above that, a drone wants an update when its position is known
            so many times worse than it was at best on this revision.
        hold_s: how long the majority has to want it.
        interval_s: shortest time from the end of one round, or from a new revision,
            to the next round; up to eight times as long while rounds do not help.
        gather_timeout_s: how long a round waits for the members' frames, beyond what these
            take on the link.
        delivery_wait_s: how long a revision may take to reach everybody alive
            before the next round, and how long a peer that claims a map may take
            to deliver it before a first one is made without it.
        contributors: of how many members' frames a map is made or updated, at most.
        lost_s: a member that has not localized for so long sends several frames.
        joiner_frames: how many.
        joiner_spacing_s: time between them.
        frame_wait_s: how long a frame that the map does not know waits for the next
            revision, while no newer frame comes.
    """

    # A round takes seconds, and in fast flight landmarks halve in five: after two halvings
    # there must still be more than localization needs (15).
    tracked: int = 100
    # Beside its own keyframe a map is seen half as well again as from anywhere else, so this
    # is little less than what is usual: it has to be early, for the same reason.
    share: float = 0.6
    enough: int = 600
    covered: float = 0.7
    novelty_deg: float = 5.0
    ahead_s: float = 2.0
    sigma_m: float = 0.005
    sigma_growth: float = 1.5
    hold_s: float = 0.1
    interval_s: float = 0.5
    gather_timeout_s: float = 5.0
    delivery_wait_s: float = 30.0
    contributors: int = 8
    lost_s: float = 3.0
    joiner_frames: int = 4
    joiner_spacing_s: float = 1.5
    frame_wait_s: float = 10.0

    def __post_init__(self) -> None:
        if self.tracked < 0:
            raise ValueError(f"tracked must not be negative, got {self.tracked}")
        if self.enough < 1:
            raise ValueError(f"enough must be positive, got {self.enough}")
        if not 0 <= self.share < 1:
            raise ValueError(f"share must lie in [0, 1), got {self.share}")
        if not 0 <= self.covered < 1:
            raise ValueError(f"covered must lie in [0, 1), got {self.covered}")
        if not self.sigma_growth > 1:
            raise ValueError(f"sigma_growth must be more than 1, got {self.sigma_growth}")
        for name in (
            "novelty_deg",
            "ahead_s",
            "sigma_m",
            "hold_s",
            "interval_s",
            "gather_timeout_s",
            "delivery_wait_s",
            "lost_s",
            "joiner_spacing_s",
            "frame_wait_s",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive, got {value}")
        if not 2 <= self.contributors <= 64:
            raise ValueError(f"contributors must lie in 2..64, got {self.contributors}")
        if not 1 <= self.joiner_frames <= 8:
            raise ValueError(f"joiner_frames must lie in 1..8, got {self.joiner_frames}")


@dataclass(frozen=True)
class Sight:
    """What a drone sees of the map in one frame.

    Attributes:
        tracked: landmarks of the map in sight, 0 without a pose.
        covered: share of the image that they fill; None where nobody has looked.
        sigma_m: of the position by them, in its worst direction; None without a pose.
        novelty_deg: how differently they look from how they are remembered.
    """

    tracked: int
    covered: float | None = None
    sigma_m: float | None = None
    novelty_deg: float = 0.0


class OwnVote:
    """Whether this drone wants its map updated, by what it has seen of it lately.

    Args:
        options: what it goes by.
        novelty_ahead_deg: how new the map will look where the drone is in so many seconds, if
            it flies on as it does; None where nobody can tell.

    Attributes:
        options: what it goes by; may be changed.
        reasons: why it wants one, each in some words; none while it does not.
    """

    def __init__(
        self,
        options: UpdateOptions,
        novelty_ahead_deg: Callable[[float], float | None] = lambda ahead_s: None,
    ) -> None:
        self.options = options
        self._novelty_ahead_deg = novelty_ahead_deg
        self._revision = b""
        self._seen: deque[tuple[float, Sight]] = deque()
        self._since_s = 0.0
        self._newest_since_s = -math.inf
        self._most = 0.0
        self._most_covered = 0.0
        self._least_sigma_m = math.inf
        self.reasons: tuple[str, ...] = ()
        self._had_reason_s = -math.inf
        self._used = b""
        self._wanted_since_s: float | None = None
        self._took_s = 0.0

    def follow(self, revision: bytes, is_wanted: bool, is_coming: bool, now_s: float) -> None:
        """Take note of how long updates take; call it before each ``look`` and ``unseen``.

        Args:
            revision: of the map in use; empty for none.
            is_wanted: whether the majority wants it updated. From that on, not from our own vote:
                one that is alone waits for the others, and would look ahead the further for it.
            is_coming: whether others fly on a newer one, and so want no update any more.
            now_s: not before the last call's.
        """
        if revision != self._used:
            if self._used and self._wanted_since_s is not None:
                self._took_s = now_s - self._wanted_since_s
            self._used, self._wanted_since_s = revision, None
        elif is_wanted and self._wanted_since_s is None:
            self._wanted_since_s = now_s
        elif not (is_wanted or is_coming):
            self._wanted_since_s = None

    def look(self, revision: bytes, sight: Sight, now_s: float) -> bool:
        """Take in what is seen now; call it several times a second.

        Args:
            revision: of the map in use; empty for none.
            sight: of it.
            now_s: not before the last call's.

        Returns:
            The vote. It stands through a change of map until the new one has
            been seen for a while, unless ``unseen`` says that nothing of it has:
            what was wanted may not have come of it.
        """
        if revision != self._revision:
            self._revision = revision
            self._seen.clear()
            self._since_s = now_s
            self._most = self._most_covered = 0.0
            self._least_sigma_m = math.inf
        if not self._seen or sight != self._seen[-1][1]:
            self._newest_since_s = now_s
        at_s = now_s
        if self._seen and now_s < self._seen[-1][0] + _LOOKS_APART_S:
            at_s, _ = self._seen.pop()
        self._seen.append((at_s, sight))
        while self._seen[0][0] < now_s - _WINDOW_S:
            self._seen.popleft()
        if not self._may_vote():
            self.reasons = ()
        elif now_s - self._since_s >= _JUDGED_SHARE * _WINDOW_S:
            judged = {
                "few landmarks": self._is_little(),
                "little of the image": self._is_narrow(),
                "vague position": self._is_vague(),
            }
            reasons = tuple(reason for reason, holds in judged.items() if holds)
            # May look all over the map: not asked where there is a reason already.
            if not reasons and self._is_new():
                reasons = ("new view",)
            if reasons:
                self.reasons, self._had_reason_s = reasons, now_s
            elif now_s >= self._had_reason_s + _STANDS_S:
                self.reasons = ()
        return bool(self.reasons)

    def unseen(self) -> bool:
        """Vote while no frame has been looked at on the map in use: nobody knows what it lacks."""
        self.reasons = ()
        return False

    def is_open(self, now_s: float) -> bool:
        """Return whether few landmarks or a new view may be a reason soon, if they stay so."""
        if self.reasons or not (self._seen and self._may_vote()):
            return False
        _, sight = self._seen[-1]
        is_reason = sight.tracked < self._least() or sight.novelty_deg > self.options.novelty_deg
        return is_reason and now_s < self._newest_since_s + _WINDOW_S

    def _may_vote(self) -> bool:
        return bool(self._revision) and bool(self.options.tracked or self.options.share)

    def _least(self) -> float:
        counted = min(self._most, self.options.enough)
        return max(self.options.tracked, self.options.share * counted)

    def _is_little(self) -> bool:
        # Half of the window does not outvote the other half.
        seen = [(at_s, float(s.tracked)) for at_s, s in self._seen]
        lately = statistics.median_high(n for _, n in seen)
        self._most = max(self._most, lately)
        return min(lately, self._foreseen(seen, lately)) < self._least()

    def _is_narrow(self) -> bool:
        known = [(at_s, s.covered) for at_s, s in self._seen if s.covered is not None]
        if not known:
            return False
        lately = statistics.median_high(share for _, share in known)
        self._most_covered = max(self._most_covered, lately)
        tracked = statistics.median_low(sight.tracked for _, sight in self._seen)
        # A pose is as sure as landmarks are far apart, and by the root of how many they are.
        needed = self.options.covered * math.sqrt(min(self.options.enough / max(tracked, 1), 1.0))
        least = min(needed, _STILL_COVERED * self._most_covered)
        return min(lately, self._foreseen(known, lately)) < least

    def _is_new(self) -> bool:
        seen = [(at_s, s.novelty_deg) for at_s, s in self._seen]
        lately_deg = statistics.median_low(novelty for _, novelty in seen)
        if lately_deg > self.options.novelty_deg:
            return True
        foreseen_deg = _NEWER_AHEAD * self.options.novelty_deg
        if not self._foreseen(seen, lately_deg) > foreseen_deg:
            return False
        there_deg = self._novelty_ahead_deg(self._ahead_s())
        return there_deg is None or there_deg > foreseen_deg

    def _foreseen(self, values: list[tuple[float, float]], lately: float) -> float:
        """Return what a quantity will be if it goes on as it does, if it goes anywhere.

        By the medians of the window's thirds, and no faster than between any two of them:
        neither a bad frame nor a step is a course.
        """
        now_s = self._seen[-1][0]
        if values[0][0] > now_s - _FORESEEN_SHARE * _WINDOW_S:
            return lately
        third_s = _WINDOW_S / 3.0
        thirds: tuple[list[float], ...] = ([], [], [])
        for at_s, value in values:
            thirds[min(int((now_s - at_s) / third_s), 2)].append(value)
        if not all(thirds):
            return lately
        newest, between, oldest = map(statistics.median_low, thirds)
        steps = newest - between, between - oldest
        if steps[0] * steps[1] <= 0.0:
            return lately
        return newest + min(steps, key=abs) * self._ahead_s() / third_s

    def _ahead_s(self) -> float:
        """Return how far ahead an update that is begun now has to look."""
        ahead_s = self.options.ahead_s
        return min(max(ahead_s, self._took_s), _FURTHEST * ahead_s)

    def _is_vague(self) -> bool:
        known = [s.sigma_m for _, s in self._seen if s.sigma_m is not None]
        if not known:
            return False
        lately_m = statistics.median_low(known)
        self._least_sigma_m = min(self._least_sigma_m, lately_m)
        growth = self.options.sigma_growth
        return lately_m > max(self.options.sigma_m, growth * self._least_sigma_m)


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
        self._n_on_this = 0  # rounds since the newest revision
        self._content_since_s = math.inf
        self._told: dict[int, tuple[bytes, int]] = {}
        self._before: dict[int, int] = {}
        self._helped = b""

    def poll(self, now_s: float) -> None:
        """Look at the group; call it several times a second."""
        group = self._group
        if group.newest_revision != self._revision:
            self._revision, self._revision_since_s = group.newest_revision, now_s
            self._n_on_this = 0
        if not group.majority_wants_update:
            self._wanted_since_s = None
        elif self._wanted_since_s is None:
            self._wanted_since_s = now_s
        # Who does not have the newest revision has not judged it.
        if group.majority_wants_update or group.lacking():
            self._content_since_s = math.inf
        else:
            self._content_since_s = min(self._content_since_s, now_s)
        self._note_tracked()
        if now_s >= self._content_since_s + _CONTENT_S:
            self._n_in_vain = 0  # the last one has helped
        elif self._helped != self._revision and self._shows_more():
            self._n_in_vain, self._helped = 0, self._revision
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

    def _note_tracked(self) -> None:
        """Remember what every member saw last on the map that it has left."""
        for member in self._group.teammates:
            state = self._group.state_of(member)
            if state is None:
                continue
            revision, tracked = self._told.get(member, (state.revision, 0))
            if revision != state.revision:
                self._before[member] = tracked
            self._told[member] = (state.revision, state.tracked)

    def _shows_more(self) -> bool:
        """Whether most members see clearly more of the newest revision than of the last."""
        teammates = set(self._group.teammates)
        more = [
            member
            for member, (revision, tracked) in self._told.items()
            if revision == self._revision
            and member in self._before
            and member in teammates
            and tracked > max(_SEES_MORE * self._before[member], self._options.tracked)
        ]
        return 2 * len(more) > len(teammates)

    def _is_lost(self, member: int) -> bool:
        state = self._group.state_of(member)
        return state is not None and not state.localized
