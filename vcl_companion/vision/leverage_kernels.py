"""How much of the poses each landmark decides, in compiled code: by the few views that see it."""

from __future__ import annotations

import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.bundle_kernels import Ints, linearized

# Of the length of a slope: what is left of one that the others explain is rounding.
_NOTHING_LEFT = 1e-9
# Steps towards the largest eigenvalue, and the relative gain that is the last.
_STEPS, _LEAST_GAIN = 200, 1e-5


@compiled
def leverages(
    points: Array,
    bodies: Array,
    mountings: Array,
    first: Ints,
    view: Ints,
    slopes: Array,
    ideal: Array,
    covariance: Array,
) -> Array:
    """Return (N,) what ``bundle.leverages`` does.

    Args:
        points: (N, 3).
        bodies: (V, 3, 4) world_from_body.
        mountings: (V, 3, 4) body_from_cam.
        first: (N + 1,) where each landmark's observations begin.
        view: (M,) of each observation.
        slopes: (M, 2, 2) d(pixel) / d(ideal).
        ideal: (M, 2).
        covariance: (6V, 6V) of the poses, of 1 px of noise.
    """
    most = 0
    for j in range(len(points)):
        most = max(most, first[j + 1] - first[j])
    residual, pose, point = np.empty(2), np.empty((most, 2, 6)), np.empty((2 * most, 3))
    spread, left = np.empty((2 * most, 2 * most)), np.empty((2, 6))
    out = np.empty(len(points))
    for j in range(len(points)):
        begin, s = first[j], first[j + 1] - first[j]
        for m in range(s):
            i = view[begin + m]
            linearized(
                points[j],
                bodies[i],
                mountings[i],
                slopes[begin + m],
                ideal[begin + m],
                residual,
                pose[m],
                point[2 * m : 2 * m + 2],
            )
        # What the poses' errors make of the landmark's observations.
        for m in range(s):
            a = 6 * view[begin + m]
            for n in range(m + 1):
                b = 6 * view[begin + n]
                for k in range(2):
                    for d in range(6):
                        total = 0.0
                        for c in range(6):
                            total += pose[m, k, c] * covariance[a + c, b + d]
                        left[k, d] = total
                for k in range(2):
                    for q in range(2):
                        total = 0.0
                        for d in range(6):
                            total += left[k, d] * pose[n, q, d]
                        spread[2 * m + k, 2 * n + q] = total
                        spread[2 * n + q, 2 * m + k] = total
        _without(point[: 2 * s], spread[: 2 * s, : 2 * s])
        out[j] = _largest_eigenvalue(spread[: 2 * s, : 2 * s])
    return out


@compiled
def _without(slopes: Array, spread: Array) -> None:
    """Take out of an (n, n) covariance what goes along (n, 3) slopes, in place; spoils these."""
    n = len(slopes)
    along = np.empty(n)
    for c in range(3):
        before = 0.0
        for k in range(n):
            before += slopes[k, c] ** 2
        # Twice, or rounding leaves them not at right angles (Gram-Schmidt).
        for _ in range(2):
            for d in range(c):
                shared = 0.0
                for k in range(n):
                    shared += slopes[k, c] * slopes[k, d]
                for k in range(n):
                    slopes[k, c] -= shared * slopes[k, d]
        length = 0.0
        for k in range(n):
            length += slopes[k, c] ** 2
        if length <= _NOTHING_LEFT**2 * before:
            slopes[:, c] = 0.0
            continue
        slopes[:, c] /= np.sqrt(length)
        # As a product from both sides with what is left without this direction.
        both = 0.0
        for r in range(n):
            along[r] = 0.0
            for k in range(n):
                along[r] += spread[r, k] * slopes[k, c]
            both += along[r] * slopes[r, c]
        for r in range(n):
            for k in range(n):
                spread[r, k] -= (
                    along[r] * slopes[k, c]
                    + slopes[r, c] * along[k]
                    - both * slopes[r, c] * slopes[k, c]
                )


@compiled
def _largest_eigenvalue(matrix: Array) -> float:
    """Return that of a symmetric matrix without negative ones, by power iteration."""
    n, at = len(matrix), 0
    for k in range(n):
        if matrix[k, k] > matrix[at, at]:
            at = k
    if n == 0 or not matrix[at, at] > 0.0:
        return 0.0
    # The column of the largest diagonal: it has a share of the largest eigenvector.
    vector, moved = matrix[:, at].copy(), np.empty(n)
    value = 0.0
    for _ in range(_STEPS):
        vector /= np.sqrt((vector**2).sum())
        for r in range(n):
            total = 0.0
            for k in range(n):
                total += matrix[r, k] * vector[k]
            moved[r] = total
        better = 0.0
        for k in range(n):
            better += moved[k] * vector[k]
        vector[:] = moved
        if better - value < _LEAST_GAIN * better:
            return better
        value = better
    return value
