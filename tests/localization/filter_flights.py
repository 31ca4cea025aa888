"""Flights and their measurements as the pose filter believes them to be, for its tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_filter import (
    FilterOptions,
    predict,
    started,
    update,
)

NO_MAP_ERROR = np.zeros((12, 12))
NO_LEVER = np.zeros((6, 12))
STEP_NS = 200_000_000
STEP_S = 0.2
FIX_SIGMA = np.array([0.05, 0.03, 0.04, 0.004, 0.003, 0.005])
# Attitude offsets that neither drift nor grow by turning: what the simulation does.
STEADY = FilterOptions(acceleration_m_s2=1.0, attitude_drift_deg_s=1e-6, attitude_turn_error=0.0)


def fix_at(
    pose: Pose,
    sigma: Array = FIX_SIGMA,
    *,
    lever: Array = NO_LEVER,
    keyframe_covariance: Array = NO_MAP_ERROR,
    own_map_covariance: Array | None = None,
) -> Localized:
    own = np.zeros((6, 6)) if own_map_covariance is None else own_map_covariance
    return Localized(pose, np.diag(sigma**2), own, lever, keyframe_covariance, 100, 90, True, 0.5)


def updated(predicted: FilterState | None, fix: Localized) -> FilterState:
    assert predicted is not None
    state = update(predicted, fix)
    assert isinstance(state, FilterState), state
    return state


@dataclass(frozen=True, eq=False)
class Flight:
    """True poses every 0.2 s, and attitude as the autopilot tells it.

    Attributes:
        poses: K world_from_body.
        velocity_world: (K, 3) m/s.
        attitudes: K (3, 3) ned_from_body as measured, or None.
    """

    poses: list[Pose]
    velocity_world: Array
    attitudes: list[Array | None]


def fly(
    rng: np.random.Generator,
    n: int,
    options: FilterOptions,
    *,
    speed_m_s: float = 1.0,
    attitude: bool = True,
    turn_rad_s: float = 0.4,
    step_s: float = STEP_S,
    held_from: int | None = None,
) -> Flight:
    """Move and measure exactly as the filter believes: white acceleration, biased attitude.

    From frame ``held_from`` on, where fixes end, the acceleration stays what it is.
    """
    position, velocity = rng.standard_normal(3), speed_m_s * rng.standard_normal(3)
    rotation = matrix_from_euler(*(0.3 * rng.standard_normal(3)))
    rate = turn_rad_s * rng.standard_normal(3)
    ned_from_world = matrix_from_euler(0.01, -0.02, 1.5)
    sigma = np.deg2rad(options.attitude_sigma_deg)
    poses, velocities, attitudes = [], [], []
    shove = np.zeros(3)
    for k in range(n):
        poses.append(Pose(rotation, position))
        velocities.append(velocity)
        sample = ned_from_world @ rotation @ exp_so3(sigma * rng.standard_normal(3))
        attitudes.append(sample if attitude else None)
        if held_from is None or k <= held_from:
            shove = options.acceleration_m_s2 * rng.standard_normal(3)
        position = position + velocity * step_s + 0.5 * shove * step_s**2
        velocity = velocity + shove * step_s
        turned = rate * step_s
        if not attitude:
            turned = np.deg2rad(options.turn_rate_deg_s) * step_s * rng.standard_normal(3)
        rotation = rotation @ exp_so3(turned)
    return Flight(poses, np.array(velocities), attitudes)


def filtered(
    flight: Flight,
    fix_of: Callable[[Pose], Localized],
    options: FilterOptions,
    step_ns: int = STEP_NS,
) -> list[FilterState]:
    state = started(fix_of(flight.poses[0]), 0, flight.attitudes[0], options)
    states = [state]
    for k in range(1, len(flight.poses)):
        predicted = predict(state, k * step_ns, flight.attitudes[k], options)
        assert predicted is not None
        after = update(predicted, fix_of(flight.poses[k]))
        # One honest fix in ten thousand is refused by bad luck.
        state = predicted if isinstance(after, NotLocalized) else after
        states.append(state)
    return states


def noisy(rng: np.random.Generator, sigma: Array = FIX_SIGMA) -> Callable[[Pose], Localized]:
    return lambda pose: fix_at(pose.retracted(sigma * rng.standard_normal(6)), sigma)


def keyframe_errors(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the (12, 12) covariance of two keyframes, the first one held, and a draw of it."""
    factor = np.zeros((12, 12))
    factor[6:, 6:] = np.diag([0.2] * 3 + [0.01] * 3) @ (np.eye(6) + 0.3 * rng.random((6, 6)))
    return factor @ factor.T, factor @ rng.standard_normal(12)


def lever_in(pose: Pose) -> Array:
    """Return a (6, 12) lever that says: the whole map sits where its second keyframe claims.

    The same world error seen from every pose; in local axes it turns with the body.
    """
    out = np.zeros((6, 12))
    out[:3, 6:9] = out[3:, 9:] = pose.rotation.T
    return out
