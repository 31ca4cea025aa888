"""How much of an image the map fills, and how new the view is: whether the map suffices (IV-G)."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array

NEAR_DEG = 7.0
"""A view no newer than this is surely joined with a map by its patches alone."""

_COLUMNS, _ROWS = 8, 6
# A patch bears a turn of so many degrees as well as being seen twice as large or small.
_OCTAVE_DEG = 15.0
_LEAST_M = 1e-9


def novelties_deg(points: Array, now: Array, then: Array) -> Array:
    """Return how differently landmarks look from here than from where they are remembered.

    Args:
        points: (M, 3) landmarks, world, m.
        now: (3,) where the camera is.
        then: (M, 3) where the camera was that remembers each, or (3,) for all.

    Returns:
        (M,) angle between the lines of sight, degrees, and the step in size: a doubling or
        halving of the distance counts like 15 degrees.
    """
    ray, before = points - now, points - then
    squared = np.maximum(np.einsum("mi,mi->m", ray, ray), _LEAST_M**2)
    squared_then = np.maximum(np.einsum("mi,mi->m", before, before), _LEAST_M**2)
    cosine = np.einsum("mi,mi->m", ray, before) / np.sqrt(squared * squared_then)
    angle_deg = np.rad2deg(np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0)))
    octaves = 0.5 * np.log2(squared / squared_then)
    return np.asarray(np.hypot(angle_deg, _OCTAVE_DEG * octaves))


def novelty_deg(points: Array, now: Array, then: Array) -> float:
    """Return the median of ``novelties_deg``; M is at least 1."""
    return float(np.median(novelties_deg(points, now, then)))


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
