"""The autopilot's recent attitudes, and the one at an instant of our clock; no socket, no clock.

An attitude carries the autopilot's milliseconds since its start. They are
turned into our time only when an attitude is asked for, by the best offset
known then.

The attitude at an instant is made of what was said around it, or shortly before: who turns by 60
degrees in a second is 6 degrees further after 0.1 s, and to those who ask it is the frame's own,
known to a fraction of a degree. Where nothing says how the drone turned, there is none.

An autopilot that turns its north (``north_turns``) is told on as if it had not, when that is to
ours. One that was told no pose yet has found its north by itself, as a PX4 does by its compass soon
after its start.
"""

from __future__ import annotations

import bisect
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vcl_companion.geometry.rotation import Array, about_down, exp_so3, log_so3
from vcl_companion.links.messages import AttitudeSample
from vcl_companion.links.north_turns import LEAST_SHARE, north_turned_rad, rate_before

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
# What comes no more turns on so long as at the nearest sample: at 2 rad/s^2 that is wrong by half a
# degree.
_MOST_CARRIED_NS = 100_000_000
# So long it may turn as nobody has said, by 0.3 degrees at 60 degrees in a second.
_HELD_NS = 5_000_000

Taken = Literal["taken", "overtaken", "rebooted", "turned"]


@dataclass(frozen=True, eq=False)
class Attitude:
    """Where the body's axes point at the instant that was asked for.

    Attributes:
        ned_from_body: (3, 3) rotation.
    """

    ned_from_body: Array

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
        self._north_rad = 0.0

    @property
    def north_rad(self) -> float:
        """By how much the autopilot has turned its north since its first sample, rad."""
        return self._north_rad

    @property
    def rate_hz(self) -> float:
        """How often samples were measured lately, Hz; 0 without two of them."""
        if len(self._samples) < 2:
            return 0.0
        lately = [self._samples[i] for i in range(-min(len(self._samples), _ARRIVALS), 0)]
        spanned_s = (lately[-1].time_boot_ms - lately[0].time_boot_ms) * 1e-3
        return (len(lately) - 1) / spanned_s if spanned_s > 0.0 else 0.0

    def add(self, sample: AttitudeSample, arrived_at_ns: int) -> Taken:
        """Take a sample in; one of an autopilot that has restarted clears those before.

        After one that has turned its north all are told in the north of those before.
        """
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
        sample = self._in_first_north(sample)
        step_rad = north_turned_rad(self._samples, sample)
        if step_rad:
            taken = "turned"
            self._north_rad += step_rad
            turned_back = about_down(-step_rad) @ sample.ned_from_body
            sample = replace(sample, ned_from_body=turned_back)
        self._samples.append(sample)
        self._arrivals.append(arrived_at_ns - self._measured_ns(sample))
        return taken

    def take_its_north(self) -> None:
        """Tell the newest sample, and those to come, in the north of now; forget the others."""
        newest = self._samples[-1]
        found = about_down(self._north_rad) @ newest.ned_from_body
        self._samples.clear()
        self._samples.append(replace(newest, ned_from_body=found))
        self._north_rad = 0.0

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()
        self._arrivals.clear()
        self._north_rad = 0.0

    def offset_by_arrival_ns(self) -> int | None:
        """Return our clock minus the autopilot's, judged by when samples came, ns.

        The quickest of the last arrivals less the latency; None without samples.
        """
        return min(self._arrivals) - self._latency_ns if self._arrivals else None

    def newest_ns(self, offset_ns: int) -> int | None:
        """Return the instant of the newest sample, our clock; None without one."""
        return self._newest_ns(offset_ns) if self._samples else None

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
            interpolated on the arc between the samples around it; or, where these are further
            apart than twice the allowed age or all are on one side, turned on from the nearest;
            None when the nearest is further away than the allowed age or 0.1 s, or nothing
            says how it turned there.
        """
        index = bisect.bisect_left(
            self._samples, at_ns, key=lambda sample: self._measured_ns(sample) + offset_ns
        )
        around = [self._samples[i] for i in (index - 1, index) if 0 <= i < len(self._samples)]
        times = [self._measured_ns(sample) + offset_ns for sample in around]
        if not around or min(abs(at_ns - time) for time in times) > self._max_age_ns:
            return None
        if len(around) == 2 and times[1] - times[0] <= 2 * self._max_age_ns:
            fraction = (at_ns - times[0]) / (times[1] - times[0])
            return Attitude(_on_arc(around[0], around[1], fraction))
        steps = self._steps_ahead(at_ns, offset_ns)
        if steps is not None:
            return Attitude(_on_arc(self._samples[-2], self._samples[-1], 1.0 + steps))
        nearest, time_ns = min(zip(around, times, strict=True), key=lambda one: abs(at_ns - one[1]))
        return self._turned_on(nearest, at_ns - time_ns)

    def _turned_on(self, sample: AttitudeSample, ahead_ns: int) -> Attitude | None:
        """Return the attitude so long after a sample, or before it; None if nothing tells of it."""
        ahead_s = ahead_ns * 1e-9
        rate = self._rate_at(sample, ahead_s)
        if rate is None:
            return Attitude(sample.ned_from_body) if abs(ahead_ns) <= _HELD_NS else None
        if abs(ahead_ns) > _MOST_CARRIED_NS:
            return None
        return Attitude(exp_so3(rate * ahead_s) @ sample.ned_from_body)

    def _rate_at(self, sample: AttitudeSample, ahead_s: float) -> Array | None:
        """Return the (3,) rate about north, east, down to turn on by, rad/s; None: not known.

        By the gyros; of who tells nothing of these by how it turned until the newest sample.
        """
        if sample.body_rates_rad_s is not None:
            return np.asarray(sample.ned_from_body @ sample.body_rates_rad_s)
        by_samples = rate_before(self._samples, ahead_s)
        if sample is not self._samples[-1] or by_samples is None:
            return None
        rate, step_s = by_samples
        is_long_enough = LEAST_SHARE * ahead_s <= step_s <= 2e-9 * self._max_age_ns
        return rate if is_long_enough else None

    def _steps_ahead(self, at_ns: int, offset_ns: int) -> float | None:
        """Return how far an instant lies behind the newest sample, in steps to the one before.

        None where turning on as before does not tell of it.
        """
        if len(self._samples) < 2:
            return None
        before, last = self._samples[-2], self._samples[-1]
        step_ns = self._measured_ns(last) - self._measured_ns(before)
        ahead_ns = at_ns - self._newest_ns(offset_ns)
        most_ns = min(_CARRIED_NS, _CARRIED_STEPS * step_ns)
        if step_ns > 2 * self._max_age_ns or not 0 <= ahead_ns <= most_ns:
            return None
        return ahead_ns / step_ns

    def _in_first_north(self, sample: AttitudeSample) -> AttitudeSample:
        if self._north_rad == 0.0:
            return sample
        return replace(sample, ned_from_body=about_down(-self._north_rad) @ sample.ned_from_body)

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
