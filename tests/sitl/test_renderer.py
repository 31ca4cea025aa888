"""The image shows every point where camera and pose say, and hides what is behind."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sitl.render_kernels import look_up
from sitl.renderer import Imaging, Renderer
from sitl.scenario import load_scenario
from sitl.town import build_town
from sitl.world import SKY, Grey, Surface, Texture, World
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.recording import BODY_FROM_CAM_FORWARD

PINHOLE = Camera(640, 480, 360.0, 362.0, 317.2, 242.9)
RADIAL = replace(
    PINHOLE, distortion_model="radial-tangential", distortion=(-0.22, 0.05, 0.002, -0.001)
)
FISHEYE = replace(PINHOLE, distortion_model="equidistant", distortion=(0.02, -0.01, 0.003, -0.0005))
CLEAN = Imaging(noise_levels=0.0)
BACKGROUND = Texture.from_image(np.full((4, 4), 40, dtype=np.uint8))

_TEXELS_PER_M = 70.0
_DOT_SIGMA_M = 0.035


def dotted_board(
    rng: np.random.Generator, corner: Array, turn: Array, size_m: tuple[float, float]
) -> tuple[Surface, Array]:
    """A dark board with bright round dots; and the dots' (N, 3) centres in the world, m."""
    width, height = size_m
    across = (np.arange(round(width * _TEXELS_PER_M)) + 0.5) / _TEXELS_PER_M
    along = (np.arange(round(height * _TEXELS_PER_M)) + 0.5) / _TEXELS_PER_M
    pitch = 0.6
    u, v = np.meshgrid(np.arange(pitch, width - 0.3, pitch), np.arange(pitch, height - 0.3, pitch))
    dots = np.stack([u.ravel(), v.ravel()], axis=1) + rng.uniform(-0.08, 0.08, (u.size, 2))
    light = np.zeros((len(along), len(across)))
    for x, y in dots:
        light += np.outer(
            np.exp(-0.5 * ((along - y) / _DOT_SIGMA_M) ** 2),
            np.exp(-0.5 * ((across - x) / _DOT_SIGMA_M) ** 2),
        )
    texture = Texture.from_image(np.rint(40.0 + 180.0 * light).astype(np.uint8))
    rotation = exp_so3(turn)
    surface = Surface(corner, rotation[:, 1], rotation[:, 2], *size_m, texture)
    points = corner + dots[:, :1] * rotation[:, 1] + dots[:, 1:] * rotation[:, 2]
    return surface, points


def dotted_world() -> tuple[World, Array]:
    """Three boards at different depths and angles that do not hide each other's dots."""
    rng = np.random.default_rng(11)
    boards = [
        dotted_board(rng, np.array([8.0, -6.0, -3.0]), np.array([0.0, 0.2, -0.5]), (5.0, 6.0)),
        dotted_board(rng, np.array([6.5, -0.4, -2.6]), np.array([0.1, 0.0, 0.4]), (4.0, 5.0)),
        dotted_board(rng, np.array([7.0, -4.0, 3.3]), np.array([0.0, -1.2, 0.0]), (8.0, 2.5)),
    ]
    return World(tuple(b[0] for b in boards), BACKGROUND), np.concatenate([b[1] for b in boards])


def poses() -> list[Pose]:
    """Cameras here and there, rolled, pitched and yawed, world_from_cam."""
    body = [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((-1.5, 1.2, -0.4), (0.12, 0.08, -0.2)),
        ((1.0, -1.0, 0.5), (-0.3, -0.05, 0.15)),
        ((-3.0, 2.5, -1.0), (0.05, -0.15, -0.4)),
        ((3.2, -1.0, -0.6), (0.4, 0.1, -0.3)),
        ((3.0, 1.6, 0.2), (-0.2, -0.7, 0.1)),
    ]
    return [
        Pose(matrix_from_euler(*angles) @ BODY_FROM_CAM_FORWARD, np.array(place))
        for place, angles in body
    ]


