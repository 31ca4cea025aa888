"""How far the autopilot's clock is from ours, estimated from TIMESYNC; no socket, no clock.

If both ways of an exchange took equally long, the autopilot answered in the middle of
it; the error is at most half of the round trip (``swarm/time_questions.py``).
"""

from __future__ import annotations

import statistics
from collections import deque

from vcl_companion.swarm.time_questions import Exchange, TimeQuestions

_WINDOW = 16
_MAX_ROUND_TRIP_NS = 1_000_000_000
# An autopilot's clock that is this much earlier than before has started anew.
_REBOOT_NS = 1_000_000_000
# Exchanges that agree with each other and not with the estimate, before they replace it.
_JUMP_EXCHANGES = 5
_JUMP_NS = 100_000_000
# Crystals differ by up to 50 ppm: 1.5 ms in this time.
_STALE_NS = 30_000_000_000


class TimesyncEstimator:
    """The offset between two clocks: the median over the quicker half of a window.

    A slow round trip says little, so the slower half is not used; the median
    over the others ignores single wrong ones.
    """

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=_WINDOW)
        self._questions = TimeQuestions(_MAX_ROUND_TRIP_NS)
        self._last_tc1_ns: int | None = None
        self._disagreeing: list[Exchange] = []

    @property
    def n_exchanges(self) -> int:
        """How many exchanges the estimate has to choose from."""
        return len(self._exchanges)

    @property
    def unanswered(self) -> int:
        """How many questions in a row got no answer."""
        return self._questions.unanswered

    @property
    def round_trip_s(self) -> float | None:
        """Shortest round trip of the window, s; None before the first."""
        if not self._exchanges:
            return None
        return min(exchange.round_trip_ns for exchange in self._exchanges) * 1e-9

    def ask(self, now_ns: int) -> int:
        """Return the ``ts1`` of a new question, ns; no two questions have the same."""
        return self._questions.ask(now_ns)

    def answered(self, ts1_ns: int, tc1_ns: int, now_ns: int) -> str | None:
        """Take an answer in.

        Returns:
            None, or why it is refused.
        """
        exchange = self._questions.answered(ts1_ns, tc1_ns, now_ns)
        if isinstance(exchange, str):
            return exchange
        if self._last_tc1_ns is not None and tc1_ns < self._last_tc1_ns - _REBOOT_NS:
            self.reset()
        self._last_tc1_ns = tc1_ns
        self._take(exchange)
        return None

    def offset_ns(self, at_ns: int) -> int | None:
        """Return our clock minus the autopilot's, ns; None when unknown near ``at_ns``."""
        if not self._exchanges or abs(at_ns - self._exchanges[-1].heard_at_ns) > _STALE_NS:
            return None
        return self._estimate_ns()

    def reset(self) -> None:
        """Forget everything about the other clock: it has started anew."""
        self._exchanges.clear()
        self._questions.forget()
        self._disagreeing.clear()
        self._last_tc1_ns = None

    def _take(self, exchange: Exchange) -> None:
        if self.offset_ns(exchange.heard_at_ns) is None:
            self._exchanges.clear()
        else:
            error_ns = abs(exchange.offset_ns - self._estimate_ns())
            if error_ns > _JUMP_NS + exchange.round_trip_ns:
                self._disagree(exchange)
                return
        self._disagreeing.clear()
        self._exchanges.append(exchange)

    def _disagree(self, exchange: Exchange) -> None:
        """Let a clock that stepped be believed soon, and one odd answer never."""
        same = [e for e in self._disagreeing if abs(e.offset_ns - exchange.offset_ns) < _JUMP_NS]
        self._disagreeing = [*same, exchange]
        if len(self._disagreeing) >= _JUMP_EXCHANGES:
            self._exchanges.clear()
            self._exchanges.extend(self._disagreeing)
            self._disagreeing = []

    def _estimate_ns(self) -> int:
        longest = statistics.median_high(e.round_trip_ns for e in self._exchanges)
        quick = [e.offset_ns for e in self._exchanges if e.round_trip_ns <= longest]
        return statistics.median_low(quick)
