"""An autopilot's ``time_boot_ms``, made to run on where its 32 bits begin anew, after 49.7 days.

TIMESYNC tells the same time in 64 bits (ArduPilot's ``micros64``, PX4's ``hrt_absolute_time``), so
the two may be off each other by whole turns of the 32 bits: also where we have begun to listen
after the first of them.
"""

from __future__ import annotations

_NS_PER_MS = 1_000_000
_TURN_MS = 1 << 32
_TURN_NS = _TURN_MS * _NS_PER_MS
# A stamp that comes after a turn is as late as any; who has restarted says another time.
_MOST_LATE_MS = 5_000


class BootClock:
    """One autopilot's, by the stamps that have come; it holds no clock of ours."""

    def __init__(self) -> None:
        self._last_ms: int | None = None
        self._last_at_ns = 0

    def running_ms(self, time_boot_ms: int, now_ns: int) -> int:
        """Return a stamp that goes on from the last one; of who has restarted an earlier one.

        Args:
            time_boot_ms: 32 bits, as it has come.
            now_ns: our clock; one that is not above 0 has not been told the time yet.
        """
        turns = 0
        if self._last_ms is not None:
            turns = self._last_ms // _TURN_MS
            expected_ms = self._last_ms + (now_ns - self._last_at_ns) // _NS_PER_MS
            nearest = round((expected_ms - time_boot_ms) / _TURN_MS)
            off_ms = time_boot_ms + nearest * _TURN_MS - expected_ms
            if self._last_at_ns > 0 and abs(off_ms) <= _MOST_LATE_MS:
                turns = nearest
        self._last_ms, self._last_at_ns = time_boot_ms + turns * _TURN_MS, now_ns
        return self._last_ms

    def offset_ns(self, offset_ns: int, now_ns: int) -> int:
        """Return our clock minus that of ``running_ms``, by our clock minus that of TIMESYNC, ns.

        The last stamp is of about now, and not of many days before.
        """
        if self._last_ms is None:
            return offset_ns
        return offset_ns + _turns_ns(now_ns - offset_ns - self._last_ms * _NS_PER_MS)


def instant_ns(time_boot_ms: int, offset_ns: int, now_ns: int) -> int:
    """Return the instant of a stamp that has just come, our clock, ns.

    Args:
        time_boot_ms: 32 bits, as it has come.
        offset_ns: our clock minus the autopilot's, but for whole turns.
        now_ns: our clock.
    """
    at_ns = time_boot_ms * _NS_PER_MS + offset_ns
    return at_ns + _turns_ns(now_ns - at_ns)


def _turns_ns(ns: int) -> int:
    return round(ns / _TURN_NS) * _TURN_NS
