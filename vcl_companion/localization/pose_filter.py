"""The Kalman filter of eqs. 5 to 7, on SO(3), with the map's error considered.

A fix begins it, the autopilot's attitude carries it on, fixes correct it. What it estimates, and
what it considers besides, is told with its state (``filter_state``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, angle_between
from vcl_companion.localization.contradictions import reconciled
from vcl_companion.localization.filter_state import (
    N_OWN,
    OFFSET,
    POSITION,
    SAMPLE,
    VELOCITY,
    FilterState,
    Measurement,
    kalman_step,
)
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.other_keyframes import on_own_views, on_revision, with_keyframes
from vcl_companion.options import require_positive

_MAX_COAST_S = 60.0
# Who brakes or turns goes on doing so for about as long.
_LASTS_NS = 1_000_000_000


@dataclass(frozen=True)
class FilterOptions:
    """How a drone moves, and how good its autopilot's attitude is.

    Attributes:
        acceleration_m_s2: unknown acceleration, 1 sigma.
        speed_m_s: unknown speed at the start, 1 sigma per axis.
        attitude_sigma_deg: noise of one attitude sample, 1 sigma.
        attitude_drift_deg_s: change of the attitude's offset in a second, 1 sigma.
        attitude_turn_error: change of that offset as a share of the angle turned, 1 sigma.
        turn_rate_deg_s: unknown rotation when the autopilot sends no attitude, 1 sigma.
        coast_s: how long after the last fix a pose by attitude and motion alone is
            still sent; 0: never, for nobody has measured it.
    """

    acceleration_m_s2: float = 3.0
    speed_m_s: float = 5.0
    attitude_sigma_deg: float = 0.3
    attitude_drift_deg_s: float = 0.1
    attitude_turn_error: float = 0.02
    turn_rate_deg_s: float = 45.0
    coast_s: float = 0.0

    def __post_init__(self) -> None:
        require_positive(
            self,
            "acceleration_m_s2",
            "speed_m_s",
            "attitude_sigma_deg",
            "attitude_drift_deg_s",
            "turn_rate_deg_s",
        )
        if not 0 <= self.attitude_turn_error < 1:
            raise ValueError(
                f"attitude_turn_error must lie in [0, 1), got {self.attitude_turn_error}"
            )
        if not 0 <= self.coast_s <= _MAX_COAST_S:
            raise ValueError(f"coast_s must lie in 0..{_MAX_COAST_S:.0f}, got {self.coast_s}")


def started(
    fix: Localized, at_ns: int, ned_from_body: Array | None, options: FilterOptions
) -> FilterState:
    """Begin from a single fix, with unknown speed."""
    rotation = fix.world_from_body.rotation
    attitude = np.eye(3) if ned_from_body is None else ned_from_body
    sample_sigma_rad = _sample_sigma_rad(ned_from_body, options)
    n_map = fix.map_lever.shape[1]
    # Independent sources: the fix's noise, the sample's error, speed, the keyframes.
    sources = np.zeros((N_OWN + n_map, N_OWN + n_map))
    sources[:6, :6] = fix.noise_covariance + fix.own_map_covariance
    sources[6:9, 6:9] = np.eye(3) * options.speed_m_s**2
    sources[9:12, 9:12] = np.eye(3) * sample_sigma_rad**2
    sources[N_OWN:, N_OWN:] = fix.keyframe_covariance
    mixing = np.eye(N_OWN + n_map)
    mixing[:6, :6] = 0.0
    mixing[POSITION, 0:3] = mixing[OFFSET, 3:6] = mixing[OFFSET, SAMPLE] = -rotation
    mixing[POSITION, N_OWN:] = -rotation @ fix.map_lever[:3]
    mixing[OFFSET, N_OWN:] = -rotation @ fix.map_lever[3:]
    return FilterState(
        at_ns,
        fix.world_from_body,
        np.zeros(3),
        rotation @ attitude.T,
        ned_from_body,
        mixing @ sources @ mixing.T,
        fix.own_map_covariance,
        at_ns,
        0,
        ned_from_body,
        at_ns,
    )


def predict(
    state: FilterState, at_ns: int, ned_from_body: Array | None, options: FilterOptions
) -> FilterState | None:
    """Carry the state to a later instant (eq. 5): constant velocity, the autopilot's attitude.

    What is unknown of the motion is taken to last, a second or until the next fix: who brakes
    or turns goes on doing so. Uncertainty therefore grows with the time, and the angle,
    since the last fix, however many predictions lie between.

    Args:
        state: at its own instant.
        at_ns: the instant wanted; one before the state's is taken for the state's own.
        ned_from_body: (3, 3) attitude then, or None.
        options: process noise.

    Returns:
        The predicted state; None a minute after the last fix, when it tells nothing.
    """
    if at_ns - state.fixed_at_ns > _MAX_COAST_S * 1e9:
        return None
    dt_s = max(at_ns - state.at_ns, 0) * 1e-9
    until_ns = max(at_ns, state.at_ns)
    transition = _carrying(dt_s)
    transition[SAMPLE] = 0.0
    process = np.zeros((N_OWN, N_OWN))
    process += options.acceleration_m_s2**2 * _shoved(
        state.at_ns - state.fixed_at_ns, until_ns - state.fixed_at_ns
    )
    if ned_from_body is not None and state.ned_from_body is not None:
        offset = state.world_from_ned
        variance = np.deg2rad(options.attitude_drift_deg_s) ** 2 * dt_s
        variance += options.attitude_turn_error**2 * _turned_squared(state, ned_from_body)
    else:
        # The last rotation itself becomes the reference, and may have turned meanwhile.
        attitude = np.eye(3) if ned_from_body is None else ned_from_body
        offset = state.world_from_body.rotation @ attitude.T
        transition[OFFSET, SAMPLE] = state.world_from_body.rotation
        since_s = (state.at_ns - state.turned_from_ns) * 1e-9
        variance = np.deg2rad(options.turn_rate_deg_s) ** 2 * ((since_s + dt_s) ** 2 - since_s**2)
    process[OFFSET, OFFSET] += np.eye(3) * variance
    process[SAMPLE, SAMPLE] = np.eye(3) * _sample_sigma_rad(ned_from_body, options) ** 2
    # The keyframes stay what they are off.
    covariance = state.covariance.copy()
    covariance[:N_OWN] = transition @ covariance[:N_OWN]
    covariance[:, :N_OWN] = covariance[:, :N_OWN] @ transition.T
    covariance[:N_OWN, :N_OWN] += process
    rotation = offset @ (np.eye(3) if ned_from_body is None else ned_from_body)
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = rotation.T @ state.world_from_body.rotation
    return replace(
        state,
        at_ns=until_ns,
        world_from_body=Pose(
            rotation, state.world_from_body.translation + state.velocity_world * dt_s
        ),
        world_from_ned=offset,
        ned_from_body=ned_from_body,
        covariance=covariance,
        own_map_covariance=turned @ state.own_map_covariance @ turned.T,
        turned_from_ns=state.turned_from_ns if ned_from_body is None else until_ns,
    )


def update(predicted: FilterState, fix: Localized) -> FilterState | NotLocalized:
    """Take a fix of the same instant in (eqs. 6 and 7).

    Where it contradicts the prediction, it is refused, or of the prediction less is believed
    (``contradictions``).
    """
    before = predicted
    predicted = with_keyframes(before, fix)
    measured = Measurement(
        predicted.world_from_body.local(fix.world_from_body),
        _observation(predicted, fix),
        fix.noise_covariance + fix.own_map_covariance,
    )
    is_another = predicted is not before
    if is_another and not fix.is_on_map:
        predicted = on_own_views(before, fix, measured)
    believed = reconciled(predicted, fix, measured)
    if isinstance(believed, NotLocalized):
        return believed
    if is_another and fix.is_on_map and believed.n_jumps == before.n_jumps:
        believed = on_revision(believed, fix, measured)
    step, covariance = kalman_step(believed.covariance, measured)
    return believed.corrected(step, covariance, fix.own_map_covariance)


def _carrying(dt_s: float) -> Array:
    """Return (12, 12) how so long a time moves the error state."""
    out = np.eye(N_OWN)
    out[POSITION, VELOCITY] = np.eye(3) * dt_s
    return out


def _shoved(since_ns: int, until_ns: int) -> Array:
    """Return (12, 12) what an unknown acceleration of 1 m/s^2 adds to the error state's covariance.

    While it is the same it moves position by t^2/2 and speed by t; what the state has of it already
    is carried over and counts once. It lasts for a while, then it is another one: were it the same
    until the next fix, that would tell the speed of one who has stopped long ago.

    Args:
        since_ns: from when on, after the last fix.
        until_ns: up to when.
    """
    out = np.zeros((N_OWN, N_OWN))
    while since_ns < until_ns:
        began_ns = since_ns - since_ns % _LASTS_NS
        ends_ns = min(until_ns, began_ns + _LASTS_NS)
        carrying = _carrying((ends_ns - since_ns) * 1e-9)
        had = carrying @ _shove((since_ns - began_ns) * 1e-9)
        has = _shove((ends_ns - began_ns) * 1e-9)
        out = carrying @ out @ carrying.T + has @ has.T - had @ had.T
        since_ns = ends_ns
    return out


def _shove(for_s: float) -> Array:
    """Return (12, 3) how a constant acceleration has moved the error state."""
    out = np.zeros((N_OWN, 3))
    out[POSITION], out[VELOCITY] = np.eye(3) * 0.5 * for_s**2, np.eye(3) * for_s
    return out


def _turned_squared(state: FilterState, ned_from_body: Array) -> float:
    """Return by how much the square of the angle turned since the last fix has grown, rad^2.

    Turning back takes no error away for certain: it is never less than the step's own.
    """
    before = state.ned_from_body if state.ned_from_body is not None else ned_from_body
    origin = state.fixed_attitude if state.fixed_attitude is not None else before
    had, has, step = (
        angle_between(a, b)
        for a, b in ((origin, before), (origin, ned_from_body), (before, ned_from_body))
    )
    return max(has**2 - had**2, step**2)


def _sample_sigma_rad(ned_from_body: Array | None, options: FilterOptions) -> float:
    """Without attitude the sample is an exact identity, and the offset is the rotation itself."""
    return 0.0 if ned_from_body is None else float(np.deg2rad(options.attitude_sigma_deg))


def _observation(predicted: FilterState, fix: Localized) -> Array:
    """Return (6, n): a fix sees the true pose, moved by the keyframes' errors."""
    out = predicted.to_pose()
    # The lever is in the fix's axes. Left there, the little that these are turned against the
    # predicted ones, new in every frame, would look like news of the map's error.
    turned = predicted.world_from_body.rotation.T @ fix.world_from_body.rotation
    out[:3, N_OWN:] = turned @ fix.map_lever[:3]
    out[3:, N_OWN:] = turned @ fix.map_lever[3:]
    return out
