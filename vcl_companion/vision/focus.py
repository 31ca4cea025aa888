"""An image with its detail where landmarks may be, in fewer bytes.

An encoder spends its bytes on everything that has texture; a map is followed by small
patches around corners. What lies between those is blurred before: it costs little then, and
still says what larger features and coarse steps of an alignment need.
"""

from __future__ import annotations

import cv2
import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Image

# A patch and how far it is moved while it is aligned.
_RADIUS_PX = 10
_BLUR_PX = 3.0
_EDGE_PX = 1.5


def focused(image: Image, pixels: Array) -> Image:
    """Return an image that is blurred where none of some places is near.

    Args:
        image: (H, W) uint8.
        pixels: (N, 2) places to keep, px.
    """
    near = np.zeros(image.shape[:2], np.uint8)
    for x, y in np.rint(pixels).astype(int).tolist():
        cv2.circle(near, (x, y), _RADIUS_PX, 255, -1)
    kept = cv2.GaussianBlur(near, (0, 0), _EDGE_PX).astype(np.float32) / 255.0
    blurred = cv2.GaussianBlur(image, (0, 0), _BLUR_PX).astype(np.float32)
    return np.asarray(np.rint(kept * image + (1.0 - kept) * blurred), dtype=np.uint8)
