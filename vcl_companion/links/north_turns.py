"""Whether an autopilot has turned its north between two attitudes, and by how much.

One that begins to take its heading from our poses turns its north at once, by what it was wrong.
Nobody turns so fast, and its gyros do not feel it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from vcl_companion.geometry.rotation import Array, log_so3
from vcl_companion.links.messages import AttitudeSample

# What a heading changes by beyond its last rate is the autopilot's doing when it is more than
# the noise of two samples, more than a drone can accelerate its turn, and not between what the
# gyros say at both samples.
_HEADING_NOISE_RAD = math.radians(1.5)
_HEADING_ACCELERATION_RAD_S2 = 20.0
# A rate is by samples at least so far from each other, as a share of how long it is carried on.
LEAST_SHARE, _MOST_STEPS_BACK = 0.7, 16


def north_turned_rad(before: Sequence[AttitudeSample], sample: AttitudeSample) -> float:
    """Return by how much the autopilot turned its north before a sample, rad; 0 if not.

    Args:
        before: the samples until then, oldest first, in the north that they began with.
        sample: the next one.
    """
    if not before:
        return 0.0
    last = before[-1]
    since_s = s_between(last, sample)
    expected = _heading_rate_before(before, since_s) or _rate_felt(since_s, last, sample)
    if expected is None:
        return 0.0
    rate_rad_s, step_s = expected
    change_rad = _heading_change(last, sample)
    beyond_rad = change_rad - rate_rad_s * since_s
    possible_rad = _HEADING_NOISE_RAD * max(1.0, since_s / step_s)
    possible_rad += _HEADING_ACCELERATION_RAD_S2 * since_s * max(step_s, since_s)
    is_own = abs(beyond_rad) <= possible_rad or _is_felt(change_rad, since_s, last, sample)
    return 0.0 if is_own else beyond_rad


def rate_before(samples: Sequence[AttitudeSample], since_s: float) -> tuple[Array, float] | None:
    """Return the rate to carry on for so long, and the time that it is by, s; None: none.

    The rate is (3,) about north, east and down, rad/s. Both are by the samples, of which one is
    too few.
    """
    if len(samples) < 2:
        return None
    before, last = _far_enough_back(samples, since_s), samples[-1]
    step_s = s_between(before, last)
    return (_turn(before, last) / step_s, step_s) if step_s > 0.0 else None


def s_between(before: AttitudeSample, after: AttitudeSample) -> float:
    """Return the time between two samples, s."""
    return (after.time_boot_ms - before.time_boot_ms) * 1e-3


def _far_enough_back(samples: Sequence[AttitudeSample], since_s: float) -> AttitudeSample:
    """Return the sample to take the rate by that is carried on for so long; of two or more.

    By one close to the newest it would be mostly noise, and they do come at odd times.
    """
    back = range(2, min(len(samples), _MOST_STEPS_BACK) + 1)
    last, earlier = samples[-1], [samples[-i] for i in back]
    far = (s for s in earlier if s_between(s, last) >= LEAST_SHARE * since_s)
    return next(far, earlier[-1])


def _heading_rate_before(
    samples: Sequence[AttitudeSample], since_s: float
) -> tuple[float, float] | None:
    by_samples = rate_before(samples, since_s)
    return None if by_samples is None else (float(by_samples[0][2]), by_samples[1])


def _turn(before: AttitudeSample, after: AttitudeSample) -> Array:
    """Return the (3,) turn from one sample to another about north, east and down, rad."""
    return log_so3(after.ned_from_body @ before.ned_from_body.T)


def _heading_change(before: AttitudeSample, after: AttitudeSample) -> float:
    """Return by how much a body turned about the vertical from one sample to another, rad."""
    return float(_turn(before, after)[2])


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
