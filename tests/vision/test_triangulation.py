import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.checks import assert_consistent
from tests.scenes import CAMERAS, facade_scene, observe
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.vision.bundle import linearized
from vcl_companion.vision.triangulation import ray_angles, triangulate


@given(st.integers(0, 2**32 - 1), st.integers(2, 4), st.floats(0.0, 3.0), st.floats(0.05, 4.0))
def test_exact_rays_meet_in_the_landmark(
    seed: int, n_views: int, relief_m: float, baseline_m: float
) -> None:
    scene = facade_scene(
        np.random.default_rng(seed),
        30,
        relief_m,
        n_views=n_views,
        baseline_m=baseline_m,
        missed=0.2,
    )
    points = triangulate(scene.worlds_from_cams, scene.ideal)
    enough = scene.seen.sum(axis=1) >= 2
    assert np.isnan(points[~enough]).all()
    np.testing.assert_allclose(points[enough], scene.points_world[enough], rtol=0, atol=1e-6)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.distortion_model)
def test_any_lens_will_do(camera: Camera) -> None:
    scene = facade_scene(np.random.default_rng(1), 80, camera=camera)
    points = triangulate(scene.worlds_from_cams, scene.ideal)
    both = scene.seen.all(axis=1)
    np.testing.assert_allclose(points[both], scene.points_world[both], rtol=0, atol=1e-6)


@pytest.mark.parametrize("offset_m", [0.0, 1e2, 1e4, 1e5])
def test_precision_does_not_depend_on_where_the_world_begins(offset_m: float) -> None:
    scene = facade_scene(np.random.default_rng(2), 50, baseline_m=1.0)
    shift = Pose(np.eye(3), np.array([offset_m, -offset_m, 0.1 * offset_m]))
    both = scene.seen.all(axis=1)
    points = triangulate([shift @ w for w in scene.worlds_from_cams], scene.ideal[both])
    expected = shift.apply(scene.points_world[both])
    np.testing.assert_allclose(points, expected, rtol=0, atol=1e-8 + 1e-13 * offset_m)


@pytest.mark.parametrize("n_views", [2, 3])
def test_errors_are_those_of_least_squares(n_views: int) -> None:
    rng = np.random.default_rng(3)
    scene = facade_scene(rng, 400, 4.0, n_views=n_views, noise_px=0.4)
    seen = scene.seen.all(axis=1)
    information = np.zeros((int(seen.sum()), 3, 3))
    for i in range(n_views):
        _, _, by_point = linearized(
            scene.bodies[i], scene.mountings[i], scene.slopes[seen, i], scene.points_world[seen],
            scene.ideal[seen, i],
        )  # fmt: skip
        information += np.swapaxes(by_point, 1, 2) @ by_point / scene.noise_px**2
    points = triangulate(scene.worlds_from_cams, scene.ideal[seen])
    # The linear solution is not quite the least-squares one, and depth errors are skewed.
    assert_consistent(points - scene.points_world[seen], np.linalg.inv(information), slack=1.1)


def test_too_few_views_and_parallel_rays_give_nothing() -> None:
    scene = facade_scene(np.random.default_rng(4), 10, n_views=3)
    ideal = scene.ideal.copy()
    ideal[0] = np.nan
    ideal[1, 1:] = np.nan
    points = triangulate(scene.worlds_from_cams, ideal)
    assert np.isnan(points[:2]).all()
    assert triangulate(scene.worlds_from_cams, ideal[:0]).shape == (0, 3)
    beside = [Pose.identity(), Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))]
    assert np.isnan(triangulate(beside, np.full((1, 2, 2), 0.25))).all()


def test_one_place_gives_no_depth() -> None:
    rng = np.random.default_rng(5)
    scene = facade_scene(rng, 40)
    body, mounting = scene.bodies[1], scene.mountings[1]
    still = observe(rng, scene.points_world, (body, body), (mounting, mounting), scene.camera)
    assert np.isnan(triangulate(still.worlds_from_cams, still.ideal)).all()


def test_rays_that_meet_behind_are_handed_back_as_they_are() -> None:
    beside = [Pose.identity(), Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))]
    behind = np.array([[0.3, 0.2, -5.0]])
    ideal = np.stack([(behind - b.translation)[:, :2] / behind[:, 2:] for b in beside], axis=1)
    np.testing.assert_allclose(triangulate(beside, ideal), behind, atol=1e-9)


def test_ray_angle_is_the_widest_between_two_views_that_see_it() -> None:
    cams = [Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 1.0, -1.0)]
    points = np.array([[0.0, 0.0, 1.0]]).repeat(4, axis=0)
    seen = np.array([[1, 1, 1], [1, 1, 0], [1, 0, 0], [0, 0, 0]], dtype=bool)
    np.testing.assert_allclose(
        np.rad2deg(ray_angles(cams, points, seen)), [90.0, 45.0, 0.0, 0.0], atol=1e-6
    )
    at_a_camera = ray_angles(cams, np.array([[1.0, 0.0, 0.0]]), np.ones((1, 3), dtype=bool))
    assert np.isfinite(at_a_camera).all()
