"""Places that the map does not have yet: matched along epipolar lines, verified by patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.patch_table import PatchTable, Reference
from vcl_companion.mapping.thinning import N_CELLS, cells_of
from vcl_companion.vision.features import Features
from vcl_companion.vision.guided_pairs import match_epipolar
from vcl_companion.vision.patches import AlignRules

# A feature so near to where a landmark is seen already is that landmark.
_SAME_PX = 3.0
# Depths of one feature that differ by less are one.
_SAME_DEPTH = np.log(1.03)
# What may come into view is nearer or farther than what is known by so many times.
_NEARER, _FARTHER = 3.0, 5.0
_RULES = AlignRules(max_iterations=15, least_score=0.85, max_moved_px=3.0, settled_px=0.02)
# Of a depth from one pair of features.
_RELATIVE_SIGMA = 0.03


@dataclass(frozen=True, eq=False)
class Shown:
    """What one view shows.

    Attributes:
        features: one detector's.
        ideal: (N, 2) where they are, x/z, y/z.
    """

    features: Features
    ideal: Array


def shown(features: Features, camera: Camera) -> Shown:
    """Return features with their ideal coordinates, without what the lens cannot produce."""
    ideal = camera.ideal_from_pixels(features.pixels)
    usable = np.flatnonzero(np.isfinite(ideal).all(axis=1))
    return Shown(features.subset(usable), ideal[usable])


def free_of(view: Shown, taken_px: Array) -> Shown:
    """Return those features that are not at one of (K, 2) pixels already."""
    if len(taken_px) == 0 or len(view.features) == 0:
        return view
    distance, _ = cKDTree(taken_px).query(view.features.pixels)
    free = np.flatnonzero(np.asarray(distance) > _SAME_PX)
    return Shown(view.features.subset(free), view.ideal[free])


def with_room(view: Shown, taken_px: Array, camera: Camera, per_cell: int) -> Shown:
    """Return those features in whose cells fewer than so many of (K, 2) pixels lie."""
    taken = np.bincount(cells_of(taken_px, camera), minlength=N_CELLS)
    free = np.flatnonzero(taken[cells_of(view.features.pixels, camera)] < per_cell)
    return Shown(view.features.subset(free), view.ideal[free])


def depth_range(cam_from_world: Pose, points: Array) -> tuple[float, float]:
    """Return the least and largest inverse depth, 1/m, that a view of (N, 3) points may show."""
    z = cam_from_world.apply(points)[:, 2]
    z = z[z > 0.05]
    if len(z) == 0:
        return 0.0, 0.0
    near, far = np.quantile(z, [0.02, 0.98])
    return float(1.0 / (far * _FARTHER)), float(_NEARER / near)


def new_landmarks(
    source: int,
    targets: list[int],
    views: dict[int, Shown],
    cameras: list[Camera],
    worlds_from_cams: list[Pose],
    inverse_depths: tuple[float, float],
    table: PatchTable,
) -> tuple[Array, Array]:
    """Find landmarks of one view's features in others.

    Args:
        source: the view that patches are cut from.
        targets: views to match it with.
        views: the features of all of them that are no landmark yet.
        cameras: of all V views.
        worlds_from_cams: where they were taken.
        inverse_depths: least and largest that the source may show, 1/m (``depth_range``).
        table: all images.

    Returns:
        (K, V, 2) pixels, NaN where not found; (K, 3) points, by the first match. Each is
        found by its patch in one target at least.
    """
    world_from_a = worlds_from_cams[source]
    own, rows, depths = views[source], [], []
    for t in targets:
        b_from_a = worlds_from_cams[t].inverse() @ world_from_a
        i, _, r = match_epipolar(
            own.features,
            views[t].features,
            own.ideal,
            views[t].ideal,
            b_from_a,
            inverse_depths,
            cameras[t].focal_px,
        )
        rows.append(i)
        depths.append(r)
    none = np.zeros((0, len(cameras), 2)), np.zeros((0, 3))
    if not rows or sum(map(len, rows)) == 0:
        return none
    row, inverse = _distinct(np.concatenate(rows), np.concatenate(depths))
    rays = np.column_stack([own.ideal[row], np.ones(len(row))])
    points = world_from_a.apply(rays / inverse[:, None])
    reference = Reference(
        np.full(len(row), source),
        own.features.pixels[row],
        points,
        np.full(len(row), _RELATIVE_SIGMA),
    )
    found = table.found(reference, worlds_from_cams, targets, _RULES).pixels
    count = np.isfinite(found[:, :, 0]).sum(axis=1)
    best = _best_of_each(row, count)
    best = best[count[best] >= 2]
    return found[best], points[best]


def _distinct(row: Index, inverse: Array) -> tuple[Index, Array]:
    """Return each feature with each of its depths that differ."""
    order = np.lexsort((inverse, row))
    row, inverse = row[order], inverse[order]
    again = np.zeros(len(row), dtype=bool)
    again[1:] = (row[1:] == row[:-1]) & (np.diff(np.log(inverse)) < _SAME_DEPTH)
    return row[~again], inverse[~again]


def _best_of_each(row: Index, count: Index) -> Index:
    """Return for each feature the place in the list that most views confirm."""
    order = np.lexsort((-count, row))
    _, first = np.unique(row[order], return_index=True)
    return np.asarray(order[first], dtype=np.intp)
