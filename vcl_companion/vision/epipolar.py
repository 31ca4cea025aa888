"""Errors of matches under an essential matrix, and the pose that makes them least (IV-B), compiled.

The error is Sampson's: to first order, how far both pixels together must move
to satisfy b^T E a = 0. Good matches err by a Gaussian of unknown sigma, wrong
ones uniformly; which is which, sigma, and the share of good ones are estimated
along with the pose (expectation maximisation).
"""

from __future__ import annotations

import math

import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

_FINEST_PX = 0.01
_NEVER = -30.0


@compiled
def squared_sampson(essentials: Array, a: Array, b: Array, focal_px: float) -> Array:
    """Return (K, N) squared Sampson distances, px^2.

    Args:
        essentials: (K, 3, 3) with b^T E a = 0.
        a: (N, 2) ideal image coordinates in camera a.
        b: (N, 2) the same in camera b.
        focal_px: px per ideal unit.
    """
    n = len(a)
    out = np.empty((len(essentials), n))
    scale = focal_px * focal_px
    for k in range(len(essentials)):
        e = essentials[k]
        e00, e01, e02 = e[0, 0], e[0, 1], e[0, 2]
        e10, e11, e12 = e[1, 0], e[1, 1], e[1, 2]
        e20, e21, e22 = e[2, 0], e[2, 1], e[2, 2]
        for i in range(n):
            x, y, u, v = a[i, 0], a[i, 1], b[i, 0], b[i, 1]
            line_x = e00 * x + e01 * y + e02
            line_y = e10 * x + e11 * y + e12
            back_x = e00 * u + e10 * v + e20
            back_y = e01 * u + e11 * v + e21
            product = u * line_x + v * line_y + e20 * x + e21 * y + e22
            slope = line_x * line_x + line_y * line_y + back_x * back_x + back_y * back_y
            out[k, i] = scale * product * product / max(slope, 1e-300)
    return out


@compiled
def signed_sampson(essentials: Array, a: Array, b: Array, focal_px: float) -> Array:
    """Return (K, N) Sampson distances with the sign of b^T E a, px; see ``squared_sampson``."""
    out = np.empty((len(essentials), len(a)))
    for k in range(len(essentials)):
        e = essentials[k]
        for i in range(len(a)):
            x, y, u, v = a[i, 0], a[i, 1], b[i, 0], b[i, 1]
            line_x = e[0, 0] * x + e[0, 1] * y + e[0, 2]
            line_y = e[1, 0] * x + e[1, 1] * y + e[1, 2]
            back_x = e[0, 0] * u + e[1, 0] * v + e[2, 0]
            back_y = e[0, 1] * u + e[1, 1] * v + e[2, 1]
            product = u * line_x + v * line_y + e[2, 0] * x + e[2, 1] * y + e[2, 2]
            slope = line_x * line_x + line_y * line_y + back_x * back_x + back_y * back_y
            out[k, i] = focal_px * product / max(math.sqrt(slope), 1e-12)
    return out


