"""Lenses bend as cameras do; patches are found to a few hundredths of a pixel, or refused."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.checks import numeric_jacobian
from tests.scenes import CAMERAS, PINHOLE
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.vision.features import Image
from vcl_companion.vision.patch_choice import ChoiceRules, choose_anchors
from vcl_companion.vision.patch_kernels import FLAT, FOUND, OUTSIDE, UNLIKE
from vcl_companion.vision.patch_tables import Anchors, keyframe_images, lens_of, pyramid_of
from vcl_companion.vision.patch_views import bent, seen_from
from vcl_companion.vision.patches import Alignment, AlignRules, align_patches

RULES = ChoiceRules(40.0, 4.0, 0.05, 0.5, 0.03, 1.5, 3.5)
STRICT = AlignRules()


def painted(rng: np.random.Generator, height: int = 480, width: int = 640) -> Image:
    total = np.zeros((height, width), np.float32)
    for step in (6, 16, 50):
        cells = height // step + 2, width // step + 2
        coarse = rng.standard_normal(cells).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.clip(128 + 32 * total, 0, 255), dtype=np.uint8)


def anchored(
    image: Image, pixels: Array, camera: Camera = PINHOLE, depth_m: float = 10.0
) -> Anchors:
    """Places of one keyframe at the origin, on a plane across its axis."""
    n = len(pixels)
    ideal = camera.ideal_from_pixels(pixels)
    slopes = np.linalg.inv(camera.pixel_slopes(ideal)).reshape(-1, 4)
    still = np.zeros(n)
    return Anchors(
        first=np.arange(n + 1, dtype=np.int64),
        landmark=np.arange(n, dtype=np.int64),
        keyframe=np.zeros(n, np.int64),
        planes=np.column_stack([ideal, np.full(n, 1.0 / depth_m), still, still, slopes]),
        pixels=pixels,
        points_world=np.column_stack([ideal, np.ones(n)]) * depth_m,
        own=np.zeros((n, 3)),
        spread=np.tile([1e-4, 0.0, 0.0, 1e-4, 0.0, 1e-4], (n, 1)),
        texture=np.tile([4e4, 0.0, 4e4], (n, 1)),
        images=keyframe_images([pyramid_of(image)], [Pose.identity()]),
    )


def aligned(
    anchors: Anchors,
    image: Image,
    cam_from_world: Pose,
    radius_px: float = 0.0,
    level: int = 0,
    camera: Camera = PINHOLE,
    rules: AlignRules = STRICT,
) -> Alignment:
    rows = np.arange(len(anchors.landmark))
    radii = np.full(len(rows), radius_px)
    return align_patches(
        anchors,
        rows,
        pyramid_of(image),
        lens_of(camera),
        cam_from_world,
        radii,
        level,
        rules,
    )


@pytest.mark.parametrize("camera", CAMERAS, ids=["none", "radial4", "radial5", "fisheye"])
def test_the_compiled_lens_is_the_camera(camera: Camera) -> None:
    lens = lens_of(camera)
    pixels = np.array([[3.0, 5.0], [600.0, 20.0], [320.0, 240.0], [camera.cx_px, camera.cy_px]])
    for ideal, pixel in zip(camera.ideal_from_pixels(pixels), pixels, strict=True):
        u, v, *slopes = bent(lens.table, *ideal)
        assert np.allclose((u, v), pixel, atol=1e-6)
        expected = numeric_jacobian(lambda x: camera.pixels_from_ideal(x[None])[0], ideal)
        assert np.allclose(np.reshape(slopes, (2, 2)), expected, rtol=1e-4, atol=1e-3)
        assert (ideal**2).sum() < lens.reach


@pytest.mark.parametrize("camera", CAMERAS, ids=["none", "radial4", "radial5", "fisheye"])
def test_the_affine_map_is_the_derivative_of_the_true_mapping(camera: Camera) -> None:
    """Keyframe pixel to ray, to the inclined plane, to the other camera's pixel."""
    frame_from_key = Pose(exp_so3(np.array([0.05, -0.2, 0.1])), np.array([0.8, -0.3, 1.0]))
    pixel = np.array([250.0, 300.0])
    x, y = camera.ideal_from_pixels(pixel[None])[0]
    r, b, c = 0.1, 0.03, -0.02
    slopes = np.linalg.inv(camera.pixel_slopes(np.array([[x, y]]))[0]).ravel()

    def elsewhere(key_pixel: Array) -> Array:
        p, q = camera.ideal_from_pixels(key_pixel[None])[0]
        point = np.array([p, q, 1.0]) / (r + b * (p - x) + c * (q - y))
        return np.asarray(camera.project(frame_from_key.apply(point)[None])[0])

    out, lens = np.empty(15), lens_of(camera)
    plane = np.array([x, y, r, b, c, *slopes])
    transform = np.ascontiguousarray(frame_from_key.matrix()[:3])
    assert seen_from(plane, lens.table, lens.reach, transform, out)
    assert np.allclose(out[3:5], elsewhere(pixel), atol=1e-6)
    assert np.allclose(out[9:13].reshape(2, 2), numeric_jacobian(elsewhere, pixel, 1e-3), atol=1e-3)
    behind = np.ascontiguousarray(Pose(exp_so3(np.array([0, np.pi, 0])), np.zeros(3)).matrix()[:3])
    assert not seen_from(plane, lens.table, lens.reach, behind, out)


