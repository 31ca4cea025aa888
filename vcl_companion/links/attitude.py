"""The autopilot's recent attitudes, and the one at an instant of our clock; no socket, no clock.

An attitude carries the autopilot's milliseconds since its start. They are
turned into our time only when an attitude is asked for, by the best offset
known then.
"""

from __future__ import annotations

import bisect
from collections import deque
from dataclasses import dataclass
from typing import Literal

import numpy as np

from vcl_companion.geometry.rotation import Array, exp_so3, log_so3
from vcl_companion.links.messages import AttitudeSample

_NS_PER_MS = 1_000_000
# The stamp is cut off to whole milliseconds: on average the truth is half of one later.
_CUT_OFF_NS = _NS_PER_MS // 2
_MAX_SAMPLES = 1024
# A stamp this much earlier than the last is a restart, less is a datagram overtaken.
_REBOOT_MS = 1000
_ARRIVALS = 128
# Who turns goes on turning for so long, and no longer than from one sample to the next: a
# frame need not wait for the sample after it. At 2 rad/s^2 that is wrong by 0.04 degrees.
_CARRIED_NS = 25_000_000
_CARRIED_STEPS = 1.25

Taken = Literal["taken", "overtaken", "rebooted"]


@dataclass(frozen=True, eq=False)
class Attitude:
    """Where the body's axes point.

    Attributes:
        ned_from_body: (3, 3) rotation.
        at_ns: our clock. It is the instant asked for when samples lie on both
            sides of it or shortly before it, else the instant of the nearest sample.
    """

    ned_from_body: Array
    at_ns: int

    def __post_init__(self) -> None:
        if self.ned_from_body.shape != (3, 3):
            raise ValueError(f"an attitude is (3, 3), got {self.ned_from_body.shape}")
        self.ned_from_body.flags.writeable = False


class AttitudeHistory:
    """The last samples of one message, oldest first.

    Args:
        latency_ns: from measuring to arriving, used only without TIMESYNC.
        max_age_ns: how far from the instant asked for a sample may be.
    """

    def __init__(self, latency_ns: int, max_age_ns: int) -> None:
        self._latency_ns = latency_ns
        self._max_age_ns = max_age_ns
        self._samples: deque[AttitudeSample] = deque(maxlen=_MAX_SAMPLES)
        self._arrivals: deque[int] = deque(maxlen=_ARRIVALS)

    def add(self, sample: AttitudeSample, arrived_at_ns: int) -> Taken:
        """Take a sample in; one of an autopilot that has restarted clears those before."""
        taken: Taken = "taken"
        if self._samples:
            later_ms = sample.time_boot_ms - self._samples[-1].time_boot_ms
            if later_ms < -_REBOOT_MS:
                self.clear()
                taken = "rebooted"
            elif later_ms < 0:
                return "overtaken"
            elif later_ms == 0:
                self._samples.pop()
        self._samples.append(sample)
        self._arrivals.append(arrived_at_ns - self._measured_ns(sample))
        return taken

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()
        self._arrivals.clear()

    def offset_by_arrival_ns(self) -> int | None:
        """Return our clock minus the autopilot's, judged by when samples came, ns.

        The quickest of the last arrivals less the latency; None without samples.
        """
        return min(self._arrivals) - self._latency_ns if self._arrivals else None

    def is_near(self, at_ns: int, offset_ns: int) -> bool:
        """Return whether the stream reaches up to ``at_ns``, but for the allowed age."""
        return bool(self._samples) and self._newest_ns(offset_ns) >= at_ns - self._max_age_ns

    def covers(self, at_ns: int, offset_ns: int) -> bool:
        """Return whether what has come tells of ``at_ns``, as far as stamps can tell.

        A sample at or after it does, and so do two shortly before it.
        """
        if not self._samples:
            return False
        if self._newest_ns(offset_ns) + _CUT_OFF_NS >= at_ns:
            return True
        return self._steps_ahead(at_ns, offset_ns) is not None

    def at(self, at_ns: int, offset_ns: int) -> Attitude | None:
        """Return the attitude at an instant.

        Args:
            at_ns: our clock.
            offset_ns: our clock minus the autopilot's.

        Returns:
            interpolated on the arc between the samples around it, or carried on from
            two shortly before it, or the nearest sample when all are on one side;
            None when the nearest is further away than the allowed age.
        """
        index = bisect.bisect_left(
            self._samples, at_ns, key=lambda sample: self._measured_ns(sample) + offset_ns
        )
        around = [self._samples[i] for i in (index - 1, index) if 0 <= i < len(self._samples)]
        times = [self._measured_ns(sample) + offset_ns for sample in around]
        if not around or min(abs(at_ns - time) for time in times) > self._max_age_ns:
            return None
        if len(around) == 1:
            steps = self._steps_ahead(at_ns, offset_ns)
            if steps is None:
                return Attitude(around[0].ned_from_body, times[0])
            return Attitude(_on_arc(self._samples[-2], self._samples[-1], 1.0 + steps), at_ns)
        fraction = (at_ns - times[0]) / (times[1] - times[0])
        return Attitude(_on_arc(around[0], around[1], fraction), at_ns)

    def _steps_ahead(self, at_ns: int, offset_ns: int) -> float | None:
        """Return how far an instant lies behind the newest sample, in steps to the one before.

        None where turning on as before does not tell of it.
        """
        if len(self._samples) < 2:
            return None
        before, last = self._samples[-2], self._samples[-1]
        step_ns = self._measured_ns(last) - self._measured_ns(before)
        ahead_ns = at_ns - self._newest_ns(offset_ns)
        if not 0 <= ahead_ns <= min(_CARRIED_NS, _CARRIED_STEPS * step_ns):
            return None
        return ahead_ns / step_ns

    def _newest_ns(self, offset_ns: int) -> int:
        return self._measured_ns(self._samples[-1]) + offset_ns

    @staticmethod
    def _measured_ns(sample: AttitudeSample) -> int:
        """Return the likeliest instant of a sample by the autopilot's clock, ns."""
        return sample.time_boot_ms * _NS_PER_MS + _CUT_OFF_NS


def _on_arc(before: AttitudeSample, after: AttitudeSample, fraction: float) -> Array:
    """Return (3, 3) the attitude at a fraction of the turn from one to another, or beyond it."""
    turn = log_so3(before.ned_from_body.T @ after.ned_from_body)
    return np.asarray(before.ned_from_body @ exp_so3(fraction * turn))
