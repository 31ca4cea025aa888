"""The refinement of a pose over many sightings, compiled (eq. 4).

What ``vision.resection`` does in arrays of all sightings, in loops, for as many
sightings as patches give: same weights, same steps, same pose.

Sightings are laid out in blocks of ``_BLOCK``, number by number: first one number
of each of them, then the next number, so that the compiler takes several at once.
What is behind the last one is zero, and is no sighting.

  sighted (_N_SIGHTED * _BLOCK,): ideal x, y; slopes of the lens (4); point (3); its covariance
    xx xy xz yy yz zz; that of the pixel xx xy yy; 1, or 0 for none
  whitened (_N_WHITENED * _BLOCK,), errors in units of their sigma, what is first and what else
    is second by Cholesky's root G of a residual's covariance, of which residual = G whitened:
    the first by the pose (6), the first itself; the second likewise (7); the first by the
    point (3), the second (3); G's xx, yx, yy; the squared length; the weight
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled, reordered
from vcl_companion.geometry.rotation import Array

Ints = NDArray[np.int64]

_BLOCK = 64
_N_SIGHTED, _N_WHITENED = 19, 25
_IDEAL, _SLOPES, _POINT, _SPREAD, _PIXEL, _IS = (_BLOCK * k for k in (0, 2, 6, 9, 15, 18))
_FIRST, _SECOND, _BY_POINT, _ROOT, _SQUARED, _WEIGHT = (_BLOCK * k for k in (0, 7, 14, 20, 23, 24))
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
    blocks = _laid_out(ideal, slopes, points, point_covariances, pixel_covariances)
    whitened = np.empty(_N_WHITENED * _BLOCK)
    sums, step = np.empty((7, 7)), np.empty(6)
    for k in range(len(scales)):
        scale = scales[k]
        for _ in range(4):
            sums[:] = 0.0
            if prior_information[0, 0] > 0.0:
                sums[:6, :6] = prior_information
                sums[6, :6] = prior_information @ _local(start, now)
            # Not one after the other: numba would not know that each lies without gaps.
            for b in range(len(blocks)):
                _whiten(now, body_from_cam, blocks[b], whitened)
                _weigh(blocks[b], whitened, scale, np.inf)
                _add_up(whitened, sums)
            if not _solved(sums, step):
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
) -> tuple[NDArray[np.bool_], Array, Array, Array, Array, Array, float]:
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
        (M,) who agrees; (6, 6) their normal matrix; (2, 6, M) and (2, 3, M) whitened residuals
        by pose and by point, (3, M) the roots of their covariances, xx yx yy, px, and (M,)
        their weights, zero for those who do not agree; the sum of squared residuals of those
        who do, px^2.
    """
    m = len(points)
    agrees, weights = np.zeros(m, np.bool_), np.empty(m)
    j_poses, j_points, roots = np.empty((2, 6, m)), np.empty((2, 3, m)), np.empty((3, m))
    blocks = _laid_out(ideal, slopes, points, point_covariances, pixel_covariances)
    whitened = np.empty(_N_WHITENED * _BLOCK)
    sums, squared_px = np.zeros((7, 7)), 0.0
    for k in range(len(blocks)):
        _whiten(pose, body_from_cam, blocks[k], whitened)
        _weigh(blocks[k], whitened, 1.0, largest)
        _add_up(whitened, sums)
        begin = k * _BLOCK
        n = min(_BLOCK, m - begin)
        for i in range(n):
            for c in range(6):
                j_poses[0, c, begin + i] = whitened[_FIRST + c * _BLOCK + i]
                j_poses[1, c, begin + i] = whitened[_SECOND + c * _BLOCK + i]
            for c in range(3):
                j_points[0, c, begin + i] = whitened[_BY_POINT + c * _BLOCK + i]
                j_points[1, c, begin + i] = whitened[_BY_POINT + (3 + c) * _BLOCK + i]
                roots[c, begin + i] = whitened[_ROOT + c * _BLOCK + i]
            weights[begin + i] = whitened[_WEIGHT + i]
            if not whitened[_SQUARED + i] < largest:
                continue
            agrees[begin + i] = True
            u, v = whitened[_FIRST + 6 * _BLOCK + i], whitened[_SECOND + 6 * _BLOCK + i]
            x = whitened[_ROOT + i] * u
            y = whitened[_ROOT + _BLOCK + i] * u + whitened[_ROOT + 2 * _BLOCK + i] * v
            squared_px += x * x + y * y
    normal = sums[:6, :6].copy()
    for c in range(6):
        for d in range(c):
            normal[d, c] = normal[c, d]
    return agrees, normal, j_poses, j_points, roots, weights, squared_px


