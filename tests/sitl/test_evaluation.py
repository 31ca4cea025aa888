import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sitl.evaluation import (
    Estimates,
    covariance_from_upper,
    pose_errors,
    ref_from_world,
    rigid_alignment,
    scores,
    sent_error,
    upper_from_covariance,
)
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, euler_from_matrix, matrix_from_euler

# A frame far off and turned, so that nothing that confuses the two frames passes.
REF_FROM_WORLD = Pose(matrix_from_euler(0.02, -0.03, 2.0), np.array([40.0, -7.0, -3.0]))


def random_poses(rng: np.random.Generator, n: int) -> list[Pose]:
    """World_from_body of n poses as drones have them: any heading, modest tilt."""
    angles = rng.uniform([-0.4, -0.4, -np.pi], [0.4, 0.4, np.pi], size=(n, 3))
    return [Pose(matrix_from_euler(*a), rng.normal(size=3, scale=10.0)) for a in angles]


def estimates_of(poses: list[Pose], covariance: Array | None = None) -> Estimates:
    shape = np.eye(6) * 1e-4 if covariance is None else covariance
    return Estimates(
        np.arange(len(poses)) * 200_000_000,
        tuple(poses),
        np.broadcast_to(shape, (len(poses), 6, 6)),
    )


def in_ref(poses: list[Pose]) -> tuple[Pose, ...]:
    return tuple(REF_FROM_WORLD @ pose for pose in poses)


def noisy(rng: np.random.Generator, pose: Pose, covariance: Array) -> Pose:
    """Return a pose with an error drawn in the terms that MAVLink's covariance speaks of."""
    error = rng.multivariate_normal(np.zeros(6), covariance)
    angles = np.add(euler_from_matrix(pose.rotation), error[3:])
    return Pose(matrix_from_euler(*angles), pose.translation + error[:3])


def random_covariance(rng: np.random.Generator, sigma_m: float, sigma_rad: float) -> Array:
    mixing = rng.normal(size=(6, 6))
    scale = np.array([sigma_m] * 3 + [sigma_rad] * 3)
    return np.asarray((mixing @ mixing.T / 6.0 + 0.2 * np.eye(6)) * np.outer(scale, scale))


def test_exact_estimates_have_no_error() -> None:
    poses = random_poses(np.random.default_rng(1), 20)
    errors = pose_errors(estimates_of(poses), in_ref(poses), REF_FROM_WORLD)
    result = scores(errors)
    assert result is not None
    assert result.ate_m < 1e-12
    assert result.ate_aligned_m is not None
    assert result.ate_aligned_m < 1e-12
    assert result.yaw_rmse_deg < 1e-9
    assert np.max(errors.nees) < 1e-18
    assert (result.within_3_sigma_share, result.within_3_sigma_or_10cm_share) == (1.0, 1.0)


def test_the_leader_s_first_estimate_lies_on_its_truth_whatever_world_is() -> None:
    estimate, truth = random_poses(np.random.default_rng(2), 2)
    laid = ref_from_world(truth, estimate) @ estimate
    assert np.allclose(laid.matrix(), truth.matrix(), atol=1e-12)


def test_a_constant_offset_is_the_ate_and_alignment_takes_it_away() -> None:
    poses = random_poses(np.random.default_rng(3), 30)
    offset_ref = np.array([0.3, -0.4, 1.2])
    truth = tuple(Pose(p.rotation, p.translation - offset_ref) for p in in_ref(poses))
    result = scores(pose_errors(estimates_of(poses), truth, REF_FROM_WORLD))
    assert result is not None
    assert result.ate_m == pytest.approx(1.3, abs=1e-9)
    assert result.worst_m == pytest.approx(1.3, abs=1e-9)
    assert result.rmse_m == pytest.approx((0.3, 0.4, 1.2), abs=1e-9)
    assert result.ate_aligned_m == pytest.approx(0.0, abs=1e-9)


def test_rmse_is_told_along_the_recording_s_own_axes() -> None:
    poses = random_poses(np.random.default_rng(3), 5)
    truth = tuple(Pose(p.rotation, p.translation - (0.3, -0.4, 1.2)) for p in in_ref(poses))
    errors = pose_errors(estimates_of(poses), truth, REF_FROM_WORLD)
    enu_from_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    result = scores(errors, enu_from_ned)
    assert result is not None
    assert result.rmse_m == pytest.approx((0.4, 0.3, 1.2), abs=1e-9)


def test_one_turn_of_the_whole_track_costs_ate_but_not_aligned_ate() -> None:
    poses = random_poses(np.random.default_rng(4), 30)
    turn = Pose(matrix_from_euler(0.0, 0.0, np.radians(2.0)), np.zeros(3))
    turned = [turn @ pose for pose in poses]
    result = scores(pose_errors(estimates_of(turned), in_ref(poses), REF_FROM_WORLD))
    assert result is not None
    assert result.yaw_rmse_deg == pytest.approx(2.0, abs=0.2)
    assert result.ate_m > 0.1
    assert result.ate_aligned_m is not None
    assert result.ate_aligned_m < 1e-9


@pytest.mark.parametrize("promised", [1.0, 3.0])
def test_nees_tells_honest_covariance_from_overconfident(promised: float) -> None:
    """The median of chi-square with 6 degrees of freedom is 5.348; 1/9 of it makes it 48."""
    rng = np.random.default_rng(5)
    truth_world = random_poses(rng, 3000)
    covariances = np.array([random_covariance(rng, 0.05, 0.01) for _ in truth_world])
    sent = [noisy(rng, p, c) for p, c in zip(truth_world, covariances, strict=True)]
    estimates = Estimates(np.arange(3000), tuple(sent), covariances / promised**2)
    errors = pose_errors(estimates, in_ref(truth_world), REF_FROM_WORLD)
    result = scores(errors)
    assert result is not None
    assert result.nees_median is not None
    assert 5.05 < result.nees_median / promised**2 < 5.65
    if promised == 1.0:
        # Three axes within 3 sigma each: 0.9973 when one, 0.9919 when independent.
        assert 0.985 < result.within_3_sigma_share < 0.9985
        assert 5.7 < np.mean(errors.nees) < 6.3
    else:
        assert result.within_3_sigma_share < 0.5


