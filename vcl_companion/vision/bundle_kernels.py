"""Bundle adjustment, compiled: landmarks are eliminated as they are linearised.

Observations stand landmark by landmark, so that a landmark's blocks are built,
inverted and eliminated in one pass; nothing of size (landmarks x views) is made.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

Ints = NDArray[np.int64]

_MIN_DEPTH_M = 1e-3
_BEHIND_PX = 1e3
# 1/m^2; of what is known no better nothing is.
_LEAST_INFORMATION = 1e-12


@compiled
def _turned_back(pose: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point in the axes of a (3, 4) pose."""
    x, y, z = x - pose[0, 3], y - pose[1, 3], z - pose[2, 3]
    return (
        pose[0, 0] * x + pose[1, 0] * y + pose[2, 0] * z,
        pose[0, 1] * x + pose[1, 1] * y + pose[2, 1] * z,
        pose[0, 2] * x + pose[1, 2] * y + pose[2, 2] * z,
    )


@compiled
def linearized(
    point: Array,
    body: Array,
    mounting: Array,
    slopes: Array,
    ideal: Array,
    residual: Array,
    j_pose: Array,
    j_point: Array,
) -> None:
    """Residual (2,) of one observation, its slopes (2, 6) by the body and (2, 3) by the point.

    ``body`` is world_from_body, ``mounting`` body_from_cam, each (3, 4).
    """
    p0, p1, p2 = _turned_back(body, point[0], point[1], point[2])
    c0, c1, c2 = _turned_back(mounting, p0, p1, p2)
    if not c2 > _MIN_DEPTH_M:
        residual[:] = _BEHIND_PX
        j_pose[:] = 0.0
        j_point[:] = 0.0
        return
    inverse = 1.0 / c2
    u, v = c0 * inverse, c1 * inverse
    off_u, off_v = u - ideal[0], v - ideal[1]
    for k in range(2):
        by_u, by_v = slopes[k, 0], slopes[k, 1]
        a, b, d = by_u * inverse, by_v * inverse, -(by_u * u + by_v * v) * inverse
        # By the point in body axes.
        x = a * mounting[0, 0] + b * mounting[0, 1] + d * mounting[0, 2]
        y = a * mounting[1, 0] + b * mounting[1, 1] + d * mounting[1, 2]
        z = a * mounting[2, 0] + b * mounting[2, 1] + d * mounting[2, 2]
        residual[k] = by_u * off_u + by_v * off_v
        j_pose[k, 0], j_pose[k, 1], j_pose[k, 2] = -x, -y, -z
        j_pose[k, 3] = y * p2 - z * p1
        j_pose[k, 4] = z * p0 - x * p2
        j_pose[k, 5] = x * p1 - y * p0
        for r in range(3):
            j_point[k, r] = x * body[r, 0] + y * body[r, 1] + z * body[r, 2]


@compiled
def residuals(
    points: Array, cams_from_world: Array, slopes: Array, ideal: Array, least_depth_m: float
) -> Array:
    """Return (N, V, 2) projected minus observed, px; NaN where unseen or not in front.

    Args:
        points: (N, 3).
        cams_from_world: (V, 3, 4).
        slopes: (N, V, 2, 2) pixels by ideal coordinates.
        ideal: (N, V, 2) observed; NaN where unseen.
        least_depth_m: what is nearer is not in front.
    """
    n, v = ideal.shape[0], ideal.shape[1]
    out = np.full((n, v, 2), np.nan)
    for j in range(n):
        p = points[j]
        for i in range(v):
            c = cams_from_world[i]
            z = c[2, 0] * p[0] + c[2, 1] * p[1] + c[2, 2] * p[2] + c[2, 3]
            if np.isnan(ideal[j, i, 0]) or not z > least_depth_m:
                continue
            x = (c[0, 0] * p[0] + c[0, 1] * p[1] + c[0, 2] * p[2] + c[0, 3]) / z - ideal[j, i, 0]
            y = (c[1, 0] * p[0] + c[1, 1] * p[1] + c[1, 2] * p[2] + c[1, 3]) / z - ideal[j, i, 1]
            out[j, i, 0] = slopes[j, i, 0, 0] * x + slopes[j, i, 0, 1] * y
            out[j, i, 1] = slopes[j, i, 1, 0] * x + slopes[j, i, 1, 1] * y
    return out