@compiled
def _laid_out(
    ideal: Array, slopes: Array, points: Array, point_covariances: Array, pixel_covariances: Array
) -> Array:
    """Return (ceil(M / _BLOCK), _N_SIGHTED * _BLOCK) sightings, see the module."""
    m = len(points)
    out = np.zeros(((m + _BLOCK - 1) // _BLOCK, _N_SIGHTED * _BLOCK))
    # None has slopes of zero, so it says nothing; but it has a covariance.
    out[:, _PIXEL : _PIXEL + _BLOCK] = 1.0
    out[:, _PIXEL + 2 * _BLOCK : _PIXEL + 3 * _BLOCK] = 1.0
    for j in range(m):
        block, i = out[j // _BLOCK], j % _BLOCK
        for c in range(2):
            block[_IDEAL + c * _BLOCK + i] = ideal[j, c]
            block[_SLOPES + c * _BLOCK + i] = slopes[j, 0, c]
            block[_SLOPES + (2 + c) * _BLOCK + i] = slopes[j, 1, c]
        for c in range(3):
            block[_POINT + c * _BLOCK + i] = points[j, c]
            block[_PIXEL + c * _BLOCK + i] = pixel_covariances[j, c]
        for c in range(6):
            block[_SPREAD + c * _BLOCK + i] = point_covariances[j, c]
        block[_IS + i] = 1.0
    return out


@reordered
def _whiten(pose: Array, body_from_cam: Array, sighted: Array, out: Array) -> None:
    """Fill all but the weights of a block, see the module; behind the camera it is infinitely off.

    The derivatives are those of ``bundle.linearized``.
    """
    r00, r01, r02, t0 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    r10, r11, r12, t1 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    r20, r21, r22, t2 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    m = body_from_cam
    m00, m01, m02, m03 = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
    m10, m11, m12, m13 = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
    m20, m21, m22, m23 = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
    for i in range(_BLOCK):
        d0 = sighted[_POINT + i] - t0
        d1 = sighted[_POINT + _BLOCK + i] - t1
        d2 = sighted[_POINT + 2 * _BLOCK + i] - t2
        # In body axes, then from the camera.
        p0 = r00 * d0 + r10 * d1 + r20 * d2
        p1 = r01 * d0 + r11 * d1 + r21 * d2
        p2 = r02 * d0 + r12 * d1 + r22 * d2
        b0, b1, b2 = p0 - m03, p1 - m13, p2 - m23
        depth = m02 * b0 + m12 * b1 + m22 * b2
        is_ahead = depth > _MIN_DEPTH_M
        z = depth if is_ahead else 1.0
        x = (m00 * b0 + m10 * b1 + m20 * b2) / z
        y = (m01 * b0 + m11 * b1 + m21 * b2) / z
        dx, dy = x - sighted[_IDEAL + i], y - sighted[_IDEAL + _BLOCK + i]
        # By the point: the column u, in camera, body and world axes, then the row v.
        sx, sy = sighted[_SLOPES + i] / z, sighted[_SLOPES + _BLOCK + i] / z
        s = -(sx * x + sy * y)
        u0, u1, u2 = m00 * sx + m01 * sy, m10 * sx + m11 * sy, m20 * sx + m21 * sy
        u0, u1, u2 = u0 + m02 * s, u1 + m12 * s, u2 + m22 * s
        u_off = (sx * dx + sy * dy) * z
        uw0 = r00 * u0 + r01 * u1 + r02 * u2
        uw1 = r10 * u0 + r11 * u1 + r12 * u2
        uw2 = r20 * u0 + r21 * u1 + r22 * u2
        sx, sy = sighted[_SLOPES + 2 * _BLOCK + i] / z, sighted[_SLOPES + 3 * _BLOCK + i] / z
        s = -(sx * x + sy * y)
        v0, v1, v2 = m00 * sx + m01 * sy, m10 * sx + m11 * sy, m20 * sx + m21 * sy
        v0, v1, v2 = v0 + m02 * s, v1 + m12 * s, v2 + m22 * s
        v_off = (sx * dx + sy * dy) * z
        vw0 = r00 * v0 + r01 * v1 + r02 * v2
        vw1 = r10 * v0 + r11 * v1 + r12 * v2
        vw2 = r20 * v0 + r21 * v1 + r22 * v2
        # The residual's covariance, its root, and what that leaves of everything.
        cxx, cxy = sighted[_SPREAD + i], sighted[_SPREAD + _BLOCK + i]
        cxz, cyy = sighted[_SPREAD + 2 * _BLOCK + i], sighted[_SPREAD + 3 * _BLOCK + i]
        cyz, czz = sighted[_SPREAD + 4 * _BLOCK + i], sighted[_SPREAD + 5 * _BLOCK + i]
        k0 = cxx * uw0 + cxy * uw1 + cxz * uw2
        k1 = cxy * uw0 + cyy * uw1 + cyz * uw2
        k2 = cxz * uw0 + cyz * uw1 + czz * uw2
        xx = sighted[_PIXEL + i] + uw0 * k0 + uw1 * k1 + uw2 * k2
        xy = sighted[_PIXEL + _BLOCK + i] + vw0 * k0 + vw1 * k1 + vw2 * k2
        yy = sighted[_PIXEL + 2 * _BLOCK + i] + (
            cxx * vw0 * vw0 + cyy * vw1 * vw1 + czz * vw2 * vw2
            + 2.0 * (cxy * vw0 * vw1 + cxz * vw0 * vw2 + cyz * vw1 * vw2)
        )  # fmt: skip
        g = math.sqrt(xx)
        mixed = xy / g
        h = math.sqrt(max(yy - mixed * mixed, _LEAST_PIVOT * yy))
        first, second = 1.0 / g, 1.0 / h
        u0, u1, u2, u_off = u0 * first, u1 * first, u2 * first, u_off * first
        v0, v1, v2 = (
            (v0 - mixed * u0) * second,
            (v1 - mixed * u1) * second,
            (v2 - mixed * u2) * second,
        )
        v_off = (v_off - mixed * u_off) * second
        uw0, uw1, uw2 = uw0 * first, uw1 * first, uw2 * first
        out[_FIRST + i], out[_FIRST + _BLOCK + i], out[_FIRST + 2 * _BLOCK + i] = -u0, -u1, -u2
        out[_FIRST + 3 * _BLOCK + i] = u1 * p2 - u2 * p1
        out[_FIRST + 4 * _BLOCK + i] = u2 * p0 - u0 * p2
        out[_FIRST + 5 * _BLOCK + i] = u0 * p1 - u1 * p0
        out[_FIRST + 6 * _BLOCK + i] = u_off
        out[_SECOND + i], out[_SECOND + _BLOCK + i], out[_SECOND + 2 * _BLOCK + i] = -v0, -v1, -v2
        out[_SECOND + 3 * _BLOCK + i] = v1 * p2 - v2 * p1
        out[_SECOND + 4 * _BLOCK + i] = v2 * p0 - v0 * p2
        out[_SECOND + 5 * _BLOCK + i] = v0 * p1 - v1 * p0
        out[_SECOND + 6 * _BLOCK + i] = v_off
        out[_BY_POINT + i] = uw0
        out[_BY_POINT + _BLOCK + i] = uw1
        out[_BY_POINT + 2 * _BLOCK + i] = uw2
        out[_BY_POINT + 3 * _BLOCK + i] = (vw0 - mixed * uw0) * second
        out[_BY_POINT + 4 * _BLOCK + i] = (vw1 - mixed * uw1) * second
        out[_BY_POINT + 5 * _BLOCK + i] = (vw2 - mixed * uw2) * second
        out[_ROOT + i], out[_ROOT + _BLOCK + i], out[_ROOT + 2 * _BLOCK + i] = g, mixed, h
        squared = u_off * u_off + v_off * v_off
        out[_SQUARED + i] = squared if is_ahead else np.inf


@compiled
def _weigh(sighted: Array, whitened: Array, scale: float, largest: float) -> None:
    """Fill the weights of a block: redescending, of a noise so many times larger."""
    precision = 1.0 / (scale * scale)
    for i in range(_BLOCK):
        squared = whitened[_SQUARED + i]
        far = 1.0 + 0.25 * precision * squared
        weight = sighted[_IS + i] * precision / (far * far)
        whitened[_WEIGHT + i] = weight if squared < largest else 0.0


@reordered
def _add_up(whitened: Array, sums: Array) -> None:
    """Add a block's products to (7, 7) of the pose's six with each other and with the residual.

    Only the lower half.
    """
    first, second = np.empty(_BLOCK), np.empty(_BLOCK)
    weights = whitened[_WEIGHT : _WEIGHT + _BLOCK]
    for c in range(7):
        a = whitened[_FIRST + c * _BLOCK : _FIRST + (c + 1) * _BLOCK]
        b = whitened[_SECOND + c * _BLOCK : _SECOND + (c + 1) * _BLOCK]
        for i in range(_BLOCK):
            first[i], second[i] = weights[i] * a[i], weights[i] * b[i]
        for d in range(c + 1):
            a = whitened[_FIRST + d * _BLOCK : _FIRST + (d + 1) * _BLOCK]
            b = whitened[_SECOND + d * _BLOCK : _SECOND + (d + 1) * _BLOCK]
            total = 0.0
            for i in range(_BLOCK):
                total += first[i] * a[i] + second[i] * b[i]
            sums[c, d] += total


@compiled
def _solved(sums: Array, step: Array) -> bool:
    """Fill the solution of normal equations (``_add_up``) by Cholesky; False where there is none.

    LAPACK's solver would raise, in the middle of a frame.
    """
    root = np.zeros((6, 6))
    for c in range(6):
        left = sums[c, c]
        for k in range(c):
            left -= root[c, k] ** 2
        if not left > _LEAST_PIVOT * sums[c, c]:
            return False
        root[c, c] = math.sqrt(left)
        for d in range(c + 1, 6):
            below = sums[d, c]
            for k in range(c):
                below -= root[d, k] * root[c, k]
            root[d, c] = below / root[c, c]
    for c in range(6):
        step[c] = -sums[6, c]
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
