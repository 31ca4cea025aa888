"""The normal equations of a bundle adjustment, dense and plain: what the compiled ones must be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.bundle import Views, linearized


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The Gauss-Newton system at one estimate, landmarks not yet eliminated.

    Attributes:
        pose_block: (6V, 6V) normal matrix of the poses, distances included.
        pose_rhs: (6V,) negative gradient.
        point_block: (N, 3, 3) normal matrix of each point.
        point_rhs: (N, 3) negative gradient.
        cross: (N, 6V, 3) pose-point coupling.
        cost: robust cost, px^2 (distances weighted to the same unit).
    """

    pose_block: Array
    pose_rhs: Array
    point_block: Array
    point_rhs: Array
    cross: Array
    cost: float


def normal_equations(views: Views, cauchy_px: float | None) -> NormalEquations:
    """Linearise every observation and distance; ``cauchy_px`` None weighs all of them one."""
    n, v = views.ideal.shape[:2]
    pose_block = np.zeros((6 * v, 6 * v))
    pose_rhs = np.zeros(6 * v)
    point_block = np.zeros((n, 3, 3))
    point_rhs = np.zeros((n, 3))
    cross = np.zeros((n, 6 * v, 3))
    cost = 0.0
    for i in range(v):
        seen = np.flatnonzero(np.isfinite(views.ideal[:, i, 0]))
        if len(seen) == 0:
            continue
        residual, j_pose, j_point = linearized(
            views.bodies[i],
            views.mountings[i],
            views.slopes[seen, i],
            views.points[seen],
            views.ideal[seen, i],
        )
        weight, loss = _robust(residual, cauchy_px)
        cost += loss
        weighted_pose = j_pose * weight[:, None, None]
        weighted_point = j_point * weight[:, None, None]
        block = slice(6 * i, 6 * i + 6)
        flat = weighted_pose.reshape(-1, 6).T
        pose_block[block, block] += flat @ j_pose.reshape(-1, 6)
        pose_rhs[block] -= flat @ residual.ravel()
        point_block[seen] += np.swapaxes(weighted_point, 1, 2) @ j_point
        point_rhs[seen] -= np.einsum("nki,nk->ni", weighted_point, residual)
        cross[seen, block] += np.swapaxes(weighted_pose, 1, 2) @ j_point
    for known in views.distances:
        a, b = views.bodies[known.a], views.bodies[known.b]
        offset = a.translation - b.translation
        length = max(float(np.linalg.norm(offset)), 1e-9)
        error = (length - known.distance_m) / known.sigma_m
        row = np.zeros(6 * v)
        row[6 * known.a : 6 * known.a + 3] = offset / length @ a.rotation / known.sigma_m
        row[6 * known.b : 6 * known.b + 3] = -offset / length @ b.rotation / known.sigma_m
        pose_block += np.outer(row, row)
        pose_rhs -= row * error
        cost += error**2
    return NormalEquations(pose_block, pose_rhs, point_block, point_rhs, cross, cost)


def pose_information(system: NormalEquations) -> Array:
    """Return the (6V, 6V) normal matrix of the poses with the landmarks eliminated."""
    inverses = np.linalg.inv(system.point_block)
    return np.asarray(
        system.pose_block - np.einsum("nij,njk,nlk->il", system.cross, inverses, system.cross)
    )


def _robust(residual: Array, cauchy_px: float | None) -> tuple[Array, float]:
    squared = np.einsum("nk,nk->n", residual, residual)
    if cauchy_px is None:
        return np.ones(len(residual)), float(squared.sum())
    scaled = squared / cauchy_px**2
    return 1.0 / (1.0 + scaled), float(cauchy_px**2 * np.log1p(scaled).sum())
