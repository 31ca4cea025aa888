"""Landmarks that lie far before or behind what is beside them: some stand there, some are wrong.

What repeats, as windows do, is taken for the next one, and then lies where nothing beside it does.
Where that is by mistake its patch is found as well where its neighbours are, which that of a post
before a wall is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.patch_table import PatchTable, Reference
from vcl_companion.mapping.thinning import spread
from vcl_companion.vision.acransac import Mask
from vcl_companion.vision.patches import AlignRules

# Of so many neighbours half lie as deep, give or take such a part: on a slanted wall they do, and
# beside a window taken for the next one they do not; so few of a cell of ``thinning`` count, for
# most of what is next to a landmark in a window is in the same one.
N_NEIGHBOURS = 30
_PER_CELL = 3
_LIKE = 0.3
_SHARE = 0.5
# Where a landmark would be if it were as deep as its neighbours: they differ by such a part, and
# so by some px; and it is elsewhere if it is farther than that from where it was found.
_BESIDE, _REACH_PX, _ELSEWHERE_PX = 0.1, 6.0, 3.0
# Of those that are wrong two in three are found where they should be: where so many of all are, few
# of the others are right.
_MOSTLY = 0.6


def like_neighbours(pixels: Array, depth: Array, camera: Camera) -> tuple[Mask, Array]:
    """Return (N,) which landmarks are as deep as half of those beside them, and what is usual."""
    some = spread(pixels[:, None], [camera], _PER_CELL)
    _, near = cKDTree(pixels[some]).query(pixels, min(N_NEIGHBOURS, len(some)))
    beside = depth[some[np.asarray(near).reshape(len(pixels), -1)]]
    like = np.abs(beside - depth[:, None]) < _LIKE * depth[:, None]
    return np.asarray(like.mean(axis=1) >= _SHARE), np.asarray(np.median(beside, axis=1))


def ambiguous(
    table: PatchTable,
    points: Array,
    observed: Array,
    cut_from: NDArray[np.intp],
    cameras: list[Camera],
    cams: list[Pose],
    rules: AlignRules,
) -> Mask:
    """Return (N, V) what is found where its neighbours are as well as far before or behind them.

    And the rest that lies far before or behind them, where most of that is so.

    Args:
        table: the images.
        points: (N, 3) landmarks, m.
        observed: (N, V, 2) where their patches were found, NaN where not.
        cut_from: (N,) the view that each patch is of; -1 for one that is not asked about.
        cameras: of the V views.
        cams: where they were, world_from_cam.
        rules: when a patch is found.
    """
    rows, beside = _lonely(points, observed, cut_from, cameras, cams)
    out = np.zeros(observed.shape[:2], dtype=np.bool_)
    if len(rows) == 0:
        return out
    view = cut_from[rows]
    reference = Reference(view, observed[rows, view], beside, np.full(len(rows), _BESIDE))
    there = table.found(reference, cams, list(range(len(cams))), rules, _REACH_PX).pixels
    # What is not there, or was not seen, is no farther away than anything.
    elsewhere = np.linalg.norm(there - observed[rows], axis=2) > _ELSEWHERE_PX
    out[rows] = elsewhere | (elsewhere.any(axis=1).mean() > _MOSTLY)
    out[rows, view] = False
    return out


def _lonely(
    points: Array,
    observed_px: Array,
    cut_from: NDArray[np.intp],
    cameras: list[Camera],
    world_from_cams: list[Pose],
) -> tuple[NDArray[np.intp], Array]:
    """Return which landmarks are not as deep as those beside them, and where they would be if so.

    Returns:
        (M,) rows, and (M, 3) points on the same lines of sight from where they were cut, m.
    """
    rows, beside = [np.zeros(0, dtype=np.intp)], [np.zeros((0, 3))]
    for i in np.unique(cut_from[cut_from >= 0]):
        seen = np.flatnonzero(np.isfinite(observed_px[:, i, 0]))
        if len(seen) <= N_NEIGHBOURS:
            continue
        ahead = world_from_cams[i].inverse().apply(points[seen])
        depth = ahead[:, 2]
        like, usual = like_neighbours(observed_px[seen, i], depth, cameras[i])
        here = ~like & (cut_from[seen] == i) & (depth > 0.0)
        rows.append(seen[here])
        deep = (usual[here] / depth[here])[:, None]
        beside.append(world_from_cams[i].apply(ahead[here] * deep))
    return np.concatenate(rows), np.concatenate(beside)
