"""Bundle adjustment of a few views and many points by the Schur complement (IV-C).

Poses are bodies, not cameras, so that a known distance between two drones and
the mounting of each camera enter as they are. The first view is held: it fixes
position and orientation of the frame; known distances fix the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from vcl_companion.compiled import writable
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, skew
from vcl_companion.vision import bundle_kernels as kernels
from vcl_companion.vision import leverage_kernels

_MIN_DEPTH_M = 1e-3
# By so many pixels no weight falls.
_NOT_ROBUST_PX = 1e9


@dataclass(frozen=True)
class Distance:
    """The bodies of views ``a`` and ``b`` are ``distance_m`` apart, give or take ``sigma_m``."""

    a: int
    b: int
    distance_m: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Views:
    """What was seen from where.

    Attributes:
        bodies: V world_from_body poses; the first ones are held fixed.
        mountings: V body_from_cam poses.
        slopes: (N, V, 2, 2) d(pixel) / d(ideal) at the observations, by which
            residuals are in pixels of the raw image, where the noise is the same everywhere.
        ideal: (N, V, 2) observations as ideal image coordinates x/z, y/z; NaN where unseen.
        points: (N, 3) landmarks, world frame, m.
        distances: what fixes the scale.
        n_held: how many poses are held fixed, at least one.
    """

    bodies: tuple[Pose, ...]
    mountings: tuple[Pose, ...]
    slopes: Array
    ideal: Array
    points: Array
    distances: tuple[Distance, ...]
    n_held: int = 1


@dataclass(frozen=True)
class BundleOptions:
    """When to stop, and how much an outlier may pull.

    Attributes:
        max_iterations: Levenberg-Marquardt steps.
        cauchy_px: residual at which an observation's weight has fallen to one half.
        least_gain: of the cost, relative; a step that brings less is the last.
    """

    max_iterations: int = 40
    cauchy_px: float = 1.5
    least_gain: float = 1e-7


def reprojection_residuals(views: Views) -> Array:
    """Return (N, V, 2) projected minus observed, px; NaN where unseen or behind the camera."""
    cams = matrices_of(tuple(_world_from_cam(views, i).inverse() for i in range(len(views.bodies))))
    points, slopes, ideal = map(writable, (views.points, views.slopes, views.ideal))
    return kernels.residuals(points, cams, slopes, ideal, _MIN_DEPTH_M)


def adjust(
    views: Views, options: BundleOptions, weights: Array | None = None
) -> tuple[Views, float]:
    """Move poses and points until the robust reprojection error is least.

    Args:
        views: the first estimate. Every point should be seen at least twice.
        options: stopping rule and robust scale.
        weights: (N, 2, 2) that multiply the residuals of each point; None: all count alike.

    Returns:
        The adjusted views, and the robust noise of one pixel coordinate (1
        sigma, px, from the median absolute residual), without weights.
    """
    damping = 1e-4
    slopes = views.slopes if weights is None else weights[:, None] @ views.slopes
    problem = _Problem(replace(views, slopes=slopes), options.cauchy_px)
    system, cost = problem.system(views, damping), problem.cost(views)
    for _ in range(options.max_iterations):
        step = problem.step(system, damping)
        if step is not None:
            candidate = _moved(views, *step)
            new_cost = problem.cost(candidate)
            if new_cost < cost:
                converged = cost - new_cost < options.least_gain * cost
                views, cost, damping = candidate, new_cost, max(damping / 5.0, 1e-9)
                if converged:
                    break
                del system  # of a large map as much as the map, and the next is as large
                system = problem.system(views, damping)
                continue
        damping *= 6.0
        if damping > 1e8:
            break
        del system
        system = problem.system(views, damping)
    del system
    return views, residual_noise_px(reprojection_residuals(views))


def robust_cost(views: Views, cauchy_px: float) -> float:
    """Return what ``adjust`` makes least, px^2; distances are weighed to the same unit."""
    return _Problem(views, cauchy_px).cost(views)


def pose_information(views: Views) -> Array:
    """Return the (6V, 6V) normal matrix of the poses, landmarks eliminated, for 1 px of noise.

    All observations count alike. Rows of the held poses stay zero but for known distances.
    """
    return _Problem(views, _NOT_ROBUST_PX).system(views, 0.0).normal


def leverages(views: Views, covariance: Array) -> Array:
    """Return (N,) how much of some motion of the poses each landmark decides, 0 to 1.

    The largest eigenvalue of what its observations say of the poses, its own position
    eliminated, against what is known of them.

    Args:
        views: an estimate.
        covariance: (6V, 6V) of the poses, for 1 px of noise, zero for the held ones.
    """
    return leverage_kernels.leverages(*_Problem(views, 1.0).arguments(views), covariance)


def relative_sigmas(views: Views) -> Array:
    """Return (N,) 1-sigma error of each landmark, for 1 px of noise, were the poses exact.

    In its least known direction, over its distance to the nearest view that sees it; infinite
    where none does.
    """
    return kernels.relative_sigmas(*_Problem(views, 1.0).arguments(views))


@dataclass(frozen=True, eq=False)
class _System:
    """The reduced system at one estimate, and what leads from poses to landmarks."""

    normal: Array
    rhs: Array
    diagonal: Array
    inverses: Array
    pulls: Array
    crosses: Array


class _Problem:
    """The observations of one adjustment, landmark by landmark, as the compiled loops read them."""

    def __init__(self, views: Views, cauchy_px: float) -> None:
        seen = np.ascontiguousarray(np.isfinite(views.ideal[:, :, 0]))
        self._first, self._view = observations_of(seen)
        self._slopes = np.ascontiguousarray(views.slopes[seen])
        self._ideal = np.ascontiguousarray(views.ideal[seen])
        self._mountings = matrices_of(views.mountings)
        self._cauchy_px = cauchy_px
        self._n_held = views.n_held

    def cost(self, views: Views) -> float:
        """Return the robust cost, px^2 (distances weighted to the same unit)."""
        by_distance = sum(_add_distance(views, d, None, None) for d in views.distances)
        return by_distance + kernels.cost_of(*self.arguments(views), self._cauchy_px)

    def system(self, views: Views, damping: float) -> _System:
        """Linearise at an estimate."""
        found = kernels.reduced(*self.arguments(views), self._cauchy_px, damping, self._n_held)
        system = _System(*found)
        before = np.diag(system.normal).copy()
        for known in views.distances:
            _add_distance(views, known, system.normal, system.rhs)
        return replace(system, diagonal=system.diagonal + np.diag(system.normal) - before)

    def step(self, system: _System, damping: float) -> tuple[Array, Array] | None:
        """Return the damped (6V,) pose step and (N, 3) point step; None where singular."""
        # A view that sees nothing has no say, and would make the whole singular.
        free = np.flatnonzero(system.diagonal > 0.0)
        free = free[free >= 6 * self._n_held]
        damped = system.normal[np.ix_(free, free)] + damping * np.diag(system.diagonal[free])
        pose_step = np.zeros(len(system.rhs))
        try:
            pose_step[free] = np.linalg.solve(damped, system.rhs[free])
        except np.linalg.LinAlgError:
            return None
        point_step = kernels.substituted(
            pose_step, self._first, self._view, system.inverses, system.pulls, system.crosses
        )
        if not (np.all(np.isfinite(pose_step)) and np.all(np.isfinite(point_step))):
            return None
        return pose_step, point_step

    def arguments(
        self, views: Views
    ) -> tuple[Array, Array, Array, kernels.Ints, kernels.Ints, Array, Array]:
        """Return an estimate as the compiled loops take it."""
        points, bodies = writable(views.points), matrices_of(views.bodies)
        return (
            points, bodies, self._mountings, self._first, self._view, self._slopes, self._ideal
        )  # fmt: skip


def observations_of(seen: NDArray[np.bool_]) -> tuple[kernels.Ints, kernels.Ints]:
    """Return (N + 1,) where each landmark's observations begin, (M,) the view of each of these.

    Args:
        seen: (N, V) which view sees which landmark.
    """
    owner, view = np.nonzero(seen)
    first = np.searchsorted(owner, np.arange(len(seen) + 1))
    return first.astype(np.int64), view.astype(np.int64)


def matrices_of(poses: Sequence[Pose]) -> Array:
    """Return (V, 3, 4) poses as compiled loops take them."""
    return np.ascontiguousarray(np.stack([pose.matrix()[:3] for pose in poses]))


def residual_noise_px(residuals: Array) -> float:
    """Return the robust 1-sigma of one pixel coordinate behind (N, V, 2) residuals, px.

    A point seen V times leaves 2V - 3 degrees of freedom of its own; the median
    over the points of its squared residuals against the median of that
    chi-square distribution ignores up to half of the points being wrong.
    """
    seen = np.isfinite(residuals[..., 0])
    n_seen = seen.sum(axis=1)
    usable = n_seen >= 2
    if not usable.any():
        return 1.0
    squared = np.nansum(residuals[usable] ** 2, axis=(1, 2))
    # The median of chi^2, which scipy.stats would take 30 MB for.
    expected = 2.0 * np.asarray(gammaincinv(0.5 * (2 * n_seen[usable] - 3), 0.5))
    return float(max(np.sqrt(np.median(squared / expected)), 0.02))


def distance_information(views: Views) -> Array:
    """Return the (6V, 6V) normal matrix of the known distances alone."""
    size = 6 * len(views.bodies)
    normal, right = np.zeros((size, size)), np.zeros(size)
    for known in views.distances:
        _add_distance(views, known, normal, right)
    return normal


def linearized(
    world_from_body: Pose, body_from_cam: Pose, slopes: Array, points: Array, ideal: Array
) -> tuple[Array, Array, Array]:
    """Residuals of one view and their Jacobians.

    Args:
        world_from_body: the view's pose, perturbed locally.
        body_from_cam: its mounting.
        slopes: (N, 2, 2) d(pixel) / d(ideal) at the observations.
        points: (N, 3) landmarks, world frame, m.
        ideal: (N, 2) where they were seen, ideal coordinates.

    Returns:
        (N, 2) residuals, px; (N, 2, 6) by the pose; (N, 2, 3) by the point.
        A point at or behind the camera, or NaN, gets a large residual and no slope.
    """
    cam_from_body = body_from_cam.rotation.T
    points_body = (points - world_from_body.translation) @ world_from_body.rotation
    points_cam = (points_body - body_from_cam.translation) @ body_from_cam.rotation
    front = points_cam[:, 2] > _MIN_DEPTH_M
    points_body = np.where(front[:, None], points_body, 0.0)
    z = np.where(front, points_cam[:, 2], 1.0)
    uv = points_cam[:, :2] / z[:, None]
    residual = np.einsum("nkl,nl->nk", slopes, uv - ideal)
    residual[~front] = 1e3
    j_cam = np.empty((len(points), 2, 3))
    j_cam[:, :, :2] = slopes / z[:, None, None]
    j_cam[:, :, 2] = -np.einsum("nkl,nl->nk", slopes, uv) / z[:, None]
    j_cam[~front] = 0.0
    j_body = j_cam @ cam_from_body
    j_pose = np.empty((len(points), 2, 6))
    # Moving the body by d moves the point by -d in body axes; turning it by w, by -w x p.
    j_pose[:, :, :3] = -j_body
    j_pose[:, :, 3:] = j_body @ skew(points_body)
    return residual, j_pose, j_body @ world_from_body.rotation.T


def _add_distance(
    views: Views, known: Distance, pose_block: Array | None, pose_rhs: Array | None
) -> float:
    """Return the cost of a distance; add it to a normal matrix and its right side."""
    a, b = views.bodies[known.a], views.bodies[known.b]
    offset = a.translation - b.translation
    length = max(float(np.linalg.norm(offset)), 1e-9)
    error = (length - known.distance_m) / known.sigma_m
    if pose_block is None or pose_rhs is None:
        return error**2
    jacobian = np.zeros(len(pose_rhs))
    jacobian[6 * known.a : 6 * known.a + 3] = offset / length @ a.rotation
    jacobian[6 * known.b : 6 * known.b + 3] = -offset / length @ b.rotation
    jacobian /= known.sigma_m
    pose_block += np.outer(jacobian, jacobian)
    pose_rhs -= jacobian * error
    return error**2


def _moved(views: Views, pose_step: Array, point_step: Array) -> Views:
    bodies = tuple(
        body.retracted(pose_step[6 * i : 6 * i + 6]) if i >= views.n_held else body
        for i, body in enumerate(views.bodies)
    )
    return replace(views, bodies=bodies, points=views.points + point_step)


def _world_from_cam(views: Views, i: int) -> Pose:
    return views.bodies[i] @ views.mountings[i]
