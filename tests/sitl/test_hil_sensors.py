"""What the sensors that PX4 is given say of a motion, against the motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sitl.autopilots.hil_sensors import hil_sensors
from sitl.autopilots.motion import GRAVITY_M_S2, Motion, RecordedMotion

STEP_NS = 4_000_000
N = 2500


def still(down_m: float, ned_from_body: Rotation) -> Motion:
    """Ten seconds of standing somewhere."""
    quaternion = np.roll(ned_from_body.as_quat(), 1)
    recorded = RecordedMotion(
        np.array([0, STEP_NS * N]),
        np.tile([3.0, -2.0, down_m], (2, 1)),
        np.tile(quaternion, (2, 1)),
    )
    return recorded.at(STEP_NS * np.arange(N))


def readings(motion: Motion, *, shaken: bool = False, seed: int = 0) -> list[dict[str, float]]:
    since_us = 4000 + STEP_NS // 1000 * np.arange(N)
    rng = np.random.default_rng(seed)
    messages = hil_sensors(motion, since_us, np.full(N, shaken), rng)
    assert [message.time_usec for message in messages] == since_us.tolist()
    return [message.to_dict() for message in messages]


def vectors(said: list[dict[str, float]], *names: str) -> np.ndarray:
    return np.array([[one[name] for name in names] for one in said])


@pytest.mark.parametrize("shaken", [False, True])
def test_who_stands_still_feels_its_weight_and_the_field(shaken: bool) -> None:
    turned = Rotation.from_euler("ZYX", [70.0, -8.0, 15.0], degrees=True)
    said = readings(still(0.0, turned), shaken=shaken)
    forces = vectors(said, "xacc", "yacc", "zacc")
    np.testing.assert_allclose(
        forces.mean(axis=0), turned.inv().apply([0.0, 0.0, -GRAVITY_M_S2]), atol=0.01
    )
    np.testing.assert_allclose(vectors(said, "xgyro", "ygyro", "zgyro").mean(axis=0), 0, atol=5e-4)
    field = turned.apply(vectors(said, "xmag", "ymag", "zmag").mean(axis=0))
    assert np.degrees(np.arctan2(field[1], field[0])) == pytest.approx(0.0, abs=0.2)
    assert field[2] > field[0] > 0.1
    # PX4 1.16.1 measures half of this, and takes 1.2 m/s^2 of it for being moved.
    pairs = forces.reshape(-1, 2, 3).mean(axis=1)
    shakes_m_s2 = np.linalg.norm(np.diff(pairs, axis=0), axis=1).mean()
    low_m_s2, high_m_s2 = (3.0, 5.0) if shaken else (0.01, 0.1)
    assert low_m_s2 < shakes_m_s2 < high_m_s2


def test_a_climb_is_a_fall_of_pressure_by_the_standard_atmosphere() -> None:
    low, high = (readings(still(down_m, Rotation.identity())) for down_m in (0.0, -100.0))
    fall_hpa = low[0]["abs_pressure"] - high[0]["abs_pressure"]
    # ISO 2533: 954.61 hPa at 500 m, 943.22 at 600 m
    assert np.mean([one["abs_pressure"] for one in low]) == pytest.approx(954.61, abs=0.02)
    assert fall_hpa == pytest.approx(11.39, abs=0.05)
    assert np.mean([one["pressure_alt"] for one in high]) == pytest.approx(600.0, abs=0.01)


def test_each_sensor_speaks_at_its_own_rate_and_never_says_the_same_twice() -> None:
    said = readings(still(0.0, Rotation.identity()))
    fields = [int(one["fields_updated"]) for one in said]
    assert sum(bool(one & 0x1C0) for one in fields) == N // 4
    assert sum(one & 0x1A00 == 0x1A00 for one in fields) == N // 5
    assert all(one & 0x3F == 0x3F for one in fields)
    assert len({one["xmag"] for one in said}) > 0.99 * N
    assert said == readings(still(0.0, Rotation.identity()))
    assert said != readings(still(0.0, Rotation.identity()), seed=1)


def test_readings_one_by_one_come_at_the_same_rates() -> None:
    whole = [int(one["fields_updated"]) for one in readings(still(0.0, Rotation.identity()))]
    stands = RecordedMotion(np.array([0, 1]), np.zeros((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    rng = np.random.default_rng(0)
    single = [
        hil_sensors(stands.at(np.array([0])), np.array([at_us]), np.array([False]), rng)[0]
        for at_us in range(4000, 4000 * 41, 4000)
    ]
    assert [one.fields_updated for one in single] == whole[:40]
