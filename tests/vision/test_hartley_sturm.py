import cv2
import numpy as np
import pytest

from tests.scenes import random_rotation
from tests.vision.photographs import photographed
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, skew
from vcl_companion.vision.hartley_sturm import corrected_matches, triangulate_optimal

FOCAL_PX = 320.0
MOTIONS = {
    "any": (np.array([0.1, -0.2, 0.15]), np.array([1.0, -0.5, 0.4])),
    "sideways, not turned": (np.zeros(3), np.array([1.0, 0.0, 0.0])),
    "upwards": (np.array([0.05, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])),
    "forwards": (np.zeros(3), np.array([0.0, 0.0, 1.0])),
    "slantwise, not turned": (np.zeros(3), np.array([0.3, 0.4, 0.8])),
}


def seen(motion: str, noise_px: float, n: int = 400) -> tuple[Pose, Array, Array, Array]:
    """Return b_from_a, landmarks in camera a, and where both cameras saw them."""
    rng = np.random.default_rng(1)
    rotation_vector, translation = MOTIONS[motion]
    pose = Pose(exp_so3(rotation_vector), translation)
    points = np.column_stack([rng.uniform(-3.0, 3.0, (n, 2)), rng.uniform(4.0, 12.0, n)])
    moved = pose.apply(points)
    a, b = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    sigma = noise_px / FOCAL_PX
    return (
        pose,
        points,
        a + sigma * rng.standard_normal(a.shape),
        b + sigma * rng.standard_normal(b.shape),
    )


def homogeneous(ideal: Array) -> Array:
    return np.column_stack([ideal, np.ones(len(ideal))])


def essential(pose: Pose) -> Array:
    return skew(pose.translation / np.linalg.norm(pose.translation)) @ pose.rotation


def cost(a: Array, b: Array, moved_a: Array, moved_b: Array) -> Array:
    return np.asarray(((moved_a - a) ** 2).sum(axis=1) + ((moved_b - b) ** 2).sum(axis=1))


@pytest.mark.parametrize("motion", MOTIONS)
def test_agrees_with_opencv(motion: str) -> None:
    pose, _, a, b = seen(motion, 3.0)
    ours = corrected_matches(pose, a, b)
    theirs = [side[0] for side in cv2.correctMatches(essential(pose), a[None], b[None])]
    for mine, other in zip(ours, theirs, strict=True):
        assert np.abs(mine - other).max() < 1e-6
    assert np.max(cost(a, b, *ours) - cost(a, b, *theirs)) < 1e-11


@pytest.mark.parametrize("name", ["demo", "fountain-P11"])
def test_agrees_with_opencv_on_images(name: str) -> None:
    """Wrong matches far off their epipolar lines among them."""
    _, poses, ideal = photographed(name, 2)
    a, b = np.moveaxis(ideal[np.isfinite(ideal).all(axis=(1, 2))], 1, 0)
    assert len(a) > 300
    pose = poses[1].inverse() @ poses[0]
    ours = corrected_matches(pose, a, b)
    theirs = [side[0] for side in cv2.correctMatches(essential(pose), a[None], b[None])]
    for mine, other in zip(ours, theirs, strict=True):
        assert np.abs(mine - other).max() < 1e-6


@pytest.mark.parametrize("motion", MOTIONS)
def test_corrected_matches_meet_and_moved_least(motion: str) -> None:
    pose, _, a, b = seen(motion, 3.0)
    moved_a, moved_b = corrected_matches(pose, a, b)
    e = essential(pose)
    meeting = np.einsum("ni,ij,nj->n", homogeneous(moved_b), e, homogeneous(moved_a))
    assert np.abs(meeting).max() < 1e-12
    # A first-order correction of the corrected, moved at random, is another pair that meets.
    least = cost(a, b, moved_a, moved_b)
    rng = np.random.default_rng(2)
    for _ in range(20):
        other_a = moved_a + 1e-3 * rng.standard_normal(a.shape)
        other_b = moved_b + 1e-3 * rng.standard_normal(b.shape)
        for _ in range(4):
            slope = np.hstack(
                [(homogeneous(other_b) @ e)[:, :2], (homogeneous(other_a) @ e.T)[:, :2]]
            )
            off = np.einsum("ni,ij,nj->n", homogeneous(other_b), e, homogeneous(other_a))
            step = slope * (off / np.maximum((slope**2).sum(axis=1), 1e-12))[:, None]
            other_a, other_b = other_a - step[:, :2], other_b - step[:, 2:]
        assert np.all(cost(a, b, other_a, other_b) > least - 1e-9)


