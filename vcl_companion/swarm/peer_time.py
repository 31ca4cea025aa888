"""How a peer's clock goes beside ours: offset and drift, each with a bound; no socket, no clock.

An exchange says for certain that the peer's ``tc1`` happened within its round trip
(``time_questions``), however unequal the two ways were. Two clocks drift apart by a
rate that hardly changes. So every exchange of a sliding window bounds the offset of
any instant: half of its round trip, and the uncertainty of the drift times its age;
and every two of them bound the drift. What all of them allow is the answer, its middle
the estimate: quick exchanges decide, slow ones say little and do no harm.

What cannot be true together is another clock, or a lie: a peer that was restarted, or
one wrong answer. Until more answers tell which, nothing is known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from vcl_companion.swarm.time_questions import Exchange, TimeQuestions

_WINDOW = 32
# Over a slow radio, behind a map that is on its way.
_MAX_ROUND_TRIP_NS = 10_000_000_000
# Crystals of small boards are off by up to 100 ppm, to either side.
MAX_DRIFT = 200e-6
# How much that changes while the window lasts: with the temperature, some ppm.
_WANDER = 5e-6
# So many answers in a row that agree with each other, and not with what was known before.
_NEW_EPOCH = 3
# So many are enough to ask rarely.
_SETTLED = 4
# Who has not answered for so long may be another by now.
_STALE_NS = 120_000_000_000
# Worse than this, two instants are not the same: nobody keeps frames for it either.
_LEAST_KNOWN_NS = 1_000_000_000
# Nothing is on its way for longer.
_LONGEST_WAY_NS = 600_000_000_000


@dataclass(frozen=True)
class ClockRelation:
    """What is known of a peer's clock at one instant.

    Attributes:
        at_ns: the instant, our clock.
        offset_ns: our clock minus the peer's then.
        bound_ns: the true offset is no further from that.
        drift: how much faster than the peer's our clock goes: 1e-6 gains 1 us a second.
        drift_bound: the true drift is no further from that.
    """

    at_ns: int
    offset_ns: int
    bound_ns: int
    drift: float
    drift_bound: float

    def __str__(self) -> str:
        return (
            f"our clock is {self.offset_ns * 1e-9:+.6f} s from its, "
            f"within {self.bound_ns * 1e-6:.3g} ms, drift {self.drift * 1e6:+.1f} ppm "
            f"within {self.drift_bound * 1e6:.3g}"
        )


@dataclass(frozen=True)
class Instant:
    """An instant that a peer speaks of, in our time.

    Attributes:
        at_ns: our clock.
        bound_ns: the true one is no further from that; None where the clocks are not
            related, and the way of the message is taken for no time at all.
    """

    at_ns: int
    bound_ns: int | None


@dataclass(frozen=True)
class _Span:
    """What one exchange allows: ``lowest`` to ``highest`` was our clock minus theirs."""

    at_ns: int
    lowest_ns: float
    highest_ns: float


class _Fit:
    """All that exchanges allow together; without any consistent clock, ``is_possible`` is False.

    Offsets are relative to ``base_ns``, that of the last exchange: floats are exact there.
    """

    def __init__(self, exchanges: Sequence[Exchange], resolution_ns: int) -> None:
        last = exchanges[-1]
        self.at_ns, self.base_ns = last.middle_ns, last.offset_ns
        spans = [self._span(exchange, resolution_ns) for exchange in exchanges]
        self.slowest, self.fastest = -MAX_DRIFT, MAX_DRIFT
        for a, b in combinations(spans, 2):
            apart_ns = b.at_ns - a.at_ns
            if apart_ns > 0:
                self.slowest = max(self.slowest, (b.lowest_ns - a.highest_ns) / apart_ns)
                self.fastest = min(self.fastest, (b.highest_ns - a.lowest_ns) / apart_ns)
        self.lowest_ns = max(s.lowest_ns + min(self._gained(self.at_ns - s.at_ns)) for s in spans)
        self.highest_ns = min(s.highest_ns + max(self._gained(self.at_ns - s.at_ns)) for s in spans)

    @property
    def is_possible(self) -> bool:
        return self.slowest <= self.fastest and self.lowest_ns <= self.highest_ns

    def _gained(self, in_ns: int) -> tuple[float, float]:
        return self.slowest * in_ns, self.fastest * in_ns

    def _span(self, exchange: Exchange, resolution_ns: int) -> _Span:
        """Return what an exchange says, as far as it still holds at our instant."""
        half_ns = exchange.round_trip_ns * (0.5 + MAX_DRIFT) + resolution_ns + 1.0
        half_ns += _WANDER * abs(exchange.middle_ns - self.at_ns)
        middle_ns = exchange.offset_ns - self.base_ns
        return _Span(exchange.middle_ns, middle_ns - half_ns, middle_ns + half_ns)

    def at(self, at_ns: int) -> tuple[float, float]:
        """Return the lowest and the highest offset of an instant, less ``base_ns``."""
        gained_ns = self._gained(at_ns - self.at_ns)
        wander_ns = _WANDER * abs(at_ns - self.at_ns)
        return (
            self.lowest_ns + min(gained_ns) - wander_ns,
            self.highest_ns + max(gained_ns) + wander_ns,
        )

    def allows(self, exchange: Exchange, resolution_ns: int) -> bool:
        """Whether another exchange can be true as well."""
        lowest_ns, highest_ns = self.at(exchange.middle_ns)
        span = self._span(exchange, resolution_ns)
        return span.lowest_ns <= highest_ns and span.highest_ns >= lowest_ns


class PeerTime:
    """One peer's clock beside ours, from questions that the peer answered.

    Args:
        resolution_ns: how much a clock may lag behind the time that it tells; 0 for clocks
            that run, more for those that are told the time now and then.
    """

    def __init__(self, resolution_ns: int = 0) -> None:
        self._resolution_ns = resolution_ns
        self._questions = TimeQuestions(_MAX_ROUND_TRIP_NS)
        self._exchanges: deque[Exchange] = deque(maxlen=_WINDOW)
        self._doubts: list[Exchange] = []
        self._fit: _Fit | None = None
        self._is_confirmed = True
        self.n_epochs = 0
        """How many clocks the peer has had so far."""

    @property
    def is_settled(self) -> bool:
        """Whether it is enough to ask now and then."""
        return self._is_trusted and len(self._exchanges) >= _SETTLED

    @property
    def _is_trusted(self) -> bool:
        return self._is_confirmed and not self._doubts

    def ask(self, now_ns: int) -> int:
        """Return the ``ts1`` of a new question, ns; no two questions have the same."""
        return self._questions.ask(now_ns)

    def answered(self, ts1_ns: int, tc1_ns: int, now_ns: int) -> str | None:
        """Take an answer in, whatever is in it.

        Returns:
            None, or why it is refused.
        """
        exchange = self._questions.answered(ts1_ns, tc1_ns, now_ns)
        if isinstance(exchange, str):
            return exchange
        if self._fit is not None and not self._fit.allows(exchange, self._resolution_ns):
            return self._doubt(exchange)
        self.n_epochs = max(self.n_epochs, 1)
        self._doubts.clear()
        self._is_confirmed = True
        self._exchanges.append(exchange)
        self._fit = self._fitted()
        return None

    def rejoined(self) -> None:
        """Note that the peer was away: it may have another clock now, until it answers."""
        self._is_confirmed = False

    def relation(self, at_ns: int) -> ClockRelation | None:
        """Return what is known of an instant of our clock; None when that is nothing certain."""
        fit = self._fit
        if fit is None or not self._is_trusted:
            return None
        if abs(at_ns - self._exchanges[-1].heard_at_ns) > _STALE_NS:
            return None
        lowest_ns, highest_ns = fit.at(at_ns)
        return ClockRelation(
            at_ns,
            fit.base_ns + round((lowest_ns + highest_ns) / 2),
            math.ceil((highest_ns - lowest_ns) / 2) + 1,
            (fit.slowest + fit.fastest) / 2,
            (fit.fastest - fit.slowest) / 2,
        )

    def instant(self, theirs_ns: int, age_s: float, came_at_ns: int) -> Instant:
        """Return an instant that the peer speaks of in our time.

        By the clocks' relation; by its age, as if the message had taken no time, while that
        is not known well, or where the age speaks against it.

        Args:
            theirs_ns: the instant, the peer's clock.
            age_s: how long ago that was when the message was sent.
            came_at_ns: when it came, our clock.
        """
        by_age = Instant(came_at_ns - round(age_s * 1e9), None)
        now = self.relation(came_at_ns)
        then = None if now is None else self.relation(theirs_ns + now.offset_ns)
        if then is None or then.bound_ns > _LEAST_KNOWN_NS:
            return by_age
        # It was not sent later than it came, so this is the latest that it can be.
        latest_ns = by_age.at_ns + round(MAX_DRIFT * age_s * 1e9) + self._resolution_ns
        at_ns, bound_ns = theirs_ns + then.offset_ns, then.bound_ns
        if not -bound_ns <= latest_ns - at_ns <= _LONGEST_WAY_NS:
            return by_age
        return Instant(min(at_ns, latest_ns), bound_ns)

    def _fitted(self) -> _Fit:
        """Return what the window allows, without the oldest where all cannot be true."""
        while not (fit := _Fit(self._exchanges, self._resolution_ns)).is_possible:
            self._exchanges.popleft()
        return fit

    def _doubt(self, exchange: Exchange) -> str | None:
        """Let a clock that has begun anew be believed soon, and one odd answer never."""
        agreeing = [e for e in self._doubts if self._agree(e, exchange)]
        self._doubts = [*agreeing, exchange]
        if len(self._doubts) < _NEW_EPOCH:
            return "timesync answer that does not fit the others"
        self._exchanges.clear()
        self._exchanges.extend(self._doubts)
        self._doubts = []
        self._is_confirmed = True
        self._fit = self._fitted()
        self.n_epochs += 1
        return None

    def _agree(self, earlier: Exchange, later: Exchange) -> bool:
        return _Fit([earlier], self._resolution_ns).allows(later, self._resolution_ns)
