import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.checks import assert_consistent, assert_pose_close, numeric_jacobian
from tests.scenes import random_rotation
from vcl_companion.geometry.pose import Pose, adjoint, euler_pose_covariance
from vcl_companion.geometry.rotation import Array, euler_from_matrix, matrix_from_euler

seeds = st.integers(0, 2**32 - 1)


def random_pose(rng: np.random.Generator) -> Pose:
    return Pose(random_rotation(rng), 10.0 * rng.standard_normal(3))


def random_covariance(rng: np.random.Generator, sigma: float) -> Array:
    root = sigma * rng.standard_normal((6, 6))
    return np.asarray(root @ root.T)


@given(seeds)
def test_composition_names_cancel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a_from_b, b_from_c = random_pose(rng), random_pose(rng)
    points_c = rng.standard_normal((5, 3))
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points_c), a_from_b.apply(b_from_c.apply(points_c)), atol=1e-12
    )
    assert_pose_close(
        a_from_b.inverse() @ a_from_b, Pose.identity(), within_m=1e-12, within_rad=1e-12
    )
    assert_pose_close(
        Pose.from_quaternion(a_from_b.quaternion(), a_from_b.translation), a_from_b,
        within_m=0.0, within_rad=1e-12,
    )  # fmt: skip
    np.testing.assert_array_equal(Pose.from_matrix(a_from_b.matrix()).matrix(), a_from_b.matrix())
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).matrix(), a_from_b.matrix() @ b_from_c.matrix(), atol=1e-12
    )


def test_apply_takes_any_leading_shape() -> None:
    pose = random_pose(np.random.default_rng(1))
    points = np.random.default_rng(2).standard_normal((4, 2, 3))
    assert pose.apply(points).shape == (4, 2, 3)
    np.testing.assert_allclose(pose.apply(points)[1, 1], pose.apply(points[1, 1]))


@given(seeds, st.floats(0.0, 3.0))
def test_local_undoes_retracted(seed: int, turn_rad: float) -> None:
    rng = np.random.default_rng(seed)
    pose = random_pose(rng)
    axis = rng.standard_normal(3)
    delta = np.concatenate([rng.standard_normal(3), turn_rad * axis / np.linalg.norm(axis)])
    np.testing.assert_allclose(pose.local(pose.retracted(delta)), delta, atol=1e-9)


def test_a_perturbation_is_metres_and_radians_along_the_bodys_axes() -> None:
    pose = Pose(matrix_from_euler(0.0, 0.0, np.pi / 2), np.zeros(3))
    moved = pose.retracted(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.1]))
    np.testing.assert_allclose(moved.translation, [0.0, 1.0, 0.0], atol=1e-12)
    assert euler_from_matrix(moved.rotation)[2] == pytest.approx(np.pi / 2 + 0.1)


def test_adjoint_moves_a_perturbation_through_a_composition() -> None:
    rng = np.random.default_rng(3)
    a_from_b, b_from_c = random_pose(rng), random_pose(rng)
    a_from_c = a_from_b @ b_from_c
    by_first = numeric_jacobian(
        lambda d: a_from_c.local(a_from_b.retracted(d) @ b_from_c), np.zeros(6)
    )
    by_second = numeric_jacobian(
        lambda d: a_from_c.local(a_from_b @ b_from_c.retracted(d)), np.zeros(6)
    )
    np.testing.assert_allclose(adjoint(b_from_c.inverse()), by_first, atol=1e-7)
    np.testing.assert_allclose(np.eye(6), by_second, atol=1e-7)


def test_adjoint_is_a_homomorphism() -> None:
    rng = np.random.default_rng(4)
    one, other = random_pose(rng), random_pose(rng)
    np.testing.assert_allclose(adjoint(one @ other), adjoint(one) @ adjoint(other), atol=1e-11)
    np.testing.assert_allclose(adjoint(one.inverse()) @ adjoint(one), np.eye(6), atol=1e-11)


@given(seeds, st.floats(-3.0, 3.0), st.floats(-1.3, 1.3), st.floats(-3.0, 3.0))
def test_euler_covariance_is_the_numeric_jacobians(
    seed: int, roll: float, pitch: float, yaw: float
) -> None:
    rng = np.random.default_rng(seed)
    pose = Pose(matrix_from_euler(roll, pitch, yaw), rng.standard_normal(3))
    covariance = random_covariance(rng, 0.1)

    def written(delta: Array) -> Array:
        moved = pose.retracted(delta)
        turn = np.array(euler_from_matrix(moved.rotation)) - (roll, pitch, yaw)
        return np.concatenate([moved.translation, (turn + np.pi) % (2 * np.pi) - np.pi])

    jacobian = numeric_jacobian(written, np.zeros(6))
    found = euler_pose_covariance(pose, covariance)
    np.testing.assert_allclose(found, jacobian @ covariance @ jacobian.T, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found, found.T)


def test_euler_covariance_is_that_of_many_draws() -> None:
    rng = np.random.default_rng(5)
    pose = Pose(matrix_from_euler(0.2, -0.4, 2.0), np.array([3.0, -2.0, 1.0]))
    covariance = random_covariance(rng, 0.0005)  # small: the Jacobian is the first order
    truth = np.concatenate([pose.translation, euler_from_matrix(pose.rotation)])
    errors = []
    for delta in rng.multivariate_normal(np.zeros(6), covariance, 2000):
        moved = pose.retracted(delta)
        errors.append(
            np.concatenate([moved.translation, euler_from_matrix(moved.rotation)]) - truth
        )
    assert_consistent(errors, euler_pose_covariance(pose, covariance))


def test_values_are_frozen_copies() -> None:
    rotation, translation = np.eye(3), np.zeros(3)
    pose = Pose(rotation, translation)
    rotation[0, 0] = translation[0] = 7.0
    assert pose.rotation[0, 0] == 1.0
    assert pose.translation[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        pose.rotation[0, 0] = 2.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        pose.translation = np.ones(3)  # type: ignore[misc]


@pytest.mark.parametrize(
    ("rotation", "translation"),
    [
        (np.eye(4), np.zeros(3)),
        (np.eye(3), np.zeros(2)),
        (np.full((3, 3), np.nan), np.zeros(3)),
        (np.eye(3), np.array([0.0, np.inf, 0.0])),
    ],
)
def test_wrong_shapes_and_numbers_are_errors(rotation: Array, translation: Array) -> None:
    with pytest.raises(ValueError, match="must be finite with shape"):
        Pose(rotation, translation)
