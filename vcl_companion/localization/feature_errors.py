"""What a pose by features errs by beside pixel noise: unlike views, the map's own errors, lenses.

A detector puts a feature elsewhere when it looks otherwise; a landmark is not quite where the map
has it; a lens is not quite what its calibration says.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.lens_errors import lens_px
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.resection import Resection


def bias_px(
    landmark_map: LandmarkMap,
    landmarks: NDArray[np.intp],
    centre: Array,
    options: LocalizationOptions,
) -> Array:
    """Return how far a detector may misplace landmarks that look different from here.

    By how much, against the keyframe that saw the landmark most alike, the
    viewing direction and the distance have changed.

    Args:
        landmark_map: the map.
        landmarks: (M,) of it.
        centre: (3,) where the camera is, world, m.
        options: how much each of them misplaces a feature.

    Returns:
        (M,) px, 1 sigma.
    """
    points = landmark_map.points_world[landmarks]
    seen = landmark_map.seen[landmarks]
    ray = points - centre
    distance = np.linalg.norm(ray, axis=1)
    least = np.full(len(landmarks), np.inf)
    for i, keyframe in enumerate(landmark_map.keyframes):
        origin = (keyframe.world_from_body @ keyframe.body_from_cam).translation
        then = points - origin
        distance_then = np.linalg.norm(then, axis=1)
        cosine = np.einsum("mi,mi->m", ray, then) / np.maximum(distance * distance_then, 1e-9)
        angle_deg = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
        octaves = np.abs(np.log2(np.maximum(distance, 1e-3) / np.maximum(distance_then, 1e-3)))
        bias = np.hypot(options.bias_px_per_deg * angle_deg, options.bias_px_per_octave * octaves)
        least = np.where(seen[:, i], np.minimum(least, bias), least)
    return least


def map_error(
    result: Resection,
    landmarks: NDArray[np.intp],
    pixels: Array,
    camera: Camera,
    uncertainty: MapUncertainty,
) -> tuple[Array, Array]:
    """Return what a pose errs by that no better look at the same landmarks takes away.

    Args:
        result: the pose, and how each of the M landmarks that agree moves it.
        landmarks: (M,) of the map.
        pixels: (M, 2) raw px, where they were found.
        camera: whose image it is.
        uncertainty: of the map.

    Returns:
        (6, 6) local covariance by the landmarks' own errors, unlike views and the lens, and the
        (6, 6V) lever of the keyframes' errors on the pose.
    """
    by_landmark = -result.gain @ result.jacobian_points
    own = np.einsum(
        "mij,mjk,mlk->il", by_landmark, uncertainty.landmark_covariance[landmarks], by_landmark
    )
    lever = np.einsum("mij,mjk->ik", by_landmark, uncertainty.landmark_lever[landmarks])
    own += result.bias_covariance
    if uncertainty.calibration_px:
        off_px = lens_px(camera, pixels, uncertainty.calibration_px)
        by_lens = np.einsum("mij,mjk->ik", result.gain, off_px)
        own += by_lens @ by_lens.T
    return np.asarray(0.5 * (own + own.T)), np.asarray(lever)
