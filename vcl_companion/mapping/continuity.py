"""What an extended map owes to the old one: the same world, and a bounded size (IV-G)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.mapping.growth import Growth
from vcl_companion.mapping.landmark_map import KnownDistance, LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.uncertainty import MapUncertainty

# Squared Mahalanobis distance in three dimensions that one in 10 000 exceeds.
_CHI2_3_9999 = 21.1
# Of the old landmarks this share may be found wrong; more, and it is the update that is.
_MAX_MOVED = 0.1
# An encoded map has to pass as one blob of 8 MiB, its table of pixels included.
MAX_IMAGE_BYTES = 6 * 1024 * 1024


def broken_continuity(old: LandmarkMap, sure: MapUncertainty, growth: Growth) -> str:
    """Say how old landmarks moved by more than their covariance explains; empty if they did not."""
    stays = growth.old >= 0
    before = growth.old[stays]
    moved = growth.landmark_map.points_world[stays] - old.points_world[before]
    covariance = sure.marginal()[before]
    squared = np.einsum("ni,ni->n", moved, np.linalg.solve(covariance, moved[..., None])[..., 0])
    far = squared > _CHI2_3_9999
    if len(before) < 0.5 * len(old.points_world):
        return f"{len(before)} of {len(old.points_world)} old landmarks fit the new views"
    if far.mean() > _MAX_MOVED:
        metres = float(np.median(np.linalg.norm(moved[far], axis=1)))
        return (
            f"{far.sum()} of {len(far)} old landmarks would move by {metres:.2f} m, "
            "more than their covariance explains"
        )
    return ""


def pruned(landmark_map: LandmarkMap, n_old: int, options: MapOptions) -> LandmarkMap:
    """Drop keyframes and landmarks that contribute least until the map is within its bounds.

    Keyframes that carry frame or scale stay, and so do the new ones.

    Args:
        landmark_map: the extended map.
        n_old: how many of its keyframes are old, they come first.
        options: the bounds.
    """
    while True:
        keyframes = landmark_map.keyframes
        size = sum(len(k.image_bytes) for k in keyframes)
        if len(keyframes) <= options.max_keyframes and size <= MAX_IMAGE_BYTES:
            break
        held = {0} | {k for d in landmark_map.distances for k in (d.keyframe_a, d.keyframe_b)}
        free = [k for k in range(n_old) if k not in held]
        if not free:
            break
        seen = landmark_map.seen
        # A landmark that few others see is mostly this keyframe's own.
        worth = (seen / np.maximum(seen.sum(axis=1, keepdims=True) - 1, 1)).sum(axis=0)
        landmark_map = _without(landmark_map, min(free, key=lambda k: float(worth[k])))
        n_old -= 1
    excess = len(landmark_map.points_world) - options.max_landmarks
    if excess > 0:
        # The longest tracks stay; of equal ones the older.
        order = np.argsort(-landmark_map.seen.sum(axis=1), kind="stable")
        keep = np.zeros(len(order), dtype=bool)
        keep[order[: options.max_landmarks]] = True
        landmark_map = _of(landmark_map, keep)
    return landmark_map


def _without(landmark_map: LandmarkMap, k: int) -> LandmarkMap:
    """Return the map without a keyframe, and without what it alone had seen with one other."""
    observed = np.delete(landmark_map.observed_px, k, axis=1)
    shorter = replace(
        landmark_map,
        keyframes=landmark_map.keyframes[:k] + landmark_map.keyframes[k + 1 :],
        observed_px=observed,
        distances=tuple(
            KnownDistance(
                d.keyframe_a - (d.keyframe_a > k),
                d.keyframe_b - (d.keyframe_b > k),
                d.distance_m,
                d.sigma_m,
            )
            for d in landmark_map.distances
        ),
    )
    return _of(shorter, shorter.seen.sum(axis=1) >= 2)


def _of(landmark_map: LandmarkMap, keep: NDArray[np.bool_]) -> LandmarkMap:
    return replace(
        landmark_map,
        points_world=landmark_map.points_world[keep],
        observed_px=landmark_map.observed_px[keep],
    )
