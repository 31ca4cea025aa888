"""Two maps in one table: keyframes of both, and landmarks that are the same only once (IV-G).

Patches of the one's landmarks are looked for in the other's keyframes, from where these are
known to be by then: that ties the maps together by hundredths of a pixel, and shows which
landmarks of the other are one of ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.aligning import Aligned, Side
from vcl_companion.mapping.common_landmarks import shared_keyframes
from vcl_companion.mapping.culling import Mask, depth_errors
from vcl_companion.mapping.growth import view_of
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.patch_table import PatchTable, PyramidOf, pyramids_of
from vcl_companion.mapping.placing import place
from vcl_companion.mapping.uncertainty import views_of
from vcl_companion.vision.information import squared_distances
from vcl_companion.vision.resection import NotFound

# What lies so near to a landmark's patch is that landmark.
_SAME_PX = 0.75
# ... if its depth does not say otherwise: 99.9 % of a three-dimensional Gaussian.
_CHI2_3_999 = 16.3


@dataclass(frozen=True, eq=False)
class Union:
    """Two maps in the world of the one, not adjusted yet.

    Attributes:
        keyframes: the senior's, then those that only the junior has.
        points: (N, 3) the senior's landmarks, then those that only the junior has, m.
        observed: (N, V, 2) px, NaN where not seen.
        distances: of both; of the senior only where both are of one world and so are these.
        row: (N_junior,) which landmark each of the junior's is here.
    """

    keyframes: tuple[Keyframe, ...]
    points: Array
    observed: Array
    distances: tuple[KnownDistance, ...]
    row: Index


def united(
    senior: Side,
    junior: Side,
    stands: Aligned,
    pyramid_of: PyramidOf,
    options: MapOptions,
    *,
    one_world: bool,
) -> Union:
    """Put two maps together.

    Args:
        senior: whose world it is.
        junior: the other.
        stands: how that stands in it.
        pyramid_of: decodes images.
        options: whether patches are looked for; how sure a distance may be said to be.
        one_world: whether both rest on the same known distances.
    """
    n_old, at = len(senior.map.keyframes), stands.senior_from_junior
    column = np.full(len(junior.map.keyframes), -1, dtype=np.intp)
    for k, i in shared_keyframes(senior.map, junior.map):
        column[i] = k
    new = np.flatnonzero(column < 0)
    column[new] = n_old + np.arange(len(new))
    brought = tuple(
        replace(
            junior.map.keyframes[i],
            world_from_body=at.of_pose(junior.map.keyframes[i].world_from_body),
        )
        for i in new
    )
    row = np.full(len(junior.map.points_world), -1, dtype=np.intp)
    row[stands.common.junior] = stands.common.senior
    observed = np.full((len(senior.map.points_world), n_old + len(new), 2), np.nan)
    observed[:, :n_old] = senior.map.observed_px
    if options.patches:
        observed[:, n_old:] = _shown(senior, brought, pyramid_of, options)
        there = junior.map.observed_px[:, new]
        _recognised(row, observed[:, n_old:], there, _explains(senior, junior, stands))
    observed, points, row = _with_junior(observed, senior, junior, stands, column, row)
    distances = senior.map.distances
    if not one_world:
        distances += _brought_distances(senior, junior, column, options)
    return Union(senior.map.keyframes + brought, points, observed, distances, row)


def _brought_distances(
    senior: Side, junior: Side, column: Index, options: MapOptions
) -> tuple[KnownDistance, ...]:
    """Return the junior's distances, but those that the senior has as well."""
    known = {frozenset((d.keyframe_a, d.keyframe_b)) for d in senior.map.distances}
    brought = tuple(
        KnownDistance(
            int(column[d.keyframe_a]),
            int(column[d.keyframe_b]),
            d.distance_m,
            # What the other map says of its own accuracy counts no more than what is usual.
            max(d.sigma_m, options.distance_sigma_m),
        )
        for d in junior.map.distances
    )
    return tuple(d for d in brought if frozenset((d.keyframe_a, d.keyframe_b)) not in known)


