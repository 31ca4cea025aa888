"""Camera poses from three landmarks (P3P), compiled.

M. Persson and K. Nordberg, Lambda Twist: An accurate fast robust perspective
three point solver, ECCV 2018: two quadratic cones in the three depths, their
degenerate member by one cubic, two planes of it, two quadratics. The planes are
parametrised by a basis of each, so that no depth is special.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, orthonormalized

SAMPLE_SIZE = 3
MAX_MODELS = 4


def p3p(rays: Array, points: Array) -> list[Pose]:
    """Find every pose from which three landmarks appear along three rays, in front of the camera.

    Args:
        rays: (3, 3) directions in the camera frame, any length.
        points: (3, 3) landmarks, world frame, m.

    Returns:
        At most 4 poses cam_from_world; none for three landmarks on one line, or
        when rounding leaves no solution.
    """
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    sample = np.arange(SAMPLE_SIZE, dtype=np.int64)[None]
    found = poses_of_samples(
        np.array(unit, dtype=np.float64, order="C"),
        np.array(points, dtype=np.float64, order="C"),
        sample,
    )
    return [Pose(orthonormalized(matrix[:, :3]), matrix[:, 3]) for matrix in found]


@compiled
def poses_of_samples(rays: Array, points: Array, samples: NDArray[np.int64]) -> Array:
    """Return the (K, 3, 4) cam_from_world of all (B, 3) samples of (N, 3) unit rays and points."""
    found = np.empty((len(samples) * 4, 3, 4))
    count = 0
    y, x = np.empty((3, 3)), np.empty((3, 3))
    depths = np.empty((4, 3))
    for k in range(len(samples)):
        for i in range(3):
            for j in range(3):
                y[i, j] = rays[samples[k, i], j]
                x[i, j] = points[samples[k, i], j]
        for r in range(_depths(y, x, depths)):
            if _pose(y, x, depths[r], found[count]):
                count += 1
    return found[:count].copy()


@compiled
def _depths(y: Array, x: Array, depths: Array) -> int:
    """Fill the depths along three rays that give the points' mutual distances; return how many."""
    # Pairs 12, 13, 23: l_i^2 + l_j^2 - 2 c_ij l_i l_j = a_ij
    first, second = (0, 0, 1), (1, 2, 2)
    a, c = np.zeros(3), np.zeros(3)
    for pair in range(3):
        i, j = first[pair], second[pair]
        for k in range(3):
            a[pair] += (x[i, k] - x[j, k]) ** 2
            c[pair] += y[i, k] * y[j, k]
    if not min(a[0], a[1], a[2]) > 0.0:
        return 0
    scale = max(a[0], a[1], a[2])
    a /= scale
    one, other = np.zeros((3, 3)), np.zeros((3, 3))
    _add_form(one, 0, 1, c[0], a[2])
    _add_form(one, 1, 2, c[2], -a[0])
    _add_form(other, 0, 2, c[1], a[2])
    _add_form(other, 1, 2, c[2], -a[1])
    one, other = _steep_pair(one, other)
    lead = _det(other)
    if lead == 0.0:
        return 0
    gamma = _real_root(_mixed(other, one) / lead, _mixed(one, other) / lead, _det(one) / lead)
    degenerate = one + gamma * other
    values, vectors = np.linalg.eigh(degenerate)
    # One eigenvalue is zero; lines are real where the other two differ in sign.
    if not values[0] < 0.0 < values[2]:
        return 0
    ratio = np.sqrt(-values[0] / values[2])
    count = 0
    direction = np.empty(3)
    for sign in (-1.0, 1.0):
        # The plane vectors[:, 2] . l = sign ratio vectors[:, 0] . l
        along = vectors[:, 1]
        across = vectors[:, 0] + sign * ratio * vectors[:, 2]
        # There, one = -gamma other: the larger of the two tells where it vanishes.
        cone = other if abs(gamma) < 1.0 else one
        p, q, r = (
            _form(cone, across, across),
            _form(cone, across, along),
            _form(cone, along, along),
        )
        # p u^2 + 2 q u v + r v^2 = 0 for l = u across + v along
        under = q * q - p * r
        if under < 0.0:
            if under < -1e-9 * (q * q + abs(p * r)):
                continue
            under = 0.0
        big = -(q + np.copysign(np.sqrt(under), q))
        for branch in range(2):
            u, v = (big, p) if branch == 0 else (r, big)
            for i in range(3):
                direction[i] = u * across[i] + v * along[i]
            if direction[0] < 0.0:
                direction = -direction
            if not min(direction[0], direction[1], direction[2]) > 0.0:
                continue
            far = np.argmax(a)
            u, v = direction[first[far]], direction[second[far]]
            size = u * u + v * v - 2.0 * c[far] * u * v
            if not size > 0.0 or count == 4:
                continue
            factor = np.sqrt(a[far] / size)
            for i in range(3):
                depths[count, i] = factor * direction[i]
            if _polished(depths[count], a, c):
                for i in range(3):
                    depths[count, i] *= np.sqrt(scale)
                count += 1
    return count


