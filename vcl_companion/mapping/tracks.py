"""Pairwise matches joined to tracks: one landmark, its pixel in every view (IV-C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Matches between two views: (M,) feature indices in each."""

    a: NDArray[np.intp]
    b: NDArray[np.intp]


def join_tracks(
    n_features: list[int], pairs: dict[tuple[int, int], PairMatches]
) -> NDArray[np.intp]:
    """Join matches of V views.

    Args:
        n_features: number of features in each view.
        pairs: matches of view pairs.

    Returns:
        (N, V) feature index of each track in each view, -1 where unseen. A
        track that claims two features of one view contradicts itself and loses
        that view.
    """
    offset = np.concatenate([[0], np.cumsum(n_features)])
    rows = [matches.a + offset[i] for (i, _), matches in pairs.items()]
    columns = [matches.b + offset[k] for (_, k), matches in pairs.items()]
    row = np.concatenate([*rows, np.zeros(0, np.intp)])
    column = np.concatenate([*columns, np.zeros(0, np.intp)])
    total = int(offset[-1])
    graph = coo_matrix((np.ones(len(row)), (row, column)), shape=(total, total))
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label, minlength=1)
    track_of = np.cumsum(sizes >= 2) - 1
    tracks = np.full((int((sizes >= 2).sum()), len(n_features)), -1, dtype=np.intp)
    for i, n in enumerate(n_features):
        labels = label[offset[i] : offset[i] + n]
        member = np.flatnonzero(sizes[labels] >= 2)
        track = track_of[labels[member]]
        tracks[track, i] = member
        tracks[np.bincount(track, minlength=len(tracks)) > 1, i] = -1
    return np.asarray(tracks[(tracks >= 0).sum(axis=1) >= 2])


def pixels_of_tracks(tracks: NDArray[np.intp], pixels: list[Array]) -> Array:
    """Return (N, V, 2) raw pixels of (N, V) tracks, NaN where unseen."""
    out = np.full((*tracks.shape, 2), np.nan)
    for i, positions in enumerate(pixels):
        seen = tracks[:, i] >= 0
        out[seen, i] = positions[tracks[seen, i]]
    return out


def ideal_of_pixels(observed_px: Array, cameras: list[Camera]) -> Array:
    """Return (N, V, 2) ideal image coordinates x/z, y/z of (N, V, 2) raw pixels of V cameras.

    NaN where unseen, and where a camera's model cannot have produced the pixel.
    """
    out = np.full(observed_px.shape, np.nan)
    for i, camera in enumerate(cameras):
        seen = np.isfinite(observed_px[:, i, 0])
        out[seen, i] = camera.ideal_from_pixels(observed_px[seen, i])
    return out


def slopes_of_ideal(ideal: Array, cameras: list[Camera]) -> Array:
    """Return (N, V, 2, 2) d(pixel) / d(ideal) at (N, V, 2) ideal coordinates; NaN where unseen."""
    out = np.full((*ideal.shape, 2), np.nan)
    for i, camera in enumerate(cameras):
        seen = np.isfinite(ideal[:, i, 0])
        out[seen, i] = camera.pixel_slopes(ideal[seen, i])
    return out
