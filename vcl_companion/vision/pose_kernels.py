"""The refinement of a pose over many sightings, compiled (eq. 4).

What ``vision.resection`` does in arrays of all sightings, in one loop, for as
many sightings as patches give: same weights, same steps, same pose.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.compiled import compiled

Ints = NDArray[np.int64]

_MIN_DEPTH_M = 1e-3
# What is left of a diagonal's element by elimination, as a share of it, that is no rounding.
_LEAST_PIVOT = 1e-13
CONVERGED, SINGULAR, DIVERGED = 0, 1, 2


@compiled
def converged(
    pose: Array,
    body_from_cam: Array,
    ideal: Array,
    slopes: Array,
    points: Array,
    point_covariances: Array,
    pixel_covariances: Array,
    prior_information: Array,
    scales: Array,
) -> tuple[Array, int]:
    """Gauss-Newton with a redescending weight, wide at first, on a local perturbation.

    Args:
        pose: (3, 4) first guess of world_from_body.
        body_from_cam: (3, 4).
        ideal: (M, 2) where they were seen, ideal coordinates.
        slopes: (M, 2, 2) d(pixel) / d(ideal) there.
        points: (M, 3) world, m.
        point_covariances: (M, 6) xx xy xz yy yz zz, m^2.
        pixel_covariances: (M, 3) xx xy yy, px^2.
        prior_information: (6, 6) of the first guess, local; zero for none.
        scales: factors on the noise, one round each.

    Returns:
        (3, 4) pose, and CONVERGED or why it did not.
    """
    start = pose.copy()
    now = pose.copy()
    residual, j_pose, j_point = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    weighted = np.empty((2, 6))
    information = np.empty(3)
    normal, rhs, step = np.empty((6, 6)), np.empty(6), np.empty(6)
    for k in range(len(scales)):
        scale = scales[k]
        for _ in range(4):
            normal[:] = 0.0
            rhs[:] = 0.0
            if prior_information[0, 0] > 0.0:
                normal += prior_information
                rhs -= prior_information @ _local(start, now)
            for i in range(len(points)):
                if not linearized_at(
                    now, body_from_cam, ideal[i], slopes[i], points[i], residual, j_pose, j_point
                ):
                    continue
                squared = informed(
                    residual, j_point, point_covariances[i], pixel_covariances[i], information
                ) / (scale * scale)
                weight = 1.0 / ((1.0 + squared / 4.0) ** 2 * scale * scale)
                xx, xy, yy = information[0], information[1], information[2]
                for c in range(6):
                    weighted[0, c] = weight * (xx * j_pose[0, c] + xy * j_pose[1, c])
                    weighted[1, c] = weight * (xy * j_pose[0, c] + yy * j_pose[1, c])
                for c in range(6):
                    for d in range(c + 1):
                        normal[c, d] += (
                            weighted[0, c] * j_pose[0, d] + weighted[1, c] * j_pose[1, d]
                        )
                    rhs[c] -= weighted[0, c] * residual[0] + weighted[1, c] * residual[1]
            if not _solved(normal, rhs, step):
                return now, SINGULAR
            length = math.sqrt(float((step * step).sum()))
            if not length < 1e3:
                return now, DIVERGED
            _retract(now, step)
            if length < (1e-4 if scale > 1.0 else 1e-7):
                break
    return now, CONVERGED


@compiled
def supported(
    pose: Array,
    body_from_cam: Array,
    ideal: Array,
    slopes: Array,
    points: Array,
    point_covariances: Array,
    pixel_covariances: Array,
    largest: float,
) -> tuple[Ints, Array, Array, Array, Array]:
    """Find who agrees with a pose.

    Args:
        pose: (3, 4) world_from_body.
        body_from_cam: (3, 4), this and the next: as in ``converged``.
        ideal: (M, 2).
        slopes: (M, 2, 2).
        points: (M, 3).
        point_covariances: (M, 6).
        pixel_covariances: (M, 3).
        largest: squared Mahalanobis length of a residual that still agrees.

    Returns:
        (M,) 1 for those that agree; (6, 6) their normal matrix; (M, 2, 6) and (M, 2, 3)
        residuals by pose and by point; (M + 1, 3) their weighted informations xx xy yy,
        and in one more row the sum of squared residuals, px^2.
    """
    m = len(points)
    agrees, normal = np.zeros(m, np.int64), np.zeros((6, 6))
    j_poses, j_points = np.zeros((m, 2, 6)), np.zeros((m, 2, 3))
    informations = np.zeros((m + 1, 3))
    residual, information = np.empty(2), np.empty(3)
    for i in range(m):
        if not linearized_at(
            pose, body_from_cam, ideal[i], slopes[i], points[i], residual, j_poses[i], j_points[i]
        ):
            continue
        squared = informed(
            residual, j_points[i], point_covariances[i], pixel_covariances[i], information
        )
        if not squared < largest:
            continue
        agrees[i] = 1
        informations[m, 0] += residual[0] ** 2 + residual[1] ** 2
        weight = 1.0 / (1.0 + squared / 4.0) ** 2
        for c in range(3):
            informations[i, c] = weight * information[c]
        xx, xy, yy = informations[i, 0], informations[i, 1], informations[i, 2]
        j = j_poses[i]
        for c in range(6):
            left, right = xx * j[0, c] + xy * j[1, c], xy * j[0, c] + yy * j[1, c]
            for d in range(c + 1):
                normal[c, d] += left * j[0, d] + right * j[1, d]
    for c in range(6):
        for d in range(c):
            normal[d, c] = normal[c, d]
    return agrees, normal, j_poses, j_points, informations


@compiled
def gained(
    agrees: Ints,
    inverse: Array,
    j_poses: Array,
    j_points: Array,
    informations: Array,
    noises: Array,
    misplaced: Array,
    owns: Array,
    landmarks: Ints,
    levers: NDArray[np.float32],
) -> tuple[Array, Array, Array]:
    """Carry the errors of everything that fixed a pose over to it (eq. 12, and the map's).

    Args:
        agrees: (M,) of ``supported``, like the three after the inverse.
        inverse: (6, 6) of its normal matrix.
        j_poses: (M, 2, 6).
        j_points: (M, 2, 3).
        informations: (M + 1, 3).
        noises: (M, 3) xx xy yy of each pixel, new in every frame, px^2.
        misplaced: (M, 3) the same of what is alike in every frame, px^2.
        owns: (M, 3) 1-sigma displacement of each landmark by its own depth, world, m.
        landmarks: (M,) rows of ``levers``.
        levers: (N, 3, K) landmark error per keyframe error.

    Returns:
        (M,) leverage of each; (3, 6, 6) covariance by pixel noise, by misplacement, by the
        landmarks' own errors; (6, K) lever of the keyframes.
    """
    m, k = len(agrees), levers.shape[2]
    leverage, covariances, lever = np.zeros(m), np.zeros((3, 6, 6)), np.zeros((6, k))
    gain, by_point = np.empty((6, 2)), np.empty((6, 3))
    depth = np.empty(6)
    for i in range(m):
        if agrees[i] == 0:
            continue
        j = j_poses[i]
        xx, xy, yy = informations[i, 0], informations[i, 1], informations[i, 2]
        for c in range(6):
            a, b = 0.0, 0.0
            for d in range(6):
                a += inverse[c, d] * j[0, d]
                b += inverse[c, d] * j[1, d]
            gain[c, 0], gain[c, 1] = a * xx + b * xy, a * xy + b * yy
        oxx, oxy, oyx, oyy = 0.0, 0.0, 0.0, 0.0
        for c in range(6):
            oxx += j[0, c] * gain[c, 0]
            oxy += j[0, c] * gain[c, 1]
            oyx += j[1, c] * gain[c, 0]
            oyy += j[1, c] * gain[c, 1]
        half, det = 0.5 * (oxx + oyy), oxx * oyy - oxy * oyx
        leverage[i] = half + math.sqrt(max(half * half - det, 0.0))
        landmark = landmarks[i]
        for c in range(6):
            depth[c] = 0.0
            for r in range(3):
                by_point[c, r] = -(gain[c, 0] * j_points[i, 0, r] + gain[c, 1] * j_points[i, 1, r])
                depth[c] += by_point[c, r] * owns[i, r]
                for d in range(k):
                    lever[c, d] += by_point[c, r] * levers[landmark, r, d]
        for c in range(6):
            g0, g1 = gain[c, 0], gain[c, 1]
            n0, n1 = g0 * noises[i, 0] + g1 * noises[i, 1], g0 * noises[i, 1] + g1 * noises[i, 2]
            b0 = g0 * misplaced[i, 0] + g1 * misplaced[i, 1]
            b1 = g0 * misplaced[i, 1] + g1 * misplaced[i, 2]
            for d in range(c + 1):
                covariances[0, c, d] += n0 * gain[d, 0] + n1 * gain[d, 1]
                covariances[1, c, d] += b0 * gain[d, 0] + b1 * gain[d, 1]
                covariances[2, c, d] += depth[c] * depth[d]
    for part in range(3):
        for c in range(6):
            for d in range(c):
                covariances[part, d, c] = covariances[part, c, d]
    return leverage, covariances, lever


@compiled
def linearized_at(
    pose: Array,
    body_from_cam: Array,
    ideal: Array,
    slope: Array,
    point: Array,
    residual: Array,
    j_pose: Array,
    j_point: Array,
) -> bool:
    """Fill one residual, px, and its Jacobians (``bundle.linearized``); False behind the camera."""
    d0, d1, d2 = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    p = (
        pose[0, 0] * d0 + pose[1, 0] * d1 + pose[2, 0] * d2,
        pose[0, 1] * d0 + pose[1, 1] * d1 + pose[2, 1] * d2,
        pose[0, 2] * d0 + pose[1, 2] * d1 + pose[2, 2] * d2,
    )
    b0, b1, b2 = p[0] - body_from_cam[0, 3], p[1] - body_from_cam[1, 3], p[2] - body_from_cam[2, 3]
    z = body_from_cam[0, 2] * b0 + body_from_cam[1, 2] * b1 + body_from_cam[2, 2] * b2
    if not z > _MIN_DEPTH_M:
        return False
    x = (body_from_cam[0, 0] * b0 + body_from_cam[1, 0] * b1 + body_from_cam[2, 0] * b2) / z
    y = (body_from_cam[0, 1] * b0 + body_from_cam[1, 1] * b1 + body_from_cam[2, 1] * b2) / z
    dx, dy = x - ideal[0], y - ideal[1]
    for r in range(2):
        sx, sy = slope[r, 0], slope[r, 1]
        residual[r] = sx * dx + sy * dy
        c0, c1, c2 = sx / z, sy / z, -(sx * x + sy * y) / z
        g0 = c0 * body_from_cam[0, 0] + c1 * body_from_cam[0, 1] + c2 * body_from_cam[0, 2]
        g1 = c0 * body_from_cam[1, 0] + c1 * body_from_cam[1, 1] + c2 * body_from_cam[1, 2]
        g2 = c0 * body_from_cam[2, 0] + c1 * body_from_cam[2, 1] + c2 * body_from_cam[2, 2]
        j_pose[r, 0], j_pose[r, 1], j_pose[r, 2] = -g0, -g1, -g2
        j_pose[r, 3] = g1 * p[2] - g2 * p[1]
        j_pose[r, 4] = g2 * p[0] - g0 * p[2]
        j_pose[r, 5] = g0 * p[1] - g1 * p[0]
        for c in range(3):
            j_point[r, c] = g0 * pose[c, 0] + g1 * pose[c, 1] + g2 * pose[c, 2]
    return True


@compiled
def informed(
    residual: Array, j_point: Array, point_covariance: Array, pixel_covariance: Array, out: Array
) -> float:
    """Fill xx, xy, yy of a residual's information; return its squared Mahalanobis length."""
    xx, xy, yy = pixel_covariance[0], pixel_covariance[1], pixel_covariance[2]
    m = point_covariance
    x0, x1, x2 = j_point[0, 0], j_point[0, 1], j_point[0, 2]
    y0, y1, y2 = j_point[1, 0], j_point[1, 1], j_point[1, 2]
    mx0 = m[0] * x0 + m[1] * x1 + m[2] * x2
    mx1 = m[1] * x0 + m[3] * x1 + m[4] * x2
    mx2 = m[2] * x0 + m[4] * x1 + m[5] * x2
    xx += x0 * mx0 + x1 * mx1 + x2 * mx2
    xy += y0 * mx0 + y1 * mx1 + y2 * mx2
    yy += (
        m[0] * y0 * y0 + m[3] * y1 * y1 + m[5] * y2 * y2
        + 2.0 * (m[1] * y0 * y1 + m[2] * y0 * y2 + m[4] * y1 * y2)
    )  # fmt: skip
    determinant = xx * yy - xy * xy
    out[0], out[1], out[2] = yy / determinant, -xy / determinant, xx / determinant
    a, b = residual[0], residual[1]
    return float(out[0] * a * a + 2.0 * out[1] * a * b + out[2] * b * b)


@compiled
def _solved(normal: Array, rhs: Array, step: Array) -> bool:
    """Fill the solution of (6, 6) normal equations by Cholesky; False where there is none.

    LAPACK's solver would raise, in the middle of a frame.
    """
    root = np.zeros((6, 6))
    for c in range(6):
        left = normal[c, c]
        for k in range(c):
            left -= root[c, k] ** 2
        if not left > _LEAST_PIVOT * normal[c, c]:
            return False
        root[c, c] = math.sqrt(left)
        for d in range(c + 1, 6):
            below = normal[d, c]
            for k in range(c):
                below -= root[d, k] * root[c, k]
            root[d, c] = below / root[c, c]
    for c in range(6):
        step[c] = rhs[c]
        for k in range(c):
            step[c] -= root[c, k] * step[k]
        step[c] /= root[c, c]
    for c in range(5, -1, -1):
        for k in range(c + 1, 6):
            step[c] -= root[k, c] * step[k]
        step[c] /= root[c, c]
    return True


@compiled
def _retract(pose: Array, step: Array) -> None:
    """Move a (3, 4) pose by a local perturbation, in place (``Pose.retracted``)."""
    rotation = pose[:, :3].copy()
    for r in range(3):
        pose[r, 3] += rotation[r, 0] * step[0] + rotation[r, 1] * step[1] + rotation[r, 2] * step[2]
    x, y, z = step[3], step[4], step[5]
    angle = math.sqrt(x * x + y * y + z * z)
    first, second = 1.0, 0.5
    if angle > 1e-6:
        first, second = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle**2
    turn = np.empty((3, 3))
    turn[0, 0], turn[1, 1], turn[2, 2] = (
        1.0 - second * (y * y + z * z),
        1.0 - second * (x * x + z * z),
        1.0 - second * (x * x + y * y),
    )
    turn[0, 1], turn[1, 0] = second * x * y - first * z, second * x * y + first * z
    turn[0, 2], turn[2, 0] = second * x * z + first * y, second * x * z - first * y
    turn[1, 2], turn[2, 1] = second * y * z - first * x, second * y * z + first * x
    pose[:, :3] = rotation @ turn


@compiled
def _local(start: Array, now: Array) -> Array:
    """Return (6,) the local perturbation from one (3, 4) pose to another, small angles."""
    out = np.empty(6)
    relative = start[:, :3].T.copy() @ now[:, :3].copy()
    moved = now[:, 3] - start[:, 3]
    for r in range(3):
        out[r] = start[0, r] * moved[0] + start[1, r] * moved[1] + start[2, r] * moved[2]
    out[3] = 0.5 * (relative[2, 1] - relative[1, 2])
    out[4] = 0.5 * (relative[0, 2] - relative[2, 0])
    out[5] = 0.5 * (relative[1, 0] - relative[0, 1])
    return out
