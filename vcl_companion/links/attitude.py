"""The autopilot's recent attitudes, and the one at an instant of our clock; no socket, no clock.

An attitude carries the autopilot's milliseconds since its start. They are
turned into our time only when an attitude is asked for, by the best offset
known then.

An autopilot that begins to take its heading from our poses turns its north at once, by what it
was wrong. Nobody turns so fast, and its gyros do not feel it: its attitudes are told on as if it
had not. One that was told no pose yet has found its north by itself, as a PX4 does by its compass
soon after its start.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from vcl_companion.geometry.rotation import Array, about_down, exp_so3, log_so3
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

# What a heading changes by beyond its last rate is the autopilot's doing when it is more than
# the noise of two samples, more than a drone can accelerate its turn, and not between what the
# gyros say at both samples.
_HEADING_NOISE_RAD = math.radians(1.5)
_HEADING_ACCELERATION_RAD_S2 = 20.0
# A rate is by samples at least so far from each other, as a share of how long it is carried on.
_LEAST_SHARE, _MOST_STEPS_BACK = 0.7, 16

Taken = Literal["taken", "overtaken", "rebooted", "turned"]


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
        step_rad = self._turned_by(sample)
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

    def _in_first_north(self, sample: AttitudeSample) -> AttitudeSample:
        if self._north_rad == 0.0:
            return sample
        return replace(sample, ned_from_body=about_down(-self._north_rad) @ sample.ned_from_body)

    def _turned_by(self, sample: AttitudeSample) -> float:
        """Return by how much the autopilot turned its north before a sample, rad; 0 if not."""
        if not self._samples:
            return 0.0
        last = self._samples[-1]
        since_s = self._s_between(last, sample)
        expected = self._rate_before(since_s) or _rate_felt(since_s, last, sample)
        if expected is None:
            return 0.0
        rate_rad_s, step_s = expected
        change_rad = _heading_change(last, sample)
        beyond_rad = change_rad - rate_rad_s * since_s
        possible_rad = _HEADING_NOISE_RAD * max(1.0, since_s / step_s)
        possible_rad += _HEADING_ACCELERATION_RAD_S2 * since_s * max(step_s, since_s)
        is_own = abs(beyond_rad) <= possible_rad or _is_felt(change_rad, since_s, last, sample)
        return 0.0 if is_own else beyond_rad

    def _rate_before(self, since_s: float) -> tuple[float, float] | None:
        """Return the rate to carry on for so long, rad/s, and the time that it is by; None: none.

        Both by the samples before, of which one is too few.
        """
        if len(self._samples) < 2:
            return None
        before, last = self._far_enough_back(since_s), self._samples[-1]
        step_s = self._s_between(before, last)
        return (_heading_change(before, last) / step_s, step_s) if step_s > 0.0 else None

    def _far_enough_back(self, since_s: float) -> AttitudeSample:
        """Return the sample to take the rate by that is carried on for so long; of two or more.

        By one close to the newest it would be mostly noise, and they do come at odd times.
        """
        back = range(2, min(len(self._samples), _MOST_STEPS_BACK) + 1)
        last, earlier = self._samples[-1], [self._samples[-i] for i in back]
        far = (s for s in earlier if self._s_between(s, last) >= _LEAST_SHARE * since_s)
        return next(far, earlier[-1])

    def _s_between(self, before: AttitudeSample, after: AttitudeSample) -> float:
        return (self._measured_ns(after) - self._measured_ns(before)) * 1e-9

    def _newest_ns(self, offset_ns: int) -> int:
        return self._measured_ns(self._samples[-1]) + offset_ns

    @staticmethod
    def _measured_ns(sample: AttitudeSample) -> int:
        """Return the likeliest instant of a sample by the autopilot's clock, ns."""
        return sample.time_boot_ms * _NS_PER_MS + _CUT_OFF_NS


def _heading_change(before: AttitudeSample, after: AttitudeSample) -> float:
    """Return by how much a body turned about the vertical from one sample to another, rad."""
    return float(log_so3(after.ned_from_body @ before.ned_from_body.T)[2])


def _felt(*samples: AttitudeSample) -> list[float]:
    """Return what the gyros say of the heading at those of some samples that tell, rad/s."""
    return [s.heading_rate_rad_s for s in samples if s.heading_rate_rad_s is not None]


def _rate_felt(since_s: float, *samples: AttitudeSample) -> tuple[float, float] | None:
    """Return the mean of what the gyros say at samples so far apart, and that time.

    None where one does not say.
    """
    rates = _felt(*samples)
    return (sum(rates) / len(rates), since_s) if len(rates) == len(samples) else None


def _is_felt(change_rad: float, since_s: float, *samples: AttitudeSample) -> bool:
    """Whether a change of heading lies between what the gyros say at these samples."""
    known = _felt(*samples)
    if not known:
        return False
    least, most = min(known) * since_s, max(known) * since_s
    return least - _HEADING_NOISE_RAD <= change_rad <= most + _HEADING_NOISE_RAD


def _on_arc(before: AttitudeSample, after: AttitudeSample, fraction: float) -> Array:
    """Return (3, 3) the attitude at a fraction of the turn from one to another, or beyond it."""
    turn = log_so3(before.ned_from_body.T @ after.ned_from_body)
    return np.asarray(before.ned_from_body @ exp_so3(fraction * turn))
