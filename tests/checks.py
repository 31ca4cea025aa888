"""What tests assert about poses, Jacobians and covariances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array


def assert_pose_close(
    found: Pose, truth: Pose, *, within_m: float, within_rad: float, least_m: float = 0.0
) -> None:
    """Assert that a pose is near the truth, and no nearer than the noise allows.

    Args:
        found: the estimate.
        truth: what it should be.
        within_m: largest error of position (length).
        within_rad: largest error of orientation (angle).
        least_m: smallest believable error of position: less means that the noise
            did not reach the estimate. 0 for exact tests.
    """
    error = truth.local(found)
    metres, radians = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
    assert metres <= within_m, f"position is {metres:.3g} m off, {within_m:.3g} allowed"
    assert radians <= within_rad, f"rotation is {radians:.3g} rad off, {within_rad:.3g} allowed"
    assert metres >= least_m, f"position is only {metres:.3g} m off; noise of {least_m:.3g} lost"


def numeric_jacobian(
    function: Callable[[Array], Array], at: ArrayLike, step: float = 1e-6
) -> Array:
    """Return the (M, K) derivative of a (K,) -> (M,) function by central differences."""
    x = np.array(at, dtype=np.float64)
    columns = []
    for k in range(len(x)):
        delta = np.zeros_like(x)
        delta[k] = step
        columns.append((np.ravel(function(x + delta)) - np.ravel(function(x - delta))) / (2 * step))
    return np.stack(columns, axis=1)


def nees(errors: ArrayLike, covariances: ArrayLike) -> Array:
    """Return (K,) normalised squared errors of (K, D) errors; covariances (K, D, D) or (D, D)."""
    e = np.atleast_2d(np.asarray(errors, dtype=np.float64))
    c = np.broadcast_to(np.asarray(covariances, dtype=np.float64), (len(e), e.shape[1], e.shape[1]))
    return np.asarray(np.einsum("kd,kd->k", e, np.linalg.solve(c, e[..., None])[..., 0]))


def assert_consistent(
    errors: ArrayLike,
    covariances: ArrayLike,
    *,
    confidence: float = 0.999,
    slack: float = 1.0,
) -> None:
    """Assert that errors are as large as their covariances say: neither over- nor underconfident.

    The sum of K independent normalised squared errors in D dimensions is
    chi-square with K*D degrees of freedom; its mean must lie within the
    two-sided ``confidence`` interval.

    Args:
        errors: (K, D), or (D,) for one.
        covariances: (K, D, D), or (D, D) for all.
        confidence: two-sided probability that a consistent estimator passes.
        slack: widens both bounds by this factor, for estimators whose covariance
            is approximate; say why where you use it.
    """
    values = nees(errors, covariances)
    k, d = len(values), np.atleast_2d(np.asarray(errors)).shape[1]
    low = float(chi2.ppf((1 - confidence) / 2, k * d)) / k
    high = float(chi2.ppf((1 + confidence) / 2, k * d)) / k
    mean = float(values.mean())
    assert low / slack <= mean <= high * slack, (
        f"mean NEES {mean:.2f} of {k} draws is outside [{low / slack:.2f}, {high * slack:.2f}] "
        f"for {d} degrees of freedom: " + ("overconfident" if mean > high else "underconfident")
    )
