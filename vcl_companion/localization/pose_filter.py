"""The Kalman filter of eqs. 5 to 7, on SO(3), with the map's error considered.

What is estimated, besides position and velocity, is the rotation between the
map's world and the autopilot's north-east-down: the autopilot's attitude is
good from frame to frame and wrong by a slowly changing offset. The map's error
is common to all frames and must not be averaged away: the keyframes' errors
are *considered* (Schmidt 1966), that is, their correlation with the state is
kept, while they themselves are not estimated.

Error state: position (world), offset rotation (world), velocity (world), the
attitude sample's own error (body, new in every frame), keyframe errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, exp_so3, heading_of, log_so3
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.localization.covariance_intersection import intersect, unlikeness
from vcl_companion.localization.fix import Localized, NotLocalized, Prior

_P, _B, _V, _W = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_N_OWN = 12
# 99.99 % of chi^2 with 6 and with 3 degrees of freedom: beyond, it is not noise.
_GATE_POSE, _GATE_ROTATION, _GATE_POSITION = 27.9, 21.1, 21.1
# An autopilot that takes its attitude from our poses in part, as it does while they begin, errs
# by degrees that its noise does not tell of: by 3, and where our first poses come late by 12. More
# than the former is believed of it only where what is seen leaves no doubt: so many patches of the
# map, and so large a share of those tried, are where they should be at no wrong place.
_MOST_TURNED_RAD, _MOST_TURNED_SEEN_RAD = np.deg2rad(6.0), np.deg2rad(20.0)
_SEEN_PATCHES, _SEEN_SHARE = 200, 0.8
# What is known after a jump, 1 sigma: nothing.
_FORGOTTEN_M, _FORGOTTEN_M_S, _FORGOTTEN_RAD = 1e3, 10.0, np.pi
_MAX_COAST_S = 60.0
# A proposal has to take this much of the variance away to be news.
_NEWS = 0.95
_LEAST_OMEGA = 1e-3


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
        for name in (
            "acceleration_m_s2",
            "speed_m_s",
            "attitude_sigma_deg",
            "attitude_drift_deg_s",
            "turn_rate_deg_s",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not 0 <= self.attitude_turn_error < 1:
            raise ValueError(
                f"attitude_turn_error must lie in [0, 1), got {self.attitude_turn_error}"
            )
        if not 0 <= self.coast_s <= _MAX_COAST_S:
            raise ValueError(f"coast_s must lie in 0..{_MAX_COAST_S:.0f}, got {self.coast_s}")


@dataclass(frozen=True, eq=False)
class FilterState:
    """What the filter believes at one instant.

    Attributes:
        at_ns: the instant, host clock.
        world_from_body: pose.
        velocity_world: (3,) m/s.
        world_from_ned: (3, 3) offset of the autopilot's attitude.
        ned_from_body: (3, 3) the attitude sample of this instant, or None.
        covariance: (12 + 6V, 12 + 6V), see the module.
        own_map_covariance: (6, 6) local, the used landmarks' own errors.
        fixed_at_ns: instant of the last fix.
        n_jumps: how often the estimate moved by more than its covariance explains.
        fixed_attitude: (3, 3) the attitude sample of the last fix, or None.
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

    def pose_covariance(self) -> Array:
        """Return (6, 6) covariance of the pose, local perturbation, the map's error in it."""
        to_pose = _to_pose(self.world_from_body.rotation, len(self.covariance))
        out = to_pose @ self.covariance @ to_pose.T + self.own_map_covariance
        return np.asarray(0.5 * (out + out.T))

    def velocity_covariance(self) -> Array:
        """Return (3, 3) covariance of the velocity, world axes, m^2/s^2."""
        return np.array(self.covariance[_V, _V])

    def prior(self) -> Prior:
        """Return where the drone is expected, for guiding the matching."""
        return Prior(self.world_from_body, self.pose_covariance())


