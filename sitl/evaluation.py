"""How far the sent poses are from the truth, and whether their covariance says so.

Two frames occur. ``world`` is the daemons' own; ``ref`` is the recording's.
``ref_from_world`` is **one** rigid transform for the whole swarm: the leader's
true pose against the leader's own estimate at its first estimated frame. That
one estimate is therefore taken to be exact: its error, up to its sent
covariance, is part of every other error here, and so are the lever arms of its
angles. A swarm whose covariances are honest relative to the map can look a
little overconfident for it, never the other way round.

Covariances are compared as they were sent: x y z in the axes of ``world``, then
roll pitch yaw; so errors are carried back into ``world`` first.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, euler_from_matrix

CLOSE_ENOUGH_M = 0.10
_UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class Estimates:
    """The poses one autopilot received.

    Attributes:
        at_ns: (T,) int64 instants they are about, the recording's time.
        world_from_body: T poses.
        covariances: (T, 6, 6) as sent: x y z in world axes, m, then roll pitch
            yaw, rad; NaN where none was sent.
        reset_counters: (T,) int64 as sent; zeros where not given.
    """

    at_ns: NDArray[np.int64]
    world_from_body: tuple[Pose, ...]
    covariances: Array
    reset_counters: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        n = len(self.world_from_body)
        if len(self.reset_counters) == 0:
            object.__setattr__(self, "reset_counters", np.zeros(n, dtype=np.int64))
        for name, shape, kind in (
            ("at_ns", (n,), np.int64),
            ("covariances", (n, 6, 6), float),
            ("reset_counters", (n,), np.int64),
        ):
            value = np.array(getattr(self, name), dtype=kind)
            if value.shape != shape:
                raise ValueError(f"Estimates.{name} has shape {value.shape}, expected {shape}")
            value.flags.writeable = False
            object.__setattr__(self, name, value)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Estimate minus truth, for the T estimates that have a truth.

    Attributes:
        at_ns: (T,) instants.
        position_ref_m: (T, 3) position error along the axes of ``ref``.
        position_sigma_ref_m: (T, 3) the sent 1-sigma along the same axes.
        yaw_rad: (T,) heading error, in -pi..pi.
        yaw_sigma_rad: (T,) its sent 1-sigma.
        nees: (T,) normalised error squared, 6 degrees of freedom, expected 6,
            median 5.35 for a normal error; NaN when no usable covariance was sent.
        within_3_sigma: (T,) |error| <= 3 sigma along x, y and z of ``world``,
            each by itself.
        within_3_sigma_or_10cm: (T,) the same with 3 sigma taken as at least 0.1 m.
        truth_ref_m: (T, 3) true positions.
        estimate_ref_m: (T, 3) estimated positions, carried over by the leader's start.
    """

    at_ns: NDArray[np.int64]
    position_ref_m: Array
    position_sigma_ref_m: Array
    yaw_rad: Array
    yaw_sigma_rad: Array
    nees: Array
    within_3_sigma: NDArray[np.bool_]
    within_3_sigma_or_10cm: NDArray[np.bool_]
    truth_ref_m: Array
    estimate_ref_m: Array


@dataclass(frozen=True)
class Scores:
    """One drone's flight in numbers; see ``PoseErrors`` for what each is made of.

    ``ate_aligned_m`` is None below three poses, where a rigid alignment could
    hide any error.
    """

    ate_m: float
    ate_aligned_m: float | None
    rmse_m: tuple[float, float, float]
    yaw_rmse_deg: float
    within_3_sigma_share: float
    within_3_sigma_or_10cm_share: float
    nees_median: float | None
    worst_m: float


def ref_from_world(truth: Pose, estimate: Pose) -> Pose:
    """Return the transform that lays one estimate (world_from_body) onto its truth."""
    return truth @ estimate.inverse()


def covariance_from_upper(values: Array) -> Array:
    """Return (..., 6, 6) symmetric matrices of (..., 21) row-major upper triangles (MAVLink)."""
    if values.shape[-1:] != (21,):
        raise ValueError(f"a pose covariance has 21 values, got {values.shape}")
    out = np.empty((*values.shape[:-1], 6, 6))
    out[..., _UPPER[0], _UPPER[1]] = values
    out[..., _UPPER[1], _UPPER[0]] = values
    return out


def upper_from_covariance(covariance: Array) -> Array:
    """Return the (..., 21) row-major upper triangles of (..., 6, 6) matrices (MAVLink)."""
    return np.asarray(covariance[..., _UPPER[0], _UPPER[1]])