def street(camera: Camera, height_m: float, back_m: float, rng: np.random.Generator) -> Image:
    """A painted street below a level camera, its optical axis ahead, so far behind the origin."""
    waves = rng.standard_normal((60, 2)) * 6.0
    phases = rng.uniform(0.0, 2.0 * np.pi, 60)
    fine = (np.arange(3 * camera.height_px) + 0.5) / 3 - 0.5
    across = (np.arange(3 * camera.width_px) + 0.5) / 3 - 0.5
    columns, rows = np.meshgrid(across, fine)
    ideal = camera.ideal_from_pixels(np.column_stack([columns.ravel(), rows.ravel()]))
    depth = height_m / np.maximum(ideal[:, 1], 0.02)
    ground = np.column_stack([ideal[:, 0] * depth, depth - back_m])
    light = sum(np.sin(ground @ w + p) for w, p in zip(waves, phases, strict=True))
    grey = np.clip(128.0 + 9.0 * np.asarray(light), 0, 255).reshape(rows.shape).astype(np.float32)
    size = camera.width_px, camera.height_px
    return np.rint(cv2.resize(grey, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)


def test_patches_of_the_ground_are_found_where_they_are_from_farther_away() -> None:
    """What an affine warp leaves out of a receding surface pushes all its patches to one side."""
    camera, height_m, back_m = replace(PINHOLE, cy_px=60.0), 3.0, 4.0
    near, far = (street(camera, height_m, b, np.random.default_rng(3)) for b in (0.0, back_m))
    pixels = np.random.default_rng(7).uniform([60.0, 240.0], [580.0, 440.0], (300, 2))
    anchors = anchored(near, pixels, camera)
    planes = anchors.planes.copy()
    planes[:, 2] = planes[:, 1] / height_m
    planes[:, 4] = 1.0 / height_m
    anchors = replace(anchors, planes=planes)
    found = aligned(anchors, far, Pose(np.eye(3), np.array([0.0, 0.0, back_m])), camera=camera)
    error = (found.pixels - found.predicted)[found.found]
    assert found.found.mean() > 0.8
    assert np.abs(np.median(error, axis=0)).max() < 0.01
    assert np.median(np.abs(error), axis=0).max() < 0.05


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (1.7, 0.9), (-2.2, 1.4)])
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.5, 60.0)])
def test_a_shifted_image_is_found_to_a_few_hundredths(
    shift: tuple[float, float], gain: float, offset: float
) -> None:
    rng = np.random.default_rng(4)
    image = np.asarray(cv2.GaussianBlur(painted(rng), (0, 0), 0.7), dtype=np.uint8)
    # By Fourier's theorem; a warp by OpenCV is itself off by 0.05 px.
    row, column = np.fft.fftfreq(480)[:, None], np.fft.fftfreq(640)[None]
    phase = np.exp(-2j * np.pi * (column * shift[0] + row * shift[1]))
    exact = np.fft.ifft2(np.fft.fft2(image.astype(float)) * phase).real * gain + offset
    noisy = np.rint(exact + rng.standard_normal(exact.shape))
    moved = np.clip(noisy, 0, 255).astype(np.uint8)
    pixels = rng.uniform(30.0, [610.0, 450.0], (150, 2))
    found = aligned(anchored(image, pixels), moved, Pose.identity())
    good = found.found
    assert good.mean() > 0.9
    error = (found.pixels - found.predicted)[good] - shift
    # One grey level of noise is more of a picture of less contrast.
    assert np.median(np.abs(error)) < 0.02 / gain
    assert np.abs(np.median(error, axis=0)).max() < 0.01 / gain
    # What is left is what the residual of the grey levels says.
    sigma = np.sqrt(found.noise[good][:, [0, 2]])
    assert 0.7 < np.median(np.abs(error) / sigma) / 0.6745 < 1.4
    expected = PINHOLE.ideal_from_pixels(found.pixels[good])
    assert np.allclose(found.ideal[good], expected, atol=1e-9)


