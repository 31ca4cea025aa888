import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recording.folders import START_NS, random_trajectory
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, log_so3
from vcl_companion.recording import InertialSamples, Trajectory
from vcl_companion.recording.sensor import NED_FROM_REFERENCE


def test_between_two_rows_it_moves_and_turns_steadily() -> None:
    rng = np.random.default_rng(1)
    first = Pose(exp_so3(rng.normal(0, 1, 3)), np.array([1.0, 2.0, -3.0]))
    turn = np.array([0.3, -0.2, 0.9])
    second = Pose(first.rotation @ exp_so3(turn), np.array([2.0, 0.0, -3.5]))
    trajectory = Trajectory.from_poses([START_NS, START_NS + 200], [first, second])
    for share in (0.0, 0.25, 0.5, 1.0):
        pose = trajectory.pose_at(START_NS + int(200 * share))
        assert pose is not None
        position = (1 - share) * first.translation + share * second.translation
        np.testing.assert_allclose(pose.translation, position, atol=1e-12)
        turned = log_so3(first.rotation.T @ pose.rotation)
        np.testing.assert_allclose(turned, share * turn, atol=1e-9)


def test_a_quaternion_of_the_other_sign_does_not_turn_the_long_way() -> None:
    q = np.array([[1.0, 0.0, 0.0, 0.0], [-np.cos(0.1), 0.0, 0.0, -np.sin(0.1)]])
    trajectory = Trajectory(np.array([0, 100]), np.zeros((2, 3)), q)
    pose = trajectory.pose_at(50)
    assert pose is not None
    np.testing.assert_allclose(log_so3(pose.rotation), [0.0, 0.0, 0.1], atol=1e-12)


def test_outside_there_is_no_pose_but_for_a_microsecond() -> None:
    trajectory = random_trajectory(np.random.default_rng(2), [START_NS, START_NS + 10])
    last = START_NS + 10
    for at_ns, row in ((START_NS - 1000, 0), (last + 1000, 1)):
        pose = trajectory.pose_at(at_ns)
        assert pose is not None
        np.testing.assert_array_equal(pose.translation, trajectory.positions_m[row])
    assert trajectory.pose_at(START_NS - 1001) is None
    assert trajectory.pose_at(last + 1001) is None
    assert trajectory.pose_at(2**80) is None
    assert trajectory.pose_at(-(2**80)) is None


@given(st.integers(0, 2**32 - 1), st.sampled_from(["NED", "ENU", "NWU"]))
def test_other_axes_and_back(seed: int, axes: str) -> None:
    trajectory = random_trajectory(np.random.default_rng(seed), [1, 5, 9])
    ned_from_reference = {str(k): v for k, v in NED_FROM_REFERENCE.items()}[axes]
    there = trajectory.turned(ned_from_reference.T)
    np.testing.assert_allclose(
        there.pose(1).rotation, ned_from_reference.T @ trajectory.pose(1).rotation, atol=1e-12
    )
    back = there.turned(ned_from_reference)
    for k in range(3):
        np.testing.assert_allclose(back.pose(k).matrix(), trajectory.pose(k).matrix(), atol=1e-12)
    assert back.velocities_m_s is not None
    assert trajectory.velocities_m_s is not None
    np.testing.assert_array_equal(back.velocities_m_s, trajectory.velocities_m_s)


@pytest.mark.parametrize(
    ("at_ns", "positions", "quaternions"),
    [
        ([], np.zeros((0, 3)), np.zeros((0, 4))),
        ([1, 1], np.zeros((2, 3)), np.eye(4)[[0, 0]]),
        ([2, 1], np.zeros((2, 3)), np.eye(4)[[0, 0]]),
        ([1], np.full((1, 3), np.nan), np.eye(4)[:1]),
        ([1], np.zeros((1, 2)), np.eye(4)[:1]),
        ([1], np.zeros((1, 3)), 2.0 * np.eye(4)[:1]),
        ([1], np.zeros((1, 3)), np.zeros((1, 4))),
    ],
)
def test_a_trajectory_checks_itself(
    at_ns: list[int], positions: np.ndarray, quaternions: np.ndarray
) -> None:
    with pytest.raises(ValueError, match=r"at_ns|finite|unit length"):
        Trajectory(np.array(at_ns, dtype=np.int64), positions, quaternions)


def test_arrays_are_read_only_copies() -> None:
    at_ns, positions = np.array([1, 2]), np.zeros((2, 3))
    trajectory = Trajectory(at_ns, positions, np.eye(4)[[0, 0]])
    samples = InertialSamples(at_ns, positions, positions)
    positions[:] = 7.0
    at_ns[:] = 7
    assert trajectory.at_ns.tolist() == samples.at_ns.tolist() == [1, 2]
    assert not trajectory.positions_m.any()
    for array in (trajectory.at_ns, trajectory.positions_m, trajectory.quaternions):
        assert not array.flags.writeable
    assert not samples.angular_rates_rad_s.flags.writeable
