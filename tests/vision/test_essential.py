import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.checks import assert_consistent, numeric_jacobian
from tests.scenes import CAMERAS, Scene, facade_scene, observe, random_rotation
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3, matrix_from_euler
from vcl_companion.vision.essential import (
    EssentialOptions,
    RelativePose,
    relative_poses,
    sampson_px,
)

OPTIONS = EssentialOptions()
QUICK = EssentialOptions(max_samples=2000)


def matches_of(scene: Scene) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Ideal coordinates of what both views saw, and which of it is wrong."""
    both = scene.seen.all(axis=1)
    ideal = scene.ideal[both]
    return ideal[:, 0], ideal[:, 1], np.asarray(scene.wrong[both].any(axis=1))


def truth_of(scene: Scene) -> Pose:
    world_from_a, world_from_b = scene.worlds_from_cams[:2]
    b_from_a = world_from_b.inverse() @ world_from_a
    return Pose(b_from_a.rotation, b_from_a.translation / np.linalg.norm(b_from_a.translation))


def off_deg(found: Pose, truth: Pose) -> tuple[float, float]:
    """Angles of the rotation's and of the translation direction's error."""
    turn = float(np.linalg.norm(log_so3(truth.rotation.T @ found.rotation)))
    cosine = np.clip(truth.translation @ found.translation, -1.0, 1.0)
    return float(np.rad2deg(turn)), float(np.rad2deg(np.arccos(cosine)))


def solve(
    scene: Scene, options: EssentialOptions, guess: Array | None = None
) -> list[RelativePose]:
    a, b, _ = matches_of(scene)
    return relative_poses(a, b, scene.camera.focal_px, guess, options)


def tangent(direction: Array) -> Array:
    return np.asarray(np.linalg.svd(direction[None])[2][1:].T)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.distortion_model)
def test_exact_matches_give_the_exact_pose(camera: Camera) -> None:
    scene = facade_scene(np.random.default_rng(1), 120, 4.0, camera=camera)
    best = solve(scene, OPTIONS)[0]
    turn, direction = off_deg(best.b_from_a, truth_of(scene))
    assert turn < 1e-4
    assert direction < 1e-3
    assert best.inliers.all()
    assert best.cost < 1e-6
    assert np.linalg.norm(best.b_from_a.translation) == pytest.approx(1.0, abs=1e-12)


def test_sampson_distance_has_the_noise_of_a_pixel() -> None:
    rng = np.random.default_rng(2)
    exact = facade_scene(rng, 1500, 4.0)
    noisy = exact.observed_again(rng, 0.4)
    truth, focal_px = truth_of(exact), exact.camera.focal_px
    a, b, _ = matches_of(exact)
    np.testing.assert_allclose(sampson_px(truth, a, b, focal_px), 0.0, atol=1e-9)
    a, b, _ = matches_of(noisy)
    distance = sampson_px(truth, a, b, focal_px)
    assert 0.37 < distance.std() < 0.43
    assert abs(distance.mean()) < 0.04


def test_sampson_distance_is_signed_and_scales_with_the_focal_length() -> None:
    # Sideways motion: epipolar lines are the rows; a match half off in each image is 1/sqrt 2 off.
    sideways = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    a, b = np.array([[0.1, 0.0], [0.1, 0.0]]), np.array([[0.2, 0.01], [0.2, -0.01]])
    found = sampson_px(sideways, a, b, 100.0)
    np.testing.assert_allclose(np.abs(found), 1.0 / np.sqrt(2.0), rtol=1e-12)
    assert found[0] == -found[1]


def test_errors_are_those_of_least_squares() -> None:
    errors, covariances = [], []
    for seed in range(24):
        scene = facade_scene(np.random.default_rng(seed), 120, 5.0, noise_px=0.3)
        truth, focal_px = truth_of(scene), scene.camera.focal_px
        a, b, _ = matches_of(scene)
        basis = tangent(truth.translation)

        def residual(
            delta: Array, truth: Pose = truth, basis: Array = basis, a: Array = a, b: Array = b,
            focal_px: float = focal_px,
        ) -> Array:  # fmt: skip
            moved = truth.translation + basis @ delta[3:]
            pose = Pose(truth.rotation @ exp_so3(delta[:3]), moved / np.linalg.norm(moved))
            return sampson_px(pose, a, b, focal_px)

        jacobian = numeric_jacobian(residual, np.zeros(5))
        best = solve(scene, QUICK)[0].b_from_a
        turn = log_so3(truth.rotation.T @ best.rotation)
        errors.append(np.concatenate([turn, basis.T @ best.translation]))
        covariances.append(0.3**2 * np.linalg.inv(jacobian.T @ jacobian))
    assert_consistent(errors, np.array(covariances), slack=1.2)  # Cauchy loss, curvature


@pytest.mark.parametrize("relief_m", [3.0, 6.0])
@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_with_relief_the_right_hypothesis_is_the_cheapest(relief_m: float, outliers: float) -> None:
    for seed in range(4):
        scene = facade_scene(
            np.random.default_rng(seed), 200, relief_m, baseline_m=3.0, noise_px=0.3,
            outliers=outliers,
        )  # fmt: skip
        hypotheses = solve(scene, OPTIONS)
        _, _, wrong = matches_of(scene)
        best = hypotheses[0]
        turn, direction = off_deg(best.b_from_a, truth_of(scene))
        assert 1e-3 < turn < 1.0
        assert 1e-3 < direction < 6.0
        assert best.inliers[~wrong].mean() > 0.97
        assert best.inliers[wrong].mean() < 0.2 if wrong.any() else True
        costs = [h.cost for h in hypotheses]
        assert costs == sorted(costs)
        for h in hypotheses:
            assert h.cost <= 9.0 * len(wrong)
            assert h.inliers.shape == wrong.shape


@pytest.mark.parametrize("noise_px", [0.0, 0.2])
def test_both_planar_twins_are_returned(noise_px: float) -> None:
    # Towards the facade and aside: a motion whose twin has all points in front as well.
    for seed in range(4):
        rng = np.random.default_rng(seed)
        flat = facade_scene(rng, 200, 0.0)
        bodies = (
            Pose(matrix_from_euler(0.0, 0.0, 0.1), np.zeros(3)),
            Pose(matrix_from_euler(0.02, -0.03, -0.1), np.array([3.0, 1.5, -1.0])),
        )
        scene = observe(
            rng, flat.points_world, bodies, flat.mountings, flat.camera, noise_px=noise_px
        )
        a, b, _ = matches_of(observe(rng, flat.points_world, bodies, flat.mountings, flat.camera))
        homography, _ = cv2.findHomography(a, b)
        _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
        rays = np.hstack([a, np.ones((len(a), 1))])
        twins = [
            Pose(np.asarray(r), np.asarray(t)[:, 0] / np.linalg.norm(t))
            for r, t, n in zip(rotations, translations, normals, strict=True)
            if (rays @ np.asarray(n) > 0).all()
        ]
        assert len(twins) == 2
        assert off_deg(*twins)[0] > 3.0
        assert min(max(off_deg(t, truth_of(scene))) for t in twins) < 1e-3
        hypotheses = solve(scene, OPTIONS)
        most_deg = 1e-2 if noise_px == 0.0 else 6.0
        for twin in twins:
            near = [h for h in hypotheses if max(off_deg(h.b_from_a, twin)) < most_deg]
            assert near, f"twin {off_deg(twin, truth_of(scene))} is missing"
            assert near[0].inliers.mean() > 0.95


def test_a_known_rotation_is_start_enough() -> None:
    blind = EssentialOptions(max_samples=1)  # what the search finds by then is luck
    for seed in range(6):
        rng = np.random.default_rng(seed)
        scene = facade_scene(
            rng, 150, 20.0, baseline_m=4.0, turn_deg=8.0, noise_px=0.2, outliers=0.15
        )
        truth = truth_of(scene)
        guess = truth.rotation @ exp_so3(np.deg2rad(1.0) * rng.standard_normal(3))
        turn, direction = off_deg(solve(scene, blind, guess)[0].b_from_a, truth)
        assert turn < 0.5
        assert direction < 3.0


def test_a_wrong_guess_does_no_harm() -> None:
    rng = np.random.default_rng(3)
    scene = facade_scene(rng, 150, 5.0, baseline_m=3.0, noise_px=0.2)
    best = solve(scene, OPTIONS)[0]
    misled = solve(scene, OPTIONS, random_rotation(rng))[0]
    assert misled.cost <= best.cost * (1.0 + 1e-6)
    turn, direction = off_deg(misled.b_from_a, best.b_from_a)
    assert turn < 0.02
    assert direction < 0.2


def test_hypotheses_are_distinct_and_repeatable() -> None:
    scene = facade_scene(np.random.default_rng(4), 150, 0.0, noise_px=0.3, outliers=0.1)
    one, two = solve(scene, OPTIONS), solve(scene, OPTIONS)
    assert [h.cost for h in one] == [h.cost for h in two]
    for i in range(len(one)):
        for k in range(i):
            turn, direction = off_deg(one[i].b_from_a, one[k].b_from_a)
            assert turn >= 0.3 or direction >= 1.5


def test_wrong_and_unfinished_matches_cost_only_themselves() -> None:
    scene = facade_scene(np.random.default_rng(5), 100, 4.0)
    a, b, _ = matches_of(scene)
    a[3], b[8, 1] = np.nan, np.inf
    for guess in (None, truth_of(scene).rotation):
        best = relative_poses(a, b, scene.camera.focal_px, guess, OPTIONS)[0]
        assert max(off_deg(best.b_from_a, truth_of(scene))) < 1e-3
        np.testing.assert_array_equal(np.flatnonzero(~best.inliers), [3, 8])


def test_too_few_and_degenerate_matches_raise_nothing() -> None:
    rng = np.random.default_rng(6)
    spread = rng.uniform(-0.5, 0.5, (50, 2))
    line = np.column_stack([np.linspace(-0.5, 0.5, 50), np.zeros(50)])
    nowhere, blind = np.zeros((50, 2)), np.full((50, 2), np.nan)
    must_be_empty = [
        (spread[:11], spread[:11] + 0.01),
        (spread[:0], spread[:0]),
        (blind, blind),
        (spread, blind),
        (nowhere, nowhere),
        (spread, spread),  # no motion: no direction
        (spread, rng.uniform(-0.5, 0.5, (50, 2))),
    ]
    for guess in (None, np.eye(3)):
        for a, b in must_be_empty:
            assert relative_poses(a, b, 320.0, guess, QUICK) == []
        for a, b in ((nowhere, nowhere + 0.1), (line, line + 0.01), (1e8 * spread, 1e8 * spread)):
            for h in relative_poses(a, b, 320.0, guess, QUICK):
                assert np.isfinite(h.cost)
