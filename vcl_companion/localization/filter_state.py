"""What the pose filter believes of a drone at one instant, and how a measurement moves it.

What is estimated, besides position and velocity, is the rotation between the
map's world and the autopilot's north-east-down: the autopilot's attitude is
good from frame to frame and wrong by a slowly changing offset. The map's error
is common to all frames and must not be averaged away: the keyframes' errors
are *considered* (Schmidt 1966), that is, their correlation with the state is
kept, while they themselves are not estimated.

Error state: position (world), offset rotation (world), velocity (world), the
attitude sample's own error (body, new in every frame), keyframe errors, 6V of the swarm's map;
of a map of own views there is one more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, exp_so3, heading_of
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.localization.fix import Prior

POSITION, OFFSET, VELOCITY, SAMPLE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""The parts of the error state; those of the keyframes follow."""

N_OWN = 12
"""Length of the error state without the keyframes."""

GATE_POSE = 27.9
"""99.99 % of chi^2 with 6 degrees of freedom: beyond, it is not noise."""

# Of the sum of the keyframes' variances; rounding leaves more.
_EXACT = 1e-12
# Keyframes are not off alike: what the next ones are off beside those a state was found by, as a
# share of it.
_UNLIKE = 0.1


def unknown(covariance: Array, sigmas: Sequence[tuple[slice, float]]) -> Array:
    """Return an error state's covariance where nothing is known of some parts of three numbers.

    Args:
        covariance: (12 + K, 12 + K) of the error state.
        sigmas: each part, and how far it may be off then, 1 sigma.
    """
    out = covariance.copy()
    for part, sigma in sigmas:
        out[part] = out[:, part] = 0.0
        out[part, part] = np.eye(3) * sigma**2
    return out


@dataclass(frozen=True, eq=False)
class FilterState:
    """What the filter believes at one instant.

    Attributes:
        at_ns: the instant, host clock.
        world_from_body: pose.
        velocity_world: (3,) m/s.
        world_from_ned: (3, 3) offset of the autopilot's attitude.
        ned_from_body: (3, 3) the attitude sample of this instant, or None.
        covariance: (12 + 6V, 12 + 6V) of the error state, see the module.
        own_map_covariance: (6, 6) local, the used landmarks' own errors.
        fixed_at_ns: instant of the last fix.
        n_jumps: how often the estimate moved by more than its covariance explains.
        fixed_attitude: (3, 3) the attitude sample of the last fix, or None.
        turned_from_ns: instant of the last fix or attitude sample: how far the drone has turned
            is known up to there.
    """

    at_ns: int
    world_from_body: Pose
    velocity_world: Array
    world_from_ned: Array
    ned_from_body: Array | None
    covariance: Array
    own_map_covariance: Array
    fixed_at_ns: int
    n_jumps: int
    fixed_attitude: Array | None = None
    turned_from_ns: int = 0

    def pose_covariance(self) -> Array:
        """Return (6, 6) covariance of the pose, local perturbation, the map's error in it."""
        to_pose = self.to_pose()
        out = to_pose @ self.covariance @ to_pose.T + self.own_map_covariance
        return np.asarray(0.5 * (out + out.T))

    def velocity_covariance(self) -> Array:
        """Return (3, 3) covariance of the velocity, world axes, m^2/s^2."""
        return np.array(self.covariance[VELOCITY, VELOCITY])

    def prior(self) -> Prior:
        """Return where the drone is expected, for guiding the matching."""
        return Prior(self.world_from_body, self.pose_covariance())

    def priors_on_own_views(self) -> tuple[Prior, Prior]:
        """Return where the drone is expected by views that were found as it was; the surer first.

        What their keyframes are off, the state is off as well: that makes it no less certain where
        they show things. After a minute's flight it is most of what it is off. The other one is
        for where the state has been led away from them since.
        """
        whole, to_pose = self.prior(), self.to_pose()[:, :N_OWN]
        own = to_pose @ self.beside_keyframes() @ to_pose.T + self.own_map_covariance
        among = own + _UNLIKE**2 * (whole.covariance - own)
        return Prior(self.world_from_body, np.asarray(0.5 * (among + among.T))), whole

    def considers(self, keyframe_covariance: Array) -> bool:
        """Whether these are the very keyframes whose errors are considered."""
        return np.array_equal(self.covariance[N_OWN:, N_OWN:], keyframe_covariance)

    def beside_keyframes(self) -> Array:
        """Return (12, 12) of the error state were the keyframes' errors known."""
        known, by_keys = self.covariance[:N_OWN, :N_OWN], self.covariance[:N_OWN, N_OWN:]
        keys = self.covariance[N_OWN:, N_OWN:]
        # The first keyframe of a map has no error: not to be inverted as it is.
        certain = np.eye(len(keys)) * (_EXACT * max(float(np.trace(keys)), 1.0))
        own = known - by_keys @ np.linalg.solve(keys + certain, by_keys.T)
        return np.asarray(0.5 * (own + own.T))

    def to_pose(self) -> Array:
        """Return (6, 12 + 6V) local pose perturbation by error state."""
        out = np.zeros((6, len(self.covariance)))
        out[:3, POSITION] = out[3:, OFFSET] = self.world_from_body.rotation.T
        out[3:, SAMPLE] = np.eye(3)
        return out

    def fixed(self) -> FilterState:
        """Return the state as one that has just been fixed."""
        return replace(
            self,
            fixed_at_ns=self.at_ns,
            fixed_attitude=self.ned_from_body,
            turned_from_ns=self.at_ns,
        )

    def corrected(self, step: Array, covariance: Array, own_map_covariance: Array) -> FilterState:
        """Return the state as one that has just been fixed, moved by an error state.

        Args:
            step: (12 + 6V,) the error state; the keyframes stay where they are.
            covariance: (12 + 6V, 12 + 6V) of what is left of it.
            own_map_covariance: (6, 6) local, the used landmarks' own errors.
        """
        turned = exp_so3(step[OFFSET])
        return replace(
            self.fixed(),
            world_from_body=Pose(
                turned @ self.world_from_body.rotation @ exp_so3(step[SAMPLE]),
                self.world_from_body.translation + step[POSITION],
            ),
            velocity_world=self.velocity_world + step[VELOCITY],
            world_from_ned=turned @ self.world_from_ned,
            covariance=0.5 * (covariance + covariance.T),
            own_map_covariance=own_map_covariance,
        )