@compiled
def refined_pose(
    rotation: Array,
    translation: Array,
    a: Array,
    b: Array,
    focal_px: float,
    sigma_px: float,
    wrong_density: float,
    rounds: int,
) -> tuple[Array, Array, float, float]:
    """Move a relative pose to the maximum of the likelihood of all matches.

    Levenberg-Marquardt on rotation and direction with analytic slopes; after
    each step sigma and the share of good matches follow.

    Args:
        rotation: (3, 3) b_from_a.
        translation: (3,) likewise, of length 1.
        a: (N, 2) ideal image coordinates in camera a.
        b: (N, 2) the same in camera b.
        focal_px: px per ideal unit.
        sigma_px: first guess of the noise of good matches.
        wrong_density: probability per px of error of a wrong match, near 0.
        rounds: steps at most.

    Returns:
        (3, 3) rotation, (3,) direction, sigma in px, share of good matches.
    """
    n = len(a)
    share = 0.5
    damping = 1e-4
    residual, slopes = np.empty(n), np.empty((n, 5))
    linearize(rotation, translation, a, b, focal_px, residual, slopes)
    weight = np.empty(n)
    ceiling = 3.0 * sigma_px
    for _ in range(3):
        sigma_px, share = _mixture(residual, sigma_px, share, wrong_density, ceiling, weight)
    moved_residual, moved_slopes = np.empty(n), np.empty((n, 5))
    for _ in range(rounds):
        normal, right = np.zeros((5, 5)), np.zeros(5)
        for i in range(n):
            if weight[i] < 1e-6:
                continue
            for p in range(5):
                weighted = weight[i] * slopes[i, p]
                right[p] -= weighted * residual[i]
                for q in range(p + 1):
                    normal[p, q] += weighted * slopes[i, q]
        for p in range(5):
            for q in range(p):
                normal[q, p] = normal[p, q]
            normal[p, p] += damping * normal[p, p] + 1e-9
        step = np.linalg.solve(normal, right).astype(np.float64)
        moved_rotation, moved_translation = _stepped(rotation, translation, step)
        linearize(moved_rotation, moved_translation, a, b, focal_px, moved_residual, moved_slopes)
        # With the weights held, less of this is a greater likelihood.
        if not _weighted_squares(moved_residual, weight) < _weighted_squares(residual, weight):
            damping *= 10.0
            if damping > 1e4 or np.abs(step).max() < 1e-9:
                break
            continue
        damping = max(damping * 0.1, 1e-7)
        rotation, translation = moved_rotation, moved_translation
        residual, moved_residual = moved_residual, residual
        slopes, moved_slopes = moved_slopes, slopes
        before = sigma_px
        sigma_px, share = _mixture(residual, sigma_px, share, wrong_density, ceiling, weight)
        if np.abs(step).max() < 1e-7 and abs(sigma_px - before) < 1e-3 * before:
            break
    return rotation, translation, sigma_px, share


@compiled
def refined_essential(
    essential: Array,
    a: Array,
    b: Array,
    focal_px: float,
    sigma_px: float,
    wrong_density: float,
    rounds: int,
) -> Array:
    """Do the same with an essential matrix; which of its four poses it is makes no difference."""
    u, _, vt = np.linalg.svd(essential)
    # R = U W V^T up to sign, W a quarter turn about z; t is U's last column.
    turned = np.empty((3, 3))
    turned[:, 0], turned[:, 1], turned[:, 2] = u[:, 1], -u[:, 0], u[:, 2]
    rotation = turned @ np.ascontiguousarray(vt)
    if np.linalg.det(rotation) < 0.0:
        rotation = -rotation
    rotation, translation, _, _ = refined_pose(
        rotation, u[:, 2].copy(), a, b, focal_px, sigma_px, wrong_density, rounds
    )
    return _cross_matrix(translation) @ rotation


@compiled
def tangent(direction: Array) -> Array:
    """Return (2, 3) unit vectors across a unit vector and each other."""
    smallest = np.argmin(np.abs(direction))
    out = np.empty((2, 3))
    for j in range(3):
        out[0, j] = (1.0 if j == smallest else 0.0) - direction[smallest] * direction[j]
    out[0] /= np.sqrt((out[0] ** 2).sum())
    out[1, 0] = direction[1] * out[0, 2] - direction[2] * out[0, 1]
    out[1, 1] = direction[2] * out[0, 0] - direction[0] * out[0, 2]
    out[1, 2] = direction[0] * out[0, 1] - direction[1] * out[0, 0]
    return out


@compiled
def _stepped(rotation: Array, translation: Array, step: Array) -> tuple[Array, Array]:
    """Turn by a rotation vector on the right, move the direction along its tangent."""
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    cross = _cross_matrix(step[:3])
    if angle < 1e-8:
        turn = np.eye(3) + cross
    else:
        turn = (
            np.eye(3)
            + np.sin(angle) / angle * cross
            + (1.0 - np.cos(angle)) / angle**2 * (cross @ cross)
        )
    axes = tangent(translation)
    moved = translation + step[3] * axes[0] + step[4] * axes[1]
    return rotation @ turn, moved / np.sqrt((moved**2).sum())


@compiled
def _cross_matrix(v: Array) -> Array:
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]
    return out


