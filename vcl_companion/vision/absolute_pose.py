"""A camera's pose from landmarks by P3P in a-contrario RANSAC (IV-D)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, orthonormalized
from vcl_companion.vision.acransac import (
    THRESHOLD_SIGMAS,
    AcRansacOptions,
    Consensus,
    Indices,
    Mask,
    NotFound,
    ac_ransac,
    consensus_of,
)
from vcl_companion.vision.p3p import MAX_MODELS, SAMPLE_SIZE, poses_of_samples

ErrorKind = Literal["pixel", "angle"]

_FINEST_PX = 0.01
_NEVER = -30.0
_ROUNDS = 30
_ROUNDS_OF_A_REFIT = 6


@dataclass(frozen=True, eq=False)
class AbsolutePose:
    """A pose that cannot be chance.

    Attributes:
        cam_from_world: the pose.
        inliers: (M,) bool, within the threshold and in front of the camera.
        threshold_px: of the reprojection error, found from the data.
        sigma_px: noise of one pixel coordinate of the good ones, 1 sigma, likewise.
        log_nfa: natural logarithm of the number of false alarms; negative.
    """

    cam_from_world: Pose
    inliers: Mask
    threshold_px: float
    sigma_px: float
    log_nfa: float


@dataclass(frozen=True, eq=False)
class ResectionProblem:
    """Poses (3, 4) cam_from_world for ``ac_ransac``.

    The error is measured in the image plane (``pixel``), or as the angle between
    the rays times the focal length (``angle``), which a lens of a very wide view
    stretches less. A landmark behind the camera is nobody's inlier.

    Attributes:
        ideal: (N, 2) ideal image coordinates x/z, y/z.
        points: (N, 3) landmarks, world frame, m.
        focal_px: px per ideal unit.
        area_px2: of the part of the image, or of the sphere around the camera of
            radius ``focal_px``, in which wrong matches lie.
        error: which error.
    """

    ideal: Array
    points: Array
    focal_px: float
    area_px2: float
    error: ErrorKind = "pixel"
    sample_size: int = SAMPLE_SIZE
    max_models: int = MAX_MODELS
    dimension: int = 2

    @property
    def n_data(self) -> int:
        """How many matches there are."""
        return len(self.points)

    @property
    def log_alpha(self) -> float:
        """Log of the share of the image within 1 px of a point."""
        return float(np.log(np.pi / self.area_px2))

    @property
    def rays(self) -> Array:
        """(N, 3) unit directions in the camera frame."""
        rays = np.hstack([self.ideal, np.ones((len(self.ideal), 1))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def fit(self, samples: Indices) -> Array:
        """Return (K, 3, 4) poses of (B, 3) samples."""
        return poses_of_samples(self.rays, self.points, samples)

    def squared_errors(self, models: Array) -> Array:
        """Return (K, N) squared errors, px^2."""
        return _squared_errors(
            models, self.ideal, self.points, self.focal_px, self.error == "angle"
        )

    def refit(self, model: Array, threshold: float) -> Array:
        """Return the pose most likely to be behind all matches."""
        return self.refined(model, threshold, _ROUNDS_OF_A_REFIT)[0]

    def refined(
        self, model: Array, threshold_px: float, rounds: int = _ROUNDS
    ) -> tuple[Array, float]:
        """Return the most likely (3, 4) pose near a given one, and the noise of its inliers, px."""
        moved, sigma = _refined(
            np.ascontiguousarray(model), self.ideal, self.points, self.focal_px,
            self.error == "angle",
            threshold_px / THRESHOLD_SIGMAS, np.exp(self.log_alpha), rounds,
        )  # fmt: skip
        return moved, sigma


def resect(
    ideal: Array,
    points: Array,
    focal_px: float,
    rng: np.random.Generator,
    options: AcRansacOptions | None = None,
    error: ErrorKind = "pixel",
) -> AbsolutePose | NotFound:
    """Find the pose that the matches make most meaningful, and refine it.

    Args:
        ideal: (M, 2) where landmarks were seen, ideal coordinates x/z, y/z, finite.
        points: (M, 3) the landmarks, world frame, m.
        focal_px: px per ideal unit.
        rng: of the search; the same one gives the same answer.
        options: how long to search.
        error: what is called an error (``ResectionProblem``).
    """
    # A kernel is compiled once more for arrays that may not be written, and for integers.
    ideal, points = (np.array(side, dtype=np.float64, order="C") for side in (ideal, points))
    if len(ideal) <= SAMPLE_SIZE + 1:
        return NotFound(f"{len(ideal)} landmarks matched, more than {SAMPLE_SIZE + 1} needed")
    # Precision is lost with the square of the distance to the origin.
    centre = np.asarray(points.mean(axis=0))
    area = _extent_px2(ideal, focal_px, error)
    problem = ResectionProblem(ideal, points - centre, float(focal_px), area, error)
    found = ac_ransac(problem, rng, options)
    if isinstance(found, NotFound):
        return found
    model, sigma = problem.refined(found.model, found.threshold_px)
    judged = consensus_of(problem, model)
    if judged.log_nfa >= 0.0:
        model, judged = found.model, found
    return _absolute_pose(model, sigma, judged, centre)


def _absolute_pose(model: Array, sigma: float, judged: Consensus, centre: Array) -> AbsolutePose:
    rotation = orthonormalized(model[:, :3])
    pose = Pose(rotation, model[:, 3] - rotation @ centre)
    return AbsolutePose(pose, judged.inliers, judged.threshold_px, sigma, judged.log_nfa)


def _extent_px2(ideal: Array, focal_px: float, error: ErrorKind) -> float:
    """Return how large the part of the image, or of the sphere, is where landmarks were seen."""
    if error == "pixel":
        return float(np.maximum(np.ptp(ideal, axis=0) * focal_px, 1e-3).prod())
    low, high = ideal.min(axis=0), ideal.max(axis=0)
    corners = [
        (sx * sy, x, y)
        for sx, x in ((-1, low[0]), (1, high[0]))
        for sy, y in ((-1, low[1]), (1, high[1]))
    ]
    # Solid angle of a rectangle in the image plane
    angle = sum(s * np.arctan(x * y / np.sqrt(1.0 + x * x + y * y)) for s, x, y in corners)
    return float(max(angle * focal_px**2, 1e-6))


@compiled
def _squared_errors(
    models: Array, ideal: Array, points: Array, focal_px: float, angular: bool
) -> Array:
    n = len(points)
    out = np.empty((len(models), n))
    scale = focal_px * focal_px
    for k in range(len(models)):
        m = models[k]
        for i in range(n):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
            if not z > 1e-9:
                out[k, i] = np.inf
                continue
            x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]
            y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]
            if angular:
                u, v = ideal[i, 0], ideal[i, 1]
                seen, real = np.sqrt(1.0 + u * u + v * v), np.sqrt(x * x + y * y + z * z)
                dx, dy, dz = x / real - u / seen, y / real - v / seen, z / real - 1.0 / seen
                # A chord; for the angles of inliers the same as the arc.
                out[k, i] = scale * (dx * dx + dy * dy + dz * dz)
            else:
                du, dv = x / z - ideal[i, 0], y / z - ideal[i, 1]
                out[k, i] = scale * (du * du + dv * dv)
    return out


@compiled
def _refined(
    model: Array,
    ideal: Array,
    points: Array,
    focal_px: float,
    angular: bool,
    sigma_px: float,
    wrong_density: float,
    rounds: int,
) -> tuple[Array, float]:
    """Move a pose to the maximum of the likelihood of all matches.

    Good ones err by a Gaussian, wrong ones uniformly; sigma and the share of
    good ones are estimated along (expectation maximisation).

    ``sigma_px`` is a first guess of the noise of one coordinate, ``wrong_density``
    the probability per squared px of radius of a wrong match; the rest is
    ``ResectionProblem``'s. Returns the (3, 4) pose, and sigma.
    """
    n = len(points)
    share, damping, ceiling = 0.5, 1e-4, 3.0 * sigma_px
    residual, slopes = np.empty((n, 2)), np.empty((n, 2, 6))
    weight = np.empty(n)
    linearize(model, ideal, points, focal_px, angular, residual, slopes)
    for _ in range(3):
        sigma_px, share = _mixture(residual, sigma_px, share, wrong_density, ceiling, weight)
    moved_residual, moved_slopes = np.empty((n, 2)), np.empty((n, 2, 6))
    for _ in range(rounds):
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for i in range(n):
            if weight[i] < 1e-6:
                continue
            for c in range(2):
                for p in range(6):
                    weighted = weight[i] * slopes[i, c, p]
                    right[p] -= weighted * residual[i, c]
                    for q in range(p + 1):
                        normal[p, q] += weighted * slopes[i, c, q]
        for p in range(6):
            for q in range(p):
                normal[q, p] = normal[p, q]
            normal[p, p] += damping * normal[p, p] + 1e-12
        step = np.linalg.solve(normal, right).astype(np.float64)
        moved = _stepped(model, step)
        linearize(moved, ideal, points, focal_px, angular, moved_residual, moved_slopes)
        # With the weights held, less of this is a greater likelihood.
        if not _weighted_squares(moved_residual, weight) < _weighted_squares(residual, weight):
            damping *= 10.0
            if damping > 1e4 or np.abs(step).max() < 1e-10:
                break
            continue
        damping = max(damping * 0.1, 1e-7)
        model = moved
        residual, moved_residual = moved_residual, residual
        slopes, moved_slopes = moved_slopes, slopes
        before = sigma_px
        sigma_px, share = _mixture(residual, sigma_px, share, wrong_density, ceiling, weight)
        if np.abs(step).max() < 1e-8 and abs(sigma_px - before) < 1e-3 * before:
            break
    return model, sigma_px


@compiled
def _stepped(model: Array, step: Array) -> Array:
    """Turn about the camera's axes by step[:3], rad, and move its points by step[3:], m."""
    angle = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    cross = np.zeros((3, 3))
    cross[0, 1], cross[0, 2], cross[1, 2] = -step[2], step[1], -step[0]
    cross[1, 0], cross[2, 0], cross[2, 1] = step[2], -step[1], step[0]
    turn = np.eye(3) + cross
    if angle > 1e-8:
        turn = (
            np.eye(3)
            + np.sin(angle) / angle * cross
            + (1.0 - np.cos(angle)) / angle**2 * (cross @ cross)
        )
    out = turn @ model
    out[:, 3] += step[3:]
    return out


