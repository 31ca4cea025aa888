"""A map's observations measured again by patches, and adjusted again (issue 4; IV-C, IV-F)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array, angle_between
from vcl_companion.mapping.apart import ambiguous
from vcl_companion.mapping.culling import depth_errors, fitting
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.patch_table import (
    PatchTable,
    PyramidOf,
    Reference,
    decoded_pyramid,
    landmark_noise,
    pyramids_of,
)
from vcl_companion.mapping.strays import strays
from vcl_companion.mapping.uncertainty import views_of
from vcl_companion.mapping.weighing import adjust_weighed
from vcl_companion.vision.bundle import BundleOptions
from vcl_companion.vision.patches import AlignRules

# A first alignment starts from poses that are some pixels off, the last one does not.
_LOOSELY = AlignRules(max_iterations=15, least_score=0.8, max_moved_px=3.0, settled_px=0.02)
_CLOSELY = AlignRules(max_iterations=15, least_score=0.85, max_moved_px=1.5, settled_px=0.02)
# Patches were turned and stretched by the poses that there were: where these turn by so much, they
# are measured once more, no more often than so.
_TURNED_RAD, _MOST_LOOSELY = np.deg2rad(1.0), 3
# Residuals of patches that are the same spot.
_MAX_SIGMAS, _LEAST_LIMIT_PX = 4.0, 0.5
# Along the valley of a scene that is nearly flat an adjustment takes some hundred steps.
_MAX_STEPS = 400
_CAUCHY_PX = 0.5
SETTLED_CAUCHY_PX = 0.15
"""The same for patches measured from poses that are adjusted already.

Most err by some hundredths of a pixel; those at the edge of something that stands out err by some
tenths, and neighbours alike, so that they bend a map unless they count for little. First maps of
rendered scenes and of photographs were better by a quarter to a half than with 0.5.
"""


def sharpened(
    landmark_map: LandmarkMap,
    options: MapOptions,
    pyramid_of: PyramidOf = decoded_pyramid,
) -> LandmarkMap:
    """Return a map whose observations are patches aligned to each other.

    Each landmark is cut out of that keyframe from which most others find it.
    Landmarks that no other keyframe finds are left out.

    Args:
        landmark_map: of a few keyframes.
        options: largest depth error, smallest angle.
        pyramid_of: the image of a keyframe.
    """
    cameras = [k.camera for k in landmark_map.keyframes]
    images = [(k.image_bytes, k.camera) for k in landmark_map.keyframes]
    table = PatchTable(cameras, pyramids_of(images, pyramid_of))
    for _ in range(_MOST_LOOSELY):
        before = landmark_map
        landmark_map = _round(before, table, cameras, _LOOSELY, _CAUCHY_PX, options)
        if len(landmark_map.points_world) < options.min_landmarks:
            return landmark_map
        if _turned_rad(before, landmark_map) < _TURNED_RAD:
            break
    return _round(landmark_map, table, cameras, _CLOSELY, SETTLED_CAUCHY_PX, options)


def _turned_rad(one: LandmarkMap, other: LandmarkMap) -> float:
    """Return by how much that keyframe turned that turned most."""
    pairs = zip(one.keyframes, other.keyframes, strict=True)
    return max(
        angle_between(a.world_from_body.rotation, b.world_from_body.rotation) for a, b in pairs
    )


def _round(
    landmark_map: LandmarkMap,
    table: PatchTable,
    cameras: list[Camera],
    rules: AlignRules,
    cauchy_px: float,
    options: MapOptions,
) -> LandmarkMap:
    landmark, view = np.nonzero(landmark_map.seen)
    order = np.argsort(landmark, kind="stable")
    landmark, view = landmark[order], view[order]
    reference = Reference(
        view,
        landmark_map.observed_px[landmark, view],
        landmark_map.points_world[landmark],
        depth_errors(views_of(landmark_map))[landmark],
    )
    cams = [k.world_from_body @ k.body_from_cam for k in landmark_map.keyframes]
    found = table.found(reference, cams, list(range(len(cams))), rules)
    count = np.isfinite(found.pixels[:, :, 0]).sum(axis=1)
    # The last one written wins: of each landmark the patch that most keyframes find.
    best = np.full(len(landmark_map.points_world), -1, dtype=np.intp)
    rising = np.argsort(count, kind="stable")
    best[landmark[rising]] = rising
    kept = np.flatnonzero(best >= 0)
    points, observed = landmark_map.points_world[kept], found.pixels[best[kept]]
    noise = landmark_noise(found.noise[best[kept]])
    cut_from = view[best[kept]]
    observed[ambiguous(table, points, observed, cut_from, cameras, cams, rules)] = np.nan
    observed[strays(points, observed, cut_from, cameras, cams)] = np.nan
    seen_twice = np.isfinite(observed[:, :, 0]).sum(axis=1) >= 2
    measured = replace(
        landmark_map, points_world=points[seen_twice], observed_px=observed[seen_twice]
    )
    if len(measured.points_world) < options.min_landmarks:
        return measured
    return _adjusted(measured, noise[seen_twice], cauchy_px, options)


def _adjusted(
    landmark_map: LandmarkMap, noise: Array, cauchy_px: float, options: MapOptions
) -> LandmarkMap:
    """Adjust a map of patches; leave out what misses by more than patches do."""
    bundle = BundleOptions(_MAX_STEPS, cauchy_px)
    views, noise_px = adjust_weighed(views_of(landmark_map), noise, bundle)
    limit_px = max(_MAX_SIGMAS * noise_px, _LEAST_LIMIT_PX)
    fits, good = fitting(views, limit_px, options)
    observed = np.where(fits[..., None], landmark_map.observed_px, np.nan)[good]
    return replace(
        landmark_map,
        keyframes=tuple(
            replace(k, world_from_body=body)
            for k, body in zip(landmark_map.keyframes, views.bodies, strict=True)
        ),
        points_world=views.points[good],
        observed_px=observed,
        pixel_noise_px=noise_px,
    )
