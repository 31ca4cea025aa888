"""How far the autopilot's clock is from ours, estimated from TIMESYNC; no socket, no clock.

One exchange: we ask at our instant t0 (``ts1``), the autopilot answers with its own
instant (``tc1``), we hear that at t1. If both ways took equally long, its ``tc1``
happened at (t0 + t1) / 2 of ours; the error is at most half of the round trip.
"""

from __future__ import annotations

import statistics
from collections import deque
from dataclasses import dataclass

_WINDOW = 16
_MAX_OUTSTANDING = 16
_MAX_ROUND_TRIP_NS = 1_000_000_000
# An autopilot's clock that is this much earlier than before has started anew.
_REBOOT_NS = 1_000_000_000
# Exchanges that agree with each other and not with the estimate, before they replace it.
_JUMP_EXCHANGES = 5
_JUMP_NS = 100_000_000
# Crystals differ by up to 50 ppm: 1.5 ms in this time.
_STALE_NS = 30_000_000_000


@dataclass(frozen=True)
class Exchange:
    """One question with its answer.

    Attributes:
        offset_ns: our clock minus the autopilot's.
        round_trip_ns: from asking to hearing the answer.
        at_ns: when the answer came, our clock.
    """

    offset_ns: int
    round_trip_ns: int
    at_ns: int


class TimesyncEstimator:
    """The offset between two clocks: the median over the quicker half of a window.

    A slow round trip says little, so the slower half is not used; the median
    over the others ignores single wrong ones.
    """

    def __init__(self) -> None:
        self._exchanges: deque[Exchange] = deque(maxlen=_WINDOW)
        self._outstanding: dict[int, int] = {}
        self._last_ts1_ns = -1
        self._last_tc1_ns: int | None = None
        self._unanswered = 0
        self._disagreeing: list[Exchange] = []

    @property
    def n_exchanges(self) -> int:
        """How many exchanges the estimate has to choose from."""
        return len(self._exchanges)

    @property
    def unanswered(self) -> int:
        """How many questions in a row got no answer."""
        return self._unanswered

    @property
    def round_trip_s(self) -> float | None:
        """Shortest round trip of the window, s; None before the first."""
        if not self._exchanges:
            return None
        return min(exchange.round_trip_ns for exchange in self._exchanges) * 1e-9

    def ask(self, now_ns: int) -> int:
        """Return the ``ts1`` of a new question, ns; no two questions have the same."""
        ts1_ns = max(now_ns, self._last_ts1_ns + 1)
        self._last_ts1_ns = ts1_ns
        self._outstanding[ts1_ns] = now_ns
        self._unanswered += 1
        if len(self._outstanding) > _MAX_OUTSTANDING:
            del self._outstanding[next(iter(self._outstanding))]
        return ts1_ns

    def answered(self, ts1_ns: int, tc1_ns: int, now_ns: int) -> str | None:
        """Take an answer in.

        Returns:
            None, or why it is refused.
        """
        asked_at_ns = self._outstanding.pop(ts1_ns, None)
        if asked_at_ns is None:
            return "timesync answer to no question"
        if tc1_ns <= 0:
            return "timesync answer without a time"
        round_trip_ns = now_ns - asked_at_ns
        if not 0 <= round_trip_ns <= _MAX_ROUND_TRIP_NS:
            return "timesync answer too late"
        if self._last_tc1_ns is not None and tc1_ns < self._last_tc1_ns - _REBOOT_NS:
            self.reset()
        self._last_tc1_ns = tc1_ns
        self._unanswered = 0
        offset_ns = (asked_at_ns + now_ns) // 2 - tc1_ns
        self._take(Exchange(offset_ns, round_trip_ns, now_ns))
        return None

    def offset_ns(self, at_ns: int) -> int | None:
        """Return our clock minus the autopilot's, ns; None when unknown near ``at_ns``."""
        if not self._exchanges or abs(at_ns - self._exchanges[-1].at_ns) > _STALE_NS:
            return None
        return self._estimate_ns()

    def reset(self) -> None:
        """Forget everything about the other clock: it has started anew."""
        self._exchanges.clear()
        self._outstanding.clear()
        self._disagreeing.clear()
        self._last_tc1_ns = None

    def _take(self, exchange: Exchange) -> None:
        if self.offset_ns(exchange.at_ns) is None:
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
