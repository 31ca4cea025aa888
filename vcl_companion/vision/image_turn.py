"""By how much a camera turned between two images of a scene that is far away against how it moved.

Corners are tracked by their optical flow, there and back; the rotation that takes their rays on is
found by consensus. Held in the hands a drone turns about itself: an essential matrix says nothing
of so little translation, and the rotation alone is well known.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array, orthonormalized

Image = NDArray[np.uint8]

_MAX_CORNERS, _QUALITY, _APART_PX = 250, 0.01, 10.0
_WINDOW_PX, _LEVELS = (21, 21), 4
# What a corner may be off on its way back, and rays of the same turn against each other.
_BACK_PX, _AGREE_PX = 1.0, 3.0
_SAMPLES = 80
_LEAST_RAYS, _LEAST_SHARE = 20, 0.4


def image_turn(
    before: Image, after: Image, camera: Camera, rng: np.random.Generator
) -> Array | None:
    """Return how a camera turned.

    Args:
        before: (H, W) grey levels.
        after: (H, W) of a moment later.
        camera: intrinsics of both.
        rng: draws the samples.

    Returns:
        (3, 3) before_from_after, camera axes; None where too few corners agree on one.
    """
    rays = _tracked_rays(before, after, camera)
    if rays is None:
        return None
    rays_before, rays_after = rays
    least_cosine = np.cos(_AGREE_PX / camera.focal_px)
    best = np.zeros(len(rays_before), dtype=bool)
    for _ in range(_SAMPLES):
        i, j = rng.choice(len(rays_before), 2, replace=False)
        turn = _turn_of(rays_before[[i, j]], rays_after[[i, j]])
        agree = _cosines(turn, rays_before, rays_after) > least_cosine
        if agree.sum() > best.sum():
            best = agree
    if best.sum() < max(_LEAST_RAYS, _LEAST_SHARE * len(best)):
        return None
    return _turn_of(rays_before[best], rays_after[best])


def _tracked_rays(before: Image, after: Image, camera: Camera) -> tuple[Array, Array] | None:
    """Return (N, 3) unit rays of corners in one image and where they are in the other."""
    corners = cv2.goodFeaturesToTrack(before, _MAX_CORNERS, _QUALITY, _APART_PX)
    if corners is None or len(corners) < _LEAST_RAYS:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, np.empty_like(corners), winSize=_WINDOW_PX, maxLevel=_LEVELS
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        after, before, there, np.empty_like(corners), winSize=_WINDOW_PX, maxLevel=_LEVELS
    )
    pixels = [np.asarray(p, dtype=np.float64).reshape(-1, 2) for p in (corners, there, back)]
    good = (found.ravel() == 1) & (returned.ravel() == 1)
    good &= np.linalg.norm(pixels[2] - pixels[0], axis=1) < _BACK_PX
    rays = []
    for points in pixels[:2]:
        ideal = camera.ideal_from_pixels(points)
        good &= np.isfinite(ideal).all(axis=1)
        rays.append(np.column_stack([ideal, np.ones(len(ideal))]))
    if good.sum() < _LEAST_RAYS:
        return None
    one, other = (r[good] / np.linalg.norm(r[good], axis=1)[:, None] for r in rays)
    return one, other


def _turn_of(rays_before: Array, rays_after: Array) -> Array:
    """Return the rotation that takes (N, 3) rays on best, N at least 2."""
    return orthonormalized(rays_before.T @ rays_after)


def _cosines(turn: Array, rays_before: Array, rays_after: Array) -> Array:
    return np.asarray(((rays_after @ turn.T) * rays_before).sum(axis=1))
