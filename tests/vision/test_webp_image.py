"""WebP that is decoded to where it was."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vcl_companion.vision.image_shift import shift_px
from vcl_companion.vision.webp_image import webp_encoded


@pytest.mark.parametrize("quality", [20, 36, 80])
def test_what_is_decoded_lies_where_it_was(quality: int) -> None:
    """The encoder alone would put it to the right and below."""
    rng = np.random.default_rng(8)
    drifts = []
    for _ in range(4):
        light = cv2.GaussianBlur(rng.normal(0.0, 1.0, (480, 640)), (0, 0), 2.0)
        image = np.asarray(np.clip(128.0 + 200.0 * light, 0, 255), np.uint8)
        plain = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1]
        both = (np.asarray(plain), np.frombuffer(webp_encoded(image, quality), np.uint8))
        decoded = [np.asarray(cv2.imdecode(b, cv2.IMREAD_GRAYSCALE), np.uint8) for b in both]
        drifts.append([shift_px(image, one) for one in decoded])
    plain_px, ours_px = np.mean(drifts, axis=0)
    assert (plain_px > 0.002).all(), plain_px
    assert np.linalg.norm(ours_px) < 0.4 * np.linalg.norm(plain_px), (plain_px, ours_px)
