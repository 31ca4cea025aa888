import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import random_rotation
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.p3p import MAX_MODELS, p3p


def sighting(rng: np.random.Generator) -> tuple[Array, Array, Pose]:
    """Return three rays of length 1, the landmarks behind them, and cam_from_world."""
    points_cam = np.column_stack([rng.uniform(-1.0, 1.0, (3, 2)), np.ones(3)])
    points_cam *= rng.uniform(2.0, 20.0, (3, 1))
    pose = Pose(random_rotation(rng), 10.0 * rng.standard_normal(3))
    rays = points_cam / np.linalg.norm(points_cam, axis=1, keepdims=True)
    return rays, pose.inverse().apply(points_cam), pose


def error(found: Pose, truth: Pose) -> float:
    return float(np.abs(found.matrix() - truth.matrix()).max())


def test_the_truth_is_among_the_solutions() -> None:
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(1000):
        rays, points, truth = sighting(rng)
        found = p3p(rays, points)
        assert 1 <= len(found) <= MAX_MODELS
        errors.append(min(error(pose, truth) for pose in found))
    assert np.median(errors) < 1e-12
    assert max(errors) < 1e-4


def test_every_solution_puts_the_landmarks_on_their_rays_in_front() -> None:
    rng = np.random.default_rng(2)
    for _ in range(300):
        rays, points, _ = sighting(rng)
        for pose in p3p(3.0 * rays, points):
            seen = pose.apply(points)
            depths = np.einsum("ni,ni->n", seen, rays)
            assert depths.min() > 0.0
            assert np.abs(seen - depths[:, None] * rays).max() < 1e-6
            assert np.linalg.det(pose.rotation) == pytest.approx(1.0)


def test_agrees_with_poselib() -> None:
    poselib = pytest.importorskip("poselib", exc_type=ImportError)
    rng = np.random.default_rng(3)
    same = 0
    for _ in range(500):
        rays, points, _ = sighting(rng)
        ours = p3p(rays, points)
        theirs = [Pose(pose.R, pose.t) for pose in poselib.p3p(list(rays), list(points))]
        same += len(ours) == len(theirs) and all(
            min(error(pose, other) for other in ours) < 1e-4 for pose in theirs
        )
    # The rest are double solutions, which rounding may make none or two.
    assert same >= 495


def test_an_equilateral_triangle_seen_along_its_axis_is_no_special_case() -> None:
    angles = 2.0 * np.pi / 3.0 * np.arange(3)
    points = np.column_stack([np.cos(angles), np.sin(angles), np.full(3, 5.0)])
    found = p3p(points / np.linalg.norm(points, axis=1, keepdims=True), points)
    assert min(error(pose, Pose.identity()) for pose in found) < 1e-5


@pytest.mark.parametrize(
    "points",
    [
        [[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [2.0, 0.0, 5.0]],
        [[0.0, 0.0, 5.0], [0.0, 0.0, 5.0], [2.0, 1.0, 5.0]],
        [[0.0, 0.0, 5.0]] * 3,
    ],
)
def test_landmarks_on_one_line_give_no_pose(points: list[list[float]]) -> None:
    seen = np.array(points)
    assert p3p(seen / np.linalg.norm(seen, axis=1, keepdims=True), seen) == []


@given(st.lists(st.floats(-1e3, 1e3), min_size=15, max_size=15))
def test_any_numbers_give_rotations_or_nothing(numbers: list[float]) -> None:
    rays = np.column_stack([np.array(numbers[:6]).reshape(3, 2), np.ones(3)])
    for pose in p3p(rays, np.array(numbers[6:]).reshape(3, 3)):
        assert np.abs(pose.rotation @ pose.rotation.T - np.eye(3)).max() < 1e-9