@pytest.mark.parametrize("noise", [3.0, 6.0])
def test_what_noise_of_both_images_makes_patches_err_is_told(noise: float) -> None:
    """Noise of the keyframe makes gradients of its own, that tell nothing of a shift."""
    rng = np.random.default_rng(8)
    clean = cv2.GaussianBlur(painted(rng), (0, 0), 1.0).astype(float) * 0.5 + 64.0
    keyframe, frame = (
        np.clip(np.rint(clean + noise * rng.standard_normal(clean.shape)), 0, 255).astype(np.uint8)
        for _ in range(2)
    )
    pixels = rng.uniform(30.0, [610.0, 450.0], (1500, 2))
    found = aligned(anchored(keyframe, pixels), frame, Pose.identity())
    good = found.found
    assert good.sum() > 500
    error = (found.pixels - found.predicted)[good]
    sigma = np.sqrt(found.noise[good][:, [0, 2]])
    assert 0.8 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.1


def test_far_predictions_are_searched_at_reduced_resolution() -> None:
    rng = np.random.default_rng(5)
    image = painted(rng)
    moved = np.roll(image, (9, -12), axis=(0, 1))
    anchors = anchored(image, rng.uniform(80.0, [560.0, 400.0], (100, 2)))
    found = aligned(anchors, moved, Pose.identity(), radius_px=20.0, level=2)
    off = np.linalg.norm((found.pixels - found.predicted)[found.found] - (-12.0, 9.0), axis=1)
    assert found.found.mean() > 0.8
    assert (off < 1.0).mean() > 0.9
    assert aligned(anchors, moved, Pose.identity()).found.mean() < 0.1


def test_what_is_not_there_is_refused_with_the_reason() -> None:
    rng = np.random.default_rng(6)
    image = painted(rng)
    image[200:260, 200:260] = 77
    pixels = np.array([[230.0, 230.0], [400.0, 300.0], [2.0, 100.0]])
    anchors = anchored(image, pixels)
    assert aligned(anchors, image, Pose.identity()).status.tolist() == [FLAT, FOUND, OUTSIDE]
    other = aligned(anchors, painted(rng), Pose.identity())
    assert other.status[1] != FOUND
    inverted = aligned(anchors, np.asarray(255 - image, np.uint8), Pose.identity())
    assert inverted.status[1] == UNLIKE
    away = aligned(anchors, image, Pose(np.eye(3), np.array([50.0, 0.0, 0.0])))
    assert (away.status == OUTSIDE).all()


