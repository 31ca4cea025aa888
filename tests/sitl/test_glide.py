"""A way that is flown straight, against how far one comes at its speed."""

import numpy as np
import pytest

from sitl.autopilots.glide import Glide

NS = 1_000_000_000
START, END = np.array([1.0, 2.0, -3.0]), np.array([7.0, 10.0, -3.0])


def glide(end: np.ndarray = END, speed_m_s: float = 2.0, yaw_rad: float = -3.0) -> Glide:
    return Glide(START, end, 3.0, yaw_rad, speed_m_s, 5 * NS)


@pytest.mark.parametrize("speed_m_s", [0.5, 2.0, 9.0])
def test_it_goes_straight_from_rest_to_rest_at_its_speed(speed_m_s: float) -> None:
    way = glide(speed_m_s=speed_m_s)
    at_ns = np.arange(5 * NS, 40 * NS, NS // 100)
    said = [way.at(int(t)) for t in at_ns]
    places, velocities, pushes = (np.array([one[k] for one in said]) for k in range(3))
    np.testing.assert_allclose(places[0], START)
    np.testing.assert_allclose(places[-1], END)
    np.testing.assert_allclose(velocities[[0, -1]], 0.0, atol=1e-12)
    ahead = (END - START) / np.linalg.norm(END - START)
    np.testing.assert_allclose(np.cross(places - START, ahead), 0.0, atol=1e-9)
    speeds = velocities @ ahead
    assert speeds.min() >= 0.0
    # 10 m at 1 m/s^2 are too few for more than the root of 10.
    assert speeds.max() == pytest.approx(min(speed_m_s, np.sqrt(10.0)), rel=0.01)
    assert np.abs(np.diff(speeds)).max() <= 0.01 + 1e-9
    np.testing.assert_allclose(pushes[-1], 0.0)
    assert set(np.round(pushes @ ahead, 9)) <= {-1.0, 0.0, 1.0}
    grown = np.cumsum(0.01 * 0.5 * (pushes[1:] + pushes[:-1]) @ ahead)
    np.testing.assert_allclose(speeds[1:], grown, atol=0.015)
    moved = np.diff(places, axis=0) @ ahead
    np.testing.assert_allclose(moved, 0.01 * 0.5 * (speeds[1:] + speeds[:-1]), atol=1e-4)


def test_before_it_begins_it_is_at_its_start() -> None:
    place, velocity, _, yaw_rad = glide().at(0)
    np.testing.assert_allclose(place, START)
    np.testing.assert_allclose(velocity, 0.0)
    assert yaw_rad == 3.0


def test_it_turns_the_shorter_way_round_and_no_faster_than_is_good_for_cameras() -> None:
    way = glide()
    yaws = np.array([way.at(t).yaw_rad for t in range(5 * NS, 15 * NS, NS // 100)])
    assert np.all(np.diff(yaws) >= 0.0)
    assert np.diff(yaws).max() <= np.deg2rad(0.3) + 1e-9
    assert np.rad2deg(yaws[-1] - 2 * np.pi) == pytest.approx(np.rad2deg(-3.0))


def test_who_is_there_already_stays() -> None:
    place, velocity, acceleration, yaw_rad = glide(START, yaw_rad=2.0).at(60 * NS)
    np.testing.assert_allclose(acceleration, 0.0)
    np.testing.assert_allclose(place, START)
    np.testing.assert_allclose(velocity, 0.0)
    assert yaw_rad == pytest.approx(2.0)
