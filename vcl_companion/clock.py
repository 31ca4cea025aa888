"""Where time comes from: an argument, never a global."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Source of instants: integer nanoseconds that never step backwards."""

    def now_ns(self) -> int:
        """Return the current instant, ns."""
        ...


class SystemClock:
    """The host's monotonic clock, the time base of a daemon in flight."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC, ns."""
        return time.monotonic_ns()


class ManualClock:
    """A clock that stands still until it is told the time (simulation, replay, tests).

    A recording replayed faster or slower than it was taken must still look to
    the daemon like the flight it was: the recording's own time is the time.
    """

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Return the instant last told, ns."""
        return self._now_ns

    def advance_to(self, now_ns: int) -> None:
        """Set the clock to ``now_ns``; an earlier instant is ignored, time never runs back."""
        self._now_ns = max(self._now_ns, now_ns)


@dataclass(frozen=True)
class Moment:
    """One instant by both of the host's clocks.

    Attributes:
        wall_ns: since 1970, GMT; steps in either direction when somebody sets it, and
            starts anywhere on a board that has no battery for it.
        monotonic_ns: never steps back; counts from an arbitrary start.
    """

    wall_ns: int
    monotonic_ns: int


def system_moment() -> Moment:
    """Return the host's present instant."""
    return Moment(time.time_ns(), time.monotonic_ns())
