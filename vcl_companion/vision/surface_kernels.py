"""How surfaces are inclined around landmarks, by their neighbours' depths; compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

_ROUNDS = 6
# Of surfaces that stand anyhow many are steep: a street recedes by more than five times its width.
_TAIL = 3.0
# Two neighbours in about one direction span no plane.
_LEAST_SINE = 0.2


@compiled
def inclinations(
    ideal: Array,
    inverse_depth: Array,
    sigma: Array,
    other: NDArray[np.int64],
    distance: Array,
    reach: float,
    inclination: float,
) -> Array:
    """Return (N, 2) slopes of the inverse depth by ideal x and y at each landmark.

    On a plane inverse depth is linear in the ideal image coordinates. A robust fit to the
    neighbours, weighted by how near and how well known they are, begun from the plane through the
    landmark and two of them that explains most of the others: where a wall meets the ground, half
    of them are on the other one. Where few are near, or they disagree, the surface faces the
    camera.

    Args:
        ideal: (N, 2) x/z, y/z in one camera.
        inverse_depth: (N,) 1/z, 1/m.
        sigma: (N,) of it.
        other: (N, K) neighbours, itself among them.
        distance: (N, K) to them, px.
        reach: neighbours farther away do not count, px.
        inclination: surfaces are believed to be inclined by, tangent, 1 sigma; a few by far more.
    """
    n, k = other.shape
    out = np.empty((n, 2))
    near = np.empty((k, 5))
    s = np.empty(3)
    for j in range(n):
        x, y, r = ideal[j, 0], ideal[j, 1], inverse_depth[j]
        length2 = 1.0 + x * x + y * y
        facing = x * r / length2, y * r / length2
        stiff = 1.0 / (inclination * r) ** 2
        m = 0
        for q in range(k):
            o = other[j, q]
            if distance[j, q] > reach:
                continue
            near[m, 0], near[m, 1] = ideal[o, 0] - x, ideal[o, 1] - y
            near[m, 2] = inverse_depth[o] - r
            near[m, 3] = sigma[o] ** 2 + sigma[j] ** 2
            near[m, 4] = np.exp(-2.0 * (distance[j, q] / reach) ** 2)
            m += 1
        s[0], s[1], s[2] = 0.0, facing[0], facing[1]
        _begin(s, near[:m], facing, stiff)
        for _ in range(_ROUNDS):
            _fit(s, near[:m], facing, stiff, 1e-9 / sigma[j] ** 2)
        out[j, 0], out[j, 1] = s[1], s[2]
    return out


@compiled
def _begin(s: Array, near: Array, facing: tuple[float, float], stiff: float) -> None:
    """Choose of the planes through two neighbours, and of that which faces the camera, the best."""
    m = len(near)
    least = _cost(s[1], s[2], near, facing, stiff)
    for a in range(m):
        for b in range(a):
            determinant = near[a, 0] * near[b, 1] - near[b, 0] * near[a, 1]
            size = (near[a, 0] ** 2 + near[a, 1] ** 2) * (near[b, 0] ** 2 + near[b, 1] ** 2)
            if determinant * determinant < _LEAST_SINE**2 * size or size == 0.0:
                continue
            by_x = (near[a, 2] * near[b, 1] - near[b, 2] * near[a, 1]) / determinant
            by_y = (near[a, 0] * near[b, 2] - near[b, 0] * near[a, 2]) / determinant
            cost = _cost(by_x, by_y, near, facing, stiff)
            if cost < least:
                least, s[1], s[2] = cost, by_x, by_y


@compiled
def _cost(
    by_x: float, by_y: float, near: Array, facing: tuple[float, float], stiff: float
) -> float:
    """Return what a plane through the landmark leaves unexplained (Geman-McClure)."""
    steep = stiff * ((by_x - facing[0]) ** 2 + (by_y - facing[1]) ** 2)
    cost = _TAIL * math.log1p(steep / _TAIL)
    for q in range(len(near)):
        error = near[q, 2] - by_x * near[q, 0] - by_y * near[q, 1]
        squared = error * error / near[q, 3]
        cost += near[q, 4] * squared / (1.0 + 0.25 * squared)
    return cost


@compiled
def _fit(s: Array, near: Array, facing: tuple[float, float], stiff: float, held: float) -> None:
    """Improve a plane by one round of weighted least squares."""
    a00, a01, a02, a12 = held, 0.0, 0.0, 0.0
    stiff /= 1.0 + stiff * ((s[1] - facing[0]) ** 2 + (s[2] - facing[1]) ** 2) / _TAIL
    a11 = a22 = stiff
    b0, b1, b2 = 0.0, stiff * facing[0], stiff * facing[1]
    for q in range(len(near)):
        dx, dy, dr, variance = near[q, 0], near[q, 1], near[q, 2], near[q, 3]
        error = dr - s[0] - s[1] * dx - s[2] * dy
        robust = 1.0 + error * error / (4.0 * variance)
        w = near[q, 4] / (variance * robust * robust)
        a00 += w
        a01 += w * dx
        a02 += w * dy
        a11 += w * dx * dx
        a12 += w * dx * dy
        a22 += w * dy * dy
        b0 += w * dr
        b1 += w * dx * dr
        b2 += w * dy * dr
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    by_x = c01 * b0 + (a00 * a22 - a02 * a02) * b1 + (a01 * a02 - a00 * a12) * b2
    by_y = c02 * b0 + (a01 * a02 - a00 * a12) * b1 + (a00 * a11 - a01 * a01) * b2
    s[0] = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
    s[1], s[2] = by_x / determinant, by_y / determinant
