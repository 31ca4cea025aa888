"""What an image says of where a place is: the squared gradient of a patch."""

from __future__ import annotations

import cv2
import numpy as np

from vcl_companion.vision.texture import textures


def test_it_is_the_sum_over_the_patch_of_central_differences() -> None:
    rng = np.random.default_rng(0)
    image = np.asarray(rng.integers(0, 256, (60, 80)), dtype=np.uint8)
    pixels = np.column_stack([rng.uniform(6.0, 73.0, 50), rng.uniform(6.0, 53.0, 50)])
    gx = 0.5 * cv2.Sobel(image, cv2.CV_64F, 1, 0, ksize=1)
    gy = 0.5 * cv2.Sobel(image, cv2.CV_64F, 0, 1, ksize=1)
    x, y = np.round(pixels).astype(int).T
    for column, product in enumerate((gx * gx, gx * gy, gy * gy)):
        summed = cv2.boxFilter(product, cv2.CV_64F, (9, 9), normalize=False)
        np.testing.assert_allclose(textures(image, pixels, 4)[:, column], summed[y, x], atol=1e-6)


def test_a_flat_image_says_nothing_and_an_edge_nothing_along_itself() -> None:
    flat = np.full((40, 40), 90, np.uint8)
    centre = np.array([[20.0, 20.0]])
    np.testing.assert_array_equal(textures(flat, centre, 4), 0.0)
    flat[:, 21:] = 190
    np.testing.assert_array_equal(textures(flat, centre, 4), [[2 * 9 * 50.0**2, 0.0, 0.0]])