@compiled
def linearize(
    rotation: Array,
    translation: Array,
    a: Array,
    b: Array,
    focal_px: float,
    residual: Array,
    slopes: Array,
) -> None:
    """Fill (N,) signed Sampson distances, px, and their (N, 5) slopes by the pose's step."""
    e = _cross_matrix(translation) @ rotation
    axes = tangent(translation)
    slope = np.empty(6)
    for i in range(len(a)):
        x, y, u, v = a[i, 0], a[i, 1], b[i, 0], b[i, 1]
        line_x = e[0, 0] * x + e[0, 1] * y + e[0, 2]
        line_y = e[1, 0] * x + e[1, 1] * y + e[1, 2]
        back_x = e[0, 0] * u + e[1, 0] * v + e[2, 0]
        back_y = e[0, 1] * u + e[1, 1] * v + e[2, 1]
        back_z = e[0, 2] * u + e[1, 2] * v + e[2, 2]
        product = x * back_x + y * back_y + back_z
        squared = line_x * line_x + line_y * line_y + back_x * back_x + back_y * back_y
        inverse = 1.0 / max(squared, 1e-300)
        scale = focal_px * np.sqrt(inverse)
        residual[i] = scale * product
        pull = product * inverse
        # Turned by w: the product by w . (a x back), half the squared slope by
        # w . (a x g - back x q) with g = line_x E[0] + line_y E[1], q = (back_x, back_y, 0).
        g0 = back_x - pull * (line_x * e[0, 0] + line_y * e[1, 0])
        g1 = back_y - pull * (line_x * e[0, 1] + line_y * e[1, 1])
        g2 = back_z - pull * (line_x * e[0, 2] + line_y * e[1, 2])
        slope[0] = y * g2 - g1 - pull * back_z * back_y
        slope[1] = g0 - x * g2 + pull * back_z * back_x
        slope[2] = x * g1 - y * g0
        # Moved by d: the product by d . (R a x b), half the squared slope by
        # d . (R a x l - b x R q) with l = (line_x, line_y, 0).
        ra0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2]
        ra1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2]
        ra2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2]
        rq0 = rotation[0, 0] * back_x + rotation[0, 1] * back_y
        rq1 = rotation[1, 0] * back_x + rotation[1, 1] * back_y
        rq2 = rotation[2, 0] * back_x + rotation[2, 1] * back_y
        h0, h1 = u - pull * line_x, v - pull * line_y
        slope[3] = ra1 - ra2 * h1 + pull * (v * rq2 - rq1)
        slope[4] = ra2 * h0 - ra0 + pull * (rq0 - u * rq2)
        slope[5] = ra0 * h1 - ra1 * h0 + pull * (u * rq1 - v * rq0)
        for k in range(3):
            slopes[i, k] = scale * slope[k]
        for k in range(2):
            slopes[i, 3 + k] = scale * (
                axes[k, 0] * slope[3] + axes[k, 1] * slope[4] + axes[k, 2] * slope[5]
            )


@compiled
def _mixture(
    residual: Array,
    sigma_px: float,
    share: float,
    wrong_density: float,
    ceiling: float,
    weight: Array,
) -> tuple[float, float]:
    """Fill the probability of each match to be good; return the new sigma and share."""
    ratio = share * np.sqrt(2.0 / np.pi) / sigma_px / ((1.0 - share) * wrong_density)
    total, squares = 0.0, 0.0
    for i in range(len(residual)):
        exponent = -0.5 * (residual[i] / sigma_px) ** 2
        good = ratio * np.exp(exponent) if exponent > _NEVER else 0.0
        weight[i] = good / (good + 1.0)
        total += weight[i]
        squares += weight[i] * residual[i] ** 2
    # The pose takes five degrees of freedom out of the residuals.
    sigma = np.sqrt(squares / max(total - 5.0, 1.0))
    share = min(max(total / len(residual), 0.01), 0.99)
    return min(max(sigma, _FINEST_PX), ceiling), share


@compiled
def _weighted_squares(residual: Array, weight: Array) -> float:
    total = 0.0
    for i in range(len(residual)):
        total += weight[i] * residual[i] ** 2
    return total