@compiled
def linearize(
    model: Array,
    ideal: Array,
    points: Array,
    focal_px: float,
    angular: bool,
    residual: Array,
    slopes: Array,
) -> None:
    """Fill (N, 2) residuals, px, and (N, 2, 6) slopes; far off and flat behind the camera."""
    gradient = np.empty((2, 3))
    for i in range(len(points)):
        x, y, z = model[0, 3], model[1, 3], model[2, 3]
        for j in range(3):
            x += model[0, j] * points[i, j]
            y += model[1, j] * points[i, j]
            z += model[2, j] * points[i, j]
        if not z > 1e-9:
            residual[i] = 1e6
            slopes[i] = 0.0
            continue
        if angular:
            # Along two axes across the ray seen; the slope is that of the unit direction.
            distance = np.sqrt(x * x + y * y + z * z)
            _across(ideal[i, 0], ideal[i, 1], gradient)
            for c in range(2):
                part = (gradient[c, 0] * x + gradient[c, 1] * y + gradient[c, 2] * z) / distance
                residual[i, c] = focal_px * part
                for j, value in ((0, x), (1, y), (2, z)):
                    out_of_line = gradient[c, j] - part * value / distance
                    gradient[c, j] = focal_px / distance * out_of_line
        else:
            u, v, s = x / z, y / z, focal_px / z
            residual[i, 0] = focal_px * (u - ideal[i, 0])
            residual[i, 1] = focal_px * (v - ideal[i, 1])
            gradient[0, 0], gradient[0, 1], gradient[0, 2] = s, 0.0, -s * u
            gradient[1, 0], gradient[1, 1], gradient[1, 2] = 0.0, s, -s * v
        for c in range(2):
            g0, g1, g2 = gradient[c, 0], gradient[c, 1], gradient[c, 2]
            slopes[i, c, 0] = y * g2 - z * g1
            slopes[i, c, 1] = z * g0 - x * g2
            slopes[i, c, 2] = x * g1 - y * g0
            slopes[i, c, 3], slopes[i, c, 4], slopes[i, c, 5] = g0, g1, g2


