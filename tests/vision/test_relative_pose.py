import numpy as np
import pytest

from tests.checks import assert_consistent, numeric_jacobian
from tests.scenes import facade_scene
from tests.vision.photographs import photographed
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3, skew
from vcl_companion.vision.acransac import AcRansacOptions, NotFound, ac_ransac
from vcl_companion.vision.epipolar import linearize, squared_sampson, tangent
from vcl_companion.vision.homography import HomographyProblem, poses_of_homography
from vcl_companion.vision.relative_pose import (
    RelativePoseProblem,
    essential_candidates,
    in_front,
    poses_of_essential,
)

FOCAL_PX = 320.0
N = 250


def two_views(
    seed: int, relief_m: float, noise_px: float, outliers: float = 0.0
) -> tuple[Array, Array, Pose]:
    """Return matches in ideal coordinates and b_from_a with a translation of length 1.

    ``outliers`` is the share of matches whose place in view b is anywhere, exactly.
    """
    rng = np.random.default_rng(seed)
    scene = facade_scene(rng, 600, relief_m, baseline_m=3.0)
    kept = scene.exact_px[np.isfinite(scene.exact_px).all(axis=(1, 2))][:N]
    assert len(kept) == N
    pixels = kept + noise_px * rng.standard_normal(kept.shape)
    wrong = rng.permutation(N)[: round(outliers * N)]
    pixels[wrong, 1] = rng.random((len(wrong), 2)) * (639.0, 479.0)
    ideal = scene.camera.ideal_from_pixels(pixels.reshape(-1, 2)).reshape(kept.shape)
    world_from_a, world_from_b = scene.worlds_from_cams
    pose = world_from_b.inverse() @ world_from_a
    unit = pose.translation / np.linalg.norm(pose.translation)
    return ideal[:, 0], ideal[:, 1], Pose(pose.rotation, unit)


def errors_deg(found: Pose, truth: Pose) -> tuple[float, float]:
    turn = np.linalg.norm(log_so3(found.rotation.T @ truth.rotation))
    along = found.translation @ truth.translation / np.linalg.norm(truth.translation)
    return float(np.rad2deg(turn)), float(np.rad2deg(np.arccos(np.clip(along, -1.0, 1.0))))


def near(found: Pose, truth: Pose, turn_deg: float, direction_deg: float) -> bool:
    turn, direction = errors_deg(found, truth)
    return turn < turn_deg and direction < direction_deg


def test_without_noise_the_pose_is_exact() -> None:
    a, b, truth = two_views(1, 6.0, 0.0)
    found = essential_candidates(a, b, FOCAL_PX, np.random.default_rng(0))
    turn, direction = errors_deg(found[0].b_from_a, truth)
    assert turn < 1e-4
    assert direction < 1e-3
    assert found[0].inliers.all()


