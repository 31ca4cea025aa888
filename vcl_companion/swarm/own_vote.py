"""Whether a drone wants its map updated, by what it has seen of it lately: its vote (IV-G).

No clock: the owner says what time it is. A drone votes for an update when one of these holds for
the median of its last second, or, of the first three, will hold when an update, begun now, is
there (``foresight``):

* landmarks in sight < max(``tracked``, ``share`` x most since this revision, of which no more
  than ``enough`` count: a pose is found by a few hundred, and is hardly better by more); of a
  new map, which nobody has seen for long enough to foresee anything, by where its landmarks lie;
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

A vote stands for half a second after its reason, so that those of a majority meet.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from vcl_companion.swarm.foresight import UpdateTime, foreseen
from vcl_companion.swarm.update_options import UpdateOptions

# One bad frame is no reason to vote: a vote is about the median of so long, s.
_WINDOW_S = 1.0
# Looks that come sooner after each other are one: who is told much at a time would look a hundred
# times at one frame, and these would outvote all others of the window.
_LOOKS_APART_S = 0.04
# What is seen hovers about the bounds: a vote stands for so long after its reason, or those of a
# majority hardly meet.
_STANDS_S = 0.5
# A new map is not judged by less than this share of the window.
_JUDGED_SHARE = 0.2
# A flight comes step by step to where a view will be so many times as new as one that is here
# already: of photographs metres apart the next one may be lost.
_NEWER_AHEAD = 1.6
# A view that is never covered more, by sky perhaps, is no reason to update.
_STILL_COVERED = 0.8


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


@dataclass
class _Best:
    """The best that has been seen of one revision, by medians.

    Attributes:
        revision: empty for no map.
        since_s: when it was first looked at.
        tracked: most landmarks in sight.
        covered: largest share of the image.
        sigma_m: least uncertainty of the position.
    """

    revision: bytes
    since_s: float
    tracked: float = 0.0
    covered: float = 0.0
    sigma_m: float = math.inf


class OwnVote:
    """Whether this drone wants its map updated, by what it has seen of it lately.

    Args:
        options: what it goes by.
        novelty_ahead_deg: how new the map will look where the drone is in so many seconds, if
            it flies on as it does; None where nobody can tell.
        share_ahead: what will be in sight then, of as much as is now, if it turns on as well;
            likewise.

    Attributes:
        options: what it goes by; may be changed.
        reasons: why it wants one, each in some words; none while it does not.
    """

    def __init__(
        self,
        options: UpdateOptions,
        novelty_ahead_deg: Callable[[float], float | None] = lambda ahead_s: None,
        share_ahead: Callable[[float], float | None] = lambda ahead_s: None,
    ) -> None:
        self.options = options
        self._novelty_ahead_deg = novelty_ahead_deg
        self._share_ahead = share_ahead
        self._update_time = UpdateTime()
        self._best = _Best(b"", 0.0)
        self._seen: deque[tuple[float, Sight]] = deque()
        self._newest_since_s = -math.inf
        self.reasons: tuple[str, ...] = ()
        self._had_reason_s = -math.inf

    def follow(self, revision: bytes, is_wanted: bool, is_coming: bool, now_s: float) -> None:
        """Take note of how long updates take; call it before each ``look`` and ``unseen``.

        The arguments are those of ``UpdateTime.follow``.
        """
        self._update_time.follow(revision, is_wanted, is_coming, now_s)

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
        if revision != self._best.revision:
            self._best = _Best(revision, now_s)
            self._seen.clear()
        self._remember(sight, now_s)
        if not self._may_vote():
            self.reasons = ()
        elif now_s - self._best.since_s >= _JUDGED_SHARE * _WINDOW_S:
            reasons = self._reasons_now()
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
        return bool(self._best.revision) and bool(self.options.tracked or self.options.share)

    def _remember(self, sight: Sight, now_s: float) -> None:
        """Keep what is seen now, and of what was seen the window."""
        if not self._seen or sight != self._seen[-1][1]:
            self._newest_since_s = now_s
        at_s = now_s
        if self._seen and now_s < self._seen[-1][0] + _LOOKS_APART_S:
            at_s, _ = self._seen.pop()
        self._seen.append((at_s, sight))
        while self._seen[0][0] < now_s - _WINDOW_S:
            self._seen.popleft()

    def _reasons_now(self) -> tuple[str, ...]:
        """Return what the window gives reason to vote by."""
        judged = {
            "few landmarks": self._is_little(),
            "little of the image": self._is_narrow(),
            "vague position": self._is_vague(),
        }
        reasons = tuple(reason for reason, holds in judged.items() if holds)
        # May look all over the map: not asked where there is a reason already.
        if not reasons and self._is_new():
            reasons = ("new view",)
        return reasons

    def _least(self) -> float:
        """Return the landmarks that have to be in sight."""
        counted = min(self._best.tracked, self.options.enough)
        return max(self.options.tracked, self.options.share * counted)

    def _is_little(self) -> bool:
        # Half of the window does not outvote the other half.
        seen = [(at_s, float(s.tracked)) for at_s, s in self._seen]
        lately = statistics.median_high(n for _, n in seen)
        self._best.tracked = max(self._best.tracked, lately)
        least = self._least()
        return min(lately, self._foreseen(seen, lately)) < least or self._turns_away(lately, least)

    def _turns_away(self, lately: float, least: float) -> bool:
        """Whether little of a new map will be in sight, by where its landmarks lie.

        Its window is too short for a course yet, and who turns may be past it before.
        """
        now_s, _ = self._seen[-1]
        if now_s >= self._best.since_s + _WINDOW_S:
            return False
        share = self._share_ahead(self._ahead_s)
        return share is not None and share * lately < least

    def _is_narrow(self) -> bool:
        known = [(at_s, s.covered) for at_s, s in self._seen if s.covered is not None]
        if not known:
            return False
        lately = statistics.median_high(share for _, share in known)
        self._best.covered = max(self._best.covered, lately)
        tracked = statistics.median_low(sight.tracked for _, sight in self._seen)
        # A pose is as sure as landmarks are far apart, and by the root of how many they are.
        needed = self.options.covered * math.sqrt(min(self.options.enough / max(tracked, 1), 1.0))
        least = min(needed, _STILL_COVERED * self._best.covered)
        return min(lately, self._foreseen(known, lately)) < least

    def _is_new(self) -> bool:
        seen = [(at_s, s.novelty_deg) for at_s, s in self._seen]
        lately_deg = statistics.median_low(novelty for _, novelty in seen)
        if lately_deg > self.options.novelty_deg:
            return True
        foreseen_deg = _NEWER_AHEAD * self.options.novelty_deg
        if not self._foreseen(seen, lately_deg) > foreseen_deg:
            return False
        there_deg = self._novelty_ahead_deg(self._ahead_s)
        return there_deg is None or there_deg > foreseen_deg

    def _is_vague(self) -> bool:
        known = [s.sigma_m for _, s in self._seen if s.sigma_m is not None]
        if not known:
            return False
        lately_m = statistics.median_low(known)
        self._best.sigma_m = min(self._best.sigma_m, lately_m)
        growth = self.options.sigma_growth
        return lately_m > max(self.options.sigma_m, growth * self._best.sigma_m)

    def _foreseen(self, values: Sequence[tuple[float, float]], lately: float) -> float:
        """Return what a quantity will be when an update is there; as lately without a course."""
        now_s, _ = self._seen[-1]
        there = foreseen(values, now_s, _WINDOW_S, self._ahead_s)
        return lately if there is None else there

    @property
    def _ahead_s(self) -> float:
        return self._update_time.ahead_s(self.options.ahead_s)
