"""How noisy an image is said to be, against noise that was added."""

from __future__ import annotations

import numpy as np
import pytest

from vcl_companion.vision.features import Image
from vcl_companion.vision.image_noise import grey_noise


def inclined() -> Image:
    """Dark below, bright above."""
    return np.asarray(np.repeat(np.linspace(200, 60, 480)[:, None], 640, axis=1), dtype=np.uint8)


def noisy(image: Image, sigma: float) -> Image:
    noise = np.random.default_rng(3).normal(0.0, sigma, image.shape)
    return np.asarray(np.clip(np.rint(image + noise), 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("sigma", [1.0, 3.0, 7.0, 15.0])
def test_white_noise_is_told(sigma: float) -> None:
    assert grey_noise(noisy(inclined(), sigma)) == pytest.approx(sigma, rel=0.1)


def test_texture_is_no_noise_where_some_of_the_image_has_none() -> None:
    rng = np.random.default_rng(4)
    image = inclined()
    image[160:] = rng.integers(0, 256, (320, 640), dtype=np.uint8)
    assert grey_noise(noisy(image, 2.0)) == pytest.approx(2.0, rel=0.2)
    assert grey_noise(image) < 0.5


def test_what_is_cut_off_tells_nothing() -> None:
    """A black sky has no noise, and is not why the rest has none."""
    image = inclined()
    image[:240] = 0
    assert grey_noise(noisy(image, 5.0)) == pytest.approx(5.0, rel=0.1)
    for grey in (0, 255):
        assert grey_noise(np.full((480, 640), grey, np.uint8)) == 0.0


def test_an_image_of_hardly_a_block_has_noise_as_well() -> None:
    image = inclined()[:43, :44]
    assert grey_noise(noisy(image, 6.0)) == pytest.approx(6.0, rel=0.3)
