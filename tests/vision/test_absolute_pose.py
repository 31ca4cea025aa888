import numpy as np
import pytest

from tests.checks import assert_pose_close, numeric_jacobian
from tests.scenes import facade_scene
from tests.vision.photographs import photographed
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.vision.absolute_pose import (
    AbsolutePose,
    ErrorKind,
    ResectionProblem,
    linearize,
    resect,
)
from vcl_companion.vision.acransac import AcRansacOptions, NotFound
from vcl_companion.vision.hartley_sturm import triangulate_optimal

FOCAL_PX = 320.0
N = 200
KINDS: tuple[ErrorKind, ...] = ("pixel", "angle")


def sighting(
    seed: int, noise_px: float, outliers: float = 0.0, relief_m: float = 4.0
) -> tuple[Array, Array, Pose]:
    """Return ideal coordinates, landmarks, and the true cam_from_world."""
    rng = np.random.default_rng(seed)
    scene = facade_scene(rng, 500, relief_m)
    kept = np.flatnonzero(np.isfinite(scene.exact_px[:, 1, 0]))[:N]
    pixels = scene.exact_px[kept, 1] + noise_px * rng.standard_normal((N, 2))
    wrong = rng.permutation(N)[: round(outliers * N)]
    pixels[wrong] = rng.random((len(wrong), 2)) * (639.0, 479.0)
    pose = scene.worlds_from_cams[1].inverse()
    return scene.camera.ideal_from_pixels(pixels), scene.points_world[kept], pose


