"""Images that keep their detail where landmarks may be."""

from __future__ import annotations

import cv2
import numpy as np

from vcl_companion.vision.features import Image
from vcl_companion.vision.focus import focused


def texture() -> Image:
    noise = np.random.default_rng(4).integers(0, 255, (240, 320)).astype(np.float32)
    coarse = np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.0))
    return np.asarray(np.clip(128.0 + 2.0 * (coarse - coarse.mean()), 0.0, 255.0), np.uint8)


def test_detail_stays_around_the_places_and_nowhere_else() -> None:
    image = texture()
    kept = focused(image, np.array([[60.0, 80.0], [200.4, 99.6]]))
    assert kept.shape == image.shape
    assert kept.dtype == np.uint8
    for x, y in ((60, 80), (200, 100)):
        around = np.s_[y - 5 : y + 6, x - 5 : x + 6]
        assert np.abs(kept[around].astype(int) - image[around]).max() <= 1
    away = np.s_[180:230, 20:300]
    assert kept[away].std() < 0.6 * image[away].std()


def test_bytes_are_saved_and_an_image_without_places_is_only_blurred() -> None:
    image = texture()

    def n_bytes(one: Image) -> int:
        return len(cv2.imencode(".webp", one, [cv2.IMWRITE_WEBP_QUALITY, 80])[1])

    places = np.array([[x, y] for x in range(20, 320, 60) for y in range(20, 240, 60)], float)
    some, none = focused(image, places), focused(image, np.zeros((0, 2)))
    assert n_bytes(none) < n_bytes(some) < n_bytes(image)


def test_places_at_and_beyond_the_edge_are_no_trouble() -> None:
    image = texture()
    kept = focused(image, np.array([[0.0, 0.0], [319.0, 239.0], [-50.0, 500.0]]))
    assert np.abs(kept[:6, :6].astype(int) - image[:6, :6]).max() <= 1