def _shown(
    senior: Side, brought: tuple[Keyframe, ...], pyramid_of: PyramidOf, options: MapOptions
) -> Array:
    """Return (N, K, 2) where K keyframes show the senior's landmarks, found by their patches."""
    known = senior.map
    all_of_them = known.keyframes + brought
    cameras = [k.camera for k in all_of_them]
    table = PatchTable(
        cameras, pyramids_of([(k.image_bytes, k.camera) for k in all_of_them], pyramid_of)
    )
    cams = [k.world_from_body @ k.body_from_cam for k in known.keyframes]
    relative = depth_errors(views_of(known))
    out = np.full((len(known.points_world), len(brought), 2), np.nan)
    for i, keyframe in enumerate(brought):
        found = place(
            view_of(keyframe),
            len(cams) + i,
            keyframe.world_from_body,
            known,
            senior.sure,
            relative,
            table,
            cams,
            options,
        )
        if not isinstance(found, NotFound):
            out[found.landmarks, i] = found.pixels
    return out


def _explains(senior: Side, junior: Side, stands: Aligned) -> Callable[[Index, Index], Mask]:
    """Return what says whether pairs of landmarks are one by where they are."""
    at = stands.senior_from_junior
    turn = at.scale * at.rotation
    of_a, of_b = senior.sure.marginal(), junior.sure.marginal()

    def explained(one: Index, other: Index) -> Mask:
        apart = senior.map.points_world[one] - at.apply(junior.map.points_world[other])
        covariance = of_a[one] + turn @ of_b[other] @ turn.T
        return squared_distances(apart, covariance) < _CHI2_3_999

    return explained


def _recognised(
    row: Index, found: Array, there: Array, explains: Callable[[Index, Index], Mask]
) -> None:
    """Unite landmarks of the junior that lie where its keyframes show one of the senior's.

    Args:
        row: (N_junior,) the senior's landmark that each is, -1 for none; is completed.
        found: (N, K, 2) where the junior's keyframes show the senior's.
        there: (N_junior, K, 2) and where they show its own.
        explains: whether they are one by where they are.
    """
    for i in range(found.shape[1]):
        here = np.flatnonzero(np.isfinite(found[:, i, 0]))
        own = np.flatnonzero(np.isfinite(there[:, i, 0]) & (row < 0))
        here = here[~np.isin(here, row)]
        if len(here) == 0 or len(own) == 0:
            continue
        away_px, nearest = cKDTree(found[here, i]).query(there[own, i])
        distance = np.asarray(away_px, dtype=np.float64)
        one = here[np.asarray(nearest, dtype=np.intp)]
        same = (distance < _SAME_PX) & explains(one, own)
        order = np.flatnonzero(same)[np.argsort(distance[same], kind="stable")]
        order = order[np.sort(np.unique(one[order], return_index=True)[1])]
        row[own[order]] = one[order]


def _with_junior(
    observed: Array, senior: Side, junior: Side, stands: Aligned, column: Index, row: Index
) -> tuple[Array, Array, Index]:
    """Add what the junior saw: to landmarks of both where it is not known yet, and its own."""
    n, seen = len(observed), np.full((len(row), observed.shape[1], 2), np.nan)
    seen[:, column] = junior.map.observed_px
    both = np.flatnonzero(row >= 0)
    known = observed[row[both]]
    # Found by the same patch in several of its keyframes, its own pixels would say it again.
    lacking = ~np.isfinite(known[..., :1])
    own = np.isfinite(known[:, len(senior.map.keyframes) :, 0]).sum(axis=1) >= 2
    lacking[own, len(senior.map.keyframes) :] = False
    observed[row[both]] = np.where(lacking, seen[both], known)
    fresh = np.flatnonzero(row < 0)
    row = row.copy()
    row[fresh] = n + np.arange(len(fresh))
    points = stands.senior_from_junior.apply(junior.map.points_world[fresh])
    return (
        np.concatenate([observed, seen[fresh]]),
        np.concatenate([senior.map.points_world, points]),
        row,
    )
