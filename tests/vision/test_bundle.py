from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent, assert_pose_close, numeric_jacobian
from tests.dense_bundle import normal_equations, pose_information
from tests.scenes import EQUIDISTANT, PINHOLE, Scene, facade_scene, perturbed_scene_start
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision import bundle
from vcl_companion.vision.bundle import (
    BundleOptions,
    Distance,
    Views,
    adjust,
    distance_information,
    linearized,
    relative_sigmas,
    reprojection_residuals,
    residual_noise_px,
    robust_cost,
)

OPTIONS = BundleOptions()


def views_of(scene: Scene, bodies: tuple[Pose, ...], points: Array) -> Views:
    """A scene's observations with an estimate; all that two views see, scaled by one distance."""
    twice = scene.seen.sum(axis=1) >= 2
    return Views(
        bodies,
        scene.mountings,
        scene.slopes[twice],
        scene.ideal[twice],
        points[twice],
        (Distance(0, 1, scene.baseline_m(0, 1), 0.01),),
    )


def truth_of(scene: Scene) -> Views:
    return views_of(scene, scene.bodies, scene.points_world)


def joint_covariance(views: Views, noise_px: float) -> Array:
    """(6V-6, 6V-6) of the free poses, by inverting the whole dense normal matrix."""
    system = normal_equations(replace(views, slopes=views.slopes / noise_px), None)
    n, n_pose = len(views.points), len(system.pose_rhs)
    dense = np.zeros((n_pose + 3 * n, n_pose + 3 * n))
    dense[:n_pose, :n_pose] = system.pose_block
    for j in range(n):
        block = slice(n_pose + 3 * j, n_pose + 3 * j + 3)
        dense[block, block] = system.point_block[j]
        dense[:n_pose, block] = system.cross[j]
        dense[block, :n_pose] = system.cross[j].T
    return np.asarray(np.linalg.inv(dense[6:, 6:])[: n_pose - 6, : n_pose - 6])


def test_jacobians_are_the_numeric_ones() -> None:
    rng = np.random.default_rng(1)
    scene = facade_scene(rng, 6, 4.0, turn_deg=20.0, lever_arm_m=0.5, noise_px=3.0, camera=PINHOLE)
    body, mounting, points = scene.bodies[1], scene.mountings[1], scene.points_world
    ideal = rng.uniform(-0.5, 0.5, (6, 2))
    slopes = rng.uniform(-300.0, 300.0, (6, 2, 2))

    def residual(pose: Pose, at: Array) -> Array:
        return linearized(pose, mounting, slopes, at, ideal)[0]

    _, by_pose, by_point = linearized(body, mounting, slopes, points, ideal)
    numeric = numeric_jacobian(lambda d: residual(body.retracted(d), points), np.zeros(6))
    np.testing.assert_allclose(by_pose.reshape(12, 6), numeric, rtol=1e-5, atol=1e-5)
    for j in range(6):

        def of_point(delta: Array, j: int = j) -> Array:
            return np.asarray(residual(body, points + delta)[j])

        one = numeric_jacobian(of_point, np.zeros(3))
        np.testing.assert_allclose(by_point[j], one, rtol=1e-5, atol=1e-5)


def test_residual_is_that_of_the_camera_model() -> None:
    scene = facade_scene(np.random.default_rng(2), 50, noise_px=1.0)
    residual, _, _ = linearized(
        scene.bodies[1],
        scene.mountings[1],
        scene.slopes[:, 1],
        scene.points_world,
        scene.ideal[:, 1],
    )
    seen = scene.seen[:, 1]
    expected = (scene.exact_px - scene.observed_px)[seen, 1]
    np.testing.assert_allclose(residual[seen], expected, atol=1e-9)
    views = replace(truth_of(scene), points=scene.points_world, ideal=scene.ideal)
    np.testing.assert_allclose(reprojection_residuals(views)[seen, 1], expected, atol=1e-9)
    assert np.isnan(reprojection_residuals(views)[~scene.seen]).all()


