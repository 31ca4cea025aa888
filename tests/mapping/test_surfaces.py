"""How steep the surfaces are that landmarks lie on."""

from __future__ import annotations

import numpy as np

from tests.scenes import PINHOLE as CAMERA
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.surfaces import slopes_of

SIGMA = 0.002


def street(rng: np.random.Generator, n: int) -> tuple[Array, Array, Array, Array]:
    """Return pixels, ideal coordinates, inverse depths and slopes of a wall and the ground.

    Both recede: the wall, 4 m to the right, stands on the ground 1.5 m below the camera.
    """
    size = np.array([CAMERA.width_px, CAMERA.height_px])
    pixels = rng.uniform(0.0, 1.0, (4 * n, 2)) * size
    ideal = CAMERA.ideal_from_pixels(pixels)
    x, y = ideal.T
    # One over the depth: of the wall x / 4, of the ground y / 1.5; the nearer one is seen.
    inverse_depth = np.maximum(x / 4.0, y / 1.5)
    shown = np.flatnonzero(inverse_depth > 0.05)[:n]
    slopes = np.where((x / 4.0 > y / 1.5)[:, None], [0.25, 0.0], [0.0, 1.0 / 1.5])
    return pixels[shown], ideal[shown], inverse_depth[shown], slopes[shown]


def test_where_a_wall_meets_the_ground_a_landmark_lies_on_one_of_both() -> None:
    rng = np.random.default_rng(3)
    pixels, ideal, inverse_depth, slopes = street(rng, 900)
    sigma = SIGMA * inverse_depth
    measured = inverse_depth + sigma * rng.standard_normal(len(sigma))
    off = slopes_of(pixels, ideal, measured, sigma) - slopes
    # In units of a surface that recedes by its distance over its distance.
    error = np.linalg.norm(off, axis=1) / inverse_depth
    beside = np.abs(ideal[:, 0] / 4.0 - ideal[:, 1] / 1.5) * CAMERA.focal_px < 15.0
    assert 50 < beside.sum() < 450
    assert np.mean(error[~beside] > 0.5) < 0.02
    assert np.mean(error[beside] > 0.5) < 0.2


def test_a_landmark_among_neighbours_of_all_depths_faces_the_camera() -> None:
    rng = np.random.default_rng(4)
    pixels = rng.uniform(0.0, 1.0, (400, 2)) * [CAMERA.width_px, CAMERA.height_px]
    ideal = CAMERA.ideal_from_pixels(pixels)
    inverse_depth = 1.0 / rng.uniform(3.0, 30.0, 400)
    slopes = slopes_of(pixels, ideal, inverse_depth, SIGMA * inverse_depth)
    facing = ideal * (inverse_depth / (1.0 + (ideal**2).sum(axis=1)))[:, None]
    error = np.linalg.norm(slopes - facing, axis=1) / inverse_depth
    # Planes steeper than 60 degrees explain nothing that is not chance.
    assert np.median(error) < 1.7


def test_a_landmark_alone_faces_the_camera() -> None:
    pixels = np.array([[400.0, 100.0]])
    ideal = CAMERA.ideal_from_pixels(pixels)
    slopes = slopes_of(pixels, ideal, np.array([0.2]), np.array([0.001]))
    facing = ideal * 0.2 / (1.0 + (ideal**2).sum())
    np.testing.assert_allclose(slopes, facing, atol=1e-6)