def carried(state: FilterState, other_from_world: Similarity) -> FilterState:
    """Return a state as it is in another world, whose map it goes on with.

    The error of the map that it was begun on is kept; how well the two maps are joined is
    part of the other map's own error.
    """
    turn, scale = other_from_world.rotation, other_from_world.scale
    moving = np.eye(len(state.covariance))
    moving[POSITION, POSITION] = moving[VELOCITY, VELOCITY] = scale * turn
    moving[OFFSET, OFFSET] = turn
    stretching = np.diag([scale] * 3 + [1.0] * 3)
    return replace(
        state,
        world_from_body=other_from_world.of_pose(state.world_from_body),
        velocity_world=scale * turn @ state.velocity_world,
        world_from_ned=turn @ state.world_from_ned,
        covariance=moving @ state.covariance @ moving.T,
        own_map_covariance=stretching @ state.own_map_covariance @ stretching,
    )


def north_aligned(state: FilterState) -> Array:
    """Return the (3, 3) turn about the vertical from the autopilot's north to the world's."""
    return about_down(heading_of(state.world_from_ned))


@dataclass(frozen=True, eq=False)
class Measurement:
    """A pose that was measured, as the filter takes it.

    Attributes:
        innovation: (6,) local, from the pose that was expected.
        observation: (6, 12 + 6V) of that, by error state.
        noise: (6, 6) local covariance of what was measured, the keyframes' errors not in it.
    """

    innovation: Array
    observation: Array
    noise: Array

    def expected_by(self, covariance: Array) -> Array:
        """Return (6, 6) covariance of the innovation where an error state has such a one."""
        return np.asarray(self.observation @ covariance @ self.observation.T + self.noise)


def kalman_step(covariance: Array, measured: Measurement) -> tuple[Array, Array]:
    """Return the Kalman filter's step by a measurement, the map's error considered (Schmidt 1966).

    Args:
        covariance: (12 + 6V, 12 + 6V) of the error state before.
        measured: a pose.

    Returns:
        (12 + 6V,) step of the error state, and its covariance after, symmetric but for rounding.
    """
    observation = measured.observation
    seen = observation @ covariance
    # Of the keyframes nothing is estimated, they are considered: their rows of the gain are zero.
    gain = np.linalg.solve(measured.expected_by(covariance), seen).T[:N_OWN]
    # Joseph's form holds for any gain, so for a considered state too.
    kept = covariance[:N_OWN] - gain @ seen
    left = covariance.copy()
    left[:N_OWN, N_OWN:] = kept[:, N_OWN:]
    left[N_OWN:, :N_OWN] = kept[:, N_OWN:].T
    left[:N_OWN, :N_OWN] = (
        kept[:, :N_OWN] - kept @ observation.T @ gain.T + gain @ measured.noise @ gain.T
    )
    step = np.zeros(len(covariance))
    step[:N_OWN] = gain @ measured.innovation
    return step, left
