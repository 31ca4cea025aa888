"""Light at scattered places of a texture, filtered to how much of it one sample covers."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.world import Grey, Texture

Floats = NDArray[np.float32]

_REMAP_COLUMNS = 512  # cv2.remap takes images, not lists: samples are folded into rows of this


def sampled(texture: Texture, across: Floats, along: Floats, level: Floats) -> Floats:
    """Return (N,) grey values at fractions of the texture's width and height, trilinear.

    Args:
        texture: what is sampled; its edge texels go on beyond it.
        across: (N,) fractions of its width, 0 to 1.
        along: (N,) fractions of its height, 0 to 1.
        level: (N,) logarithm to base 2 of the footprint in texels of the finest level.
    """
    last = len(texture.levels) - 1
    level = np.clip(level, 0.0, last)
    lower = np.minimum(level.astype(np.int16), last - 1) if last else np.zeros(len(level), np.int16)
    out = np.empty(len(level), dtype=np.float32)
    for i in range(int(lower.min()), int(lower.max()) + 1):
        chosen = np.flatnonzero(lower == i)
        if len(chosen) == 0:
            continue
        some = len(chosen) < len(level)
        part = (across[chosen], along[chosen]) if some else (across, along)
        weight = (level[chosen] if some else level) - np.float32(i)
        value = _bilinear(texture.levels[i], *part)
        if float(weight.max()) > 0.0:
            value += weight * (_bilinear(texture.levels[i + 1], *part) - value)
        out[chosen] = value
    return out


def _bilinear(image: Grey, across: Floats, along: Floats) -> Floats:
    """Return (N,) grey values of an image at fractions of its width and height."""
    n = len(across)
    rows = -(-n // _REMAP_COLUMNS)
    maps = np.zeros((2, rows * _REMAP_COLUMNS), dtype=np.float32)
    np.multiply(across, np.float32(image.shape[1]), out=maps[0, :n])
    np.multiply(along, np.float32(image.shape[0]), out=maps[1, :n])
    maps -= np.float32(0.5)  # texel (0, 0) is centred half a texel inside the rectangle
    folded = maps.reshape(2, rows, _REMAP_COLUMNS)
    values = cv2.remap(
        image, folded[0], folded[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(values).ravel()[:n].astype(np.float32)
