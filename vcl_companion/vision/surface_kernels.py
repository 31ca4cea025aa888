"""How surfaces are inclined around landmarks, by their neighbours' depths; compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.compiled import compiled

_ROUNDS = 6


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

    On a plane inverse depth is linear in the ideal image coordinates. A robust
    fit to the neighbours, weighted by how near and how well known they are;
    where few are near, or they disagree, the surface faces the camera.

    Args:
        ideal: (N, 2) x/z, y/z in one camera.
        inverse_depth: (N,) 1/z, 1/m.
        sigma: (N,) of it.
        other: (N, K) neighbours, itself among them.
        distance: (N, K) to them, px.
        reach: neighbours farther away do not count, px.
        inclination: surfaces are believed to be inclined by, tangent, 1 sigma.
    """
    n, k = other.shape
    out = np.empty((n, 2))
    s = np.empty(3)
    for j in range(n):
        x, y, r = ideal[j, 0], ideal[j, 1], inverse_depth[j]
        length2 = 1.0 + x * x + y * y
        facing_x, facing_y = x * r / length2, y * r / length2
        stiff = 1.0 / (inclination * r) ** 2
        s[0], s[1], s[2] = 0.0, facing_x, facing_y
        for _ in range(_ROUNDS):
            a00 = 1e-9 / sigma[j] ** 2
            a01 = a02 = a12 = 0.0
            a11 = a22 = stiff
            b0, b1, b2 = 0.0, stiff * facing_x, stiff * facing_y
            for q in range(k):
                if distance[j, q] > reach:
                    continue
                o = other[j, q]
                dx, dy, dr = ideal[o, 0] - x, ideal[o, 1] - y, inverse_depth[o] - r
                variance = sigma[o] ** 2 + sigma[j] ** 2
                error = dr - s[0] - s[1] * dx - s[2] * dy
                robust = 1.0 + error * error / (4.0 * variance)
                w = np.exp(-2.0 * (distance[j, q] / reach) ** 2) / (variance * robust * robust)
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
            s[0] = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
            s[1] = (
                c01 * b0 + (a00 * a22 - a02 * a02) * b1 + (a01 * a02 - a00 * a12) * b2
            ) / determinant
            s[2] = (
                c02 * b0 + (a01 * a02 - a00 * a12) * b1 + (a00 * a11 - a01 * a01) * b2
            ) / determinant
        out[j, 0], out[j, 1] = s[1], s[2]
    return out