@pytest.mark.parametrize("kind", KINDS)
def test_without_noise_the_pose_is_exact(kind: ErrorKind) -> None:
    ideal, points, truth = sighting(1, 0.0)
    found = resect(ideal, points, FOCAL_PX, np.random.default_rng(0), error=kind)
    assert isinstance(found, AbsolutePose)
    assert_pose_close(found.cam_from_world, truth, within_m=1e-8, within_rad=1e-9)
    assert found.inliers.all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("noise_px", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("outliers", [0.3, 0.8])
@pytest.mark.parametrize("relief_m", [0.0, 4.0])
def test_threshold_and_noise_are_found(
    kind: ErrorKind, noise_px: float, outliers: float, relief_m: float
) -> None:
    ideal, points, truth = sighting(2, noise_px, outliers, relief_m)
    found = resect(ideal, points, FOCAL_PX, np.random.default_rng(0), error=kind)
    assert isinstance(found, AbsolutePose)
    assert_pose_close(
        found.cam_from_world,
        truth,
        within_m=0.12 * noise_px,
        within_rad=0.012 * noise_px,
        least_m=1e-4 * noise_px,
    )
    # An angle is smaller than what the image plane makes of it.
    smallest = 0.7 if kind == "pixel" else 0.45
    assert smallest * noise_px < found.sigma_px < 1.35 * noise_px
    assert 1.2 * noise_px < found.threshold_px < 4.5 * noise_px
    good = (1.0 - outliers) * N
    assert 0.85 * good < found.inliers.sum() < good + 0.05 * N


def test_landmarks_far_from_the_origin_lose_no_precision() -> None:
    ideal, points, truth = sighting(3, 0.0)
    far = np.array([3e5, -4e5, 100.0])
    found = resect(ideal, points + far, FOCAL_PX, np.random.default_rng(0))
    assert isinstance(found, AbsolutePose)
    moved = truth @ Pose(np.eye(3), -far)
    error = found.cam_from_world.inverse().translation - moved.inverse().translation
    assert np.linalg.norm(error) < 1e-6


def test_landmarks_behind_the_camera_are_nobodys_inliers() -> None:
    ideal, points, truth = sighting(4, 0.5)
    behind = truth.inverse().apply(-truth.apply(points[:40]))
    found = resect(
        np.vstack([ideal, ideal[:40]]),
        np.vstack([points, behind]),
        FOCAL_PX,
        np.random.default_rng(0),
    )
    assert isinstance(found, AbsolutePose)
    assert_pose_close(found.cam_from_world, truth, within_m=0.1, within_rad=0.01)
    assert not found.inliers[N:].any()


@pytest.mark.parametrize("seed", range(8))
def test_wrong_matches_that_lie_close_together_do_not_end_the_search(seed: int) -> None:
    # A camera far away sees all landmarks in one spot, where most of these matches lie: more than
    # half agree with that to a hundred px, beyond chance, and the first few samples find it.
    ideal, points, truth = sighting(seed, 0.7)
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(N)[: round(0.8 * N)]
    ideal[wrong] = 0.15 * rng.standard_normal((len(wrong), 2))
    found = resect(ideal, points, FOCAL_PX, np.random.default_rng(seed), AcRansacOptions(2000))
    assert isinstance(found, AbsolutePose)
    assert_pose_close(found.cam_from_world, truth, within_m=0.2, within_rad=0.02)


def test_chance_is_refused_with_a_reason() -> None:
    rng = np.random.default_rng(5)
    ideal = rng.uniform(-1.0, 1.0, (60, 2))
    points = rng.uniform(-5.0, 5.0, (60, 3))
    found = resect(ideal, points, FOCAL_PX, rng, AcRansacOptions(max_samples=2000))
    assert isinstance(found, NotFound)
    assert "60 matches" in found.reason


@pytest.mark.parametrize("n", [0, 3, 4])
def test_too_few_landmarks_are_refused_with_a_reason(n: int) -> None:
    ideal, points, _ = sighting(6, 0.0)
    found = resect(ideal[:n], points[:n], FOCAL_PX, np.random.default_rng(0))
    assert isinstance(found, NotFound)
    assert f"{n} landmarks" in found.reason


@pytest.mark.parametrize("angular", [False, True])
def test_slopes_of_the_reprojection_error(angular: bool) -> None:
    ideal, points, truth = sighting(7, 5.0)
    model = np.ascontiguousarray(truth.matrix()[:3])

    def residuals(step: Array) -> Array:
        turned = exp_so3(step[:3]) @ model
        turned[:, 3] += step[3:]
        out = np.empty((N, 2))
        linearize(turned, ideal, points, FOCAL_PX, angular, out, np.empty((N, 2, 6)))
        return out

    residual, slopes = np.empty((N, 2)), np.empty((N, 2, 6))
    linearize(model, ideal, points, FOCAL_PX, angular, residual, slopes)
    numeric = numeric_jacobian(residuals, np.zeros(6)).reshape(N, 2, 6)
    assert np.abs(slopes - numeric).max() < 1e-5 * np.abs(numeric).max()
    kind: ErrorKind = "angle" if angular else "pixel"
    squared = ResectionProblem(ideal, points, FOCAL_PX, 1e5, kind).squared_errors(model[None])[0]
    # A chord against the sine of the angle
    assert np.allclose((residual**2).sum(axis=1), squared, rtol=2e-3)


@pytest.mark.parametrize("seed", range(4))
def test_agrees_with_pycolmap(seed: int) -> None:
    pycolmap = pytest.importorskip("pycolmap", exc_type=ImportError)
    ideal, points, truth = sighting(seed, 1.0, 0.5)
    ours = resect(ideal, points, FOCAL_PX, np.random.default_rng(seed))
    assert isinstance(ours, AbsolutePose)
    camera = pycolmap.Camera(
        model="PINHOLE", width=640, height=480, params=[FOCAL_PX, FOCAL_PX, 320.0, 240.0]
    )
    theirs = pycolmap.estimate_and_refine_absolute_pose(
        ideal * FOCAL_PX + (320.0, 240.0), points, camera
    )
    pose = theirs["cam_from_world"].matrix()
    other = Pose(pose[:, :3], pose[:, 3])
    assert_pose_close(ours.cam_from_world, other, within_m=0.05, within_rad=0.005)
    off = [np.linalg.norm(truth.local(p)[:3]) for p in (ours.cam_from_world, other)]
    assert off[0] < off[1] + 0.03


@pytest.mark.parametrize("name", ["demo", "fountain-P11", "Herz-Jesus-P8"])
def test_agrees_with_pycolmap_and_the_truth_on_images(name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap", exc_type=ImportError)
    lens, poses, ideal = photographed(name, 3)
    landmarks = poses[0].apply(
        triangulate_optimal(poses[1].inverse() @ poses[0], ideal[:, 0], ideal[:, 1])
    )
    usable = np.isfinite(landmarks).all(axis=1) & np.isfinite(ideal[:, 2, 0])
    seen, points = ideal[usable, 2], landmarks[usable]
    ours = resect(seen, points, lens.focal_px, np.random.default_rng(0))
    assert isinstance(ours, AbsolutePose)
    camera = pycolmap.Camera(
        model="PINHOLE", width=640, height=427, params=[lens.focal_px] * 2 + [320.0, 213.5]
    )
    theirs = pycolmap.estimate_and_refine_absolute_pose(
        seen * lens.focal_px + (320.0, 213.5), points, camera
    )
    pose = theirs["cam_from_world"].matrix()
    other = Pose(pose[:, :3], pose[:, 3])
    assert_pose_close(ours.cam_from_world, other, within_m=0.1, within_rad=0.01)
    assert_pose_close(ours.cam_from_world, poses[2].inverse(), within_m=0.1, within_rad=0.01)
