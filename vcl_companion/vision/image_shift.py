"""By how much one image lies beside another of the same view, far below a pixel, and undoing it."""

from __future__ import annotations

import cv2
import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Image

# Detail that an encoder leaves out does not tell where the rest lies.
_BLUR_PX = 1.0


def shift_px(image: Image, other: Image) -> Array:
    """Return (2,) by how much another image of a view is shifted to the right and down, px.

    One Gauss-Newton step of aligning the two by their grey levels (Lucas and Kanade 1981): exact
    for small parts of a pixel.

    Args:
        image: (H, W) uint8.
        other: (H, W) uint8, the same view.

    Returns:
        The shift; zero where the images do not show any.
    """
    before, after = (
        cv2.GaussianBlur(i.astype(np.float32), (0, 0), _BLUR_PX) for i in (image, other)
    )
    mean = 0.5 * (before + after)
    slopes = [cv2.Sobel(mean, cv2.CV_32F, *axis, scale=1 / 8).ravel() for axis in ((1, 0), (0, 1))]
    change = (after - before).ravel()
    normal = np.array([[float(a @ b) for b in slopes] for a in slopes])
    if not np.linalg.det(normal) > 1e-6 * normal.trace() ** 2:
        return np.zeros(2)
    return np.linalg.solve(normal, [-float(a @ change) for a in slopes])


def shifted(image: Image, shift: Array) -> Image:
    """Return an (H, W) uint8 image, shifted to the right and down by (2,) parts of a pixel."""
    across, down = (_kernel(float(part)) for part in shift)
    moved = cv2.sepFilter2D(image, cv2.CV_32F, across, down, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.clip(np.rint(moved), 0, 255), dtype=np.uint8)


def _kernel(part: float) -> Array:
    """Return (5,) weights that shift by -1 to 1 px: cubic convolution (Keys 1981)."""
    away = np.abs(np.arange(-2.0, 3.0) + part)
    near = (1.5 * away - 2.5) * away**2 + 1.0
    far = ((-0.5 * away + 2.5) * away - 4.0) * away + 2.0
    return np.where(away < 1.0, near, np.where(away < 2.0, far, 0.0))