@compiled
def cost_of(
    points: Array,
    bodies: Array,
    mountings: Array,
    first: Ints,
    view: Ints,
    slopes: Array,
    ideal: Array,
    cauchy_px: float,
) -> float:
    """Return the robust cost, px^2."""
    cost = 0.0
    for j in range(len(first) - 1):
        for m in range(first[j], first[j + 1]):
            i = view[m]
            x, y, z = _turned_back(bodies[i], points[j, 0], points[j, 1], points[j, 2])
            x, y, z = _turned_back(mountings[i], x, y, z)
            squared = 2.0 * _BEHIND_PX**2
            if z > _MIN_DEPTH_M:
                u, v = x / z - ideal[m, 0], y / z - ideal[m, 1]
                squared = (slopes[m, 0, 0] * u + slopes[m, 0, 1] * v) ** 2 + (
                    slopes[m, 1, 0] * u + slopes[m, 1, 1] * v
                ) ** 2
            cost += cauchy_px**2 * np.log1p(squared / cauchy_px**2)
    return cost


@compiled
def relative_sigmas(
    points: Array,
    bodies: Array,
    mountings: Array,
    first: Ints,
    view: Ints,
    slopes: Array,
    ideal: Array,
) -> Array:
    """Return (N,) what ``bundle.relative_sigmas`` does."""
    residual, j_pose, j_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    block, out = np.empty((3, 3)), np.full(len(points), np.inf)
    for j in range(len(points)):
        block[:] = 0.0
        nearest = np.inf
        for m in range(first[j], first[j + 1]):
            i = view[m]
            linearized(
                points[j], bodies[i], mountings[i], slopes[m], ideal[m], residual, j_pose, j_point
            )
            for r in range(3):
                for c in range(3):
                    block[r, c] += j_point[0, r] * j_point[0, c] + j_point[1, r] * j_point[1, c]
            x, y, z = _turned_back(bodies[i], points[j, 0], points[j, 1], points[j, 2])
            x, y, z = x - mountings[i, 0, 3], y - mountings[i, 1, 3], z - mountings[i, 2, 3]
            nearest = min(nearest, np.sqrt(x * x + y * y + z * z))
        if first[j + 1] > first[j]:
            # The least known direction has the smallest eigenvalue.
            least = max(_smallest_eigenvalue(block), _LEAST_INFORMATION)
            out[j] = 1.0 / (np.sqrt(least) * nearest)
    return out


@compiled
def _smallest_eigenvalue(a: Array) -> float:
    """Return that of a symmetric 3x3 matrix, in closed form (Smith 1961)."""
    mean = (a[0, 0] + a[1, 1] + a[2, 2]) / 3.0
    d0, d1, d2 = a[0, 0] - mean, a[1, 1] - mean, a[2, 2] - mean
    b0, b1, b2 = a[0, 1], a[0, 2], a[1, 2]
    size = np.sqrt((d0 * d0 + d1 * d1 + d2 * d2 + 2.0 * (b0 * b0 + b1 * b1 + b2 * b2)) / 6.0)
    if size == 0.0:
        return float(mean)
    determinant = (
        d0 * (d1 * d2 - b2 * b2) - b0 * (b0 * d2 - b2 * b1) + b1 * (b0 * b2 - d1 * b1)
    ) / size**3
    angle = np.arccos(min(max(determinant / 2.0, -1.0), 1.0)) / 3.0
    return float(mean + 2.0 * size * np.cos(angle + 2.0 * np.pi / 3.0))


