"""How much an image says about where a place of it is, compiled."""

from __future__ import annotations

import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Image


@compiled
def textures(image: Image, pixels: Array, half_px: int) -> Array:
    """Return (M, 3) xx xy yy of the squared gradient summed over the patch at each pixel.

    Args:
        image: (H, W) grey levels.
        pixels: (M, 2) centres, more than ``half_px`` + 1 inside.
        half_px: a patch has twice as many pixels a side, and one.
    """
    out = np.zeros((len(pixels), 3))
    for m in range(len(pixels)):
        x, y = round(pixels[m, 0]), round(pixels[m, 1])
        for v in range(y - half_px, y + half_px + 1):
            for u in range(x - half_px, x + half_px + 1):
                gx = 0.5 * (float(image[v, u + 1]) - float(image[v, u - 1]))
                gy = 0.5 * (float(image[v + 1, u]) - float(image[v - 1, u]))
                out[m, 0] += gx * gx
                out[m, 1] += gx * gy
                out[m, 2] += gy * gy
    return out
