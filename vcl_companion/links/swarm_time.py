"""The time that frames are signed with: it only rises, and a drone without a clock can learn it.

The guide (https://mavlink.io/en/guide/message_signing.html) wants timestamps of the wall
clock. Many companion boards have none that survives a reboot, and a field has no time
server: their clocks start in 1970, or where they were when the board was last switched off.
So the swarm's time is its own. It is the **latest** that any member knows, and it only rises:

* A drone starts at its wall clock or at the mark that its last run has left on the disk,
  whichever is later (``timestamp_file.py``). A clock outside of 2026 to 2075 is not set.
* From there it goes on with the monotonic clock, and jumps ahead with the wall clock. A
  wall clock that is set back changes nothing.
* Who hears that a member is ahead by more than the allowed skew asks it for the time. What
  it was told **before** it asked proves nothing: it may be a recording of another flight. So
  the question is a TIMESYNC with a random number (below 0, where no clock stands), and only
  a signed answer that repeats that number moves our time: it was signed after the question
  was, by one who has the key.
* One who is far behind must be able to ask, so a question is answered whatever its own
  timestamp. That gives nothing away: an answer to an old question is nobody's any more.

Whatever is later, up to the end of 2075, wins for everybody: were it followed by so many years
of each drone's own only, one would follow a wrong clock that another refuses, and none of the two
would take anything of the other any more. A swarm that has followed a wrong clock stays ahead;
that does no harm, since all are there, and who joins is told.
"""

from __future__ import annotations

from dataclasses import dataclass

from vcl_companion.clock import Moment

TICK_NS = 10_000
TICKS_PER_S = 100_000
# 1 January of 2015, the start of MAVLink's timestamps, 2026, 2076 and 2100, in s since 1970.
_ZERO_S, _FIRST_S, _LAST_S, _END_S = 1_420_070_400, 1_767_225_600, 3_345_062_400, 4_102_444_800
EARLIEST = (_FIRST_S - _ZERO_S) * TICKS_PER_S
LATEST = (_LAST_S - _ZERO_S) * TICKS_PER_S
# A swarm that was told the latest time runs on from there in all its flights. MAVLink ends in 2104.
END = (_END_S - _ZERO_S) * TICKS_PER_S


@dataclass(frozen=True)
class TimeOptions:
    """How the swarm's time is learned.

    Attributes:
        asked_s: how long an answer is waited for before the next question; it is how far
            behind a delayed answer can leave us.
        answered_s: a member is answered no more often than this.
    """

    asked_s: float = 3.0
    answered_s: float = 0.2


def wall_ticks(wall_ns: int) -> int:
    """Return a wall clock's instant in MAVLink's timestamps; below 0 before 2015."""
    return wall_ns // TICK_NS - _ZERO_S * TICKS_PER_S


class SwarmTime:
    """What time it is in the swarm, in ticks of 10 us since 2015, GMT.

    Args:
        earliest: the mark of the last run, which nothing was signed beyond; 0: none.
        now: the present instant.
        options: how far others are followed.
    """

    def __init__(self, earliest: int, now: Moment, options: TimeOptions | None = None) -> None:
        self._options = options or TimeOptions()
        self._base = min(max(earliest, EARLIEST), END)
        self._base_at_ns = now.monotonic_ns
        self._last = self._base
        self._asked: tuple[int, int] | None = None
        self._answered_at_ns: dict[int, int] = {}

    def at(self, now: Moment) -> int:
        """Return the time; it never falls."""
        running = self._base + max(0, now.monotonic_ns - self._base_at_ns) // TICK_NS
        wall = wall_ticks(now.wall_ns)
        if running < wall <= LATEST:
            self._base, self._base_at_ns = wall, now.monotonic_ns
            return wall
        return running

    @property
    def latest(self) -> int:
        """The time of the latest frame that was sent; before the first where time began."""
        return self._last

    def next(self, now: Moment) -> int:
        """Return the time for a frame that is sent now; it rises with every frame."""
        self._last = max(self._last + 1, self.at(now))
        return self._last

    def asks(self, number: int, now: Moment) -> bool:
        """Whether to ask for the time now, as somebody is ahead; ``number`` goes with it.

        Args:
            number: random, so that nobody could know it before.
            now: the present instant.
        """
        if self._asked is not None and self._since_s(self._asked[1], now) < self._options.asked_s:
            return False
        self._asked = (number, now.monotonic_ns)
        return True

    def told(self, number: int, timestamp: int, now: Moment) -> float | None:
        """Take the time of a correctly signed answer, if it answers our question.

        Args:
            number: of the question that is answered.
            timestamp: what the answer was signed with.
            now: the present instant.

        Returns:
            By how much the time has risen, s; None when it is as it was: the answer was not
            asked for, came late, is behind us, or too far ahead to be believed.
        """
        if self._asked is None or number != self._asked[0]:
            return None
        # All answers within the time count: the first may be of one who is behind as well.
        if self._since_s(self._asked[1], now) >= self._options.asked_s:
            return None
        ahead_s = (timestamp - self.at(now)) / TICKS_PER_S
        if not ahead_s > 0.0 or timestamp > LATEST:
            return None
        self._base, self._base_at_ns = timestamp, now.monotonic_ns
        return ahead_s

    def answers(self, member: int, now: Moment) -> bool:
        """Whether to answer a member's question, whose frame was correctly signed."""
        at_ns = self._answered_at_ns.get(member)
        if at_ns is not None and self._since_s(at_ns, now) < self._options.answered_s:
            return False
        self._answered_at_ns[member] = now.monotonic_ns
        return True

    @staticmethod
    def _since_s(at_ns: int, now: Moment) -> float:
        return (now.monotonic_ns - at_ns) * 1e-9