def centroid(image: Grey, near_px: Array, half_px: int) -> Array:
    """Where the light in a window around a place is centred, px, against the background of 40."""
    x0, y0 = (np.rint(near_px) - half_px).astype(int)
    window = image[y0 : y0 + 2 * half_px + 1, x0 : x0 + 2 * half_px + 1].astype(float) - 40.0
    rows, columns = np.indices(window.shape)
    total = window.sum()
    return np.array([x0 + (columns * window).sum() / total, y0 + (rows * window).sum() / total])


def dot_errors(renderer: Renderer, camera: Camera, pose: Pose, world: World, dots: Array) -> Array:
    """(N, 2) measured minus expected pixels of the dots that are whole and unhidden, px."""
    image = renderer.render(pose)
    dots_cam = pose.inverse().apply(dots)
    expected = camera.project(dots_cam)
    reach = world.intersect(pose.translation, dots - pose.translation)
    seen = np.all((expected > 18) & (expected < (621, 461)), axis=1)
    seen &= np.abs(reach.distance - 1.0) < 1e-6
    # A window wide enough for the dot and no wider than the gap to the next one.
    half = np.ceil(4.5 * _DOT_SIGMA_M * 360.0 / dots_cam[:, 2])
    seen &= (half >= 5) & (half <= 16)
    chosen = np.flatnonzero(seen)
    for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1)):  # on the same board as the dot
        pixels = expected[chosen] + half[chosen, None] * corner
        rays = np.column_stack([camera.ideal_from_pixels(pixels), np.ones(len(chosen))])
        around = world.intersect(pose.translation, rays @ pose.rotation.T)
        chosen = chosen[around.surface == reach.surface[chosen]]
    return np.array([centroid(image, expected[i], int(half[i])) - expected[i] for i in chosen])


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL, FISHEYE], ids=["none", "radtan", "equi"])
def test_known_points_are_seen_where_camera_and_pose_say(camera: Camera) -> None:
    world, dots = dotted_world()
    renderer = Renderer(world, camera, CLEAN)
    errors = np.concatenate([dot_errors(renderer, camera, p, world, dots) for p in poses()])
    assert len(errors) > 150
    assert np.abs(errors).max() < 0.1
    assert np.sqrt(np.mean(errors**2)) < 0.02
    assert np.abs(errors.mean(axis=0)).max() < 0.01  # half a pixel off would show here


@pytest.mark.parametrize("supersampling", [1, 2, 3, 4])
def test_supersampling_moves_nothing(supersampling: int) -> None:
    world, dots = dotted_world()
    renderer = Renderer(world, PINHOLE, replace(CLEAN, supersampling=supersampling, blur_px=0.8))
    errors = dot_errors(renderer, PINHOLE, poses()[1], world, dots)
    assert len(errors) > 30
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert np.abs(errors).max() < 0.1


def test_an_edge_in_front_hides_what_is_behind_up_to_its_place() -> None:
    white = Texture.from_image(np.full((4, 4), 240, dtype=np.uint8))
    down, east = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    far = Surface(np.array([9.0, -20.0, -20.0]), east, down, 40.0, 40.0, BACKGROUND)
    near = Surface(np.array([5.0, 0.503, -20.0]), east, down, 20.0, 40.0, white)
    camera = replace(PINHOLE, distortion_model="none", distortion=())
    pose = Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
    edge_px = camera.project(pose.inverse().apply(np.array([[5.0, 0.503, 0.0]])))[0, 0]
    image = Renderer(
        World((far, near), BACKGROUND), camera, replace(CLEAN, supersampling=4)
    ).render(pose)
    # The light in a row says how many columns right of the edge are white.
    white_columns = (image.astype(float) - 40.0).sum(axis=1) / 200.0
    assert camera.width_px - 0.5 - white_columns == pytest.approx(edge_px, abs=0.13)
    swapped = Renderer(World((near, far), BACKGROUND), camera, replace(CLEAN, supersampling=4))
    assert np.array_equal(swapped.render(pose), image)


@pytest.fixture(scope="module")
def demo_world() -> World:
    return build_town(load_scenario("demo").world)


