"""How differently landmarks look from how they are remembered: how new a view is (IV-G)."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.rotation import Array

NEAR_DEG = 7.0
"""A view no newer than this is surely joined with a map by its patches alone."""

# A patch bears a turn of so many degrees as well as being seen twice as large or small.
_OCTAVE_DEG = 15.0
_LEAST_M = 1e-9


def angles_and_novelties_deg(points: Array, now: Array, then: Array) -> tuple[Array, Array]:
    """Return the angles under which two places see landmarks, and ``novelties_deg``.

    Args:
        points: (M, 3) landmarks, world, m.
        now: (3,) where one camera is.
        then: (M, 3) where the other is for each, or (3,) for all.

    Returns:
        (M,) angles between the lines of sight, degrees, and (M,) novelties.
    """
    ray, before = points - now, points - then
    squared = np.maximum(np.einsum("mi,mi->m", ray, ray), _LEAST_M**2)
    squared_then = np.maximum(np.einsum("mi,mi->m", before, before), _LEAST_M**2)
    cosine = np.einsum("mi,mi->m", ray, before) / np.sqrt(squared * squared_then)
    angle_deg = np.rad2deg(np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0)))
    octaves = 0.5 * np.log2(squared / squared_then)
    return angle_deg, np.asarray(np.hypot(angle_deg, _OCTAVE_DEG * octaves))


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
    return angles_and_novelties_deg(points, now, then)[1]


def novelty_deg(points: Array, now: Array, then: Array) -> float:
    """Return the median of ``novelties_deg``; M is at least 1."""
    return float(np.median(novelties_deg(points, now, then)))
