"""Questions about another's time (TIMESYNC), and which of their answers count.

One exchange: we ask at our instant t0 (``ts1``), the other answers with its own
instant (``tc1``), we hear that at t1. Its ``tc1`` happened somewhere between t0
and t1 of ours, and nothing that comes over the link can say more.
"""

from __future__ import annotations

from dataclasses import dataclass

_MAX_OUTSTANDING = 16


@dataclass(frozen=True)
class Exchange:
    """One question with its answer.

    Attributes:
        asked_at_ns: when it was asked, our clock.
        theirs_at_ns: when it was answered, the other's clock.
        heard_at_ns: when the answer came, our clock.
    """

    asked_at_ns: int
    theirs_at_ns: int
    heard_at_ns: int

    @property
    def round_trip_ns(self) -> int:
        """From asking to hearing the answer."""
        return self.heard_at_ns - self.asked_at_ns

    @property
    def middle_ns(self) -> int:
        """When it was answered, our clock, if both ways took equally long."""
        return (self.asked_at_ns + self.heard_at_ns) // 2

    @property
    def offset_ns(self) -> int:
        """Our clock minus the other's, wrong by at most half of the round trip."""
        return self.middle_ns - self.theirs_at_ns


class TimeQuestions:
    """What was asked and not answered yet; at most sixteen questions are waited for.

    Args:
        max_round_trip_ns: an answer that takes longer says too little.
    """

    def __init__(self, max_round_trip_ns: int) -> None:
        self._max_round_trip_ns = max_round_trip_ns
        self._outstanding: dict[int, int] = {}
        self._last_ts1_ns = -1
        self._unanswered = 0

    @property
    def unanswered(self) -> int:
        """How many questions in a row got no answer."""
        return self._unanswered

    def ask(self, now_ns: int) -> int:
        """Return the ``ts1`` of a new question, ns; no two questions have the same."""
        ts1_ns = max(now_ns, self._last_ts1_ns + 1)
        self._last_ts1_ns = ts1_ns
        self._outstanding[ts1_ns] = now_ns
        self._unanswered += 1
        if len(self._outstanding) > _MAX_OUTSTANDING:
            del self._outstanding[next(iter(self._outstanding))]
        return ts1_ns

    def answered(self, ts1_ns: int, tc1_ns: int, now_ns: int) -> Exchange | str:
        """Return the exchange that an answer completes, or why it is refused."""
        asked_at_ns = self._outstanding.pop(ts1_ns, None)
        if asked_at_ns is None:
            return "timesync answer to no question"
        if tc1_ns <= 0:
            return "timesync answer without a time"
        if not 0 <= now_ns - asked_at_ns <= self._max_round_trip_ns:
            return "timesync answer too late"
        self._unanswered = 0
        return Exchange(asked_at_ns, tc1_ns, now_ns)

    def forget(self) -> None:
        """Wait for no answer any more: the other has started anew."""
        self._outstanding.clear()