@pytest.mark.parametrize("motion", MOTIONS)
def test_without_noise_points_are_exact(motion: str) -> None:
    pose, points, a, b = seen(motion, 0.0)
    moved_a, moved_b = corrected_matches(pose, a, b)
    assert np.abs(moved_a - a).max() < 1e-9
    assert np.abs(moved_b - b).max() < 1e-9
    off_axis = np.hypot(*(points[:, :2] / points[:, 2:]).T) > 0.1
    found = triangulate_optimal(pose, a, b)
    assert np.abs(found - points)[off_axis].max() < 1e-6


def test_the_residual_is_chi_square_with_one_degree_of_freedom() -> None:
    noise_px = 0.5
    pose, _, a, b = seen("any", noise_px, n=4000)
    squared = cost(a, b, *corrected_matches(pose, a, b)) * (FOCAL_PX / noise_px) ** 2
    assert 0.93 < squared.mean() < 1.07
    assert 0.42 < np.median(squared) < 0.49


def test_any_pose_and_the_length_of_its_translation() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        pose = Pose(random_rotation(rng), rng.standard_normal(3))
        a, b = rng.uniform(-1.0, 1.0, (2, 30, 2))
        moved = corrected_matches(pose, a, b)
        scaled = corrected_matches(Pose(pose.rotation, 1e3 * pose.translation), a, b)
        meeting = np.einsum(
            "ni,ij,nj->n", homogeneous(moved[1]), essential(pose), homogeneous(moved[0])
        )
        size = np.linalg.norm(homogeneous(moved[0]), axis=1) * np.linalg.norm(
            homogeneous(moved[1]), axis=1
        )
        assert np.abs(meeting / size).max() < 1e-9
        assert np.abs(moved[0] - scaled[0]).max() < 1e-6


def test_a_row_that_is_no_number_stays_one_and_spoils_no_other() -> None:
    pose, _, a, b = seen("any", 1.0, n=6)
    clean = corrected_matches(pose, a, b)
    a[2, 0] = np.nan
    b[4] = np.inf
    moved_a, moved_b = corrected_matches(pose, a, b)
    lost = np.array([False, False, True, False, True, False])
    assert np.array_equal(np.isnan(moved_a[:, 0]), lost)
    assert np.array_equal(np.isnan(moved_b[:, 1]), lost)
    assert np.abs(moved_a[~lost] - clean[0][~lost]).max() < 1e-12
    assert np.array_equal(np.isnan(triangulate_optimal(pose, a, b)[:, 2]), lost)


def test_cameras_in_one_place_give_no_point() -> None:
    turn = Pose(exp_so3(np.array([0.0, 0.1, 0.0])), np.zeros(3))
    a = np.array([[0.1, 0.2], [0.0, 0.0]])
    assert np.isnan(triangulate_optimal(turn, a, a)).all()


def test_a_match_at_the_epipole_is_finite_and_meets() -> None:
    forwards = Pose(np.eye(3), np.array([0.0, 0.0, 1.0]))
    a, b = np.array([[0.0, 0.0], [0.1, 0.1]]), np.array([[0.01, 0.0], [0.13, 0.12]])
    moved_a, moved_b = corrected_matches(forwards, a, b)
    assert np.all(np.isfinite(moved_a))
    assert np.all(np.isfinite(moved_b))
    meeting = np.einsum(
        "ni,ij,nj->n", homogeneous(moved_b), essential(forwards), homogeneous(moved_a)
    )
    assert np.abs(meeting).max() < 1e-12


def test_no_match_at_all() -> None:
    pose, _, a, b = seen("any", 0.0, n=1)
    assert corrected_matches(pose, a[:0], b[:0])[0].shape == (0, 2)
