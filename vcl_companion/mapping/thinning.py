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
    """Return which of (N, V, 2) observed landmarks are kept, by rising number."""
    cells = np.stack([cells_of(observed_px[:, i], c) for i, c in enumerate(cameras)], axis=1)
    order = np.argsort(-(cells >= 0).sum(axis=1), kind="stable")
    return np.flatnonzero(_chosen(cells, order, per_cell, N_CELLS))


@compiled
def _chosen(
    cells: NDArray[np.int64], order: Index, per_cell: int, n_cells: int
) -> NDArray[np.bool_]:
    n, v = cells.shape
    kept = np.zeros(n, dtype=np.bool_)
    taken = np.zeros((v, n_cells), dtype=np.int64)
    for j in order:
        for i in range(v):
            if cells[j, i] >= 0 and taken[i, cells[j, i]] < per_cell:
                kept[j] = True
        if kept[j]:
            for i in range(v):
                if cells[j, i] >= 0:
                    taken[i, cells[j, i]] += 1
    return kept
