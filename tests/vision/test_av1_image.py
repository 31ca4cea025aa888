"""Grey images as AV1 pictures without a container."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.av1_image import av1_decoded, av1_encoded, av1_size_px, can_av1
from vcl_companion.vision.features import Image
from vcl_companion.vision.image_shift import shift_px


def blotches(height: int, width: int, seed: int = 0) -> Image:
    noise = np.random.default_rng(seed).normal(0.0, 1.0, (height, width))
    light = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.asarray(np.clip(128.0 + 200.0 * light, 0, 255), np.uint8)


def test_this_opencv_writes_it() -> None:
    assert can_av1()


@pytest.mark.parametrize("size", [(1, 1), (16, 16), (33, 71), (480, 640), (801, 1280)])
@pytest.mark.parametrize("quality", [1, 40, 99])
def test_it_is_the_picture_of_an_avif_file(size: tuple[int, int], quality: int) -> None:
    image = blotches(*size)
    data = av1_encoded(image, quality)
    assert av1_size_px(data) == size[::-1]
    options = [cv2.IMWRITE_AVIF_QUALITY, quality, cv2.IMWRITE_AVIF_SPEED, 9]
    avif = cv2.imencode(".avif", image, options)[1]
    assert data in avif.tobytes()
    assert len(avif) - len(data) > 250
    decoded = av1_decoded(data)
    assert decoded is not None
    np.testing.assert_array_equal(decoded, cv2.imdecode(avif, cv2.IMREAD_GRAYSCALE))


def test_the_best_quality_loses_nothing() -> None:
    image = np.random.default_rng(1).integers(0, 256, (60, 80), np.uint8)
    decoded = av1_decoded(av1_encoded(image, 100))
    assert decoded is not None
    np.testing.assert_array_equal(decoded, image)


@pytest.mark.parametrize("quality", [40, 60])
def test_what_is_decoded_lies_where_it_was(quality: int) -> None:
    """Unlike what other encoders make of it."""

    def drift(seed: int) -> Array:
        image = blotches(480, 640, seed)
        decoded = av1_decoded(av1_encoded(image, quality))
        assert decoded is not None
        return shift_px(image, decoded)

    assert np.abs(np.mean([drift(seed) for seed in range(4)], axis=0)).max() < 0.005


def test_it_takes_fewer_bytes_than_webp_for_as_much_detail() -> None:
    image = blotches(480, 640)
    webp = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, 36])[1]
    av1 = av1_encoded(image, 40)
    decoded = av1_decoded(av1)
    assert decoded is not None
    assert len(av1) < 0.9 * len(webp)
    errors = [
        float(np.mean((image - one.astype(float)) ** 2))
        for one in (decoded, np.asarray(cv2.imdecode(webp, cv2.IMREAD_GRAYSCALE)))
    ]
    assert errors[0] < 1.2 * errors[1]
