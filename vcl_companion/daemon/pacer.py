"""When the autopilot is told of our pose: which frames' poses it gets, and when one between.

No clock and no link in here. An estimator wants a pose at least every 100 ms, whatever the camera
gives (PX4 begins to fuse only when poses are less than 0.2 s apart and stops after 0.4 s, an
ArduPilot is healthy when the last is not older than 0.3 s), and has no use for more than it takes.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass

# A frame that comes this share of the shortest time too early is in time: cameras jitter.
_EARLY = 0.25
# A camera that is slower than the least rate by less than this share is quick enough.
_SLOWER = 0.25
_N_PERIODS = 8
_N_LAGS = 16


@dataclass(frozen=True)
class Between:
    """An instant between frames that a pose is due of.

    Attributes:
        at_ns: the instant.
        due_ns: when it is told, at the earliest: it is as late as frames' poses are, and what
            lies where a frame is expected waits for that.
        share: of the time between two frames that it stands for.
    """

    at_ns: int
    due_ns: int
    share: float


class Pacer:
    """Keeps the poses that are told in order, and their rate between two bounds.

    Args:
        min_rate_hz: poses between frames are told where there would be fewer; 0: none is.
        max_rate_hz: frames' poses beyond it are held back.
    """

    def __init__(self, min_rate_hz: float, max_rate_hz: float) -> None:
        self._min_rate_hz = min_rate_hz
        self._shortest_ns = round(1e9 / max_rate_hz)
        self._max_rate_hz = max_rate_hz
        self.room_ns = round((1.0 - _EARLY) * self._shortest_ns)
        """How long before a frame there is no pose between: an ArduPilot drops what comes 20 ms
        after another, and that were the frame's."""
        self._periods: deque[int] = deque(maxlen=_N_PERIODS)
        self._lags: deque[int] = deque(maxlen=_N_LAGS)
        self._arrived_ns: int | None = None
        self._told_ns: int | None = None
        self._frame_told_ns: int | None = None
        self._not_before_ns = 0

    def arrived(self, at_ns: int) -> None:
        """Note the instant of a frame that has come."""
        if self._arrived_ns is not None and at_ns > self._arrived_ns:
            self._periods.append(at_ns - self._arrived_ns)
        self._arrived_ns = at_ns

    def holds_back(self, at_ns: int) -> str:
        """Say why the pose of a frame is not told; empty when it is."""
        if self._told_ns is not None and at_ns // 1000 <= self._told_ns // 1000:
            return "held back: the autopilot was told a later pose"
        if at_ns < self._not_before_ns - _EARLY * self._shortest_ns:
            return f"held back: more than {self._max_rate_hz:g} poses a second"
        return ""

    def told(self, at_ns: int, lag_ns: int) -> None:
        """Note that a frame's pose was told, so long after the frame's instant."""
        self._not_before_ns = max(self._not_before_ns, at_ns) + self._shortest_ns
        self._lags.append(max(lag_ns, 0))
        self._told_ns = self._frame_told_ns = at_ns

    def held_back(self, lag_ns: int) -> None:
        """Note that a frame's pose was not told, so long after the frame's instant.

        Those between have to wait for it as well: once all frames came later than before, and none
        would be told any more.
        """
        self._lags.append(max(lag_ns, 0))

    def told_between(self, at_ns: int) -> None:
        """Note that a pose between frames was told."""
        self._told_ns = at_ns

    def next_between(self, now_ns: int | None = None) -> Between | None:
        """Return the next instant that a pose is due of unless a frame's comes; None if none is.

        With the present instant those are left out that are late when a later one is due.
        """
        if (
            self._min_rate_hz <= 0.0
            or self._told_ns is None
            or self._frame_told_ns is None
            or self._arrived_ns is None
            or not self._periods
        ):
            return None
        period_ns = statistics.median_low(self._periods)
        step_ns = self._step_ns(period_ns)
        lag_ns, wait_ns = statistics.median_low(self._lags), min(period_ns, step_ns) // 2
        n = (self._told_ns - self._frame_told_ns) // step_ns + 1
        if now_ns is not None:
            n = max(n, (now_ns - wait_ns - lag_ns - self._frame_told_ns) // step_ns)
        at_ns = self._frame_told_ns + n * step_ns
        due_ns = at_ns + lag_ns
        if at_ns > self._arrived_ns + period_ns - step_ns // 2:
            due_ns += wait_ns
        return Between(at_ns, due_ns, min(1.0, step_ns / period_ns))

    def _step_ns(self, period_ns: int) -> int:
        """Return the time between two poses: whole parts of that between two frames."""
        frames_s = period_ns * 1e-9
        parts = min(
            math.ceil(frames_s * self._min_rate_hz - _SLOWER),
            math.floor(frames_s * self._max_rate_hz * (1.0 + _EARLY)),
        )
        return period_ns // parts if parts > 1 else max(period_ns, round(1e9 / self._min_rate_hz))
