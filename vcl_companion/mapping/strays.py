"""Patches that were found at the wrong place, by what their neighbours agree on (IV-B).

What repeats, as windows do, is taken for its neighbour, and then lies far behind or before what is
beside it. A few of those bend the poses until they fit them by some tenths of a pixel, for the
farthest landmarks are what a turn is known by. So a pair's pose is found of those alone that lie
as deep as their neighbours; the others are kept where they fit it.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.tracks import ideal_of_pixels
from vcl_companion.vision.essential import sampson_px
from vcl_companion.vision.relative_pose import THRESHOLD_SIGMAS, relative_pose_problem

Mask = NDArray[np.bool_]

# Of so many neighbours half lie as deep, give or take such a part: on a slanted wall they do, and
# beside a window taken for the next one they do not.
_NEIGHBOURS = 30
_LIKE = 0.3
_SHARE = 0.5
# Noise of patches that agree, px: where the search of it starts, whatever the camera's is.
_NOISE_PX = 0.3
# So far from what they agree on is more than noise: sigmas, and px.
_STRAY_SIGMAS, _STRAY_PX = 4.0, 0.3


def strays(
    points: Array,
    observed_px: Array,
    cut_from: NDArray[np.intp],
    cameras: list[Camera],
    world_from_cams: list[Pose],
) -> Mask:
    """Return (N, V) which patches lie aside of the epipolar line that those of a pair agree on.

    Args:
        points: (N, 3) landmarks, m.
        observed_px: (N, V, 2) where their patches were found, NaN where not.
        cut_from: (N,) the view that each patch is of.
        cameras: of the V views.
        world_from_cams: likewise.
    """
    ideal = ideal_of_pixels(observed_px, cameras)
    seen = np.isfinite(ideal[..., 0])
    out = np.zeros(seen.shape, dtype=np.bool_)
    for i, k in permutations(range(len(cameras)), 2):
        here = np.flatnonzero(seen[:, k] & (cut_from == i))
        if len(here) <= _NEIGHBOURS:
            continue
        depth = world_from_cams[i].inverse().apply(points[here])[:, 2]
        like = _like_neighbours(observed_px[here, i], depth)
        if like.sum() <= _NEIGHBOURS:
            continue
        a, b = ideal[here, i], ideal[here, k]
        focal_px = 0.5 * (cameras[i].focal_px + cameras[k].focal_px)
        moved = world_from_cams[k].inverse() @ world_from_cams[i]
        start = Pose(moved.rotation, moved.translation / np.linalg.norm(moved.translation))
        problem = relative_pose_problem(a[like], b[like], focal_px)
        agreed, sigma_px = problem.refined(start, THRESHOLD_SIGMAS * _NOISE_PX)
        error_px = np.abs(sampson_px(agreed, a, b, focal_px))
        out[here[error_px > max(_STRAY_SIGMAS * sigma_px, _STRAY_PX)], k] = True
    return out


def _like_neighbours(pixels: Array, depth: Array) -> Mask:
    """Return (N,) which landmarks are as deep as half of those beside them."""
    _, near = cKDTree(pixels).query(pixels, _NEIGHBOURS + 1)
    beside = np.asarray(near)[:, 1:]
    like = np.abs(depth[beside] - depth[:, None]) < _LIKE * depth[:, None]
    return np.asarray(like.mean(axis=1) >= _SHARE)
