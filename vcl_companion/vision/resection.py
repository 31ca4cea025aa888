"""A camera's pose from landmarks it sees: robust search, refinement, covariance (IV-D, IV-F).

The search is P3P inside an a-contrario RANSAC; the refinement weighs every landmark by the
pixel noise **and** by the landmark's own uncertainty as it appears in this
image, so that a badly triangulated depth cannot pull the pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.options import require_positive
from vcl_companion.vision.absolute_pose import resect
from vcl_companion.vision.acransac import AcRansacOptions
from vcl_companion.vision.acransac import NotFound as NotFound
from vcl_companion.vision.bundle import linearized
from vcl_companion.vision.information import covariance_of
from vcl_companion.vision.pose_kernels import DIVERGED, SINGULAR, converged

Mask = NDArray[np.bool_]

# 99 % of a two-dimensional Gaussian lies within this squared Mahalanobis distance.
_CHI2_2_99 = 9.21
# Variance of the robust estimate over that of its weights taken as fixed, for Gaussian
# noise in two dimensions: E[w^2 s/2] E[w]^2 / (E[w + s w']^2 E[w^2]) with w = (1 + s/4)^-2.
_ROBUST_LOSS = 1.1136
_MAX_ROUNDS = 3
_SCALES = np.array([8.0, 3.0, 1.0, 1.0])
# Smallest eigenvalue of a normal matrix, scaled to a diagonal of ones, that is no rounding.
_SINGULAR = 1e-9


@dataclass(frozen=True)
class ResectionOptions:
    """How a pose is searched and when it is believed.

    Attributes:
        min_inliers: fewer are refused.
        max_samples: of the search, at most.
        max_leverage: how much of its most determined direction one landmark may decide.
    """

    min_inliers: int = 15
    max_samples: int = 2000
    max_leverage: float = 0.4

    def __post_init__(self) -> None:
        if self.min_inliers < 6 or self.max_samples < 10:
            raise ValueError("resection needs min_inliers >= 6, max_samples >= 10")


@dataclass(frozen=True, eq=False)
class Sightings:
    """Landmarks matched to one image.

    Attributes:
        ideal: (M, 2) where they were seen, ideal image coordinates x/z, y/z.
        points: (M, 3) landmarks, world frame, m.
        point_covariances: (M, 3, 3) of the landmarks, world frame, m^2.
        focal_px: px per ideal unit, near enough for the search.
        slopes: (M, 2, 2) d(pixel) / d(ideal) at each sighting.
        body_from_cam: the camera's mounting.
        noise_px: 1-sigma of one pixel coordinate, new in every image.
        bias_px: (M,) 1-sigma of what a detector misplaces each of them by because
            it looks different from here; the same in every image taken from here.
    """

    ideal: Array
    points: Array
    point_covariances: Array
    focal_px: float
    slopes: Array
    body_from_cam: Pose
    noise_px: float
    bias_px: Array

    def __post_init__(self) -> None:
        require_positive(self, "noise_px")

    def usable(self) -> Mask:
        """Return (M,) which sightings are finite: a pixel may be none the lens can produce."""
        finite = np.isfinite(self.ideal).all(axis=1) & np.isfinite(self.points).all(axis=1)
        return np.asarray(finite & np.isfinite(self.point_covariances).all(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class Resection:
    """A pose found.

    Attributes:
        world_from_body: the pose.
        inliers: (M,) which sightings support it.
        gain: (M_in, 6, 2) the pose's local perturbation per px of residual of each inlier.
        jacobian_pose: (M_in, 2, 6) residual by pose.
        jacobian_points: (M_in, 2, 3) residual by landmark, px/m.
        noise_covariance: (6, 6) from pixel noise alone, local perturbation (eq. 12).
        bias_covariance: (6, 6) from ``bias_px``, likewise.
        rms_px: of the inliers' reprojection errors.
        median_px: of these errors' lengths.
    """

    world_from_body: Pose
    inliers: Mask
    gain: Array
    jacobian_pose: Array
    jacobian_points: Array
    noise_covariance: Array
    bias_covariance: Array
    rms_px: float
    median_px: float


@dataclass(frozen=True)
class Undecided(NotFound):
    """A pose that does not stand without single landmarks: they may be wrong, it may be right."""

    found: Resection = field(compare=False)


def search(sightings: Sightings, options: ResectionOptions, seed: int = 0) -> Pose | NotFound:
    """Find the pose that the sightings make most meaningful, without any first guess."""
    usable = sightings.usable()
    n = int(usable.sum())
    if n < options.min_inliers:
        return NotFound(f"{n} landmarks matched, {options.min_inliers} needed")
    found = resect(
        sightings.ideal[usable],
        sightings.points[usable],
        sightings.focal_px,
        np.random.default_rng(seed),
        AcRansacOptions(options.max_samples),
    )
    if isinstance(found, NotFound):
        return NotFound(f"no pose agrees with {options.min_inliers} of {n} matched landmarks")
    return (sightings.body_from_cam @ found.cam_from_world).inverse()


def refine(
    world_from_body: Pose, sightings: Sightings, options: ResectionOptions
) -> Resection | NotFound:
    """Refine a pose over all sightings that agree with it (eq. 4), with its covariance (eq. 12).

    Args:
        world_from_body: the first guess, good to some tens of px.
        sightings: all matches, wrong ones among them.
        options: how many must agree.

    Returns:
        The pose with its support, or why it is not to be believed.
    """
    usable = sightings.usable()
    first: Resection | None = None

    def failed(why: NotFound) -> NotFound:
        return why if first is None else Undecided(why.reason, first)

    for n_rounds in range(_MAX_ROUNDS):
        if usable.sum() < options.min_inliers:
            word = "left" if n_rounds else "matched"
            least = options.min_inliers
            return failed(NotFound(f"{usable.sum()} landmarks {word}, {least} needed"))
        pose = _converged(world_from_body, _of(sightings, usable))
        if isinstance(pose, NotFound):
            return failed(pose)
        found = _supported(pose, sightings, usable, options)
        if isinstance(found, NotFound):
            return failed(found)
        first = first or found
        # On a flat scene one landmark off the plane, a wrong match perhaps, would
        # fix the pose all by itself: the pose has to stand without such landmarks.
        decisive = _leverage(found) > options.max_leverage
        if not decisive.any():
            return found
        usable[np.flatnonzero(found.inliers)[decisive]] = False
        world_from_body = found.world_from_body
    return failed(NotFound("single landmarks decide the pose: the others do not fix it"))


def _converged(pose: Pose, sightings: Sightings) -> Pose | NotFound:
    """Gauss-Newton with a redescending weight, wide at first."""
    pixel = sightings.noise_px**2 + sightings.bias_px**2
    matrix, outcome = converged(
        np.ascontiguousarray(pose.matrix()[:3]),
        np.ascontiguousarray(sightings.body_from_cam.matrix()[:3]),
        np.array(sightings.ideal),
        np.array(sightings.slopes),
        np.array(sightings.points),
        np.ascontiguousarray(sightings.point_covariances[:, *np.triu_indices(3)]),
        np.column_stack([pixel, np.zeros_like(pixel), pixel]),
        np.zeros((6, 6)),
        _SCALES,
    )
    if outcome == SINGULAR:
        return NotFound("the matched landmarks do not fix a pose")
    if outcome == DIVERGED:
        return NotFound("the refinement of the pose diverged")
    return Pose(matrix[:, :3], matrix[:, 3])


def somewhere_alike(found: Resection, radius_px: float) -> NotFound | None:
    """Refuse a pose whose landmarks lie anywhere around where it puts them.

    Where landmarks are vague, whatever resembles them nearby agrees. Of wrong matches, which lie
    anywhere within the radius, a quarter are within half of it; of a place that is right most are.

    Args:
        found: the pose, by landmarks looked for near where it, or one close to it, puts them.
        radius_px: how far from there they were looked for.

    Returns:
        Why it is none; None for a place that is right.
    """
    if found.median_px < 0.5 * radius_px:
        return None
    return NotFound("landmarks lie anywhere around where they should: somewhere alike")


def _supported(
    pose: Pose, sightings: Sightings, usable: Mask, options: ResectionOptions
) -> Resection | NotFound:
    """Find who agrees with a converged pose, and how well they fix it."""
    residual, j_pose, j_point = _linearized(pose, sightings)
    information = _information(j_point, sightings, 1.0)
    squared = np.einsum("nk,nkl,nl->n", residual, information, residual)
    inliers = usable & (squared < 2.0 * _CHI2_2_99)
    n_inliers = int(inliers.sum())
    if n_inliers < options.min_inliers:
        return NotFound(f"{n_inliers} landmarks agree on a pose, {options.min_inliers} needed")
    weighted = _weighted(residual[inliers], j_pose[inliers], information[inliers])
    normal = np.einsum("nik,nkj->ij", weighted, j_pose[inliers])
    inverse = covariance_of(normal, _SINGULAR)
    if inverse is None:
        return NotFound("the matched landmarks do not fix a pose")
    gain = np.einsum("ij,njk->nik", inverse, weighted)
    by_landmark = gain @ np.swapaxes(gain, 1, 2)
    error_px = np.linalg.norm(residual[inliers], axis=1)
    return Resection(
        pose,
        np.asarray(inliers),
        gain,
        j_pose[inliers],
        j_point[inliers],
        _ROBUST_LOSS * by_landmark.sum(axis=0) * sightings.noise_px**2,
        _ROBUST_LOSS * np.einsum("nij,n->ij", by_landmark, sightings.bias_px[inliers] ** 2),
        float(np.sqrt((error_px**2).mean())),
        float(np.median(error_px)),
    )


def _leverage(found: Resection) -> Array:
    """Return (M_in,) how much of its most determined direction each inlier decides, 0 to 1."""
    own = found.jacobian_pose @ found.gain
    return np.asarray(np.abs(np.linalg.eigvals(own)).max(axis=1))


def _of(sightings: Sightings, chosen: Mask) -> Sightings:
    return replace(
        sightings,
        ideal=sightings.ideal[chosen],
        points=sightings.points[chosen],
        point_covariances=sightings.point_covariances[chosen],
        bias_px=sightings.bias_px[chosen],
        slopes=sightings.slopes[chosen],
    )


def _weighted(residual: Array, j_pose: Array, information: Array) -> Array:
    """Return (M, 6, 2) transposed Jacobians times information times robust weight."""
    squared = np.einsum("nk,nkl,nl->n", residual, information, residual)
    weight = 1.0 / (1.0 + squared / 4.0) ** 2
    out = np.einsum("nki,nkl->nil", j_pose, information)
    return np.asarray(out * weight[:, None, None])


def _linearized(pose: Pose, sightings: Sightings) -> tuple[Array, Array, Array]:
    return linearized(
        pose, sightings.body_from_cam, sightings.slopes, sightings.points, sightings.ideal
    )


def _information(j_point: Array, sightings: Sightings, scale: float) -> Array:
    """Return (M, 2, 2) inverse covariances of the residuals: pixel noise and landmark error.

    ``scale`` widens the noise in early iterations, when the pose is still off.
    """
    covariance = j_point @ sightings.point_covariances @ np.swapaxes(j_point, 1, 2)
    covariance[:, [0, 1], [0, 1]] += sightings.noise_px**2 + sightings.bias_px[:, None] ** 2
    return np.asarray(np.linalg.inv(covariance * scale**2))