@pytest.mark.parametrize("camera", [PINHOLE, RADIAL], ids=["none", "radtan"])
def test_depth_of_every_pixel_is_that_of_its_ray(demo_world: World, camera: Camera) -> None:
    pose = Pose(
        matrix_from_euler(0.05, -0.1, 0.3) @ BODY_FROM_CAM_FORWARD, np.array([-1.0, -2.0, -5.0])
    )
    image = Renderer(demo_world, camera).depth(pose)
    assert image.depth_m.shape == (480, 640)
    rng = np.random.default_rng(4)
    columns, rows = rng.integers(0, 640, 4000), rng.integers(0, 480, 4000)
    ideal = camera.ideal_from_pixels(np.stack([columns, rows], axis=1).astype(np.float64))
    rays = np.column_stack([ideal, np.ones(len(ideal))]) @ pose.rotation.T
    hits = demo_world.intersect(pose.translation, rays)
    same = image.surface[rows, columns] == hits.surface
    assert same.mean() > 0.998  # the rest are rays along an edge
    assert 0.05 < np.mean(hits.surface == SKY) < 0.6
    solid = same & (hits.surface != SKY)
    assert image.depth_m[rows, columns][solid] == pytest.approx(hits.distance[solid], rel=2e-4)
    assert np.all(np.isinf(image.depth_m[rows, columns][same & (hits.surface == SKY)]))


def test_far_fine_texture_turns_grey_instead_of_into_patterns() -> None:
    checker = np.where(np.indices((2000, 2000)).sum(axis=0) % 2 == 0, 40, 200).astype(np.uint8)
    down, east = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    board = Surface(
        np.array([60.0, -15.0, -15.0]), east, down, 30.0, 30.0, Texture.from_image(checker)
    )
    image = Renderer(World((board,), BACKGROUND), PINHOLE, CLEAN).render(
        Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
    )
    middle = image[200:280, 280:360]
    assert abs(float(middle.mean()) - 120.0) < 1.5
    assert float(middle.std()) < 2.0


def test_noise_is_as_told_and_drawn_from_the_given_generator() -> None:
    world, _ = dotted_world()
    renderer = Renderer(world, PINHOLE, Imaging(noise_levels=2.5))
    pose = poses()[0]
    clean = renderer.render(pose)
    noisy = renderer.render(pose, np.random.default_rng(7))
    assert np.array_equal(noisy, renderer.render(pose, np.random.default_rng(7)))
    assert not np.array_equal(noisy, renderer.render(pose, np.random.default_rng(8)))
    difference = noisy.astype(float) - clean
    # Both images are rounded to whole levels, which adds 2 / 12 to the variance.
    assert 2.4 < difference.std() < 2.7
    assert abs(difference.mean()) < 0.03


def test_gain_and_vignetting_darken_as_told() -> None:
    even = World((), Texture.from_image(np.full((4, 4), 200, dtype=np.uint8)))
    camera = Camera(641, 481, 360.0, 360.0, 320.0, 240.0)
    options = Imaging(noise_levels=0.0, gain=0.5, vignetting=0.4)
    image = Renderer(even, camera, options).render(Pose(BODY_FROM_CAM_FORWARD, np.zeros(3)))
    assert image[240, 320] == 100
    assert image[0, 0] == image[480, 640] == 60


def test_a_lens_that_cannot_be_inverted_is_refused() -> None:
    distortion = (-1.5, 0.0, 0.0, 0.0)
    broken = Camera(64, 48, 36.0, 36.0, 31.5, 23.5, "radial-tangential", distortion)
    with pytest.raises(ValueError, match="inverted"):
        Renderer(World((), BACKGROUND), broken)


