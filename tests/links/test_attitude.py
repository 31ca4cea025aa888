"""Attitudes at instants of our clock, from samples stamped by another."""

import numpy as np
import pytest

from vcl_companion.geometry.rotation import Array, exp_so3, log_so3
from vcl_companion.links.attitude import AttitudeHistory
from vcl_companion.links.messages import AttitudeSample

MS = 1_000_000
OFFSET_NS = 5_000 * MS
RATE_RAD_S = np.array([0.4, -0.7, 1.1])
START = exp_so3(np.array([0.1, 0.2, -2.0]))


def true_at(boot_ns: float) -> Array:
    return START @ exp_so3(RATE_RAD_S * boot_ns * 1e-9)


def sample(boot_ns: int) -> AttitudeSample:
    """What an autopilot sends that measured at ``boot_ns``: its stamp is cut to milliseconds."""
    return AttitudeSample(1, 1, boot_ns // MS, true_at(boot_ns), "quaternion")


def history(latency_ms: int = 0, max_age_ms: int = 100) -> AttitudeHistory:
    return AttitudeHistory(latency_ms * MS, max_age_ms * MS)


def angle(a: Array, b: Array) -> float:
    return float(np.linalg.norm(log_so3(a.T @ b)))


def test_between_samples_it_lies_on_the_arc() -> None:
    rng = np.random.default_rng(1)
    ours = history()
    for boot_ns in range(1000 * MS, 3000 * MS, 20 * MS):
        ours.add(sample(boot_ns + int(rng.integers(0, MS))), 0)
    errors = []
    for at_ns in rng.integers(1100 * MS, 2900 * MS, 200).tolist():
        attitude = ours.at(at_ns + OFFSET_NS, OFFSET_NS)
        assert attitude is not None
        assert attitude.at_ns == at_ns + OFFSET_NS
        errors.append(angle(attitude.ned_from_body, true_at(at_ns)))
    # Stamps err by up to half a millisecond, at 1.36 rad/s.
    assert 1e-5 < max(errors) < 0.0005 * 1.36 * 1.01


def test_outside_the_nearest_is_held_within_the_age_only() -> None:
    ours = history()
    assert ours.at(0, OFFSET_NS) is None
    ours.add(sample(1000 * MS), 0)
    held = ours.at(1090 * MS + OFFSET_NS, OFFSET_NS)
    assert held is not None
    assert held.at_ns == 1000 * MS + MS // 2 + OFFSET_NS
    np.testing.assert_array_equal(held.ned_from_body, true_at(1000 * MS))
    assert ours.at(910 * MS + OFFSET_NS, OFFSET_NS) is not None
    assert ours.at(1101 * MS + OFFSET_NS, OFFSET_NS) is None
    assert ours.at(899 * MS + OFFSET_NS, OFFSET_NS) is None


def test_shortly_after_two_samples_it_turns_on_as_before() -> None:
    ours = history()
    ours.add(sample(1000 * MS), 0)
    assert not ours.covers(1010 * MS + OFFSET_NS, OFFSET_NS)
    ours.add(sample(1020 * MS), 0)
    for ahead_ms in (1, 15, 25):
        at_ns = 1020 * MS + ahead_ms * MS
        assert ours.covers(at_ns + OFFSET_NS, OFFSET_NS)
        carried = ours.at(at_ns + OFFSET_NS, OFFSET_NS)
        assert carried is not None
        assert carried.at_ns == at_ns + OFFSET_NS
        assert angle(carried.ned_from_body, true_at(at_ns - MS // 2)) < 1e-9
    late_ns = 1047 * MS + OFFSET_NS
    assert not ours.covers(late_ns, OFFSET_NS)
    held = ours.at(late_ns, OFFSET_NS)
    assert held is not None
    np.testing.assert_array_equal(held.ned_from_body, true_at(1020 * MS))


def test_it_turns_on_no_longer_than_from_one_sample_to_the_next() -> None:
    ours = history()
    ours.add(sample(1000 * MS), 0)
    ours.add(sample(1004 * MS), 0)
    assert ours.covers(1009 * MS + OFFSET_NS, OFFSET_NS)
    assert not ours.covers(1010 * MS + OFFSET_NS, OFFSET_NS)


def test_a_gap_is_not_bridged() -> None:
    ours = history()
    ours.add(sample(1000 * MS), 0)
    ours.add(sample(2000 * MS), 0)
    assert ours.at(1500 * MS + OFFSET_NS, OFFSET_NS) is None


@pytest.mark.parametrize("fraction_ns", [0, 1, 400_000, 999_999])
def test_a_sample_of_the_very_instant_covers_it(fraction_ns: int) -> None:
    boot_ns = 1000 * MS + fraction_ns
    ours = history()
    ours.add(sample(boot_ns), 0)
    # A cut stamp must not make the sample look earlier than the frame it was made for.
    assert ours.covers(boot_ns + OFFSET_NS, OFFSET_NS)
    assert not ours.covers(boot_ns + 2 * MS + OFFSET_NS, OFFSET_NS)


def test_order_and_restarts() -> None:
    ours = history()
    assert ours.add(sample(5000 * MS), 0) == "taken"
    assert ours.add(sample(4980 * MS), 0) == "overtaken"
    assert ours.add(sample(5000 * MS + 1), 0) == "taken"
    assert ours.add(sample(100 * MS), 0) == "rebooted"
    assert ours.at(5000 * MS, 0) is None
    assert ours.at(100 * MS, 0) is not None


def test_without_timesync_the_quickest_arrival_sets_the_time() -> None:
    rng = np.random.default_rng(2)
    ours = history(latency_ms=10)
    assert ours.offset_by_arrival_ns() is None
    for boot_ns in range(1000 * MS, 3000 * MS, 20 * MS):
        delay_ns = 10 * MS + int(rng.exponential(8 * MS))
        ours.add(sample(boot_ns), boot_ns + OFFSET_NS + delay_ns)
    offset_ns = ours.offset_by_arrival_ns()
    assert offset_ns is not None
    assert -MS < offset_ns - OFFSET_NS < 2 * MS