@compiled
def reduced(
    points: Array,
    bodies: Array,
    mountings: Array,
    first: Ints,
    view: Ints,
    slopes: Array,
    ideal: Array,
    cauchy_px: float,
    damping: float,
    n_held: int,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Linearise every observation and eliminate the landmarks.

    Args:
        points: (N, 3).
        bodies: (V, 3, 4) world_from_body.
        mountings: (V, 3, 4) body_from_cam.
        first: (N + 1,) where each landmark's observations begin.
        view: (M,) of each observation.
        slopes: (M, 2, 2) d(pixel) / d(ideal).
        ideal: (M, 2).
        cauchy_px: robust scale.
        damping: of the landmarks' own blocks, relative.
        n_held: so many of the first bodies do not move; their rows stay zero.

    Returns:
        (6V, 6V) reduced normal matrix, (6V,) its right side, (6V,) the poses' own
        diagonal, (N, 3, 3) inverses of the landmarks' blocks, (N, 3) their right
        sides, (M, 3, 6) couplings.
    """
    size = 6 * len(bodies)
    normal, rhs, diagonal = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    inverses, pulls = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    crosses = np.zeros((len(view), 3, 6))
    residual, j_pose, j_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    block, left = np.empty((3, 3)), np.empty((6, 3))
    for j in range(len(points)):
        block[:] = 0.0
        for m in range(first[j], first[j + 1]):
            i = view[m]
            linearized(
                points[j], bodies[i], mountings[i], slopes[m], ideal[m], residual, j_pose, j_point
            )
            squared = residual[0] ** 2 + residual[1] ** 2
            weight = 1.0 / (1.0 + squared / cauchy_px**2)
            a = 6 * i
            for r in range(6):
                if i < n_held:
                    break
                wr0, wr1 = weight * j_pose[0, r], weight * j_pose[1, r]
                rhs[a + r] -= wr0 * residual[0] + wr1 * residual[1]
                for c in range(6):
                    normal[a + r, a + c] += wr0 * j_pose[0, c] + wr1 * j_pose[1, c]
                for c in range(3):
                    crosses[m, c, r] = wr0 * j_point[0, c] + wr1 * j_point[1, c]
                diagonal[a + r] += wr0 * j_pose[0, r] + wr1 * j_pose[1, r]
            for r in range(3):
                wr0, wr1 = weight * j_point[0, r], weight * j_point[1, r]
                pulls[j, r] -= wr0 * residual[0] + wr1 * residual[1]
                for c in range(3):
                    block[r, c] += wr0 * j_point[0, c] + wr1 * j_point[1, c]
        for r in range(3):
            block[r, r] = block[r, r] * (1.0 + damping) + 1e-9
        inverse = inverses[j]
        _invert(block, inverse)
        for m in range(first[j], first[j + 1]):
            if view[m] < n_held:
                continue
            a = 6 * view[m]
            for r in range(6):
                for c in range(3):
                    left[r, c] = (
                        crosses[m, 0, r] * inverse[0, c]
                        + crosses[m, 1, r] * inverse[1, c]
                        + crosses[m, 2, r] * inverse[2, c]
                    )
                rhs[a + r] -= (
                    left[r, 0] * pulls[j, 0] + left[r, 1] * pulls[j, 1] + left[r, 2] * pulls[j, 2]
                )
            for n in range(first[j], m + 1):
                if view[n] < n_held:
                    continue
                b, cross = 6 * view[n], crosses[n]
                for r in range(6):
                    # A row from zero on: numba looks out for negative positions otherwise.
                    row, x, y, z = normal[a + r, b : b + 6], left[r, 0], left[r, 1], left[r, 2]
                    for c in range(6):
                        row[c] -= x * cross[0, c] + y * cross[1, c] + z * cross[2, c]
    # Observations of a landmark stand by rising view: only blocks below the diagonal were written.
    for a in range(size):
        for b in range(a):
            normal[b, a] = normal[a, b]
    return normal, rhs, diagonal, inverses, pulls, crosses


@compiled
def _invert(block: Array, inverse: Array) -> None:
    """Invert a symmetric (3, 3) block by its cofactors."""
    a, b, c = block[0, 0], block[0, 1], block[0, 2]
    d, e, f = block[1, 1], block[1, 2], block[2, 2]
    first, second, third = d * f - e * e, c * e - b * f, b * e - c * d
    factor = 1.0 / (a * first + b * second + c * third)
    inverse[0, 0] = first * factor
    inverse[0, 1] = inverse[1, 0] = second * factor
    inverse[0, 2] = inverse[2, 0] = third * factor
    inverse[1, 1] = (a * f - c * c) * factor
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) * factor
    inverse[2, 2] = (a * d - b * b) * factor


@compiled
def substituted(
    pose_step: Array, first: Ints, view: Ints, inverses: Array, pulls: Array, crosses: Array
) -> Array:
    """Return the (N, 3) step of the landmarks that goes with a (6V,) step of the poses."""
    out = np.empty(pulls.shape)
    right = np.empty(3)
    for j in range(len(pulls)):
        right[:] = pulls[j]
        for m in range(first[j], first[j + 1]):
            a = 6 * view[m]
            for r in range(6):
                for c in range(3):
                    right[c] -= crosses[m, c, r] * pose_step[a + r]
        for r in range(3):
            out[j, r] = (
                inverses[j, r, 0] * right[0]
                + inverses[j, r, 1] * right[1]
                + inverses[j, r, 2] * right[2]
            )
    return out
