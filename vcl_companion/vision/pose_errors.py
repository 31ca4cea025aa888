"""What the errors of all that fixed a pose come to in it, compiled (eq. 12, and the map's)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import reordered
from vcl_companion.geometry.rotation import Array

Ints = NDArray[np.int64]


@reordered
def gained(
    inverse: Array,
    j_poses: Array,
    j_points: Array,
    roots: Array,
    weights: Array,
    noises: Array,
    misplaced: Array,
    owns: Array,
    landmarks: Ints,
    levers: NDArray[np.float32],
) -> tuple[Array, Array, Array]:
    """Carry the errors of everything that fixed a pose over to it.

    Args:
        inverse: (6, 6) of the normal matrix of ``pose_kernels.supported``.
        j_poses: (2, 6, M) of the same, like the next three.
        j_points: (2, 3, M).
        roots: (3, M).
        weights: (M,) zero for those that do not count.
        noises: (M, 3) xx xy yy of each pixel, new in every frame, px^2.
        misplaced: (M, 3) the same of what is alike in every frame, px^2.
        owns: (M, 3) 1-sigma displacement of each landmark by its own depth, world, m.
        landmarks: (M,) rows of ``levers``.
        levers: (N, 3, K) landmark error per keyframe error.

    Returns:
        (M,) leverage of each; (3, 6, 6) covariance by pixel noise, by misplacement, by the
        landmarks' own errors; (6, K) lever of the keyframes.
    """
    m = len(weights)
    # The pose by the whitened residuals' first and second.
    first, second = np.zeros((6, m)), np.zeros((6, m))
    for c in range(6):
        for d in range(6):
            for i in range(m):
                first[c, i] += inverse[c, d] * j_poses[0, d, i]
                second[c, i] += inverse[c, d] * j_poses[1, d, i]
        for i in range(m):
            first[c, i] *= weights[i]
            second[c, i] *= weights[i]
    by_point, by_own = np.empty((6, 3, m)), np.zeros((6, m))
    for c in range(6):
        for r in range(3):
            for i in range(m):
                moved = -(first[c, i] * j_points[0, r, i] + second[c, i] * j_points[1, r, i])
                by_point[c, r, i] = moved
                by_own[c, i] += moved * owns[i, r]
    covariances = np.zeros((3, 6, 6))
    _add_up(first, second, _whitened(noises, roots), covariances[0])
    _add_up(first, second, _whitened(misplaced, roots), covariances[1])
    for c in range(6):
        for d in range(c + 1):
            total = 0.0
            for i in range(m):
                total += by_own[c, i] * by_own[d, i]
            covariances[2, c, d] = covariances[2, d, c] = total
    lever = _levers(by_point, weights, landmarks, levers)
    return _leverage(j_poses, first, second), covariances, lever


@reordered
def _leverage(j_poses: Array, first: Array, second: Array) -> Array:
    """Return (M,) the larger eigenvalue of what each says of itself."""
    m = first.shape[1]
    out, uu, uv, vv = np.empty(m), np.zeros(m), np.zeros(m), np.zeros(m)
    for c in range(6):
        for i in range(m):
            uu[i] += j_poses[0, c, i] * first[c, i]
            uv[i] += j_poses[0, c, i] * second[c, i]
            vv[i] += j_poses[1, c, i] * second[c, i]
    for i in range(m):
        half, apart = 0.5 * (uu[i] + vv[i]), 0.5 * (uu[i] - vv[i])
        out[i] = half + math.sqrt(apart * apart + uv[i] * uv[i])
    return out


@reordered
def _whitened(pixels: Array, roots: Array) -> Array:
    """Return (3, M) xx xy yy of pixels' covariances in units of the residuals' sigmas."""
    m = len(pixels)
    out = np.empty((3, m))
    for i in range(m):
        a, d = 1.0 / roots[0, i], 1.0 / roots[2, i]
        c = -roots[1, i] * a * d
        across = c * pixels[i, 0] + d * pixels[i, 1]
        out[0, i], out[1, i] = a * a * pixels[i, 0], a * across
        out[2, i] = c * across + d * (c * pixels[i, 1] + d * pixels[i, 2])
    return out


@reordered
def _add_up(first: Array, second: Array, errors: Array, out: Array) -> None:
    """Fill (6, 6) the covariance that errors of all residuals make, (3, M) xx xy yy of each."""
    m = first.shape[1]
    by_first, by_second = np.empty(m), np.empty(m)
    for c in range(6):
        for i in range(m):
            by_first[i] = first[c, i] * errors[0, i] + second[c, i] * errors[1, i]
            by_second[i] = first[c, i] * errors[1, i] + second[c, i] * errors[2, i]
        for d in range(c + 1):
            total = 0.0
            for i in range(m):
                total += by_first[i] * first[d, i] + by_second[i] * second[d, i]
            out[c, d] = out[d, c] = total


@reordered
def _levers(by_point: Array, weights: Array, landmarks: Ints, levers: NDArray[np.float32]) -> Array:
    """Return (6, K) the pose's error per keyframe error, by that of all landmarks."""
    k = levers.shape[2]
    # Whole eights, which are taken at once.
    n_eights = (k + 7) // 8
    moved, out = np.zeros((3, 8 * n_eights)), np.zeros((6, 8 * n_eights))
    for i in range(len(weights)):
        if weights[i] == 0.0:
            continue
        for r in range(3):
            for d in range(k):
                moved[r, d] = levers[landmarks[i], r, d]
        for c in range(6):
            x, y, z = by_point[c, 0, i], by_point[c, 1, i], by_point[c, 2, i]
            for eight in range(0, 8 * n_eights, 8):
                for d in range(eight, eight + 8):
                    out[c, d] += x * moved[0, d] + y * moved[1, d] + z * moved[2, d]
    return out[:, :k].copy()
