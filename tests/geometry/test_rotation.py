import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.checks import numeric_jacobian
from tests.scenes import random_rotation
from vcl_companion.geometry.rotation import (
    Array,
    angle_between,
    euler_from_matrix,
    euler_jacobian,
    exp_so3,
    log_so3,
    matrix_from_euler,
    matrix_from_quaternion,
    orthonormalized,
    quaternion_from_matrix,
    right_jacobian_so3,
    skew,
)

angles = st.floats(-np.pi, np.pi)
pitches = st.floats(-1.5, 1.5)


def turns(most_rad: float) -> st.SearchStrategy[Array]:
    """Rotation vectors, the tiny ones too, where the series expansions take over."""
    direction = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3)
    length = st.one_of(
        st.floats(0.0, most_rad),
        st.sampled_from([0.0, 1e-12, 0.99e-7, 1.01e-7, 0.99e-5, 1.01e-5, most_rad]),
    )
    return st.builds(lambda d, s: np.array(d) / np.linalg.norm(d) * s, direction, length)


@given(turns(np.pi))
def test_exp_is_scipys_rotation(vector: Array) -> None:
    np.testing.assert_allclose(
        exp_so3(vector), Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=1e-14
    )


@given(turns(np.pi - 1e-6))
def test_log_undoes_exp(vector: Array) -> None:
    np.testing.assert_allclose(log_so3(exp_so3(vector)), vector, rtol=0, atol=1e-9)


@given(turns(np.pi), turns(np.pi - 1e-6))
def test_the_angle_between_two_rotations_is_that_of_what_leads_from_one_to_the_other(
    first: Array, vector: Array
) -> None:
    one = exp_so3(first)
    other = one @ exp_so3(vector)
    angle_rad = pytest.approx(np.linalg.norm(vector), abs=1e-7)
    assert angle_between(one, other) == angle_rad
    assert angle_between(other, one) == angle_rad


@pytest.mark.parametrize("axis", [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], np.ones(3) / 3**0.5])
def test_half_a_turn_has_a_vector_of_length_pi(axis: Array) -> None:
    rotation = exp_so3(np.pi * axis)
    vector = log_so3(rotation)
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=1e-9)
    np.testing.assert_allclose(exp_so3(vector), rotation, atol=1e-12)


@given(turns(3.0), turns(1e-5))
def test_right_jacobian_carries_a_small_turn(vector: Array, small: Array) -> None:
    jacobian = right_jacobian_so3(vector)
    exact = log_so3(exp_so3(vector).T @ exp_so3(vector + small))
    np.testing.assert_allclose(jacobian @ small, exact, rtol=0, atol=3e-10)


@pytest.mark.parametrize("length_rad", [0.0, 0.9e-5, 1.1e-5, 1e-3, 0.5, 3.0])
def test_right_jacobian_is_the_numeric_one(length_rad: float) -> None:
    vector = length_rad * np.array([2.0, -1.0, 2.0]) / 3.0
    at = exp_so3(vector)
    numeric = numeric_jacobian(lambda d: log_so3(at.T @ exp_so3(vector + d)), np.zeros(3))
    np.testing.assert_allclose(right_jacobian_so3(vector), numeric, atol=1e-8)


def test_skew_is_the_cross_product_of_every_row() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 7, 3))
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b), rtol=0, atol=1e-14
    )
    np.testing.assert_array_equal(skew(a[0]), skew(a)[0])


@given(st.integers(0, 2**32 - 1))
def test_quaternion_and_matrix_are_one_rotation(seed: int) -> None:
    rotation = random_rotation(np.random.default_rng(seed))
    quaternion = quaternion_from_matrix(rotation)
    assert quaternion[0] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(matrix_from_quaternion(quaternion), rotation, atol=1e-14)
    np.testing.assert_allclose(matrix_from_quaternion(-3.0 * quaternion), rotation, atol=1e-14)
    scipys = Rotation.from_matrix(rotation).as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(quaternion, scipys, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_quaternion_of_half_turns(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    np.testing.assert_allclose(quaternion_from_matrix(rotation)[1 + axis], 1.0, atol=1e-15)


@pytest.mark.parametrize("bad", [[0.0] * 4, [np.nan, 0, 0, 1], [np.inf, 0, 0, 0], [1e-12, 0, 0, 0]])
def test_no_rotation_is_an_error(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="not a rotation"):
        matrix_from_quaternion(np.array(bad))


@given(angles, pitches, angles)
def test_euler_round_trip(roll: float, pitch: float, yaw: float) -> None:
    rotation = matrix_from_euler(roll, pitch, yaw)
    scipys = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    np.testing.assert_allclose(rotation, scipys, atol=1e-14)
    np.testing.assert_allclose(
        matrix_from_euler(*euler_from_matrix(rotation)), rotation, rtol=0, atol=1e-12
    )


@given(angles, st.sampled_from([-1.0, 1.0]), st.floats(-1e-4, 1e-4), angles)
def test_euler_round_trip_at_gimbal_lock(roll: float, up: float, off: float, yaw: float) -> None:
    rotation = matrix_from_euler(roll, up * np.pi / 2 + off, yaw)
    # Inside the lock roll is taken as zero: the matrix is off by at most the distance to it.
    np.testing.assert_allclose(
        matrix_from_euler(*euler_from_matrix(rotation)), rotation, rtol=0, atol=1e-4
    )


@given(angles, st.floats(-1.4, 1.4), angles)
def test_euler_jacobian_is_the_numeric_one(roll: float, pitch: float, yaw: float) -> None:
    rotation = matrix_from_euler(roll, pitch, yaw)

    def moved(turn: Array) -> Array:
        new = np.array(euler_from_matrix(rotation @ exp_so3(turn)))
        old = np.array([roll, pitch, yaw])
        return np.asarray((new - old + np.pi) % (2 * np.pi) - np.pi)

    np.testing.assert_allclose(
        euler_jacobian(roll, pitch), numeric_jacobian(moved, np.zeros(3)), rtol=1e-6, atol=1e-6
    )


@pytest.mark.parametrize("pitch_rad", [np.pi / 2, -np.pi / 2, np.pi / 2 + 1e-12])
def test_euler_jacobian_stays_finite_at_gimbal_lock(pitch_rad: float) -> None:
    jacobian = euler_jacobian(0.3, pitch_rad)
    assert np.all(np.isfinite(jacobian))
    assert 900.0 < np.abs(jacobian).max() <= 1001.0


def test_orthonormalized_undoes_drift_and_never_reflects() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        rotation = random_rotation(rng)
        found = orthonormalized(rotation + 1e-3 * rng.standard_normal((3, 3)))
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(found) > 0
        off = float(np.linalg.norm(log_so3(rotation.T @ found)))
        assert 1e-5 < off < 5e-3
    assert np.linalg.det(orthonormalized(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1.0)
