"""Which keyframes a new view is matched with, for what the map does not have yet (IV-G)."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.new_landmarks import Shown
from vcl_companion.mapping.novelty import angles_and_novelties_deg

# A point counts fully from this angle between two rays on, and hardly where they are parallel.
_WIDE_DEG = 5.0
# Features are found again the less the more differently they look: from so new a place, six of ten.
_ALIKE_DEG = 12.0


def overlap(points: Array, one: Pose, other: Pose) -> float:
    """Return how many points two cameras share, counted by the angle they are seen under.

    Args:
        points: (N, 3) that both show, world, m.
        one: where a camera is, world_from_cam.
        other: where the other is.
    """
    angles_deg, _ = angles_and_novelties_deg(points, one.translation, other.translation)
    return float(_widths(angles_deg).sum())


def partners(
    view: Shown,
    known_px: Array,
    known_points: Array,
    world_from_cam: Pose,
    keyframes: list[Pose],
    cameras: list[Camera],
    n: int,
) -> list[int]:
    """Return the keyframes that show best what a view shows and the map does not have.

    Not those that share most landmarks with it: in flight these are the oldest, whose
    landmarks are the most for having been looked for by many, and which show the least of
    what has come into view since.

    Args:
        view: its features that are no landmarks.
        known_px: (M, 2) where it shows landmarks; as far away as the next of these may a
            feature be.
        known_points: (M, 3) these landmarks, world, m.
        world_from_cam: where it was taken.
        keyframes: where K keyframes were taken, world_from_cam.
        cameras: theirs, in the same order; there may be more.
        n: how many to return at most.

    Returns:
        Indices of keyframes, the best first; none that shows nothing of it.
    """
    points = _guessed(view, known_px, known_points, world_from_cam)
    worth = np.zeros((len(keyframes), len(points)))
    for k, keyframe in enumerate(keyframes):
        pixels = cameras[k].project(keyframe.inverse().apply(points))
        inside = cameras[k].shows(pixels, 0.0)
        angles_deg, novelties_deg = angles_and_novelties_deg(
            points[inside], world_from_cam.translation, keyframe.translation
        )
        alike = np.exp(-((novelties_deg / _ALIKE_DEG) ** 2) / 2.0)
        worth[k, inside] = alike * _widths(angles_deg)
    # To be found in one of them is enough: next is who shows best what the others show badly.
    chosen: list[int] = []
    best = np.zeros(len(points))
    for _ in range(min(n, len(keyframes))):
        gains = np.maximum(worth - best, 0.0).sum(axis=1)
        k = int(np.argmax(gains))
        if gains[k] <= 0.0:
            break
        chosen.append(k)
        best = np.maximum(best, worth[k])
    return chosen


def _guessed(view: Shown, known_px: Array, known_points: Array, world_from_cam: Pose) -> Array:
    """Return (F, 3) where a view's features may be."""
    if len(known_px) == 0 or len(view.features) == 0:
        return np.zeros((0, 3))
    depths = world_from_cam.inverse().apply(known_points)[:, 2]
    _, nearest = cKDTree(known_px).query(view.features.pixels)
    rays = np.column_stack([view.ideal, np.ones(len(view.ideal))])
    return world_from_cam.apply(rays * depths[np.asarray(nearest)][:, None])


def _widths(angles_deg: Array) -> Array:
    """Return (N,) what points count by the angles they are seen under, 0 to 1."""
    return np.asarray(np.minimum(angles_deg / _WIDE_DEG, 1.0))