def pose_errors(
    estimates: Estimates, truth: tuple[Pose | None, ...], ref_from_world: Pose
) -> PoseErrors:
    """Compare estimates with the truth at the same instants.

    Args:
        estimates: T poses as received.
        truth: T true poses ref_from_body; where None, the estimate is left out.
        ref_from_world: see the module.
    """
    if len(truth) != len(estimates.world_from_body):
        raise ValueError(f"{len(truth)} true poses for {len(estimates.world_from_body)} estimates")
    world_from_ref = ref_from_world.inverse()
    kept, rows = [], []
    for t, (estimate, true) in enumerate(zip(estimates.world_from_body, truth, strict=True)):
        if true is None:
            continue
        kept.append(t)
        error = sent_error(estimate, world_from_ref @ true)
        estimate_ref = ref_from_world @ estimate
        yaw = _yaw(estimate_ref) - _yaw(true)
        rows.append((error, true.translation, estimate_ref.translation, _wrapped(yaw)))
    error_world = np.array([row[0] for row in rows]).reshape(-1, 6)
    truth_ref = np.array([row[1] for row in rows]).reshape(-1, 3)
    estimate_ref_m = np.array([row[2] for row in rows]).reshape(-1, 3)
    covariances = estimates.covariances[kept]
    in_ref = ref_from_world.rotation @ covariances[:, :3, :3] @ ref_from_world.rotation.T
    limit_m = 3.0 * _sigmas(covariances[:, :3, :3])
    # NaN compares false: without a covariance nothing is within its sigma, and with the
    # 10 cm floor a pose is judged by the floor alone.
    floor_m = np.fmax(limit_m, CLOSE_ENOUGH_M)
    return PoseErrors(
        at_ns=estimates.at_ns[kept],
        position_ref_m=estimate_ref_m - truth_ref,
        position_sigma_ref_m=_sigmas(in_ref),
        yaw_rad=np.array([row[3] for row in rows], dtype=float),
        yaw_sigma_rad=_sigmas(covariances)[:, 5],
        nees=np.array([nees_of(e, c) for e, c in zip(error_world, covariances, strict=True)]),
        within_3_sigma=np.all(np.abs(error_world[:, :3]) <= limit_m, axis=1),
        within_3_sigma_or_10cm=np.all(np.abs(error_world[:, :3]) <= floor_m, axis=1),
        truth_ref_m=truth_ref,
        estimate_ref_m=estimate_ref_m,
    )


def sent_error(estimate: Pose, truth: Pose) -> Array:
    """Return the (6,) error of an estimate in the terms it is sent in.

    x y z in the axes of ``world``, m, then the differences of roll, pitch and
    yaw, rad, each in -pi..pi.
    """
    angles = np.subtract(euler_from_matrix(estimate.rotation), euler_from_matrix(truth.rotation))
    return np.concatenate([estimate.translation - truth.translation, _wrapped(angles)])


def scores(errors: PoseErrors, axes_from_ref: Array | None = None) -> Scores | None:
    """Return a flight's numbers; None when no estimate has a truth.

    Args:
        errors: of one drone.
        axes_from_ref: (3, 3) rotation into the axes that ``rmse_m`` is told along; None: ``ref``.
    """
    if not len(errors.at_ns):
        return None
    aligned_m = None
    if len(errors.at_ns) >= 3:
        moved = rigid_alignment(errors.estimate_ref_m, errors.truth_ref_m)
        left = moved.apply(errors.estimate_ref_m) - errors.truth_ref_m
        aligned_m = position_rms_m(left)
    along = (
        errors.position_ref_m if axes_from_ref is None else errors.position_ref_m @ axes_from_ref.T
    )
    x, y, z = (_rms(along[:, axis]) for axis in range(3))
    known = errors.nees[np.isfinite(errors.nees)]
    return Scores(
        ate_m=position_rms_m(errors.position_ref_m),
        ate_aligned_m=aligned_m,
        rmse_m=(x, y, z),
        yaw_rmse_deg=float(np.degrees(_rms(errors.yaw_rad))),
        within_3_sigma_share=float(np.mean(errors.within_3_sigma)),
        within_3_sigma_or_10cm_share=float(np.mean(errors.within_3_sigma_or_10cm)),
        nees_median=float(np.median(known)) if len(known) else None,
        worst_m=float(np.linalg.norm(errors.position_ref_m, axis=1).max()),
    )


def position_rms_m(errors_m: Array) -> float:
    """Return the root mean square length of (N, 3) position errors, m; N is at least 1."""
    return _rms(np.linalg.norm(errors_m, axis=1))


def rigid_alignment(moved: Array, fixed: Array) -> Pose:
    """Return fixed_from_moved, the rotation and translation of least squares (Umeyama 1991).

    Args:
        moved: (N, 3) points, m.
        fixed: (N, 3) where they should come to lie, m; no scale is fitted.
    """
    centre_moved, centre_fixed = moved.mean(axis=0), fixed.mean(axis=0)
    u, _, vt = np.linalg.svd((fixed - centre_fixed).T @ (moved - centre_moved))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Pose(rotation, centre_fixed - rotation @ centre_moved)


def nees_of(error: Array, covariance: Array) -> float:
    """Return e^T C^-1 e; NaN unless C is finite and positive definite."""
    if not np.all(np.isfinite(covariance)):
        return float("nan")
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(covariance), error)
    except np.linalg.LinAlgError:
        return float("nan")
    return float(whitened @ whitened)


def _sigmas(covariances: Array) -> Array:
    """Return (T, n) square roots of the diagonals of (T, n, n); NaN for a negative variance."""
    diagonal = np.diagonal(covariances, axis1=-2, axis2=-1)
    return np.sqrt(np.where(diagonal >= 0.0, diagonal, np.nan))


def _yaw(pose: Pose) -> float:
    return euler_from_matrix(pose.rotation)[2]


def _wrapped(angle: Array | float) -> Array:
    """Return angles carried into -pi..pi."""
    return np.asarray(np.arctan2(np.sin(angle), np.cos(angle)))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
