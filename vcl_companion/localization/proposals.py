"""What a peer says of our pose, taken into our state: begun from, or fused (eqs. 10 and 11)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.covariance_intersection import intersect, unlikeness
from vcl_companion.localization.filter_state import (
    GATE_POSE,
    N_OWN,
    OFFSET,
    POSITION,
    FilterState,
    Measurement,
    kalman_step,
)
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.pose_filter import FilterOptions, started

# A proposal has to take this much of the variance away to be news.
_NEWS = 0.95
_LEAST_OMEGA = 1e-3


@dataclass(frozen=True)
class NotFused:
    """A proposal was not taken, and why.

    Attributes:
        reason: for people.
        contradicts: whether it says otherwise than what we know; else it came too late.
    """

    reason: str
    contradicts: bool = False


def fuse(
    state: FilterState, world_from_body: Pose, covariance: Array, arm_m: float
) -> FilterState | NotFused:
    """Fuse what a peer says of our pose at the state's instant (eqs. 10 and 11).

    What is correlated with what is unknown: both came from the same map, and
    what the peer knows may have come from us. Covariance intersection is a
    Kalman update after both sides are widened, ours by 1/omega, the proposal by
    1/(1 - omega).

    Args:
        state: of the instant that the proposal is about.
        world_from_body: where the peer says that we were.
        covariance: (6, 6) local, of that.
        arm_m: distance of the scene, to weigh radians against metres.

    Returns:
        The state with the proposal in it, confirmed but not moved when the
        proposal has little to add; or why it is not taken: a pose that the
        covariances cannot explain at any correlation.
    """
    own = state.pose_covariance()
    try:
        weighed = intersect(state.world_from_body, own, world_from_body, covariance, arm_m)
    except ValueError as error:
        return NotFused(str(error))
    distance = unlikeness(state.world_from_body, own, world_from_body, covariance)
    if not distance <= GATE_POSE:
        metres = np.linalg.norm(world_from_body.translation - state.world_from_body.translation)
        return NotFused(f"{metres:.1f} m from where we are, more than both sigmas explain", True)
    units = np.diag([1.0, 1.0, 1.0, arm_m, arm_m, arm_m]) ** 2
    if np.trace(units @ weighed.covariance) > _NEWS * np.trace(units @ own):
        # Widening what the proposal says nothing of would cost more.
        return state if state.fixed_at_ns == state.at_ns else state.fixed()
    omega = min(max(weighed.omega, _LEAST_OMEGA), 1.0 - _LEAST_OMEGA)
    observation = state.to_pose()
    # The landmarks' own errors are part of what is widened, and absorbed with it.
    absorbing = np.zeros((len(state.covariance), 6))
    absorbing[POSITION, :3] = absorbing[OFFSET, 3:] = state.world_from_body.rotation
    prior = state.covariance + absorbing @ state.own_map_covariance @ absorbing.T
    # Of velocity and offset only what follows from the pose is widened with it: what is
    # unknown of them besides is the drone's own motion, of which no peer ever heard.
    with_pose = prior @ observation.T
    prior += (1.0 / omega - 1.0) * with_pose @ np.linalg.solve(own, with_pose.T)
    measured = Measurement(
        state.world_from_body.local(world_from_body), observation, covariance / (1.0 - omega)
    )
    step, fused = kalman_step(prior, measured)
    # The keyframes' own errors did not grow; scaling them back keeps the correlations.
    fused[N_OWN:] *= np.sqrt(omega)
    fused[:, N_OWN:] *= np.sqrt(omega)
    fused[N_OWN:, N_OWN:] = state.covariance[N_OWN:, N_OWN:]
    return state.corrected(step, fused, np.zeros((6, 6)))


def started_from_proposal(
    world_from_body: Pose,
    covariance: Array,
    at_ns: int,
    ned_from_body: Array | None,
    options: FilterOptions,
) -> FilterState:
    """Begin from where a peer says that we were, with unknown speed.

    Args:
        world_from_body: the proposed pose.
        covariance: (6, 6) local, of that; the map's error is part of it and can
            not be told apart, so the next fix brings its own.
        at_ns: instant of the frame that the proposal is about.
        ned_from_body: (3, 3) attitude of that instant, or None.
        options: the filter's.
    """
    fix = Localized(
        world_from_body,
        noise_covariance=covariance,
        own_map_covariance=np.zeros((6, 6)),
        map_lever=np.zeros((6, 0)),
        keyframe_covariance=np.zeros((0, 0)),
        n_matched=0,
        n_inliers=0,
        guided=False,
        rms_px=0.0,
    )
    return started(fix, at_ns, ned_from_body, options)
