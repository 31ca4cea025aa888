"""The surfaces that landmarks lie on: how steep each is, by the depths of its neighbours."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.surface_kernels import inclinations

_N_NEIGHBOURS = 12
_NEIGHBOURHOOD_PX = 40.0
# Surfaces are believed to be inclined by so much, tangent, 1 sigma.
_INCLINATION = 1.0


def slopes_of(pixels: Array, ideal: Array, inverse_depth: Array, sigma: Array) -> Array:
    """Return (N, 2) slopes of the inverse depth by ideal x and y at landmarks of one view.

    Args:
        pixels: (N, 2) where they are, px; N at least 1.
        ideal: (N, 2) the same as x/z, y/z.
        inverse_depth: (N,) 1/m.
        sigma: (N,) of it, 1/m.
    """
    near = min(_N_NEIGHBOURS, len(pixels))
    distance, other = cKDTree(pixels).query(pixels, near)
    return inclinations(
        np.ascontiguousarray(ideal),
        np.ascontiguousarray(inverse_depth),
        np.ascontiguousarray(sigma),
        np.asarray(other, dtype=np.int64).reshape(len(pixels), near),
        np.asarray(distance, dtype=np.float64).reshape(len(pixels), near),
        _NEIGHBOURHOOD_PX,
        _INCLINATION,
    )
