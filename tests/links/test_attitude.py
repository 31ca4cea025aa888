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


def sample(boot_ns: int, has_gyros: bool = False) -> AttitudeSample:
    """What an autopilot sends that measured at ``boot_ns``: its stamp is cut to milliseconds."""
    rates = RATE_RAD_S.copy() if has_gyros else None
    return AttitudeSample(1, 1, boot_ns // MS, true_at(boot_ns), "quaternion", rates)


def about_itself(boot_ms: int, heading: float, rate: float | None) -> AttitudeSample:
    """What one sends that stands upright, and what its gyros feel."""
    rates = None if rate is None else np.array([0.0, 0.0, rate])
    turned = exp_so3(np.array([0.0, 0.0, heading]))
    return AttitudeSample(1, 1, boot_ms, turned, "quaternion", rates)


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
        errors.append(angle(attitude.ned_from_body, true_at(at_ns)))
    # Stamps err by up to half a millisecond, at 1.36 rad/s.
    assert 1e-5 < max(errors) < 0.0005 * 1.36 * 1.01


def error_at(ours: AttitudeHistory, at_ns: int) -> float:
    """Return by how much what is told of an instant of the autopilot's clock is wrong, rad."""
    attitude = ours.at(at_ns + OFFSET_NS, OFFSET_NS)
    assert attitude is not None
    return angle(attitude.ned_from_body, true_at(at_ns - MS // 2))


def test_outside_the_nearest_turns_on_by_its_gyros_within_the_age_only() -> None:
    ours = history()
    assert ours.at(0, OFFSET_NS) is None
    ours.add(sample(1000 * MS, has_gyros=True), 0)
    for off_ms in (-99, -30, 0, 4, 30, 100):
        assert error_at(ours, (1000 + off_ms) * MS) < 1e-9
    assert ours.at(1101 * MS + OFFSET_NS, OFFSET_NS) is None
    assert ours.at(899 * MS + OFFSET_NS, OFFSET_NS) is None


def test_it_turns_on_no_longer_than_a_tenth_of_a_second_whatever_is_allowed() -> None:
    ours = history(max_age_ms=500)
    ours.add(sample(1000 * MS, has_gyros=True), 0)
    assert ours.at(1100 * MS + OFFSET_NS, OFFSET_NS) is not None
    assert ours.at(1102 * MS + OFFSET_NS, OFFSET_NS) is None


def test_where_nothing_says_how_it_turned_the_nearest_is_of_its_own_instant_only() -> None:
    ours = history()
    ours.add(sample(1000 * MS), 0)
    assert ours.at(1005 * MS + OFFSET_NS, OFFSET_NS) is not None
    assert ours.at(1030 * MS + OFFSET_NS, OFFSET_NS) is None
    assert ours.at(970 * MS + OFFSET_NS, OFFSET_NS) is None


@pytest.mark.parametrize("has_gyros", [True, False])
def test_of_a_slow_stream_that_ends_each_instant_is_told_as_it_was(has_gyros: bool) -> None:
    """At 5 Hz, turned by 78 degrees in a second: the nearest would be wrong by 7.8 degrees."""
    ours = history()
    for boot_ms in range(1000, 2001, 200):
        ours.add(sample(boot_ms * MS, has_gyros), 0)
    for at_ms in range(1005, 2100, 5):
        assert error_at(ours, at_ms * MS) < 1e-9
    assert ours.at(2102 * MS + OFFSET_NS, OFFSET_NS) is None


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
        assert angle(carried.ned_from_body, true_at(at_ns - MS // 2)) < 1e-9
    assert not ours.covers(1047 * MS + OFFSET_NS, OFFSET_NS)
    assert (
        ours.at(1055 * MS + OFFSET_NS, OFFSET_NS) is None
    )  # a step of 20 ms does not tell of 35 more
    ours.add(sample(1040 * MS), 0)
    assert error_at(ours, 1090 * MS) < 1e-9


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
    assert ours.at(1050 * MS + OFFSET_NS, OFFSET_NS) is None
    assert not ours.covers(2020 * MS + OFFSET_NS, OFFSET_NS)


def test_at_the_edges_of_a_gap_it_is_as_the_gyros_say() -> None:
    """It turned about another axis meanwhile."""
    ours = history()
    ours.add(sample(1000 * MS, has_gyros=True), 0)
    ours.add(sample(2000 * MS, has_gyros=True), 0)
    elsewhere = exp_so3(np.array([0.3, 0.0, 0.0])) @ true_at(2400 * MS)
    ours.add(AttitudeSample(1, 1, 2400, elsewhere, "quaternion", RATE_RAD_S.copy()), 0)
    for at_ms in (1050, 1090, 1920, 1990, 2050, 2099):
        assert error_at(ours, at_ms * MS) < 1e-9
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


NORTH_RAD = np.deg2rad(5.0)


def flown(at_boot_ns: list[int], turned_from_ns: int, noise_deg: float = 0.0) -> AttitudeHistory:
    """A history of one whose autopilot turns its north by 5 degrees at an instant."""
    rng = np.random.default_rng(2)
    ours = history()
    for boot_ns in at_boot_ns:
        one = sample(boot_ns)
        north = NORTH_RAD if boot_ns >= turned_from_ns else 0.0
        noise = exp_so3(rng.normal(0.0, np.deg2rad(noise_deg), 3))
        turned = exp_so3(np.array([0.0, 0.0, north])) @ one.ned_from_body @ noise
        taken = ours.add(AttitudeSample(1, 1, one.time_boot_ms, turned, "quaternion"), 0)
        first = min(b for b in (*at_boot_ns, 10**12) if b >= turned_from_ns)
        assert taken == ("turned" if boot_ns == first else "taken")
    return ours


def test_an_autopilot_that_turns_its_north_does_not_turn_the_drone() -> None:
    times = list(range(1000 * MS, 3000 * MS, 20 * MS))
    ours = flown(times, 2000 * MS)
    assert np.isclose(ours.north_rad, NORTH_RAD, rtol=1e-3)
    for at_ns in (1500 * MS, 1999 * MS, 2003 * MS, 2900 * MS):
        attitude = ours.at(at_ns + OFFSET_NS + MS // 2, OFFSET_NS)
        assert attitude is not None
        assert angle(attitude.ned_from_body, true_at(at_ns)) < np.deg2rad(0.1)


def test_one_that_has_found_its_north_tells_in_that_from_then_on() -> None:
    times = list(range(1000 * MS, 2020 * MS, 20 * MS))
    ours = flown(times, 2000 * MS)
    ours.take_its_north()
    assert ours.north_rad == 0.0
    assert ours.at(1900 * MS + OFFSET_NS, OFFSET_NS) is None
    found = exp_so3(np.array([0.0, 0.0, NORTH_RAD]))
    for boot_ns in range(2020 * MS, 2200 * MS, 20 * MS):
        one = sample(boot_ns)
        turned = found @ one.ned_from_body
        assert ours.add(AttitudeSample(1, 1, one.time_boot_ms, turned, "quaternion"), 0) == "taken"
    for at_ns in (2001 * MS, 2103 * MS):
        attitude = ours.at(at_ns + OFFSET_NS + MS // 2, OFFSET_NS)
        assert attitude is not None
        assert angle(attitude.ned_from_body, found @ true_at(at_ns)) < np.deg2rad(0.1)


@pytest.mark.parametrize("short_ms", [1, 2, 4])
def test_two_samples_shortly_after_each_other_hide_no_turn_of_the_north(short_ms: int) -> None:
    """Seen at 90 samples a second: what was missed came back as a turn the other way."""
    times = list(range(1000 * MS, 2000 * MS, 11 * MS))
    times += [times[-1] + short_ms * MS]
    turned_from = times[-1] + 11 * MS
    ours = flown([*times, *range(turned_from, turned_from + 200 * MS, 7 * MS)], turned_from)
    assert np.isclose(ours.north_rad, NORTH_RAD, rtol=0.02)


def test_noise_and_lost_samples_are_no_turn_of_the_north() -> None:
    rng = np.random.default_rng(3)
    times = [t for t in range(1000 * MS, 5000 * MS, 20 * MS) if rng.random() > 0.3]
    ours = flown(times, 10**12, noise_deg=0.2)
    assert ours.north_rad == 0.0


def test_a_drone_that_begins_to_spin_turns_itself() -> None:
    ours = history()
    for k in range(100):
        heading = 0.5 * 15.0 * max(0.0, (k - 20) * 0.02) ** 2  # 15 rad/s^2
        turned = exp_so3(np.array([0.0, 0.0, heading]))
        assert ours.add(AttitudeSample(1, 1, 1000 + 20 * k, turned, "quaternion"), 0) == "taken"


@pytest.mark.parametrize("has_gyros", [True, False])
def test_what_the_gyros_feel_is_no_turn_of_the_north(has_gyros: bool) -> None:
    """Photographs flown at: a drone that turns between them begins and ends that at once."""
    ours, heading, taken = history(), 0.0, []
    for k in range(60):
        rate = 4.0 * (k // 10 % 2)
        heading += 0.02 * rate
        felt = rate if has_gyros else None
        taken.append(ours.add(about_itself(1000 + 20 * k, heading, felt), 0))
    assert ("turned" in taken) != has_gyros


def test_the_gyros_do_not_feel_a_turn_of_the_north() -> None:
    ours = history()
    for k in range(60):
        heading = 0.02 * k + NORTH_RAD * (k >= 30)
        taken = ours.add(about_itself(1000 + 20 * k, heading, 1.0), 0)
        assert taken == ("turned" if k == 30 else "taken")
    assert np.isclose(ours.north_rad, NORTH_RAD, rtol=1e-6)


@pytest.mark.parametrize("rate", [0.0, -2.8])
def test_the_gyros_tell_of_a_north_that_turns_before_the_second_sample(rate: float) -> None:
    """One that takes its heading from the first pose, told when it had spoken once."""
    ours = history()
    for k in range(10):
        heading = 0.02 * k * rate + np.deg2rad(47.0) * (k >= 1)
        taken = ours.add(about_itself(1000 + 20 * k, heading, rate), 0)
        assert taken == ("turned" if k == 1 else "taken")
    assert np.isclose(ours.north_rad, np.deg2rad(47.0), rtol=1e-6)


@pytest.mark.parametrize("later_ms", [20, 1000])
def test_a_turn_before_the_second_sample_is_the_drones_if_it_can_be(later_ms: int) -> None:
    ours = history()
    for k, rate in enumerate((0.0, 4.0)):
        heading = 2.0 * k * min(0.02 * later_ms / 20, 0.7)
        assert ours.add(about_itself(1000 + later_ms * k, heading, rate), 0) == "taken"
    assert ours.north_rad == 0.0


def test_a_restarted_autopilot_has_a_new_north() -> None:
    ours = flown(list(range(5000 * MS, 7000 * MS, 20 * MS)), 6000 * MS)
    assert ours.add(sample(100 * MS), 0) == "rebooted"
    assert ours.north_rad == 0.0