@pytest.mark.parametrize("noise_px", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("outliers", [0.3, 0.7])
def test_threshold_and_noise_are_found(noise_px: float, outliers: float) -> None:
    for seed in range(3):
        a, b, truth = two_views(seed, 6.0, noise_px, outliers)
        best = essential_candidates(a, b, FOCAL_PX, np.random.default_rng(seed))[0]
        turn, direction = errors_deg(best.b_from_a, truth)
        assert turn < 1.0 * max(noise_px, 0.3)
        assert 1e-4 < direction < 6.0 * max(noise_px, 0.3)
        assert 0.7 * noise_px < best.sigma_px < 1.4 * noise_px
        assert 1.1 * noise_px < best.threshold_px < 3.5 * noise_px
        assert best.log_nfa < 0.0
        assert best.inliers.sum() > 0.8 * (1.0 - outliers) * N


def test_errors_are_as_large_as_the_information_says() -> None:
    drawn, covariances = [], []
    for seed in range(40):
        a, b, truth = two_views(seed, 6.0, 0.5)
        problem = RelativePoseProblem(a, b, FOCAL_PX, 800.0, 307200.0)
        pose, sigma = problem.refined(truth, 1.25)
        information = problem.information(pose, sigma, np.ones(N, dtype=np.bool_))
        shift = tangent(pose.translation.copy()) @ (truth.translation - pose.translation)
        drawn.append(np.concatenate([log_so3(pose.rotation.T @ truth.rotation), shift]))
        covariances.append(np.linalg.inv(information))
    # First-order distances of both images' noise.
    assert_consistent(np.array(drawn), np.array(covariances), slack=1.1)


def test_a_plane_shows_both_twins() -> None:
    both = 0
    for seed in range(10):
        a, b, truth = two_views(seed, 0.0, 0.5, 0.3)
        found = essential_candidates(a, b, FOCAL_PX, np.random.default_rng(seed))
        errors = [errors_deg(candidate.b_from_a, truth) for candidate in found]
        assert any(near(candidate.b_from_a, truth, 0.5, 5.0) for candidate in found)
        twins = [turn for turn, _ in errors if turn > 3.0]
        both += bool(twins)
        assert len(found) <= 5
    assert both >= 8


def test_a_scene_with_depth_has_one_pose_that_is_much_better_than_any_other() -> None:
    for seed in range(5):
        a, b, truth = two_views(seed, 6.0, 0.5, 0.3)
        found = essential_candidates(a, b, FOCAL_PX, np.random.default_rng(seed))
        assert near(found[0].b_from_a, truth, 0.5, 5.0)
        assert all(other.log_nfa > 0.5 * found[0].log_nfa for other in found[1:])


def test_chance_gives_no_candidate() -> None:
    rng = np.random.default_rng(1)
    for _ in range(3):
        a, b = rng.uniform(-1.0, 1.0, (2, 60, 2)) * (1.0, 0.75)
        options = AcRansacOptions(max_samples=2000)
        assert essential_candidates(a, b, FOCAL_PX, rng, options) == []


def test_too_few_matches_give_no_candidate() -> None:
    a, b, _ = two_views(1, 6.0, 0.0)
    assert essential_candidates(a[:6], b[:6], FOCAL_PX, np.random.default_rng(0)) == []
    assert essential_candidates(a[:0], b[:0], FOCAL_PX, np.random.default_rng(0)) == []


def test_the_same_generator_gives_the_same_candidates() -> None:
    a, b, _ = two_views(2, 3.0, 1.0, 0.5)
    one, other = (essential_candidates(a, b, FOCAL_PX, np.random.default_rng(3)) for _ in range(2))
    assert [c.log_nfa for c in one] == [c.log_nfa for c in other]
    assert all(
        np.array_equal(x.b_from_a.matrix(), y.b_from_a.matrix())
        for x, y in zip(one, other, strict=True)
    )


def by_pycolmap(a: Array, b: Array) -> tuple[Pose, int]:
    """Return their b_from_a, refined over their inliers, and how many these are."""
    pycolmap = pytest.importorskip("pycolmap", exc_type=ImportError)
    camera = pycolmap.Camera(
        model="PINHOLE", width=640, height=480, params=[FOCAL_PX, FOCAL_PX, 320.0, 240.0]
    )
    pixels = [side * FOCAL_PX + np.array([320.0, 240.0]) for side in (a, b)]
    options = pycolmap.RANSACOptions(max_error=2.0, max_num_trials=5000, random_seed=1)
    found = pycolmap.estimate_relative_pose(camera, pixels[0], camera, pixels[1], options)
    refined = pycolmap.refine_relative_pose(
        found["cam2_from_cam1"], camera, pixels[0], camera, pixels[1], found["inlier_mask"]
    )
    pose = refined["cam2_from_cam1"].matrix()
    return Pose(pose[:, :3], pose[:, 3] / np.linalg.norm(pose[:, 3])), int(found["num_inliers"])


@pytest.mark.parametrize("noise_px", [0.0, 0.5])
def test_agrees_with_pycolmap_where_all_matches_are_good(noise_px: float) -> None:
    same = 0
    for seed in range(4):
        a, b, _ = two_views(seed, 6.0, noise_px)
        ours = essential_candidates(a, b, FOCAL_PX, np.random.default_rng(seed))[0]
        theirs, n_inliers = by_pycolmap(a, b)
        assert near(ours.b_from_a, theirs, 0.05, 0.2)
        assert ours.inliers.sum() > 0.95 * n_inliers
        same += near(ours.b_from_a, theirs, 1e-3, 1e-3)
    # Now and then the far tail of the noise weighs nothing with us.
    assert same >= 3


def test_is_no_worse_than_pycolmap_among_wrong_matches() -> None:
    for seed in range(4):
        a, b, truth = two_views(seed, 6.0, 0.5, 0.4)
        ours = essential_candidates(a, b, FOCAL_PX, np.random.default_rng(seed))[0]
        theirs, n_inliers = by_pycolmap(a, b)
        # The wrong matches among their inliers pull theirs.
        assert near(ours.b_from_a, theirs, 1.0, 5.0)
        assert errors_deg(ours.b_from_a, truth)[0] < errors_deg(theirs, truth)[0] + 0.05
        assert abs(ours.inliers.sum() - n_inliers) < 0.1 * n_inliers


@pytest.mark.parametrize("name", ["demo", "fountain-P11", "Herz-Jesus-P8"])
def test_agrees_with_pycolmap_and_the_truth_on_images(name: str) -> None:
    lens, poses, ideal = photographed(name, 2)
    both = np.isfinite(ideal).all(axis=(1, 2))
    a, b = ideal[both, 0], ideal[both, 1]
    truth = poses[1].inverse() @ poses[0]
    ours = essential_candidates(a, b, lens.focal_px, np.random.default_rng(0))[0]
    assert near(ours.b_from_a, truth, 0.2, 0.5)
    theirs, n_inliers = by_pycolmap(a, b)
    assert near(ours.b_from_a, theirs, 1.0, 5.0)
    assert errors_deg(ours.b_from_a, truth)[0] < errors_deg(theirs, truth)[0] + 0.05
    assert ours.inliers.sum() > 0.8 * n_inliers


def test_slopes_of_the_sampson_distance() -> None:
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-1.0, 1.0, (2, 15, 2))
    rotation = exp_so3(0.3 * rng.standard_normal(3))
    direction = rng.standard_normal(3)
    direction = direction / np.linalg.norm(direction)
    residual, slopes = np.empty(15), np.empty((15, 5))

    def distances(step: Array) -> Array:
        moved = direction + step[3:] @ tangent(direction)
        out = np.empty(15)
        turned = np.ascontiguousarray(rotation @ exp_so3(step[:3]))
        unit = moved / np.linalg.norm(moved)
        linearize(turned, unit, a, b, FOCAL_PX, out, np.empty((15, 5)))
        return out

    linearize(rotation, direction, a, b, FOCAL_PX, residual, slopes)
    numeric = numeric_jacobian(distances, np.zeros(5))
    assert np.abs(slopes - numeric).max() < 1e-5 * np.abs(numeric).max()
    essential = skew(direction) @ rotation
    assert np.allclose(residual**2, squared_sampson(essential[None], a, b, FOCAL_PX)[0])


def test_one_of_four_poses_has_the_points_in_front() -> None:
    a, b, truth = two_views(3, 6.0, 0.0)
    poses = poses_of_essential(skew(truth.translation) @ truth.rotation)
    shares = [in_front(pose, a, b).mean() for pose in poses]
    assert sorted(shares)[-2:] == pytest.approx([0.0, 1.0], abs=0.3)
    best = poses[int(np.argmax(shares))]
    assert max(shares) == 1.0
    assert near(best, truth, 1e-4, 1e-3)


def test_the_plane_is_found_among_many_wrong_matches() -> None:
    a, b, truth = two_views(5, 0.0, 1.0, 0.8)
    found = ac_ransac(HomographyProblem(a, b, FOCAL_PX, 307200.0), np.random.default_rng(0))
    assert not isinstance(found, NotFound)
    assert 2.0 < found.threshold_px < 6.0
    assert 40 <= found.inliers.sum() <= 55
    assert any(near(pose, truth, 1.5, 10.0) for pose in poses_of_homography(found.model))


def test_a_plane_whose_camera_only_turned_has_no_pose() -> None:
    assert poses_of_homography(np.eye(3)) == []
    assert poses_of_homography(np.full((3, 3), np.nan)) == []