def started(
    fix: Localized, at_ns: int, ned_from_body: Array | None, options: FilterOptions
) -> FilterState:
    """Begin from a single fix, with unknown speed."""
    rotation = fix.world_from_body.rotation
    attitude = np.eye(3) if ned_from_body is None else ned_from_body
    sample_sigma_rad = _sample_sigma_rad(ned_from_body, options)
    n_map = fix.map_lever.shape[1]
    # Independent sources: the fix's noise, the sample's error, speed, the keyframes.
    sources = np.zeros((_N_OWN + n_map, _N_OWN + n_map))
    sources[:6, :6] = fix.noise_covariance + fix.own_map_covariance
    sources[6:9, 6:9] = np.eye(3) * options.speed_m_s**2
    sources[9:12, 9:12] = np.eye(3) * sample_sigma_rad**2
    sources[_N_OWN:, _N_OWN:] = fix.keyframe_covariance
    mixing = np.eye(_N_OWN + n_map)
    mixing[:6, :6] = 0.0
    mixing[_P, 0:3] = mixing[_B, 3:6] = mixing[_B, _W] = -rotation
    mixing[_P, _N_OWN:] = -rotation @ fix.map_lever[:3]
    mixing[_B, _N_OWN:] = -rotation @ fix.map_lever[3:]
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
    )


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
    nothing = np.zeros((6, 6))
    fix = Localized(world_from_body, covariance, nothing, np.zeros((6, 0)), np.zeros((0, 0)),
                    0, 0, False, 0.0)  # fmt: skip
    return started(fix, at_ns, ned_from_body, options)


def carried(state: FilterState, other_from_world: Similarity) -> FilterState:
    """Return a state as it is in another world, whose map it goes on with.

    The error of the map that it was begun on is kept; how well the two maps are joined is
    part of the other map's own error.
    """
    turn, scale = other_from_world.rotation, other_from_world.scale
    moving = np.eye(len(state.covariance))
    moving[_P, _P] = moving[_V, _V] = scale * turn
    moving[_B, _B] = turn
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