@compiled
def _across(u: float, v: float, axes: Array) -> None:
    """Fill two unit vectors across the ray (u, v, 1) and each other."""
    length = np.sqrt(1.0 + u * u)
    whole = np.sqrt(1.0 + u * u + v * v)
    axes[0, 0], axes[0, 1], axes[0, 2] = 1.0 / length, 0.0, -u / length
    axes[1, 0] = -u * v / (length * whole)
    axes[1, 1] = length / whole
    axes[1, 2] = -v / (length * whole)


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
    ratio = share / (2.0 * sigma_px**2) / ((1.0 - share) * wrong_density)
    total, squares = 0.0, 0.0
    for i in range(len(residual)):
        squared = residual[i, 0] ** 2 + residual[i, 1] ** 2
        exponent = -0.5 * squared / sigma_px**2
        good = ratio * np.exp(exponent) if exponent > _NEVER else 0.0
        weight[i] = good / (good + 1.0)
        total += weight[i]
        squares += weight[i] * squared
    # The pose takes six degrees of freedom out of the residuals.
    sigma = np.sqrt(squares / max(2.0 * total - 6.0, 1.0))
    share = min(max(total / len(residual), 0.01), 0.99)
    return min(max(sigma, _FINEST_PX), ceiling), share


@compiled
def _weighted_squares(residual: Array, weight: Array) -> float:
    total = 0.0
    for i in range(len(residual)):
        total += weight[i] * (residual[i, 0] ** 2 + residual[i, 1] ** 2)
    return total
