"""Optimal two-view triangulation (IV-C), vectorised.

R. Hartley and P. Sturm, Triangulation, CVIU 1997: of all pairs of image points
that meet exactly, the one nearest to what was seen. With the point seen at the
origin and the epipole on the x axis of both images, the pairs of epipolar lines
have one parameter, and the squared distance is least at a root of a polynomial
of degree six. The parameter is a direction (t : w), so that no line is special.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, skew
from vcl_companion.vision.triangulation import triangulate

# More than six directions: a polynomial of degree six cannot vanish along all of them.
_DIRECTIONS = np.pi * (np.arange(9) + 0.5) / 9
_TINY = 1e-300


def corrected_matches(b_from_a: Pose, ideal_a: Array, ideal_b: Array) -> tuple[Array, Array]:
    """Move matches as little as possible so that their rays meet.

    Args:
        b_from_a: camera a's coordinates to camera b's; a translation of any length but 0.
        ideal_a: (N, 2) ideal image coordinates x/z, y/z in camera a.
        ideal_b: (N, 2) the same places in camera b.

    Returns:
        The (N, 2) corrected coordinates in both; a row is NaN where it is in
        either image, all are NaN when the cameras are in one place.
    """
    lost = np.full((len(ideal_a), 2), np.nan)
    baseline = np.linalg.norm(b_from_a.translation)
    usable = np.isfinite(ideal_a).all(axis=1) & np.isfinite(ideal_b).all(axis=1)
    if not baseline > 0.0 or not usable.any():
        return lost, lost.copy()
    essential = skew(b_from_a.translation / baseline) @ b_from_a.rotation
    epipole_a = b_from_a.rotation.T @ b_from_a.translation / baseline
    epipole_b = b_from_a.translation / baseline
    a, b = ideal_a[usable], ideal_b[usable]
    frame_a, f_a = _frames(a, epipole_a)
    frame_b, f_b = _frames(b, epipole_b)
    moved = frame_b @ essential @ np.swapaxes(frame_a, 1, 2)
    lines = (moved[:, 1, 1], moved[:, 1, 2], moved[:, 2, 1], moved[:, 2, 2], f_a, f_b)
    t, w = _nearest(*lines)
    line_a = np.stack([t * f_a, w, -t], axis=1)
    p, q, r, s = lines[:4]
    line_b = np.stack([-f_b * (r * t + s * w), p * t + q * w, r * t + s * w], axis=1)
    out_a, out_b = lost, lost.copy()
    out_a[usable], out_b[usable] = _feet(line_a, frame_a), _feet(line_b, frame_b)
    return out_a, out_b


def triangulate_optimal(b_from_a: Pose, ideal_a: Array, ideal_b: Array) -> Array:
    """Find the most likely points behind noisy matches.

    Args:
        b_from_a: camera a's coordinates to camera b's, m.
        ideal_a: (N, 2) ideal image coordinates x/z, y/z in camera a.
        ideal_b: (N, 2) the same places in camera b.

    Returns:
        (N, 3) points in camera a's frame, m, behind it as well; NaN where the
        rays are parallel or a coordinate is NaN. Angle, depth and error are for
        the caller to judge (``ray_angles``).
    """
    corrected = corrected_matches(b_from_a, ideal_a, ideal_b)
    return triangulate([Pose.identity(), b_from_a.inverse()], np.stack(corrected, axis=1))


def _frames(ideal: Array, epipole: Array) -> tuple[Array, Array]:
    """Return (N, 3, 3) maps of lines into frames of their own, and there (N,) f.

    In a point's frame the point seen is the origin and the epipole (1, 0, f); the
    map of lines is the inverse transpose of that of points.
    """
    n = len(ideal)
    ex, ey = epipole[0] - ideal[:, 0] * epipole[2], epipole[1] - ideal[:, 1] * epipole[2]
    length = np.hypot(ex, ey)
    at_epipole = length < 1e-12
    cosine = np.where(at_epipole, 1.0, ex / np.where(at_epipole, 1.0, length))
    sine = np.where(at_epipole, 0.0, ey / np.where(at_epipole, 1.0, length))
    frame = np.zeros((n, 3, 3))
    frame[:, 0, 0], frame[:, 0, 1] = cosine, sine
    frame[:, 1, 0], frame[:, 1, 1] = -sine, cosine
    frame[:, 2, 0], frame[:, 2, 1], frame[:, 2, 2] = ideal[:, 0], ideal[:, 1], 1.0
    f = epipole[2] / np.where(at_epipole, 1e-12, length)
    return frame, np.broadcast_to(f, (n,))


def _nearest(p: Array, q: Array, r: Array, s: Array, f_a: Array, f_b: Array) -> tuple[Array, Array]:
    """Return the direction (t, w) of each pair of lines with the least squared distance.

    Line a is (t f_a, w, -t), line b (-f_b (r t + s w), p t + q w, r t + s w).
    """
    # Polynomials in t at w = 1, highest power first, as homogeneous forms.
    line_x, line_y = np.stack([p, q], axis=1), np.stack([r, s], axis=1)
    across = _product(line_x, line_x) + f_b[:, None] ** 2 * _product(line_y, line_y)
    n = len(p)
    along = np.stack([f_a**2, np.zeros(n), np.ones(n)], axis=1)
    zero = np.zeros((n, 1))
    # t w across^2 - (p s - q r) (w^2 + f_a^2 t^2)^2 (p t + q w)(r t + s w)
    first = np.hstack([zero, _product(across, across), zero])
    second = _product(_product(along, along), _product(line_x, line_y))
    form = first - (p * s - q * r)[:, None] * second
    form = form / np.maximum(np.abs(form).max(axis=1, keepdims=True), _TINY)
    cosine, sine = _steepest(form)
    # With t = c u - d, w = d u + c the leading coefficient is the form at (c, d): not zero.
    turned = _turned(form, cosine, sine)
    companion = np.zeros((n, 6, 6))
    companion[:, np.arange(1, 6), np.arange(5)] = 1.0
    companion[:, 0, :] = -turned[:, 1:] / turned[:, :1]
    ok = np.isfinite(companion).all(axis=(1, 2))
    companion[~ok] = 0.0
    u = np.linalg.eigvals(companion).real
    # Every direction is a pair of meeting lines; a complex root's real part does no harm.
    t = cosine[:, None] * u - sine[:, None]
    w = sine[:, None] * u + cosine[:, None]
    norm = np.hypot(t, w)
    t, w = t / norm, w / norm
    x = p[:, None] * t + q[:, None] * w
    y = r[:, None] * t + s[:, None] * w
    distance = t**2 / np.maximum(w**2 + (f_a[:, None] * t) ** 2, _TINY)
    distance = distance + y**2 / np.maximum(x**2 + (f_b[:, None] * y) ** 2, _TINY)
    best = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=1)
    rows = np.arange(n)
    return t[rows, best], w[rows, best]


def _product(one: Array, other: Array) -> Array:
    """Return the (N, K + L - 1) products of (N, K) and (N, L) polynomials."""
    out = np.zeros((len(one), one.shape[1] + other.shape[1] - 1))
    for k in range(one.shape[1]):
        out[:, k : k + other.shape[1]] += one[:, k : k + 1] * other
    return out


def _steepest(form: Array) -> tuple[Array, Array]:
    """Return cosine and sine of the direction in which each (N, 7) form is largest."""
    powers = np.arange(6, -1, -1)
    values = np.cos(_DIRECTIONS)[:, None] ** powers * np.sin(_DIRECTIONS)[:, None] ** (6 - powers)
    best = _DIRECTIONS[np.argmax(np.abs(form @ values.T), axis=1)]
    return np.cos(best), np.sin(best)


def _turned(form: Array, cosine: Array, sine: Array) -> Array:
    """Return the (N, 7) forms in u, with t = c u - d and w = d u + c."""
    t, w = np.stack([cosine, -sine], axis=1), np.stack([sine, cosine], axis=1)
    one = np.ones((len(form), 1))
    t_powers, w_powers = [one], [one]
    for _ in range(6):
        t_powers.append(_product(t_powers[-1], t))
        w_powers.append(_product(w_powers[-1], w))
    out = np.zeros_like(form)
    for k in range(7):
        out += form[:, k : k + 1] * _product(t_powers[6 - k], w_powers[k])
    return out


def _feet(lines: Array, frame: Array) -> Array:
    """Return the (N, 2) points of lines (in their frames) nearest to what was seen."""
    x, y = -lines[:, 0] * lines[:, 2], -lines[:, 1] * lines[:, 2]
    z = np.maximum(lines[:, 0] ** 2 + lines[:, 1] ** 2, _TINY)
    x, y = x / z, y / z
    # Turned back, and shifted back to where the point was seen.
    cosine, sine = frame[:, 0, 0], frame[:, 0, 1]
    seen = frame[:, 2, :2]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1) + seen
