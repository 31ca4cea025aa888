"""Shifts of a hundredth of a pixel, found and made; the scene is known between pixels too."""

from __future__ import annotations

import numpy as np
import pytest

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Image
from vcl_companion.vision.image_shift import shift_px, shifted


def waves(shift: Array, noise: float = 0.0, seed: int = 0) -> Image:
    """Return (120, 160) a sum of waves of 8 to 60 px, displaced to the right and down."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:120, 0:160].astype(float)
    light = np.full((120, 160), 128.0)
    for _ in range(40):
        angle, length, phase = rng.uniform(0.0, 6.28, 3) * [1.0, 8.0, 1.0] + [0.0, 8.0, 0.0]
        along = (x - shift[0]) * np.cos(angle) + (y - shift[1]) * np.sin(angle)
        light += 6.0 * np.sin(2 * np.pi * along / length + phase)
    light += noise * np.random.default_rng(seed).standard_normal(light.shape)
    return np.asarray(np.clip(np.rint(light), 0, 255), np.uint8)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.02, -0.03), (-0.2, 0.1), (0.0, 0.25)])
def test_a_shift_is_found(shift: tuple[float, float]) -> None:
    found = shift_px(waves(np.zeros(2)), waves(np.array(shift)))
    # One step is right to some hundredths of what it finds.
    np.testing.assert_allclose(found, shift, rtol=0.06, atol=0.004)


def test_a_shift_is_found_under_noise() -> None:
    shift = np.array([0.05, -0.04])
    found = shift_px(waves(np.zeros(2), 4.0, 1), waves(shift, 4.0, 2))
    np.testing.assert_allclose(found, shift, atol=0.015)


@pytest.mark.parametrize("shift", [(0.03, -0.04), (-0.3, 0.2), (0.5, -0.5)])
def test_a_shifted_image_is_the_scene_displaced(shift: tuple[float, float]) -> None:
    made = shifted(waves(np.zeros(2)), np.array(shift))
    inside = np.s_[3:-3, 3:-3]
    error = made[inside].astype(float) - waves(np.array(shift))[inside]
    # Both are rounded to whole grey levels.
    assert np.abs(error).max() <= 2.0
    assert error.std() < 0.6


def test_no_shift_leaves_an_image_as_it_is() -> None:
    image = waves(np.zeros(2), 20.0)
    np.testing.assert_array_equal(shifted(image, np.zeros(2)), image)


def test_what_does_not_show_a_shift_has_none() -> None:
    blank = np.full((60, 80), 90, np.uint8)
    np.testing.assert_array_equal(shift_px(blank, blank), [0.0, 0.0])
    stripes = np.tile(np.repeat([40, 200], 8).astype(np.uint8), (60, 5))
    np.testing.assert_array_equal(shift_px(stripes, stripes), [0.0, 0.0])