def test_what_is_behind_the_camera_costs_but_does_not_pull() -> None:
    points = np.array([[-5.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [5.0, 1.0, 0.5], [0.0, 0.0, 0.0]])
    scene = facade_scene(np.random.default_rng(3), 5, lever_arm_m=0.0)
    residual, by_pose, by_point = linearized(
        scene.bodies[0],
        scene.mountings[0],
        np.tile(320.0 * np.eye(2), (4, 1, 1)),
        points,
        np.zeros((4, 2)),
    )
    for j in (0, 1, 3):
        assert np.linalg.norm(residual[j]) > 1e3
        assert not by_pose[j].any()
        assert not by_point[j].any()
    assert by_pose[2].any()


@pytest.mark.parametrize("cauchy_px", [None, 0.7])
def test_the_right_hand_side_is_the_gradient_of_the_cost(cauchy_px: float | None) -> None:
    rng = np.random.default_rng(4)
    scene = facade_scene(rng, 12, 3.0, n_views=3, noise_px=1.0, missed=0.2)
    start = views_of(scene, *perturbed_scene_start(rng, scene, 0.02, 0.002, 0.02))
    start = replace(start, distances=(Distance(0, 1, 1.9, 0.05), Distance(2, 1, 4.1, 0.1)))
    system = normal_equations(start, cauchy_px)

    def cost(delta: Array) -> Array:
        bodies = tuple(
            b.retracted(d) for b, d in zip(start.bodies, delta[:18].reshape(3, 6), strict=True)
        )
        moved = replace(start, bodies=bodies, points=start.points + delta[18:].reshape(-1, 3))
        cost = normal_equations(moved, cauchy_px).cost
        if cauchy_px is not None:
            assert robust_cost(moved, cauchy_px) == pytest.approx(cost)
        return np.array([cost])

    gradient = numeric_jacobian(cost, np.zeros(18 + 3 * len(start.points)))[0]
    ours = -2.0 * np.concatenate([system.pose_rhs, system.point_rhs.ravel()])
    np.testing.assert_allclose(ours, gradient, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())


def test_a_known_distance_is_one_row() -> None:
    rng = np.random.default_rng(5)
    scene = facade_scene(rng, 5, n_views=3)
    unseen = np.full((5, 3, 2), np.nan)
    known = Distance(1, 2, 3.0, 0.2)
    views = replace(truth_of(scene), ideal=unseen, points=scene.points_world, distances=(known,))
    system = normal_equations(views, None)
    np.testing.assert_allclose(distance_information(views), system.pose_block, atol=1e-6)

    def error(delta: Array) -> Array:
        a, b = (scene.bodies[i].retracted(delta[6 * i : 6 * i + 6]) for i in (1, 2))
        length = float(np.linalg.norm(a.translation - b.translation))
        return np.array([(length - 3.0) / 0.2])

    row = numeric_jacobian(error, np.zeros(18))[0]
    at = float(error(np.zeros(18))[0])
    np.testing.assert_allclose(system.pose_block, np.outer(row, row), atol=1e-6)
    np.testing.assert_allclose(system.pose_rhs, -row * at, atol=1e-5)
    assert system.cost == pytest.approx(at**2)
    coincident = replace(views, bodies=(scene.bodies[0],) * 3)
    assert np.isfinite(distance_information(coincident)).all()


@pytest.mark.parametrize("n_held", [1, 2])
def test_what_is_known_of_the_poses_is_the_dense_system_without_landmarks(n_held: int) -> None:
    scene = facade_scene(np.random.default_rng(17), 50, 3.0, n_views=5, noise_px=2.0, missed=0.3)
    views = replace(truth_of(scene), n_held=n_held)
    free = slice(6 * n_held, None)
    dense = pose_information(normal_equations(views, None))
    scale = np.abs(np.diag(dense)).max()
    np.testing.assert_allclose(
        bundle.pose_information(views)[free, free], dense[free, free], atol=1e-6 * scale
    )


def test_leverages_are_the_eigenvalues_of_the_dense_system() -> None:
    scene = facade_scene(np.random.default_rng(18), 50, 3.0, n_views=5, noise_px=1.0, missed=0.3)
    views = truth_of(scene)
    system = normal_equations(views, None)
    covariance = np.zeros((30, 30))
    covariance[6:, 6:] = np.linalg.inv(pose_information(system)[6:, 6:])
    root = np.linalg.cholesky(covariance[6:, 6:])
    expected = []
    for j in range(len(views.points)):
        alone = normal_equations(
            replace(
                views,
                slopes=views.slopes[j : j + 1],
                ideal=views.ideal[j : j + 1],
                points=views.points[j : j + 1],
                distances=(),
            ),
            None,
        )
        says = pose_information(alone)[6:, 6:]
        expected.append(np.linalg.eigvalsh(root.T @ says @ root)[-1])
    found = bundle.leverages(views, covariance)
    np.testing.assert_allclose(found, expected, rtol=1e-2, atol=1e-6)
    assert found.max() > 3.0 * found.min()


@pytest.mark.parametrize("n_views", [2, 3, 5])
@pytest.mark.parametrize("camera", [PINHOLE, EQUIDISTANT], ids=lambda c: c.distortion_model)
def test_exact_observations_give_the_truth_back(n_views: int, camera: Camera) -> None:
    rng = np.random.default_rng(6)
    scene = facade_scene(rng, 80, 3.0, n_views=n_views, camera=camera, missed=0.1)
    start = views_of(scene, *perturbed_scene_start(rng, scene, 0.1, 0.01, 0.2))
    found, noise_px = adjust(start, OPTIONS)
    for body, truth in zip(found.bodies, scene.bodies, strict=True):
        assert_pose_close(body, truth, within_m=1e-5, within_rad=1e-6)
    assert found.bodies[0] is start.bodies[0]
    assert noise_px == 0.02  # its floor
    np.testing.assert_allclose(found.points, truth_of(scene).points, rtol=0, atol=1e-3)


@pytest.mark.parametrize("n_views", [2, 3])
def test_noise_gives_errors_as_large_as_the_covariance(n_views: int) -> None:
    errors, covariances = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        scene = facade_scene(rng, 60, 4.0, n_views=n_views, noise_px=0.3)
        start = views_of(scene, *perturbed_scene_start(rng, scene, 0.05, 0.005, 0.1))
        known = Distance(0, 1, scene.baseline_m(0, 1) + 0.02 * float(rng.standard_normal()), 0.02)
        found, _ = adjust(replace(start, distances=(known,)), OPTIONS)
        errors.append(
            np.concatenate(
                [t.local(b) for b, t in zip(found.bodies[1:], scene.bodies[1:], strict=True)]
            )
        )
        covariances.append(joint_covariance(found, scene.noise_px))
    assert_consistent(errors, np.array(covariances))


@pytest.mark.parametrize("n_held", [2, 3])
def test_held_views_stay_and_the_others_find_their_place(n_held: int) -> None:
    rng = np.random.default_rng(11)
    scene = facade_scene(rng, 80, 4.0, n_views=4)
    truth = truth_of(scene)
    bodies = tuple(
        body if i < n_held else body.retracted(0.02 * rng.standard_normal(6))
        for i, body in enumerate(truth.bodies)
    )
    points = truth.points + 0.05 * rng.standard_normal(truth.points.shape)
    start = replace(truth, bodies=bodies, points=points, n_held=n_held)
    adjusted, _ = adjust(start, BundleOptions())
    for i in range(4):
        if i < n_held:
            assert adjusted.bodies[i] is bodies[i]
        assert_pose_close(adjusted.bodies[i], truth.bodies[i], within_m=1e-5, within_rad=1e-6)
    np.testing.assert_allclose(adjusted.points, truth.points, atol=1e-4)


def test_depths_are_as_sure_as_the_normal_equations_say() -> None:
    rng = np.random.default_rng(13)
    truth = truth_of(facade_scene(rng, 80, 4.0, n_views=4))
    ideal = truth.ideal.copy()
    ideal[rng.uniform(size=ideal.shape[:2]) < 0.3] = np.nan
    ideal[0] = np.nan  # seen by nobody
    ideal[1, 1:] = np.nan  # by one: known but for its depth
    truth = replace(truth, ideal=ideal)
    information = normal_equations(truth, None).point_block
    centres = np.stack(
        [(b @ m).translation for b, m in zip(truth.bodies, truth.mountings, strict=True)]
    )
    away = np.linalg.norm(truth.points[:, None] - centres, axis=2)
    nearest = np.where(np.isfinite(ideal[..., 0]), away, np.inf).min(axis=1)
    sigmas, n_seen = relative_sigmas(truth), np.isfinite(ideal[..., 0]).sum(axis=1)
    several = n_seen > 1
    assert 50 < several.sum() < 79
    least = np.linalg.eigvalsh(information[several])[:, 0]
    np.testing.assert_allclose(
        sigmas[several], 1.0 / (np.sqrt(least) * nearest[several]), rtol=1e-6
    )
    assert (sigmas[n_seen == 0] == np.inf).all()
    assert sigmas[n_seen == 1].min() > 100.0


def test_a_view_that_sees_nothing_stays_and_the_others_are_adjusted() -> None:
    rng = np.random.default_rng(12)
    truth = truth_of(facade_scene(rng, 80, 4.0, n_views=4))
    bodies = tuple(
        body.retracted(0.02 * rng.standard_normal(6)) if i else body
        for i, body in enumerate(truth.bodies)
    )
    ideal = truth.ideal.copy()
    ideal[:, 3] = np.nan
    adjusted, _ = adjust(replace(truth, bodies=bodies, ideal=ideal), BundleOptions())
    for i in (1, 2):
        assert_pose_close(adjusted.bodies[i], truth.bodies[i], within_m=1e-5, within_rad=1e-6)
    assert_pose_close(adjusted.bodies[3], bodies[3], within_m=1e-12, within_rad=1e-12)


def test_wrong_matches_pull_little() -> None:
    rng = np.random.default_rng(7)
    scene = facade_scene(rng, 150, 4.0, n_views=3, noise_px=0.3)
    spoilt = scene.observed_again(rng, 0.3, outliers=0.06)
    start = perturbed_scene_start(rng, scene, 0.05, 0.005, 0.1)
    clean, _ = adjust(views_of(scene, *start), OPTIONS)
    found, noise_px = adjust(views_of(spoilt, *start), OPTIONS)
    trusting, _ = adjust(views_of(spoilt, *start), BundleOptions(cauchy_px=1e4))
    for i in (1, 2):
        sigma = np.sqrt(np.diag(joint_covariance(clean, 0.3))[6 * i - 6 : 6 * i])
        off = np.abs(scene.bodies[i].local(found.bodies[i])) / sigma
        assert off.max() < 5.0
        assert np.abs(scene.bodies[i].local(trusting.bodies[i]) / sigma).max() > 20.0
    assert 0.24 < noise_px < 0.42


@pytest.mark.parametrize("n_views", [2, 3])
@pytest.mark.parametrize("sigma_px", [0.1, 0.5, 1.0])
def test_residuals_tell_the_noise_that_was_put_in(n_views: int, sigma_px: float) -> None:
    scene = facade_scene(np.random.default_rng(8), 500, 3.0, n_views=n_views, noise_px=sigma_px)
    found, noise_px = adjust(truth_of(scene), BundleOptions(cauchy_px=5.0 * sigma_px))
    assert noise_px == residual_noise_px(reprojection_residuals(found))
    assert 0.85 * sigma_px < noise_px < 1.15 * sigma_px


def test_noise_estimate_survives_wrong_points_and_gaps() -> None:
    rng = np.random.default_rng(9)
    # Residuals of points seen from fixed poses: 2V numbers, 3 fitted away.
    residuals = np.full((3000, 4, 2), np.nan)
    for j in range(3000):
        v = 2 + j % 3
        free = rng.standard_normal(2 * v)
        basis, _ = np.linalg.qr(rng.standard_normal((2 * v, 3)))
        residuals[j, :v] = 0.7 * (free - basis @ (basis.T @ free)).reshape(v, 2)
    assert residual_noise_px(residuals) == pytest.approx(0.7, rel=0.04)
    residuals[:600] *= 40.0
    assert 0.7 < residual_noise_px(residuals) < 1.1
    assert residual_noise_px(np.full((5, 3, 2), np.nan)) == 1.0
    assert residual_noise_px(np.zeros((0, 3, 2))) == 1.0


def test_degenerate_problems_end_quietly() -> None:
    rng = np.random.default_rng(10)
    scene = facade_scene(rng, 20, n_views=2, noise_px=0.2)
    views = truth_of(scene)
    nothing = replace(
        views, ideal=views.ideal[:0], slopes=views.slopes[:0], points=views.points[:0]
    )
    alone = replace(
        views, bodies=views.bodies[:1], mountings=views.mountings[:1], slopes=views.slopes[:, :1],
        ideal=views.ideal[:, :1], distances=(),
    )  # fmt: skip
    unscaled = replace(views, distances=())
    same_point = replace(
        views, points=np.ones_like(views.points) * (9.0, 0.0, 0.0), ideal=np.zeros_like(views.ideal)
    )
    behind = replace(views, points=-views.points)
    unseen = replace(views, ideal=np.full_like(views.ideal, np.nan))
    for odd in (nothing, alone, unscaled, same_point, behind, unseen):
        found, noise_px = adjust(odd, OPTIONS)
        assert np.isfinite(found.points).all()
        assert noise_px > 0


def test_one_unplaced_point_does_not_stop_the_others() -> None:
    rng = np.random.default_rng(11)
    scene = facade_scene(rng, 60, 3.0, n_views=3)
    start = views_of(scene, *perturbed_scene_start(rng, scene, 0.05, 0.005, 0.1))
    start.points[7] = np.nan
    found, _ = adjust(start, OPTIONS)
    for body, truth in zip(found.bodies, scene.bodies, strict=True):
        assert_pose_close(body, truth, within_m=1e-5, within_rad=1e-6)
    assert np.isnan(found.points[7]).all()
