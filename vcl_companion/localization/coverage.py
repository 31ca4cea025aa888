"""How much of an image the map fills: whether it suffices (IV-G)."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array

_COLUMNS, _ROWS = 8, 6


def covered_share(pixels: Array, camera: Camera) -> float:
    """Return the share of an image's 8 by 6 parts that hold a landmark, 0 to 1.

    Args:
        pixels: (M, 2) raw px of the landmarks that agree on a pose.
        camera: whose image it is.
    """
    # A pixel's centre is a whole number: the image begins half a pixel before the first.
    column = (pixels[:, 0] + 0.5) * _COLUMNS / camera.width_px
    row = (pixels[:, 1] + 0.5) * _ROWS / camera.height_px
    inside = (column >= 0) & (column < _COLUMNS) & (row >= 0) & (row < _ROWS)
    parts = row[inside].astype(np.intp) * _COLUMNS + column[inside].astype(np.intp)
    return int(np.count_nonzero(np.bincount(parts))) / (_COLUMNS * _ROWS)
