"""A lens's distortion and its inverse, of points one by one (compiled, without the lock).

Of points in the thousands, a few hundred at a time and again for every view, the numbers are
nothing beside a call into an array library for each step.

A lens is (5,) coefficients: k1 k2 p1 p2 k3 of radial-tangential ones, k1 k2 k3 k4 0 of fisheyes
(``Camera``). Patches are warped by the same two models, with their slopes, in
``vision/patch_views.py``: a kernel calls those of its own file only (``compiled``). Tests hold one
against the other.
"""

import math

import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

_STEPS = 20
# Steps end at this error of Newton's method, and what is still beyond the other is no solution.
_EXACT, _FOUND, _FOUND_RAD = 1e-12, 1e-8, 1e-9
_HARDLY_ASIDE = 1e-9
_WIDEST_RAD = np.pi / 2 - 1e-3


@compiled
def _by_radius(x: float, y: float, lens: Array) -> tuple[float, float]:
    """Return where a radial-tangential lens shows an ideal point."""
    k1, k2, p1, p2, k3 = lens
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


@compiled
def _slopes_by_radius(x: float, y: float, lens: Array) -> tuple[float, float, float]:
    """Return dx'/dx, dx'/dy (also dy'/dx), dy'/dy of a radial-tangential lens."""
    k1, k2, p1, p2, k3 = lens
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    growth = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    return (
        radial + x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
        x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@compiled
def _by_angle(theta: float, lens: Array) -> float:
    """Return how far aside a fisheye shows what is so many radians aside."""
    k1, k2, k3, k4, _ = lens
    t2 = theta * theta
    return float(theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))))


@compiled
def _slope_by_angle(theta: float, lens: Array) -> float:
    k1, k2, k3, k4, _ = lens
    t2 = theta * theta
    return float(1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4))))


@compiled
def distorted(ideal: Array, lens: Array, is_fisheye: bool) -> Array:
    """Return (N, 2) distorted normalised coordinates of (N, 2) ideal ones.

    Args:
        ideal: x/z, y/z.
        lens: (5,); see the module.
        is_fisheye: whether it is an equidistant one.
    """
    out = np.empty_like(ideal)
    for n in range(len(ideal)):
        x, y = ideal[n]
        if is_fisheye:
            r = math.sqrt(x * x + y * y)
            scale = _by_angle(math.atan(r), lens) / r if r > _HARDLY_ASIDE else 1.0
            out[n, 0], out[n, 1] = x * scale, y * scale
        else:
            out[n, 0], out[n, 1] = _by_radius(x, y, lens)
    return out


@compiled
def slopes(ideal: Array, lens: Array) -> Array:
    """Return (N, 2, 2) d(distorted) / d(ideal) of a radial-tangential lens at (N, 2) ideal ones."""
    out = np.empty((len(ideal), 2, 2))
    for n in range(len(ideal)):
        a, b, d = _slopes_by_radius(ideal[n, 0], ideal[n, 1], lens)
        out[n, 0, 0], out[n, 1, 1] = a, d
        out[n, 0, 1] = out[n, 1, 0] = b
    return out


@compiled
def _without_radius(u: float, v: float, lens: Array, fold_r2: float) -> tuple[float, float]:
    """Return what a radial-tangential lens shows at a place; NaN where Newton's method fails."""
    x, y = u, v
    for _ in range(_STEPS):
        to_x, to_y = _by_radius(x, y, lens)
        e, f = to_x - u, to_y - v
        if not max(abs(e), abs(f)) >= _EXACT:
            break
        a, b, d = _slopes_by_radius(x, y, lens)
        det = a * d - b * b
        x, y = x - (d * e - b * f) / det, y - (a * f - b * e) / det
    to_x, to_y = _by_radius(x, y, lens)
    if abs(to_x - u) < _FOUND and abs(to_y - v) < _FOUND and x * x + y * y < fold_r2:
        return x, y
    return np.nan, np.nan


@compiled
def _without_angle(u: float, v: float, lens: Array, fold_r2: float) -> tuple[float, float]:
    """Return what a fisheye shows at a place; NaN at 90 degrees and beyond, and on failure."""
    aside = math.hypot(u, v)
    theta = min(aside, np.pi / 2)
    for _ in range(_STEPS):
        step = (_by_angle(theta, lens) - aside) / _slope_by_angle(theta, lens)
        theta -= step
        if not abs(step) >= _EXACT:
            break
    if not (abs(_by_angle(theta, lens) - aside) < _FOUND_RAD and 0.0 <= theta < _WIDEST_RAD):
        return np.nan, np.nan
    tangent = math.tan(theta)
    if not tangent * tangent < fold_r2:
        return np.nan, np.nan
    scale = tangent / aside if aside > _HARDLY_ASIDE else 1.0
    return scale * u, scale * v


@compiled
def undistorted(shown: Array, lens: Array, is_fisheye: bool, fold_r2: float) -> Array:
    """Return (N, 2) ideal coordinates of (N, 2) distorted normalised ones, by Newton's method.

    Args:
        shown: where.
        lens: (5,); see the module.
        is_fisheye: whether it is an equidistant one.
        fold_r2: squared ideal radius from which on the polynomial is no lens.

    Returns:
        NaN rows where it finds nothing.
    """
    out = np.empty_like(shown)
    for n in range(len(shown)):
        u, v = shown[n]
        if is_fisheye:
            out[n, 0], out[n, 1] = _without_angle(u, v, lens, fold_r2)
        else:
            out[n, 0], out[n, 1] = _without_radius(u, v, lens, fold_r2)
    return out