def predict(
    state: FilterState, at_ns: int, ned_from_body: Array | None, options: FilterOptions
) -> FilterState | None:
    """Carry the state to a later instant (eq. 5): constant velocity, the autopilot's attitude.

    What is unknown of the motion is taken to last until the next fix: who brakes or
    turns goes on doing so. Uncertainty therefore grows with the time, and the angle,
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
    n = len(state.covariance)
    transition = np.eye(n)
    transition[_P, _V] = np.eye(3) * dt_s
    transition[_W] = 0.0
    process = np.zeros((n, n))
    # Unknown acceleration since the last fix: moves position by a t^2/2, speed by a t. What the
    # state has of it already is carried over and counts once.
    since_s = (state.at_ns - state.fixed_at_ns) * 1e-9
    had, has = _shoved(since_s, n), _shoved(since_s + dt_s, n)
    had = transition @ had
    process += options.acceleration_m_s2**2 * (has @ has.T - had @ had.T)
    if ned_from_body is not None and state.ned_from_body is not None:
        offset = state.world_from_ned
        variance = np.deg2rad(options.attitude_drift_deg_s) ** 2 * dt_s
        variance += options.attitude_turn_error**2 * _turned_squared(state, ned_from_body)
    else:
        # The last rotation itself becomes the reference, and may have turned meanwhile.
        attitude = np.eye(3) if ned_from_body is None else ned_from_body
        offset = state.world_from_body.rotation @ attitude.T
        transition[_B, _W] = state.world_from_body.rotation
        variance = np.deg2rad(options.turn_rate_deg_s) ** 2 * ((since_s + dt_s) ** 2 - since_s**2)
    process[_B, _B] += np.eye(3) * variance
    process[_W, _W] = np.eye(3) * _sample_sigma_rad(ned_from_body, options) ** 2
    rotation = offset @ (np.eye(3) if ned_from_body is None else ned_from_body)
    turned = np.zeros((6, 6))
    turned[:3, :3] = turned[3:, 3:] = rotation.T @ state.world_from_body.rotation
    return replace(
        state,
        at_ns=max(at_ns, state.at_ns),
        world_from_body=Pose(
            rotation, state.world_from_body.translation + state.velocity_world * dt_s
        ),
        world_from_ned=offset,
        ned_from_body=ned_from_body,
        covariance=transition @ state.covariance @ transition.T + process,
        own_map_covariance=turned @ state.own_map_covariance @ turned.T,
    )


def update(predicted: FilterState, fix: Localized) -> FilterState | NotLocalized:
    """Take a fix of the same instant in (eqs. 6 and 7).

    A fix whose position the covariances cannot explain (a relocalization, a
    prediction gone wrong) replaces position and speed and counts as a jump. One
    whose rotation contradicts the autopilot's turn since the last fix is wrong:
    repeated structure, a planar twin; but for a few degrees at the place where the drone was
    expected, or more where nearly all of the map's patches agree: these are the
    autopilot's own. Where it sends no attitude, a jump replaces the rotation as well.
    """
    predicted = _with_map(predicted, fix)
    innovation = predicted.world_from_body.local(fix.world_from_body)
    observation = _observation(predicted, fix)
    noise = fix.noise_covariance + fix.own_map_covariance
    expected = observation @ predicted.covariance @ observation.T + noise
    distance = innovation[3:] @ np.linalg.solve(expected[3:, 3:], innovation[3:])
    if distance > _GATE_ROTATION and predicted.ned_from_body is not None:
        turned_rad = float(np.linalg.norm(innovation[3:]))
        away = innovation[:3] @ np.linalg.solve(expected[:3, :3], innovation[:3])
        most_rad = _MOST_TURNED_SEEN_RAD if _leaves_no_doubt(fix) else _MOST_TURNED_RAD
        if turned_rad > most_rad or away > _GATE_POSITION:
            return NotLocalized(
                f"turned {np.rad2deg(turned_rad):.0f} degrees against the autopilot's attitude",
                fix.n_matched,
                fix.n_inliers,
            )
        predicted = _doubting_attitude(predicted, turned_rad)
        expected = observation @ predicted.covariance @ observation.T + noise
    if innovation @ np.linalg.solve(expected, innovation) > _GATE_POSE:
        predicted = _forgotten(predicted)
        expected = observation @ predicted.covariance @ observation.T + noise
    gain = np.linalg.solve(expected, observation @ predicted.covariance).T
    gain[_N_OWN:] = 0.0  # considered, not estimated
    step = gain @ innovation
    # Joseph's form holds for any gain, so for a considered state too.
    keep = np.eye(len(predicted.covariance)) - gain @ observation
    covariance = keep @ predicted.covariance @ keep.T + gain @ noise @ gain.T
    return replace(
        _stepped(_fixed(predicted), step),
        covariance=0.5 * (covariance + covariance.T),
        own_map_covariance=fix.own_map_covariance,
    )


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
    if not distance <= _GATE_POSE:
        metres = np.linalg.norm(world_from_body.translation - state.world_from_body.translation)
        return NotFused(f"{metres:.1f} m from where we are, more than both sigmas explain", True)
    units = np.diag([1.0, 1.0, 1.0, arm_m, arm_m, arm_m]) ** 2
    if np.trace(units @ weighed.covariance) > _NEWS * np.trace(units @ own):
        # Widening what the proposal says nothing of would cost more.
        return state if state.fixed_at_ns == state.at_ns else _fixed(state)
    omega = min(max(weighed.omega, _LEAST_OMEGA), 1.0 - _LEAST_OMEGA)
    rotation = state.world_from_body.rotation
    observation = _to_pose(rotation, len(state.covariance))
    # The landmarks' own errors are part of what is widened, and absorbed with it.
    absorbing = np.zeros((len(state.covariance), 6))
    absorbing[_P, :3] = absorbing[_B, 3:] = rotation
    prior = state.covariance + absorbing @ state.own_map_covariance @ absorbing.T
    # Of velocity and offset only what follows from the pose is widened with it: what is
    # unknown of them besides is the drone's own motion, of which no peer ever heard.
    with_pose = prior @ observation.T
    prior += (1.0 / omega - 1.0) * with_pose @ np.linalg.solve(own, with_pose.T)
    noise = covariance / (1.0 - omega)
    expected = observation @ prior @ observation.T + noise
    gain = np.linalg.solve(expected, observation @ prior).T
    gain[_N_OWN:] = 0.0
    step = gain @ state.world_from_body.local(world_from_body)
    keep = np.eye(len(prior)) - gain @ observation
    fused = keep @ prior @ keep.T + gain @ noise @ gain.T
    # The keyframes' own errors did not grow; scaling them back keeps the correlations.
    fused[_N_OWN:] *= np.sqrt(omega)
    fused[:, _N_OWN:] *= np.sqrt(omega)
    fused[_N_OWN:, _N_OWN:] = state.covariance[_N_OWN:, _N_OWN:]
    return replace(
        _stepped(_fixed(state), step),
        covariance=0.5 * (fused + fused.T),
        own_map_covariance=np.zeros((6, 6)),
    )


def _fixed(state: FilterState) -> FilterState:
    """Return the state as one that has just been fixed."""
    return replace(state, fixed_at_ns=state.at_ns, fixed_attitude=state.ned_from_body)


def _stepped(state: FilterState, step: Array) -> FilterState:
    """Return the state moved by an error state; the covariance as it was."""
    turned = exp_so3(step[_B])
    return replace(
        state,
        world_from_body=Pose(
            turned @ state.world_from_body.rotation @ exp_so3(step[_W]),
            state.world_from_body.translation + step[_P],
        ),
        velocity_world=state.velocity_world + step[_V],
        world_from_ned=turned @ state.world_from_ned,
    )


def _shoved(since_s: float, n: int) -> Array:
    """Return (n, 3) how a constant acceleration has moved the error state."""
    out = np.zeros((n, 3))
    out[_P], out[_V] = np.eye(3) * 0.5 * since_s**2, np.eye(3) * since_s
    return out


def _turned_squared(state: FilterState, ned_from_body: Array) -> float:
    """Return by how much the square of the angle turned since the last fix has grown, rad^2.

    Turning back takes no error away for certain: it is never less than the step's own.
    """
    before = state.ned_from_body if state.ned_from_body is not None else ned_from_body
    origin = state.fixed_attitude if state.fixed_attitude is not None else before
    had, has, step = (
        float(np.linalg.norm(log_so3(a.T @ b)))
        for a, b in ((origin, before), (origin, ned_from_body), (before, ned_from_body))
    )
    return max(has**2 - had**2, step**2)


def _sample_sigma_rad(ned_from_body: Array | None, options: FilterOptions) -> float:
    """Without attitude the sample is an exact identity, and the offset is the rotation itself."""
    return 0.0 if ned_from_body is None else float(np.deg2rad(options.attitude_sigma_deg))


def _to_pose(rotation: Array, n: int) -> Array:
    """Return (6, n) local pose perturbation by error state."""
    out = np.zeros((6, n))
    out[:3, _P] = out[3:, _B] = rotation.T
    out[3:, _W] = np.eye(3)
    return out


def _observation(predicted: FilterState, fix: Localized) -> Array:
    """Return (6, n): a fix sees the true pose, moved by the keyframes' errors."""
    out = _to_pose(predicted.world_from_body.rotation, len(predicted.covariance))
    # The lever is in the fix's axes. Left there, the little that these are turned against the
    # predicted ones, new in every frame, would look like news of the map's error.
    turned = predicted.world_from_body.rotation.T @ fix.world_from_body.rotation
    out[:3, _N_OWN:] = turned @ fix.map_lever[:3]
    out[3:, _N_OWN:] = turned @ fix.map_lever[3:]
    return out


