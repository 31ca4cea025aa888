"""Landmarks that are found badly, and all to one side, bend a map less where they are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.scenes import facade_scene
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.patch_table import landmark_noise
from vcl_companion.mapping.weighing import adjust_weighed
from vcl_companion.vision.bundle import BundleOptions, Distance, Views, adjust

OPTIONS = BundleOptions(cauchy_px=0.5)


def estimate(
    rng: np.random.Generator, aside_px: Array, noise_px: float = 0.01
) -> tuple[Views, Views]:
    """Return the truth, and the same with (N, 2) by which landmarks are found aside in view 2."""
    scene = facade_scene(rng, len(aside_px), 4.0, noise_px=noise_px)
    distances = (Distance(0, 1, scene.baseline_m(0, 1), 0.001),)
    truth = Views(
        scene.bodies, scene.mountings, scene.slopes, scene.ideal, scene.points_world, distances
    )
    moved = scene.ideal.copy()
    moved[:, -1] += np.einsum("nij,nj->ni", np.linalg.inv(scene.slopes[:, -1]), aside_px)
    return truth, replace(truth, ideal=moved)


def off(views: Views, truth: Views) -> float:
    """Return by how much the last view is turned away from where it was, rad."""
    return float(np.linalg.norm(truth.bodies[-1].local(views.bodies[-1])[3:]))


def test_what_is_found_badly_counts_for_little() -> None:
    rng = np.random.default_rng(4)
    n = 400
    bad = np.arange(n) < n // 2
    aside = np.where(bad[:, None], [0.0, 0.3], 0.0)
    truth, seen = estimate(rng, aside)
    told = np.where(bad[:, None], [0.3**2, 0.0, 0.3**2], [0.05**2, 0.0, 0.05**2])
    plain, _ = adjust(seen, OPTIONS)
    weighed, _ = adjust_weighed(seen, told, OPTIONS)
    assert off(weighed, truth) < 0.4 * off(plain, truth)


def test_a_landmark_counts_in_the_direction_in_which_it_is_found_well() -> None:
    """Found aside along an edge that is known to be one, it bends nothing."""
    rng = np.random.default_rng(5)
    n = 400
    aside = np.where((np.arange(n) % 2 == 1)[:, None], [0.0, 0.3], 0.0)
    truth, seen = estimate(rng, aside)
    along = np.where(
        (np.arange(n) % 2 == 1)[:, None], [0.05**2, 0.0, 0.6**2], [0.05**2, 0, 0.05**2]
    )
    across = along[:, [2, 1, 0]]
    right, _ = adjust_weighed(seen, along, OPTIONS)
    wrong, _ = adjust_weighed(seen, across, OPTIONS)
    assert off(right, truth) < 0.25 * off(wrong, truth)


def test_without_knowledge_it_is_the_plain_adjustment() -> None:
    _, seen = estimate(np.random.default_rng(6), np.zeros((80, 2)))
    plain, plain_px = adjust(seen, OPTIONS)
    weighed, weighed_px = adjust_weighed(seen, np.full((80, 3), np.nan), OPTIONS)
    np.testing.assert_allclose(weighed.points, plain.points, atol=1e-9)
    np.testing.assert_array_equal(weighed.slopes, seen.slopes)
    assert abs(weighed_px - plain_px) < 1e-9


def test_the_noise_that_is_returned_is_that_of_pixels() -> None:
    _, seen = estimate(np.random.default_rng(7), np.zeros((300, 2)), 0.05)
    _, noise_px = adjust_weighed(seen, np.tile([0.5**2, 0.0, 0.5**2], (300, 1)), OPTIONS)
    assert 0.04 < noise_px < 0.06


def test_a_landmark_s_noise_is_that_of_the_view_in_the_middle() -> None:
    noise = np.full((3, 4, 3), np.nan)
    noise[0, [0, 2, 3]] = [[1.0, 0.1, 4.0], [3.0, 0.2, 5.0], [2.0, 0.9, 6.0]]
    noise[1, 1] = [7.0, 8.0, 9.0]
    found = landmark_noise(noise)
    np.testing.assert_array_equal(found[0], [3.0, 0.2, 5.0])
    np.testing.assert_array_equal(found[1], [7.0, 8.0, 9.0])
    assert np.isnan(found[2]).all()
