"""Two maps in one table: keyframes of both, and landmarks that are the same only once (IV-G).

Patches of the one's landmarks are looked for in the other's keyframes, from where these are
known to be by then: that ties the maps together by hundredths of a pixel. United are landmarks
that both have from an image of both; those that are only alike by their descriptors where there are
neither.

Each map's own observations are taken where its own estimate puts them (``settling``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.aligning import MIN_COMMON, Aligned, Side
from vcl_companion.mapping.common_landmarks import shared_keyframes
from vcl_companion.mapping.culling import Mask, depth_errors
from vcl_companion.mapping.growth import view_of
from vcl_companion.mapping.known_features import Index
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.patch_table import PatchTable, PyramidOf, pyramids_of
from vcl_companion.mapping.placing import place
from vcl_companion.mapping.registration import MIN_SEEN
from vcl_companion.mapping.settling import believed_noise_px, settled
from vcl_companion.mapping.uncertainty import views_of
from vcl_companion.vision.bundle import Views
from vcl_companion.vision.resection import NotFound

# In an image of both maps a landmark of both lies where it did when they parted.
_SAME_PX = 0.05
# Keyframes of the other map that show so many patches each tie it to the one, its scale too.
_LEAST_TIED = 2


@dataclass(frozen=True, eq=False)
class Union:
    """Two maps in the world of the one, not adjusted yet.

    Attributes:
        keyframes: the senior's, then those that only the junior has.
        points: (N, 3) the senior's landmarks, then those that only the junior has, m.
        observed: (N, V, 2) px, NaN where not seen.
        settled: (N, V, 2) ideal image coordinates of a map's own observations by its own estimate;
            NaN where not seen, and of what was found only now.
        distances: of both; of the senior only where both are of one world and so are these.
        row: (N_junior,) which landmark each of the junior's is here.
    """

    keyframes: tuple[Keyframe, ...]
    points: Array
    observed: Array
    settled: Array
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
    shared = shared_keyframes(senior.map, junior.map)
    for k, i in shared:
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
    seen = np.full((len(senior.map.points_world), n_old + len(new), 4), np.nan)
    known = views_of(senior.map)
    seen[:, :n_old] = _seen_and_settled(senior.map, known, options)
    if options.patches:
        seen[:, n_old:, :2] = _shown(senior, depth_errors(known), brought, pyramid_of, options)
    row = np.full(len(junior.map.points_world), -1, dtype=np.intp)
    same = _are_same(senior, junior, stands, shared)
    if same.sum() < MIN_COMMON and not _are_tied(seen, n_old):
        same[:] = True
    row[stands.common.junior[same]] = stands.common.senior[same]
    there = np.full((len(row), *seen.shape[1:]), np.nan)
    there[:, column] = _seen_and_settled(junior.map, views_of(junior.map), options)
    seen, points, row = _with_junior(seen, there, senior, junior, stands, row)
    distances = senior.map.distances
    if not one_world:
        distances += _brought_distances(senior, junior, column, options)
    keyframes = senior.map.keyframes + brought
    return Union(keyframes, points, seen[..., :2], seen[..., 2:], distances, row)


def _are_same(senior: Side, junior: Side, stands: Aligned, shared: list[tuple[int, int]]) -> Mask:
    """Return (M,) which pairs of landmarks were one before the maps parted.

    Others that are alike, by their descriptors or by lying near to each other, lie some tenths of a
    pixel beside, all to one side: united they bend both maps.
    """
    one, other = stands.common.senior, stands.common.junior
    same = np.zeros(len(one), dtype=bool)
    for k, i in shared:
        apart = senior.map.observed_px[one, k] - junior.map.observed_px[other, i]
        same |= np.linalg.norm(apart, axis=1) < _SAME_PX
    return same


def _are_tied(seen: Array, n_old: int) -> bool:
    """Whether patches of the one map that the other's keyframes show hold both together."""
    shown = np.isfinite(seen[:, n_old:, 0]).sum(axis=0)
    return int((shown >= MIN_SEEN).sum()) >= _LEAST_TIED


def _seen_and_settled(landmark_map: LandmarkMap, views: Views, options: MapOptions) -> Array:
    """Return (N, V, 4) a map's observations, px, and where its estimate puts them, ideal."""
    where = settled(views, believed_noise_px(landmark_map, options))
    return np.concatenate([landmark_map.observed_px, where], axis=2)


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
    senior: Side,
    relative: Array,
    brought: tuple[Keyframe, ...],
    pyramid_of: PyramidOf,
    options: MapOptions,
) -> Array:
    """Return (N, K, 2) where K keyframes show the senior's landmarks, found by their patches."""
    known = senior.map
    all_of_them = known.keyframes + brought
    cameras = [k.camera for k in all_of_them]
    table = PatchTable(
        cameras, pyramids_of([(k.image_bytes, k.camera) for k in all_of_them], pyramid_of)
    )
    cams = [k.world_from_body @ k.body_from_cam for k in known.keyframes]
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


def _with_junior(
    observed: Array, there: Array, senior: Side, junior: Side, stands: Aligned, row: Index
) -> tuple[Array, Array, Index]:
    """Add what the junior saw: to landmarks of both where it is not known yet, and its own.

    Args:
        observed: (N_senior, V, 4) the senior's landmarks in all keyframes (``_seen_and_settled``).
        there: (N_junior, V, 4) the same of the junior's.
        senior: the one map.
        junior: the other.
        stands: how that stands in the one.
        row: (N_junior,) the senior's landmark that each of the junior's is, -1 for none.

    Returns:
        What all landmarks are seen as, where they are, and which of them each of the junior's is.
    """
    n = len(observed)
    both = np.flatnonzero(row >= 0)
    known = observed[row[both]]
    # Found by the same patch in several of its keyframes, its own pixels would say it again.
    lacking = ~np.isfinite(known[..., :1])
    own = np.isfinite(known[:, len(senior.map.keyframes) :, 0]).sum(axis=1) >= 2
    lacking[own, len(senior.map.keyframes) :] = False
    observed[row[both]] = np.where(lacking, there[both], known)
    fresh = np.flatnonzero(row < 0)
    row = row.copy()
    row[fresh] = n + np.arange(len(fresh))
    points = stands.senior_from_junior.apply(junior.map.points_world[fresh])
    return (
        np.concatenate([observed, there[fresh]]),
        np.concatenate([senior.map.points_world, points]),
        row,
    )
