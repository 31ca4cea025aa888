"""Which observations and landmarks are good: by reprojection, angle, depth and leverage (IV-C)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.leverage import leverages
from vcl_companion.mapping.options import MapOptions
from vcl_companion.vision.bundle import Views, relative_sigmas, reprojection_residuals
from vcl_companion.vision.hartley_sturm import triangulate_optimal
from vcl_companion.vision.triangulation import ray_angles, triangulate

Mask = NDArray[np.bool_]

LOOSE = 3.0
"""Poses of a registration are off by some pixels: by them what is right may miss so much more."""
# A landmark that decides more than this of the poses is left out.
_MAX_LEVERAGE = 0.25
# Pixel noise that depths are judged by: an adjustment may find less by chance.
_NOISE_PX = 0.5


def placed(worlds_from_cams: list[Pose], ideal: Array) -> Array:
    """Triangulate: optimally from two views (Hartley-Sturm), nearest to all rays from more.

    Args:
        worlds_from_cams: V camera poses.
        ideal: (N, V, 2) ideal image coordinates, NaN where unseen.

    Returns:
        (N, 3) points, NaN where fewer than two views see them or rays do not meet.
    """
    points = triangulate(worlds_from_cams, ideal)
    seen = np.isfinite(ideal[:, :, 0])
    pairs = np.flatnonzero(seen.sum(axis=1) == 2)
    a, b = np.nonzero(seen[pairs])[1].reshape(-1, 2).T
    for i, k in np.unique(np.stack([a, b], axis=1), axis=0):
        j = pairs[(a == i) & (b == k)]
        b_from_a = worlds_from_cams[k].inverse() @ worlds_from_cams[i]
        optimal = triangulate_optimal(b_from_a, ideal[j, i], ideal[j, k])
        points[j] = worlds_from_cams[i].apply(optimal)
    return points


def fitting(views: Views, limit_px: float, options: MapOptions) -> tuple[Mask, Mask]:
    """Judge every observation and landmark of an estimate.

    Args:
        views: poses, points (NaN where not placed) and observations.
        limit_px: largest reprojection error of an observation.
        options: smallest angle and largest depth error.

    Returns:
        (N, V) observations that fit, and (N,) landmarks that at least two of them
        see under an angle wide enough to know their depth.
    """
    error = np.linalg.norm(reprojection_residuals(views), axis=2)
    fits = error < limit_px
    cams = [body @ mounting for body, mounting in zip(views.bodies, views.mountings, strict=True)]
    angle = ray_angles(cams, np.nan_to_num(views.points), fits)
    good = (fits.sum(axis=1) >= 2) & (angle > np.deg2rad(options.min_angle_deg))
    vague = depth_errors(of_landmarks(of_observations(views, fits), good))
    good[np.flatnonzero(good)[vague > 2.0 * options.max_depth_error]] = False
    return np.asarray(fits), np.asarray(good)


def of_observations(views: Views, fits: Mask) -> Views:
    """Return the same views with fewer observations: the (N, V) that fit."""
    return replace(views, ideal=np.where(fits[..., None], views.ideal, np.nan))


def of_landmarks(views: Views, good: Mask) -> Views:
    """Return the same views of fewer landmarks: the (N,) good ones."""
    return replace(
        views, slopes=views.slopes[good], ideal=views.ideal[good], points=views.points[good]
    )


def depth_errors(views: Views) -> Array:
    """Return (N,) 1-sigma error of each landmark were the poses exact, over its distance.

    Args:
        views: an estimate; the distance is that to the nearest view that sees the landmark.
    """
    return np.asarray(_NOISE_PX * relative_sigmas(views))


def decisive(views: Views) -> Mask:
    """Return (N,) landmarks that decide too much of the poses, a wrong match perhaps."""
    return np.asarray(leverages(views) > _MAX_LEVERAGE)
