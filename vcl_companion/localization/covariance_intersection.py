"""Fusing two poses whose errors are correlated in an unknown way (eqs. 10 and 11).

Two drones that fly on one map share its error, and what one says of the other
contains what the other once said of it. Covariance intersection (Julier and
Uhlmann 1997) stays consistent whatever the correlation is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, right_jacobian_so3

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_FINE = 1e-5


@dataclass(frozen=True, eq=False)
class Fused:
    """What covariance intersection makes of two poses.

    Attributes:
        world_from_body: the fused pose.
        covariance: (6, 6) local perturbation.
        omega: weight of the first pose, 0 to 1; 1 leaves it as it is.
    """

    world_from_body: Pose
    covariance: Array
    omega: float


def intersect(
    first: Pose, first_covariance: Array, second: Pose, second_covariance: Array, arm_m: float
) -> Fused:
    """Fuse two poses of one body at one instant.

    Args:
        first: world_from_body.
        first_covariance: (6, 6) local perturbation, positive definite.
        second: another estimate of the same.
        second_covariance: (6, 6) likewise.
        arm_m: how far away the scene is: a rotation error of e rad counts like a
            position error of ``arm_m * e`` metres when omega is chosen (the trace
            of a pose covariance has no unit otherwise).

    Returns:
        The fused pose with the omega of least trace.

    Raises:
        ValueError: a covariance is not positive definite, or the arm not positive.
    """
    if not arm_m > 0:
        raise ValueError(f"arm_m must be positive, got {arm_m}")
    difference = first.local(second)
    # Written at the first pose: R1 Exp(phi + J^-1(phi) d) = R2 Exp(d).
    carried = np.zeros((6, 6))
    carried[:3, :3] = first.rotation.T @ second.rotation
    carried[3:, 3:] = np.linalg.inv(right_jacobian_so3(difference[3:]))
    information_a = _inverse(first_covariance)
    information_b = _inverse(carried @ second_covariance @ carried.T)
    units = np.array([1.0, 1.0, 1.0, arm_m, arm_m, arm_m])

    def cost(omega: float) -> float:
        fused = np.linalg.inv(omega * information_a + (1.0 - omega) * information_b)
        return float(np.trace(fused * np.outer(units, units)))

    omega = min((0.0, _least(cost), 1.0), key=cost)
    covariance = np.linalg.inv(omega * information_a + (1.0 - omega) * information_b)
    step = covariance @ ((1.0 - omega) * information_b @ difference)
    turned = np.eye(6)
    turned[3:, 3:] = right_jacobian_so3(step[3:])
    turned[:3, :3] = first.retracted(step).rotation.T @ first.rotation
    covariance = turned @ covariance @ turned.T
    return Fused(first.retracted(step), 0.5 * (covariance + covariance.T), omega)


def unlikeness(
    first: Pose, first_covariance: Array, second: Pose, second_covariance: Array
) -> float:
    """Return how far apart two poses are, squared, in units of the most their errors can differ.

    Whatever the correlation, the covariance of the difference is at most twice
    the sum; beyond chi-square's 99.99 % (27.9) at least one of them is wrong.
    """
    difference = first.local(second)
    bound = 2.0 * (first_covariance + second_covariance)
    return float(difference @ np.linalg.solve(bound, difference))


def _least(cost: Callable[[float], float]) -> float:
    """Return where in [0, 1] a convex cost is least, to 1e-5, by golden sections (Kiefer 1953)."""
    low, high = 0.0, 1.0
    left, right = 1.0 - _GOLDEN, _GOLDEN
    at_left, at_right = cost(left), cost(right)
    while high - low > _FINE:
        if at_left <= at_right:
            high, right, at_right = right, left, at_left
            left = high - _GOLDEN * (high - low)
            at_left = cost(left)
        else:
            low, left, at_left = left, right, at_right
            right = low + _GOLDEN * (high - low)
            at_right = cost(right)
    return 0.5 * (low + high)


def _inverse(covariance: Array) -> Array:
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        root = np.full((6, 6), np.nan)
    if not np.all(np.isfinite(root)):
        raise ValueError("a pose covariance is not positive definite")
    return np.asarray(np.linalg.inv(covariance))