def test_covariance_turns_with_the_frame_and_nees_does_not() -> None:
    quarter = Pose(matrix_from_euler(0.0, 0.0, np.pi / 2), np.zeros(3))
    estimate = Pose(np.eye(3), np.array([0.5, 0.0, 0.0]))
    long_in_world_x = np.diag([1.0, 0.01, 0.04, 0.1, 0.1, 0.1]) ** 2
    estimates = Estimates(np.arange(1), (estimate,), long_in_world_x[None])
    errors = pose_errors(estimates, (quarter @ Pose.identity(),), quarter)
    assert errors.position_ref_m[0] == pytest.approx([0.0, 0.5, 0.0], abs=1e-12)
    assert errors.position_sigma_ref_m[0, 1] == pytest.approx(1.0)
    assert errors.position_sigma_ref_m[0, 0] == pytest.approx(0.01)
    assert errors.nees[0] == pytest.approx(0.25, rel=1e-9)
    assert errors.within_3_sigma[0]


def test_the_ten_centimetre_floor_holds_for_each_axis() -> None:
    poses = [Pose.identity()] * 3
    truth = tuple(Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0001, 0.099, 0.101))
    errors = pose_errors(estimates_of(poses, np.eye(6) * 1e-6), truth, Pose.identity())
    assert errors.within_3_sigma.tolist() == [True, False, False]
    assert errors.within_3_sigma_or_10cm.tolist() == [True, True, False]


def test_without_a_covariance_nothing_is_within_sigma_and_nees_is_unknown() -> None:
    poses = [Pose.identity()] * 2
    errors = pose_errors(estimates_of(poses, np.full((6, 6), np.nan)), tuple(poses), poses[0])
    assert errors.within_3_sigma.tolist() == [False, False]
    assert errors.within_3_sigma_or_10cm.tolist() == [True, True]
    result = scores(errors)
    assert result is not None
    assert result.nees_median is None


def test_a_covariance_that_is_none_gives_no_nees() -> None:
    bad = np.eye(6)
    bad[0, 1] = bad[1, 0] = 2.0
    errors = pose_errors(estimates_of([Pose.identity()], bad), (Pose.identity(),), Pose.identity())
    assert np.isnan(errors.nees[0])


def test_headings_are_compared_across_the_half_turn() -> None:
    almost, beyond = (Pose(matrix_from_euler(0, 0, np.radians(d)), np.zeros(3)) for d in (179, 182))
    assert np.degrees(sent_error(beyond, almost)[5]) == pytest.approx(3.0)
    errors = pose_errors(estimates_of([almost]), (beyond,), Pose.identity())
    assert np.degrees(errors.yaw_rad[0]) == pytest.approx(-3.0)


def test_estimates_without_truth_are_left_out() -> None:
    poses = random_poses(np.random.default_rng(6), 3)
    truth = in_ref(poses)
    errors = pose_errors(estimates_of(poses), (truth[0], None, truth[2]), REF_FROM_WORLD)
    assert errors.at_ns.tolist() == [0, 400_000_000]
    nothing = pose_errors(estimates_of(poses), (None, None, None), REF_FROM_WORLD)
    assert scores(nothing) is None


def test_two_poses_are_too_few_to_align() -> None:
    poses = random_poses(np.random.default_rng(7), 2)
    result = scores(pose_errors(estimates_of(poses), in_ref(poses), REF_FROM_WORLD))
    assert result is not None
    assert result.ate_aligned_m is None


@pytest.mark.parametrize("flat", [False, True])
def test_alignment_agrees_with_scipy_and_never_mirrors(flat: bool) -> None:
    rng = np.random.default_rng(8)
    moved = rng.normal(size=(40, 3)) * (5.0, 3.0, 0.0 if flat else 1.0)
    fixed = REF_FROM_WORLD.apply(moved) + rng.normal(size=(40, 3), scale=0.2)
    mine = rigid_alignment(moved, fixed)
    theirs, _ = Rotation.align_vectors(fixed - fixed.mean(axis=0), moved - moved.mean(axis=0))
    assert np.allclose(mine.rotation, theirs.as_matrix(), atol=1e-9)
    assert np.linalg.det(mine.rotation) == pytest.approx(1.0)
    assert np.allclose(mine.apply(moved).mean(axis=0), fixed.mean(axis=0))


def test_the_diagonal_of_the_wire_s_order_is_where_mavlink_has_it() -> None:
    covariance = covariance_from_upper(np.arange(21.0))
    assert np.diagonal(covariance).tolist() == [0.0, 6.0, 11.0, 15.0, 18.0, 20.0]
    assert (covariance[0, 5], covariance[5, 0], covariance[1, 2]) == (5.0, 5.0, 7.0)
    with pytest.raises(ValueError, match="21 values"):
        covariance_from_upper(np.zeros(20))


@given(st.lists(st.floats(-1e6, 1e6), min_size=21, max_size=21))
def test_the_wire_s_order_goes_both_ways(values: list[float]) -> None:
    covariance = covariance_from_upper(np.array(values))
    assert np.array_equal(covariance, covariance.T)
    assert upper_from_covariance(covariance).tolist() == values