def test_the_choice_is_spread_and_takes_the_surest() -> None:
    """Half the image holds ten times as many landmarks, and one landmark in two is badly known."""
    rng = np.random.default_rng(8)
    crowd = rng.uniform([20.0, 20.0], [310.0, 460.0], (1000, 2))
    few = rng.uniform([330.0, 20.0], [620.0, 460.0], (100, 2))
    anchors = anchored(painted(rng), np.concatenate([crowd, few]))
    spread = anchors.spread.copy()
    vague = np.arange(1100) % 2 == 0
    spread[vague, 0] = spread[vague, 3] = 0.04
    anchors = replace(anchors, spread=spread)
    chosen, radii, in_view = choose_anchors(
        anchors, lens_of(PINHOLE), Pose.identity(), Pose.identity(), 1e-4 * np.eye(6), RULES, 200, 6
    )
    assert in_view == 1100
    assert len(set(chosen.tolist())) == len(chosen) == 200
    assert 0.25 < (chosen >= 1000).mean() < 0.5
    assert vague[chosen[chosen < 1000]].mean() < 0.1
    # 0.01 rad and 0.01 m at 10 m: 3.2 px and more towards the corners, three sigma of both axes.
    assert (radii > 9.0).all()
    assert (radii < 40.0).all()


def test_noise_may_be_forgiven_and_what_is_unlike_is_not() -> None:
    """At dusk a patch varies by 6 to 10 grey levels, and by 6 of noise."""
    rng = np.random.default_rng(12)
    at = rng.uniform(60.0, [580.0, 420.0], (300, 2))

    def at_dusk(image: Image) -> Image:
        grey = 0.25 * image + rng.normal(0.0, 6.0, image.shape)
        return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)

    bright, other = painted(rng), painted(rng)
    anchors = anchored(at_dusk(bright), at)
    for forgives_noise, least, most in ((False, 0.0, 0.35), (True, 0.6, 1.0)):
        rules = AlignRules(forgives_noise=forgives_noise)
        found = aligned(anchors, at_dusk(bright), Pose.identity(), rules=rules)
        assert least <= found.found.mean() <= most
        aside = np.linalg.norm(found.pixels[found.found] - at[found.found], axis=1)
        assert np.median(aside) < 1.2
        unlike = aligned(anchors, at_dusk(other), Pose.identity(), rules=rules)
        assert unlike.found.mean() < 0.1


def test_a_pyramid_keeps_places() -> None:
    image = np.zeros((120, 160), np.uint8)
    image[56:73, 72:89] = 200
    pyramid = pyramid_of(image)
    assert [tuple(s[1:]) for s in pyramid.shelves] == [(120, 160), (60, 80)]
    start, height, width = pyramid.shelves[1]
    half = pyramid.texels[start : start + height * width].reshape(height, width).astype(float)
    rows, columns = np.indices(half.shape)
    assert np.isclose((columns * half).sum() / half.sum(), 40.0, atol=0.02)
    assert np.isclose((rows * half).sum() / half.sum(), 32.0, atol=0.02)


def test_what_has_no_patch_or_lies_behind_is_not_chosen() -> None:
    """Of a landmark whose patches all did not fit nothing is left but its place in the table."""
    rng = np.random.default_rng(9)
    anchors = anchored(painted(rng), rng.uniform(40.0, [600.0, 440.0], (50, 2)))
    bare = replace(anchors, first=np.append(anchors.first, [50, 50]))
    ahead, behind = Pose.identity(), Pose(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    for pose, n in ((ahead, 50), (behind, 0)):
        chosen, radii, in_view = choose_anchors(
            bare, lens_of(PINHOLE), pose, Pose.identity(), 1e-4 * np.eye(6), RULES, 60, 6
        )
        assert (len(chosen), len(radii), in_view) == (n, n, n)
        assert sorted(chosen) == list(range(n))


@pytest.mark.parametrize("size", [(480, 640), (427, 641), (161, 83)])
def test_every_level_is_the_one_before_reduced(size: tuple[int, int]) -> None:
    image = np.random.default_rng(1).integers(0, 255, size, dtype=np.uint8)
    pyramid = pyramid_of(image)
    expected = image
    for start, height, width in pyramid.shelves:
        level = pyramid.texels[start : start + height * width].reshape(height, width)
        assert np.array_equal(level, expected)
        expected = cv2.pyrDown(expected).astype(np.uint8)
    assert len(pyramid.texels) == start + height * width
