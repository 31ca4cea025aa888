"""Landmarks spread over the images: enough of them everywhere, and nowhere a crowd.

Errors of neighbouring landmarks are alike, so that a crowd adds cost and a claim
to certainty, not accuracy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap

Index = NDArray[np.intp]

# Cells of 40 px in an image of 640 x 480.
_COLUMNS, _ROWS = 16, 12
N_CELLS = _COLUMNS * _ROWS
# Half of the side of a patch, in bins.
_BIN_PX = 1.5
_BINS_APART = 3


def cells_of(pixels: Array, camera: Camera) -> NDArray[np.int64]:
    """Return the cell of each of (..., 2) pixels of a camera's image; -1 where NaN."""
    size = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        share = np.clip((pixels + 0.5) / size, 0.0, 1.0 - 1e-9)
    unseen = ~np.isfinite(pixels[..., 0])
    place = np.where(unseen[..., None], 0.0, share * (_COLUMNS, _ROWS)).astype(np.int64)
    return np.asarray(np.where(unseen, -1, place[..., 0] + _COLUMNS * place[..., 1]))


def thinned(landmark_map: LandmarkMap, per_cell: int) -> LandmarkMap:
    """Keep landmarks, those seen most often first, that some keyframe's cell has room for."""
    cameras = [k.camera for k in landmark_map.keyframes]
    kept = spread(landmark_map.observed_px, cameras, per_cell)
    return landmark_map.of_landmarks(kept)


def spread(observed_px: Array, cameras: list[Camera], per_cell: int) -> Index:
    """Return which of (N, V, 2) observed landmarks are kept, by rising number.

    Kept is what some image has room for: fewer than ``per_cell`` in its cell there, and nothing
    so near that their patches would overlap by half, which are one measurement, not two.
    """
    cells = np.stack([cells_of(observed_px[:, i], c) for i, c in enumerate(cameras)], axis=1)
    order = np.argsort(-(cells >= 0).sum(axis=1), kind="stable")
    sizes = np.array([(c.width_px, c.height_px) for c in cameras], dtype=np.float64)
    places = np.where(cells[..., None] >= 0, np.clip(observed_px, 0.0, sizes), 0.0) / _BIN_PX
    bins = np.ceil(sizes / _BIN_PX).astype(np.int64) + 1
    return np.flatnonzero(_chosen(cells, places.astype(np.int64), bins, order, per_cell, N_CELLS))


@compiled
def _chosen(
    cells: NDArray[np.int64],
    places: NDArray[np.int64],
    bins: NDArray[np.int64],
    order: Index,
    per_cell: int,
    n_cells: int,
) -> NDArray[np.bool_]:
    n, v = cells.shape
    kept = np.zeros(n, dtype=np.bool_)
    taken = np.zeros((v, n_cells), dtype=np.int64)
    # One image after the other: of cameras of their own sizes.
    ends = np.cumsum(bins[:, 0] * bins[:, 1])
    covered = np.zeros(ends[-1], dtype=np.bool_)
    for j in order:
        for i in range(v):
            if cells[j, i] < 0:
                continue
            x, y, width, height = places[j, i, 0], places[j, i, 1], bins[i, 0], bins[i, 1]
            if covered[ends[i] - width * height + y * width + x]:
                continue
            if taken[i, cells[j, i]] < per_cell:
                kept[j] = True
        if not kept[j]:
            continue
        for i in range(v):
            if cells[j, i] < 0:
                continue
            taken[i, cells[j, i]] += 1
            x, y, width, height = places[j, i, 0], places[j, i, 1], bins[i, 0], bins[i, 1]
            left, right = max(x - _BINS_APART, 0), min(x + _BINS_APART + 1, width)
            for row in range(max(y - _BINS_APART, 0), min(y + _BINS_APART + 1, height)):
                begin = ends[i] - width * height + row * width
                covered[begin + left : begin + right] = True
    return kept