@compiled
def _add_form(form: Array, i: int, j: int, cosine: float, weight: float) -> None:
    """Add weight times (l_i^2 + l_j^2 - 2 cosine l_i l_j) to a (3, 3) quadratic form."""
    form[i, i] += weight
    form[j, j] += weight
    form[i, j] -= weight * cosine
    form[j, i] -= weight * cosine


@compiled
def _steep_pair(one: Array, other: Array) -> tuple[Array, Array]:
    """Return two other members of a pencil of forms, the second as far as can be from degenerate.

    Where the triangle or the view is symmetric, both given ones are degenerate.
    """
    best, cosine, sine = 0.0, 1.0, 0.0
    # A cubic form vanishes in three directions at most.
    for k in range(5):
        c, s = np.cos(0.2 * np.pi * (k + 0.5)), np.sin(0.2 * np.pi * (k + 0.5))
        size = abs(_det(c * one + s * other))
        if size > best:
            best, cosine, sine = size, c, s
    return sine * one - cosine * other, cosine * one + sine * other


@compiled
def _det(m: Array) -> float:
    return float(
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
        - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
        + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
    )


@compiled
def _mixed(m: Array, n: Array) -> float:
    """Return the coefficient of s in det(m + s n)."""
    total = 0.0
    for i in range(3):
        for j in range(3):
            i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            total += n[i, j] * (m[i1, j1] * m[i2, j2] - m[i1, j2] * m[i2, j1])
    return total


@compiled
def _form(m: Array, u: Array, v: Array) -> float:
    total = 0.0
    for i in range(3):
        for j in range(3):
            total += u[i] * m[i, j] * v[j]
    return total


@compiled
def _real_root(b: float, c: float, d: float) -> float:
    """Return a real root of x^3 + b x^2 + c x + d, the one farthest from its neighbours."""
    shift = b / 3.0
    p = c - b * shift
    q = 2.0 * shift**3 - shift * c + d
    if q * q / 4.0 + p**3 / 27.0 > 0.0:
        inner = -0.5 * q - np.copysign(np.sqrt(q * q / 4.0 + p**3 / 27.0), q)
        cube = np.copysign(abs(inner) ** (1.0 / 3.0), inner)
        x = cube - p / (3.0 * cube) - shift
    else:
        # Of three, the one farthest from zero, which is the one farthest from the other two.
        radius = np.sqrt(max(-p / 3.0, 0.0))
        cosine = min(0.5 * abs(q) / radius**3, 1.0) if radius > 0.0 else 1.0
        x = -np.copysign(2.0 * radius * np.cos(np.arccos(cosine) / 3.0), q)
        x -= shift
    for _ in range(3):
        slope = (3.0 * x + 2.0 * b) * x + c
        if slope == 0.0:
            break
        x -= (((x + b) * x + c) * x + d) / slope
    return float(x)