def test_the_demo_town_is_rich_and_its_corners_are_found_again(demo_world: World) -> None:
    """AKAZE finds corners all over, and the same ones from another drone's place."""
    scenario = load_scenario("demo")
    sensor = scenario.sensor(scenario.drone[0])
    detector = cv2.AKAZE.create()
    found, depth = [], []
    for i in (0, 1):
        path = scenario.drone[i].path()
        world_from_cam = path.at(0.0).ned_from_body @ sensor.body_from_cam
        renderer = Renderer(demo_world, sensor.camera, scenario.image.imaging(1.0))
        image = renderer.render(world_from_cam, np.random.default_rng(i))
        keypoints, descriptors = detector.detectAndCompute(image, np.empty(0, np.uint8))
        seen = np.array([k.pt for k in keypoints])
        found.append((world_from_cam, seen, descriptors))
        depth.append(renderer.depth(world_from_cam).depth_m)
    (pose_a, seen_a, words_a), (pose_b, seen_b, words_b) = found
    assert min(len(seen_a), len(seen_b)) >= 800
    cells, _, _ = np.histogram2d(seen_a[:, 1], seen_a[:, 0], (4, 4), ((0, 480), (0, 640)))
    assert (cells >= 10).sum() >= 12  # all but the sky
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(words_a, words_b)
    a = seen_a[[m.queryIdx for m in matches]]
    b = seen_b[[m.trainIdx for m in matches]]
    near = np.rint(a).astype(int)
    z = depth[0][near[:, 1], near[:, 0]].astype(np.float64)
    solid = np.isfinite(z)
    points_a = np.column_stack([sensor.camera.ideal_from_pixels(a), np.ones(len(a))])
    in_b = (pose_b.inverse() @ pose_a).apply(points_a[solid] * z[solid, None])
    error = np.linalg.norm(sensor.camera.project(in_b) - b[solid], axis=1)
    assert (error < 2.0).sum() > 250
    assert float(np.median(error[error < 2.0])) < 0.7


@pytest.mark.parametrize("shape", [(2, 9), (17, 2), (30, 41)])
def test_light_between_texels_is_what_a_library_says(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    image = rng.integers(0, 256, shape).astype(np.uint8)
    texture = Texture.from_image(image)
    edges = np.array([0.0, 1.0, 0.5 / shape[1], 1.0 - 0.5 / shape[0]])
    across, along = (np.append(edges, rng.random(60)).astype(np.float32) for _ in range(2))
    light = np.full(len(across), -1.0, dtype=np.float32)
    members = np.arange(len(across), dtype=np.int64)
    look_up(members, across, along, texture.texels, texture.shelves, light)
    u, v = across * shape[1] - 0.5, along * shape[0] - 0.5
    known = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(light, known.ravel(), atol=1.0)
    np.testing.assert_allclose(light[:2], [image[0, 0], image[-1, -1]], atol=1e-4)


def test_a_place_that_is_no_number_is_looked_up_inside_the_texture() -> None:
    texture = Texture.from_image(np.full((4, 4), 70, dtype=np.uint8))
    nowhere = np.full(3, np.nan, dtype=np.float32)
    light = np.zeros(3, dtype=np.float32)
    look_up(np.arange(3), nowhere, nowhere, texture.texels, texture.shelves, light)
    np.testing.assert_array_equal(light, 70.0)


def test_a_floor_that_goes_on_below_the_camera_is_seen_to_the_image_s_edge() -> None:
    """Two metres above a board, with a hole in it from 6 to 10 m ahead."""
    board = Texture.from_image(np.full((40, 40), 120, dtype=np.uint8))
    hole = np.array([[18.0, 10.0, 22.0, 14.0]])
    corner, right, down = np.array([[20.0, -20.0, 2.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    floor = Surface(corner, right, down, 40.0, 40.0, board, hole)
    renderer = Renderer(World((floor,), BACKGROUND), PINHOLE, CLEAN)
    seen = renderer.depth(Pose(BODY_FROM_CAM_FORWARD, np.zeros(3)))
    slope = (np.arange(480)[:, None] - PINHOLE.cy_px) / PINHOLE.fy_px
    with np.errstate(divide="ignore"):
        depth = np.where(slope > 0.0, 2.0 / slope, np.inf)
    with np.errstate(invalid="ignore"):
        aside = np.abs((np.arange(640)[None, :] - PINHOLE.cx_px) / PINHOLE.fx_px * depth)
    through = (depth > 6.0) & (depth < 10.0) & (aside < 2.0)
    shown = (depth < 20.0) & (aside < 20.0) & ~through
    assert through.any()
    assert shown[-1].all()
    np.testing.assert_array_equal(seen.surface == 0, shown)
    there = np.broadcast_to(depth, shown.shape)[shown]
    np.testing.assert_allclose(seen.depth_m[shown], there, rtol=1e-5)
