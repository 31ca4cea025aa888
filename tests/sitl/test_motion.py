"""What a simulated IMU feels on a recorded trajectory, against dead reckoning by it alone."""

import numpy as np
from scipy.spatial.transform import Rotation

from sitl.autopilots.motion import GRAVITY_M_S2, Motion, RecordedMotion
from vcl_companion.geometry.rotation import Array

STEP_NS = 2_500_000
START_NS = 1_760_002_000_000_000_000


def recorded() -> tuple[RecordedMotion, Array, Array]:
    """10 s at 5 Hz of a body that flies and turns in all directions."""
    t = np.arange(0.0, 10.01, 0.2)
    positions = np.c_[3.0 * np.sin(0.5 * t), np.cos(0.7 * t), -5.0 + 0.3 * t]
    angles = np.c_[0.1 * np.sin(t), 0.1 * np.cos(t), 0.5 * t]
    quaternions = np.roll(Rotation.from_euler("xyz", angles).as_quat(), 1, axis=1)
    at_ns = START_NS + np.round(t * 1e9).astype(np.int64)
    return RecordedMotion(at_ns, positions, quaternions), positions, quaternions


def rotations(motion: Motion) -> Rotation:
    return Rotation.from_quat(np.roll(motion.quaternions, -1, axis=1))


def test_the_motion_goes_through_the_recorded_poses() -> None:
    motion, positions, quaternions = recorded()
    at_ns = START_NS + np.arange(51, dtype=np.int64) * 200_000_000
    there = motion.at(at_ns)
    np.testing.assert_allclose(there.positions_m, positions, atol=1e-9)
    same = np.abs(np.sum(there.quaternions * quaternions, axis=1))
    np.testing.assert_allclose(same, 1.0, atol=1e-9)


def test_what_the_imu_feels_integrates_to_the_truth() -> None:
    """From rest before the recording to its end, by gyroscope and accelerometer alone."""
    motion, _, _ = recorded()
    at_ns = np.arange(START_NS - 8_000_000_000, START_NS + 10_000_000_000, STEP_NS, dtype=np.int64)
    felt = motion.at(at_ns)
    true = rotations(felt)
    step_s = STEP_NS * 1e-9
    turned, speed, position = true[0], felt.velocities_m_s[0], felt.positions_m[0]
    np.testing.assert_array_equal(speed, 0.0)
    furthest_m = furthest_rad = 0.0
    for k in range(len(at_ns) - 1):
        rate = felt.angular_rates_rad_s[k : k + 2].mean(axis=0)
        after = turned * Rotation.from_rotvec(rate * step_s)
        force = turned.apply(felt.specific_forces_m_s2[k])
        force = 0.5 * (force + after.apply(felt.specific_forces_m_s2[k + 1]))
        acceleration = force + np.array([0.0, 0.0, GRAVITY_M_S2])
        position = position + speed * step_s + 0.5 * acceleration * step_s**2
        speed, turned = speed + acceleration * step_s, after
        furthest_m = max(furthest_m, float(np.linalg.norm(position - felt.positions_m[k + 1])))
        furthest_rad = max(furthest_rad, float((turned.inv() * true[k + 1]).magnitude()))
    assert 1e-9 < furthest_m < 1e-3
    assert furthest_rad < 1e-5


def test_before_the_recording_it_stands_still() -> None:
    motion, _, _ = recorded()
    at_ns = START_NS - np.array([60_000_000_000, 4_000_000_000], dtype=np.int64)
    still = motion.at(at_ns)
    np.testing.assert_array_equal(still.velocities_m_s, 0.0)
    np.testing.assert_array_equal(still.angular_rates_rad_s, 0.0)
    np.testing.assert_array_equal(still.positions_m[0], still.positions_m[1])
    held = rotations(still).inv().apply([0.0, 0.0, -GRAVITY_M_S2])
    np.testing.assert_allclose(still.specific_forces_m_s2, held, atol=1e-12)
    # It does not wind itself up while it takes up its turn.
    begins = rotations(motion.at(np.array([START_NS], dtype=np.int64)))[0]
    assert np.rad2deg((rotations(still)[0].inv() * begins).magnitude()) < 10.0


def test_nothing_of_it_jumps() -> None:
    motion, _, _ = recorded()
    at_ns = np.arange(START_NS - 8_000_000_000, START_NS + 10_000_000_000, STEP_NS, dtype=np.int64)
    felt = motion.at(at_ns)
    assert np.abs(np.diff(felt.specific_forces_m_s2, axis=0)).max() < 0.1
    assert np.abs(np.diff(felt.velocities_m_s, axis=0)).max() < 0.01
    assert np.abs(np.diff(felt.angular_rates_rad_s, axis=0)).max() < 0.02