@compiled
def _polished(depth: Array, a: Array, c: Array) -> bool:
    """Two Newton steps on the three distances; False when they run away."""
    for _ in range(3):
        l1, l2, l3 = depth[0], depth[1], depth[2]
        r12 = l1 * l1 + l2 * l2 - 2.0 * c[0] * l1 * l2 - a[0]
        r13 = l1 * l1 + l3 * l3 - 2.0 * c[1] * l1 * l3 - a[1]
        r23 = l2 * l2 + l3 * l3 - 2.0 * c[2] * l2 * l3 - a[2]
        if abs(r12) + abs(r13) + abs(r23) < 1e-15:
            break
        d12, d21 = l1 - c[0] * l2, l2 - c[0] * l1
        d13, d31 = l1 - c[1] * l3, l3 - c[1] * l1
        d23, d32 = l2 - c[2] * l3, l3 - c[2] * l2
        determinant = -2.0 * (d12 * d31 * d23 + d21 * d13 * d32)
        if determinant == 0.0:
            break
        depth[0] -= (-d31 * d23 * r12 - d21 * d32 * r13 + d21 * d31 * r23) / determinant
        depth[1] -= (-d13 * d32 * r12 + d12 * d32 * r13 - d12 * d31 * r23) / determinant
        depth[2] -= (d13 * d23 * r12 - d12 * d23 * r13 - d21 * d13 * r23) / determinant
    residual = (
        abs(depth[0] ** 2 + depth[1] ** 2 - 2.0 * c[0] * depth[0] * depth[1] - a[0])
        + abs(depth[0] ** 2 + depth[2] ** 2 - 2.0 * c[1] * depth[0] * depth[2] - a[1])
        + abs(depth[1] ** 2 + depth[2] ** 2 - 2.0 * c[2] * depth[1] * depth[2] - a[2])
    )
    return bool(min(depth[0], depth[1], depth[2]) > 0.0 and residual < 1e-6)


@compiled
def _pose(y: Array, x: Array, depth: Array, out: Array) -> bool:
    """Write the (3, 4) pose that takes the points to their places on the rays."""
    seen, real = np.empty((3, 3)), np.empty((3, 3))
    for j in range(3):
        seen[j, 0] = depth[1] * y[1, j] - depth[0] * y[0, j]
        seen[j, 1] = depth[2] * y[2, j] - depth[0] * y[0, j]
        real[j, 0] = x[1, j] - x[0, j]
        real[j, 1] = x[2, j] - x[0, j]
    if not (_triad(seen) and _triad(real)):
        return False
    for i in range(3):
        out[i, 3] = depth[0] * y[0, i]
        for j in range(3):
            out[i, j] = seen[i, 0] * real[j, 0] + seen[i, 1] * real[j, 1] + seen[i, 2] * real[j, 2]
        for j in range(3):
            out[i, 3] -= out[i, j] * x[0, j]
    return True


@compiled
def _triad(m: Array) -> bool:
    """Make three axes of two columns; False when these are parallel."""
    norm = np.sqrt(m[0, 0] ** 2 + m[1, 0] ** 2 + m[2, 0] ** 2)
    length = np.sqrt(m[0, 1] ** 2 + m[1, 1] ** 2 + m[2, 1] ** 2)
    if not (norm > 0.0 and length > 0.0):
        return False
    dot = 0.0
    for j in range(3):
        m[j, 0] /= norm
        m[j, 1] /= length
        dot += m[j, 0] * m[j, 1]
    for j in range(3):
        m[j, 1] -= dot * m[j, 0]
    rest = np.sqrt(m[0, 1] ** 2 + m[1, 1] ** 2 + m[2, 1] ** 2)
    if not rest > 1e-9:
        return False
    for j in range(3):
        m[j, 1] /= rest
    m[0, 2] = m[1, 0] * m[2, 1] - m[2, 0] * m[1, 1]
    m[1, 2] = m[2, 0] * m[0, 1] - m[0, 0] * m[2, 1]
    m[2, 2] = m[0, 0] * m[1, 1] - m[1, 0] * m[0, 1]
    return True
