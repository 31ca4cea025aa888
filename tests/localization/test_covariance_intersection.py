"""Covariance intersection against what it promises, for any correlation (eqs. 10, 11)."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.covariance_intersection import intersect, unlikeness

SEEDS = st.integers(0, 2**32 - 1)


def covariance(rng: np.random.Generator, size: float = 0.1) -> Array:
    root = rng.normal(0.0, size, (6, 6)) * 10.0 ** rng.uniform(-1.0, 0.5, 6)[:, None]
    return np.asarray(root @ root.T + 1e-8 * np.eye(6))


def somewhere(rng: np.random.Generator) -> Pose:
    return Pose(exp_so3(rng.uniform(-2.0, 2.0, 3)), rng.uniform(-20.0, 20.0, 3))


@given(SEEDS, st.sampled_from(["some", "none", "whole", "same", "opposite"]))
def test_fused_is_never_below_the_true_covariance_for_any_correlation(
    seed: int, correlation: str
) -> None:
    rng = np.random.default_rng(seed)
    first, second = covariance(rng), covariance(rng)
    # Any admissible cross-covariance: L1 K L2^T with a contraction K.
    contraction = rng.normal(size=(6, 6))
    if correlation == "some":
        contraction *= rng.uniform(0.0, 1.0) / np.linalg.norm(contraction, 2)
    elif correlation == "whole":
        # Either error tells the other: the edge of what is possible.
        contraction, _ = np.linalg.qr(contraction)
    else:
        contraction = {"none": 0.0, "same": 1.0, "opposite": -1.0}[correlation] * np.eye(6)
    cross = np.linalg.cholesky(first) @ contraction @ np.linalg.cholesky(second).T
    pose = somewhere(rng)
    fused = intersect(pose, first, pose, second, arm_m=10.0)
    # At one pose the fusion is linear: W1 x1 + W2 x2 with these weights.
    weight_1 = fused.covariance @ (fused.omega * np.linalg.inv(first))
    weight_2 = fused.covariance @ ((1.0 - fused.omega) * np.linalg.inv(second))
    true = weight_1 @ first @ weight_1.T + weight_2 @ second @ weight_2.T
    true += weight_1 @ cross @ weight_2.T + weight_2 @ cross.T @ weight_1.T
    slack = np.linalg.eigvalsh(fused.covariance - true).min()
    assert slack > -1e-6 * np.linalg.eigvalsh(fused.covariance).max()


@given(SEEDS)
def test_fused_is_no_worse_than_either_in_the_measure_that_chose_omega(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second, pose = covariance(rng), covariance(rng), somewhere(rng)
    arm = 12.0
    units = np.diag([1.0, 1.0, 1.0, arm, arm, arm]) ** 2
    fused = intersect(pose, first, pose, second, arm)
    best = min(np.trace(first @ units), np.trace(second @ units))
    assert np.trace(fused.covariance @ units) <= best * (1.0 + 1e-6)
    assert 0.0 <= fused.omega <= 1.0


def test_two_equal_estimates_gain_nothing() -> None:
    """The same information twice is the same information; a Kalman update halves it."""
    rng = np.random.default_rng(1)
    pose, one = somewhere(rng), covariance(rng)
    fused = intersect(pose, one, pose, one, arm_m=5.0)
    np.testing.assert_allclose(fused.covariance, one, rtol=1e-6)


def test_a_starved_target_takes_what_the_other_knows() -> None:
    rng = np.random.default_rng(2)
    truth = somewhere(rng)
    vague, sharp = np.eye(6) * 1.0, np.eye(6) * 1e-4
    first = truth.retracted(np.array([0.8, -0.5, 0.3, 0.02, 0.01, -0.03]))
    fused = intersect(first, vague, truth, sharp, arm_m=10.0)
    assert fused.omega < 0.01
    assert np.abs(fused.world_from_body.local(truth)).max() < 1e-3
    np.testing.assert_allclose(fused.covariance, sharp, rtol=0.02, atol=1e-8)


def test_each_gives_what_it_knows_better() -> None:
    truth = Pose.identity()
    first_knows_x = np.diag([1e-4, 1.0, 1.0, 1e-4, 1e-4, 1e-4])
    second_knows_y = np.diag([1.0, 1e-4, 1.0, 1e-4, 1e-4, 1e-4])
    first = truth.retracted(np.array([0.0, 0.7, 0.0, 0.0, 0.0, 0.0]))
    second = truth.retracted(np.array([0.7, 0.0, 0.0, 0.0, 0.0, 0.0]))
    fused = intersect(first, first_knows_x, second, second_knows_y, arm_m=10.0)
    assert np.linalg.norm(fused.world_from_body.translation) < 0.01
    assert 0.0 < fused.covariance[0, 0] < 1e-3
    assert 0.0 < fused.covariance[1, 1] < 1e-3


def test_the_covariance_is_written_at_the_fused_pose() -> None:
    """Far apart in rotation, a covariance known in world axes must come out the same there."""
    first = Pose.identity()
    second = first.retracted(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.2]))
    sharp = np.diag([0.04, 0.01, 0.09, 1e-6, 1e-6, 1e-6])
    vague = np.eye(6) * 100.0
    fused = intersect(first, vague, second, sharp, arm_m=1.0)
    np.testing.assert_allclose(fused.covariance, sharp, rtol=0.05, atol=1e-3)


def test_unlikeness_is_small_for_what_can_be_and_large_for_what_cannot() -> None:
    rng = np.random.default_rng(3)
    truth = somewhere(rng)
    first, second = covariance(rng), covariance(rng)
    draws = [
        unlikeness(
            truth.retracted(rng.multivariate_normal(np.zeros(6), first) * 0.3), first, truth, second
        )
        for _ in range(50)
    ]
    assert max(draws) < 27.9
    far = truth.retracted(30.0 * np.sqrt(np.diag(first + second)))
    assert unlikeness(far, first, truth, second) > 27.9


@pytest.mark.parametrize("broken", [np.zeros((6, 6)), -np.eye(6), np.full((6, 6), np.nan)])
def test_a_covariance_that_is_none_is_refused(broken: Array) -> None:
    pose = Pose.identity()
    with pytest.raises(ValueError, match="positive definite"):
        intersect(pose, broken, pose, np.eye(6), arm_m=1.0)
    with pytest.raises(ValueError, match="arm_m"):
        intersect(pose, np.eye(6), pose, np.eye(6), arm_m=0.0)