def _with_map(state: FilterState, fix: Localized) -> FilterState:
    """Return the state with the keyframe errors of the fix's map, new ones when it changed."""
    known = state.covariance[_N_OWN:, _N_OWN:]
    if known.shape == fix.keyframe_covariance.shape and np.array_equal(
        known, fix.keyframe_covariance
    ):
        return state
    n_map = fix.map_lever.shape[1]
    covariance = np.zeros((_N_OWN + n_map, _N_OWN + n_map))
    covariance[:_N_OWN, :_N_OWN] = state.covariance[:_N_OWN, :_N_OWN]
    covariance[_N_OWN:, _N_OWN:] = fix.keyframe_covariance
    return replace(state, covariance=covariance)


def _leaves_no_doubt(fix: Localized) -> bool:
    """Whether so many of the map's patches are where they should be that the pose is right."""
    enough = fix.n_inliers >= max(_SEEN_PATCHES, _SEEN_SHARE * fix.n_matched)
    return fix.by == "patches" and enough


def _doubting_attitude(state: FilterState, turned_rad: float) -> FilterState:
    """Return the state with the attitude's offset as uncertain as it has just been seen to be."""
    covariance = state.covariance.copy()
    covariance[_B, _B] += turned_rad**2 * np.eye(3)
    return replace(state, covariance=covariance)


def _forgotten(state: FilterState) -> FilterState:
    """Return the state that knows nothing of where it is; with an autopilot, how it is turned."""
    covariance = state.covariance.copy()
    forgotten = [(_P, _FORGOTTEN_M), (_V, _FORGOTTEN_M_S)]
    if state.ned_from_body is None:
        forgotten.append((_B, _FORGOTTEN_RAD))
    for part, sigma in forgotten:
        covariance[part] = covariance[:, part] = 0.0
        covariance[part, part] = np.eye(3) * sigma**2
    return replace(
        state, covariance=covariance, velocity_world=np.zeros(3), n_jumps=state.n_jumps + 1
    )
