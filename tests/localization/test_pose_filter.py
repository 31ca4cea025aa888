"""The filter: exact without noise, honest with it, and never surer than the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.checks import assert_consistent, assert_pose_close, numeric_jacobian
from tests.localization.filter_flights import (
    FIX_SIGMA,
    STEADY,
    STEP_NS,
    filtered,
    fix_at,
    fly,
    keyframe_errors,
    lever_in,
    noisy,
    updated,
)
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3, matrix_from_euler
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.localization.filter_state import FilterState, carried
from vcl_companion.localization.fix import Localized, NotLocalized, Recognised
from vcl_companion.localization.pose_filter import (
    FilterOptions,
    _observation,
    predict,
    started,
    update,
)


@pytest.mark.parametrize("attitude", [True, False])
def test_without_noise_there_is_no_error(attitude: bool) -> None:
    rng = np.random.default_rng(0)
    still = replace(STEADY, acceleration_m_s2=1e-9, attitude_sigma_deg=1e-9)
    if not attitude:
        still = replace(still, turn_rate_deg_s=1e-9)
    flight = fly(rng, 30, still, attitude=attitude)
    tracker = replace(still, acceleration_m_s2=1.0, turn_rate_deg_s=10.0)
    # Sharp fixes: the first speed, which nobody knows, is then forgotten at once.
    states = filtered(flight, lambda pose: fix_at(pose, 1e-4 * FIX_SIGMA), tracker)
    for state, truth in zip(states, flight.poses, strict=True):
        assert_pose_close(state.world_from_body, truth, within_m=1e-6, within_rad=1e-6)
    np.testing.assert_allclose(states[-1].velocity_world, flight.velocity_world[-1], atol=1e-5)
    assert states[-1].n_jumps == 0


def test_constant_velocity_is_tracked_better_than_any_single_fix() -> None:
    rng = np.random.default_rng(1)
    steady = replace(STEADY, acceleration_m_s2=0.05)
    errors, velocity_errors = [], []
    for _ in range(20):
        flight = fly(rng, 40, steady)
        state = filtered(flight, noisy(rng), steady)[-1]
        errors.append(flight.poses[-1].local(state.world_from_body))
        velocity_errors.append(state.velocity_world - flight.velocity_world[-1])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert np.all(rms[:3] < 0.75 * FIX_SIGMA[:3])
    assert np.all(rms > 0.1 * FIX_SIGMA)
    speed_rms = float(np.sqrt(np.mean(np.square(velocity_errors))))
    assert 0.005 < speed_rms < 0.06


@pytest.mark.parametrize("attitude", [True, False], ids=["attitude", "no attitude"])
@pytest.mark.parametrize("n", [1, 2, 25])
def test_errors_are_as_large_as_stated(attitude: bool, n: int) -> None:
    rng = np.random.default_rng(2)
    options = replace(STEADY, speed_m_s=2.0, turn_rate_deg_s=20.0)
    errors, sigma = [], []
    for _ in range(60):
        flight = fly(rng, n, options, speed_m_s=options.speed_m_s, attitude=attitude)
        state = filtered(flight, noisy(rng), options)[-1]
        errors.append(state.world_from_body.local(flight.poses[-1]))
        sigma.append(state.pose_covariance())
    assert_consistent(errors, sigma)


@pytest.mark.parametrize("per_s", [5, 30])
def test_predictions_err_as_much_as_stated(per_s: int) -> None:
    """A second without a fix, at any frame rate: who brakes goes on braking."""
    rng = np.random.default_rng(3)
    options = replace(STEADY, speed_m_s=2.0)
    step_s, step_ns = 1.0 / per_s, 1_000_000_000 // per_s
    last_fix, n = 2 * per_s, 3 * per_s
    errors, sigma = [], []
    for _ in range(60):
        flight = fly(
            rng, n + 1, options, speed_m_s=options.speed_m_s, step_s=step_s, held_from=last_fix
        )
        fixed = replace(flight, poses=flight.poses[: last_fix + 1])
        state: FilterState | None = filtered(fixed, noisy(rng), options, step_ns)[-1]
        for k in range(last_fix + 1, n + 1):
            assert state is not None
            state = predict(state, k * step_ns, flight.attitudes[k], options)
        assert state is not None
        errors.append(state.prior().world_from_body.local(flight.poses[-1]))
        sigma.append(state.prior().covariance)
    assert_consistent(errors, sigma)


@pytest.mark.parametrize("attitude", [True, False], ids=["attitude", "no attitude"])
def test_a_prediction_is_as_uncertain_in_one_step_as_in_many(attitude: bool) -> None:
    """Braking and turning by 90 degrees for a second without a fix."""
    options = replace(FilterOptions(), attitude_sigma_deg=1e-6)
    turns = [matrix_from_euler(0.0, 0.0, np.pi / 2 * part) for part in np.linspace(0, 1, 31)]
    start = settled(turns[0] if attitude else None)
    many: FilterState | None = start
    for k, turn in enumerate(turns[1:], start=1):
        assert many is not None
        at_ns = start.at_ns + k * 1_000_000_000 // 30
        many = predict(many, at_ns, turn if attitude else None, options)
    once = predict(start, start.at_ns + 1_000_000_000, turns[-1] if attitude else None, options)
    assert many is not None
    assert once is not None
    np.testing.assert_allclose(many.pose_covariance(), once.pose_covariance(), rtol=2e-3, atol=1e-6)
    sigma = np.sqrt(np.diag(many.pose_covariance() - start.pose_covariance()))
    assert np.all(sigma[:3] > 0.49 * options.acceleration_m_s2)
    yaw = 0.02 * np.pi / 2 if attitude else np.deg2rad(options.turn_rate_deg_s)
    assert 0.98 * yaw < sigma[5] < 1.3 * yaw


def test_a_first_fix_is_told_as_sure_as_it_is() -> None:
    rng = np.random.default_rng(6)
    pose = Pose(matrix_from_euler(0.1, -0.2, 2.0), np.array([3.0, -1.0, 2.0]))
    covariance, _ = keyframe_errors(rng)
    fix = fix_at(pose, lever=lever_in(pose), keyframe_covariance=covariance)
    for attitude in (None, matrix_from_euler(0.1, 0.0, 0.4)):
        state = started(fix, 7, attitude, FilterOptions())
        np.testing.assert_allclose(state.pose_covariance(), fix.covariance(), atol=1e-12)
        assert state.at_ns == state.fixed_at_ns == 7
        assert_pose_close(state.world_from_body, pose, within_m=1e-12, within_rad=1e-12)


def settled(attitude: Array | None, n: int = 15) -> FilterState:
    """Return the state of a drone that hovers at the origin."""
    state = started(fix_at(Pose.identity()), 0, attitude, FilterOptions())
    for k in range(1, n):
        predicted = predict(state, k * STEP_NS, attitude, FilterOptions())
        state = updated(predicted, fix_at(Pose.identity()))
    return state


@pytest.mark.parametrize("attitude", [np.eye(3), None], ids=["attitude", "no attitude"])
def test_a_jump_of_position_is_followed_and_counted(attitude: Array | None) -> None:
    state = settled(attitude)
    there = Pose(exp_so3(np.array([0.0, 0.0, 0.002])), np.array([8.0, -5.0, 1.0]))
    after = updated(predict(state, 15 * STEP_NS, attitude, FilterOptions()), fix_at(there))
    assert after.n_jumps == 1
    error = there.local(after.world_from_body)
    assert np.abs(error[:3]).max() < 1e-3
    np.testing.assert_allclose(np.diag(after.pose_covariance())[:3], FIX_SIGMA[:3] ** 2, rtol=0.01)
    # It goes on from there, without another jump.
    moving = Pose(there.rotation, there.translation + np.array([0.5, 0.0, 0.0]))
    later = updated(predict(after, 16 * STEP_NS, attitude, FilterOptions()), fix_at(moving))
    assert later.n_jumps == 1
    assert np.abs(moving.local(later.world_from_body)[:3]).max() < 0.02


@pytest.mark.parametrize(("away_m", "off_m_s"), [(0.8, 1.6), (2.0, 4.0), (8.0, 10.0)])
def test_after_a_jump_the_speed_is_known_the_less_the_farther_that_was(
    away_m: float, off_m_s: float
) -> None:
    state = settled(np.eye(3))
    before = np.sqrt(np.diag(state.covariance)[6:9])
    there = Pose(np.eye(3), np.array([away_m, 0.0, 0.0]))
    after = updated(predict(state, 15 * STEP_NS, np.eye(3), FilterOptions()), fix_at(there))
    assert after.n_jumps == 1
    sigma = np.sqrt(np.diag(after.covariance)[6:9])
    assert before.max() < 0.5 < off_m_s
    np.testing.assert_allclose(sigma, off_m_s, rtol=0.5)
    assert np.abs(after.velocity_world).max() < 3.0 * before.max()


def test_noise_is_neither_refused_nor_a_jump() -> None:
    rng = np.random.default_rng(7)
    flights = [filtered(fly(rng, 25, STEADY), noisy(rng), STEADY) for _ in range(20)]
    # Of five hundred fixes; the gates let 0.9999 pass.
    assert sum(states[-1].n_jumps for states in flights) <= 2
    assert sum(s.fixed_at_ns < s.at_ns for states in flights for s in states) <= 2


def test_a_turn_against_the_autopilot_is_refused() -> None:
    predicted = predict(settled(np.eye(3)), 15 * STEP_NS, np.eye(3), FilterOptions())
    assert predicted is not None
    twin = Pose(exp_so3(np.array([0.0, 0.0, np.deg2rad(12.0)])), np.array([0.1, 0.0, 0.0]))
    refused = update(predicted, fix_at(twin))
    assert refused == NotLocalized("turned 12 degrees against the autopilot's attitude", 100, 90)


def test_an_autopilot_that_errs_by_a_few_degrees_is_not_believed_and_no_jump() -> None:
    """Seen of ArduPilot: two degrees within a second, as it begins to use our poses."""
    state = settled(np.eye(3))
    predicted = predict(state, 15 * STEP_NS, np.eye(3), FilterOptions())
    assert predicted is not None
    turned = exp_so3(np.deg2rad([1.5, -1.0, 3.0]))
    expected = predicted.world_from_body.translation
    after = update(predicted, fix_at(Pose(turned, expected)))
    assert isinstance(after, FilterState)
    assert after.n_jumps == state.n_jumps
    assert np.linalg.norm(log_so3(turned.T @ after.world_from_body.rotation)) < np.deg2rad(0.1)
    # The same turn somewhere else is another place that looks alike.
    elsewhere = update(predicted, fix_at(Pose(turned, expected + np.array([0.0, 4.0, 0.0]))))
    assert isinstance(elsewhere, NotLocalized)


@pytest.mark.parametrize(
    ("by", "n_matched", "n_inliers", "turned_deg", "is_taken"),
    [
        ("patches", 400, 390, 12.0, True),
        ("patches", 400, 390, 25.0, False),
        ("patches", 400, 300, 12.0, False),
        ("patches", 200, 190, 12.0, False),
        ("features", 400, 390, 12.0, False),
    ],
)
def test_what_nearly_all_patches_agree_on_is_believed_against_the_attitude(
    by: Recognised, n_matched: int, n_inliers: int, turned_deg: float, is_taken: bool
) -> None:
    """Seen of ArduPilot: twelve degrees, where our first poses came late."""
    state = settled(np.eye(3))
    predicted = predict(state, 15 * STEP_NS, np.eye(3), FilterOptions())
    assert predicted is not None
    turned = exp_so3(np.deg2rad([0.0, 0.0, turned_deg]))
    expected = predicted.world_from_body.translation

    def seen_at(place: Array) -> Localized:
        fix = fix_at(Pose(turned, place))
        return replace(fix, n_matched=n_matched, n_inliers=n_inliers, by=by)

    after = update(predicted, seen_at(expected))
    assert isinstance(after, FilterState) == is_taken
    if isinstance(after, FilterState):
        assert after.n_jumps == state.n_jumps
        assert np.linalg.norm(log_so3(turned.T @ after.world_from_body.rotation)) < np.deg2rad(0.1)
    # The same somewhere else is another place that looks alike.
    away = seen_at(expected + np.array([0.0, 4.0, 0.0]))
    assert isinstance(update(predicted, away), NotLocalized)


def test_a_turn_the_autopilot_saw_too_is_taken() -> None:
    turned = exp_so3(np.array([0.0, 0.0, np.deg2rad(60.0)]))
    predicted = predict(settled(np.eye(3)), 15 * STEP_NS, turned, FilterOptions())
    after = updated(predicted, fix_at(Pose(turned, np.zeros(3))))
    assert_pose_close(
        after.world_from_body, Pose(turned, np.zeros(3)), within_m=0.01, within_rad=0.001
    )
    assert after.n_jumps == 0


def test_without_attitude_a_jump_may_be_a_turn() -> None:
    """Lost for a moment and turned about: nobody else knows, so the fix is believed."""
    there = Pose(exp_so3(np.array([0.1, -0.2, 2.5])), np.array([4.0, 0.0, 0.0]))
    predicted = predict(settled(None), 15 * STEP_NS, None, FilterOptions())
    after = updated(predicted, fix_at(there))
    assert after.n_jumps == 1
    assert_pose_close(after.world_from_body, there, within_m=1e-3, within_rad=1e-3)


def test_attitude_that_comes_and_goes_is_taken_while_it_is_there() -> None:
    rng = np.random.default_rng(8)
    options = replace(STEADY, turn_rate_deg_s=30.0)
    errors, sigma = [], []
    for _ in range(40):
        flight = fly(rng, 30, options, turn_rad_s=0.3)
        gaps: list[Array | None] = [
            None if 8 <= k < 15 or k == 20 else a for k, a in enumerate(flight.attitudes)
        ]
        states = filtered(replace(flight, attitudes=gaps), noisy(rng), options)
        for k in (7, 14, 15, 29):
            assert states[k].n_jumps == 0
            assert_pose_close(
                states[k].world_from_body, flight.poses[k], within_m=0.3, within_rad=0.05
            )
        errors.append(states[-1].world_from_body.local(flight.poses[-1]))
        sigma.append(states[-1].pose_covariance())
        assert np.trace(states[14].pose_covariance()) > np.trace(states[7].pose_covariance())
    # While it is gone the filter expects any turn, and the flight turned at a steady rate.
    assert_consistent(errors, sigma, slack=1.1)


@pytest.mark.parametrize("lost_s", [1.0, 2.0, 5.0, 10.0])
@pytest.mark.parametrize("per_s", [5, 30])
def test_who_has_stopped_while_lost_is_not_told_to_fly_on(lost_s: float, per_s: int) -> None:
    """What is unknown of the motion was one thing then, and is another by now."""
    options, step_ns = FilterOptions(), 1_000_000_000 // per_s

    def place(at_s: float) -> Pose:
        """At 3 m/s, until it brakes to a stop within a second."""
        braking_s = min(max(at_s, 0.0), 1.0)
        return Pose(
            np.eye(3), np.array([3.0 * (min(at_s, 0.0) + braking_s - 0.5 * braking_s**2), 0, 0])
        )

    state = started(fix_at(place(-2.0)), -2_000_000_000, np.eye(3), options)
    while state.at_ns + step_ns <= 0:
        there = predict(state, state.at_ns + step_ns, np.eye(3), options)
        state = updated(there, fix_at(place((state.at_ns + step_ns) * 1e-9)))
    found_at_ns = state.at_ns + round(lost_s * per_s) * step_ns
    for at_ns in (found_at_ns, found_at_ns + step_ns):
        state = updated(predict(state, at_ns, np.eye(3), options), fix_at(place(at_ns * 1e-9)))
        speed_m_s, sigma_m_s = state.velocity_world[0], np.sqrt(state.velocity_covariance()[0, 0])
        assert abs(speed_m_s) < 3.5 * sigma_m_s
        assert state.n_jumps == 0


def test_an_attitude_that_is_missing_once_leaves_unknown_what_was_turned_meanwhile() -> None:
    """However long ago the last fix was: the attitude has told of all turns up to there."""
    options, step_ns = FilterOptions(), 33_000_000
    start = started(fix_at(Pose.identity()), 0, np.eye(3), options)
    for lost in (15, 150):
        state: FilterState | None = start
        for k in range(1, lost + 1):
            assert state is not None
            attitude = None if k == lost - 1 else np.eye(3)
            state = predict(state, k * step_ns, attitude, options)
        assert state is not None
        sigma_deg = np.rad2deg(np.sqrt(np.diag(state.pose_covariance())[3:]))
        unknown_deg = options.turn_rate_deg_s * 2 * step_ns * 1e-9
        assert (unknown_deg < sigma_deg).all()
        assert (sigma_deg < unknown_deg + 0.6).all()


def test_a_prediction_of_the_past_stays_where_it_is() -> None:
    state = replace(settled(np.eye(3)), velocity_world=np.array([1.0, 2.0, 3.0]))
    past = predict(state, state.at_ns - 5 * STEP_NS, np.eye(3), FilterOptions())
    assert past is not None
    assert past.at_ns == state.at_ns
    assert_pose_close(past.world_from_body, state.world_from_body, within_m=1e-12, within_rad=1e-3)
    np.testing.assert_array_equal(past.velocity_world, state.velocity_world)
    assert np.trace(past.pose_covariance()) < 1.1 * np.trace(state.pose_covariance())


def test_after_a_minute_without_a_fix_it_knows_nothing() -> None:
    state: FilterState | None = settled(np.eye(3))
    assert state is not None
    fixed_at_ns = state.fixed_at_ns
    # The clock runs from the last fix, not from the last prediction.
    for _ in range(2):
        assert state is not None
        state = predict(state, state.at_ns + 29_000_000_000, np.eye(3), FilterOptions())
    assert state is not None
    assert state.fixed_at_ns == fixed_at_ns
    last = predict(state, fixed_at_ns + 60_000_000_000, np.eye(3), FilterOptions())
    assert last is not None
    assert np.sqrt(np.trace(last.pose_covariance()[:3, :3])) > 30.0
    assert predict(state, fixed_at_ns + 60_000_000_001, np.eye(3), FilterOptions()) is None


def displaced(state: FilterState, error: Array) -> FilterState:
    """Return the state moved by a (12,) error: position, offset, velocity, attitude sample."""
    offset = exp_so3(error[3:6]) @ state.world_from_ned
    attitude = np.eye(3) if state.ned_from_body is None else state.ned_from_body
    return replace(
        state,
        world_from_body=Pose(
            offset @ attitude @ exp_so3(error[9:]), state.world_from_body.translation + error[:3]
        ),
        velocity_world=state.velocity_world + error[6:9],
        world_from_ned=offset,
    )


def moving_state(rng: np.random.Generator, attitude: Array | None) -> FilterState:
    """Return a state with everything away from zero and a dense covariance of two keyframes."""
    pose = Pose(matrix_from_euler(0.3, -0.4, 1.2), np.array([1.0, 2.0, -3.0]))
    covariance, _ = keyframe_errors(rng)
    fix = fix_at(pose, lever=lever_in(pose), keyframe_covariance=covariance)
    state = started(fix, 0, attitude, STEADY)
    factor = 0.1 * rng.standard_normal((24, 24))
    return replace(state, velocity_world=np.array([2.0, -1.0, 0.5]), covariance=factor @ factor.T)


@pytest.mark.parametrize("attitude", [matrix_from_euler(0.2, 0.1, -0.7), None])
def test_the_observation_s_jacobian_is_the_numeric_one(attitude: Array | None) -> None:
    rng = np.random.default_rng(9)
    state = moving_state(rng, attitude)
    lever = rng.standard_normal((6, 12))
    fix = fix_at(state.world_from_body, lever=lever)

    def seen(error: Array) -> Array:
        truth = displaced(state, error[:12])
        found = truth.world_from_body.retracted(lever @ error[12:])
        return state.world_from_body.local(found)

    numeric = numeric_jacobian(seen, np.zeros(24))
    np.testing.assert_allclose(_observation(state, fix), numeric, atol=1e-8)


@pytest.mark.parametrize("attitude", [matrix_from_euler(0.2, 0.1, -0.7), None])
def test_in_another_world_it_is_the_same_state_with_the_same_errors(attitude: Array | None) -> None:
    rng = np.random.default_rng(9)
    state = moving_state(rng, attitude)
    way = Similarity(matrix_from_euler(0.0, 0.0, 2.0), np.array([5.0, -7.0, 1.0]), 1.02)
    there = carried(state, way)
    exactly = {"within_m": 1e-9, "within_rad": 1e-9}
    assert_pose_close(there.world_from_body, way.of_pose(state.world_from_body), **exactly)
    ahead, ahead_there = (predict(one, 500_000_000, attitude, STEADY) for one in (state, there))
    assert ahead is not None
    assert ahead_there is not None
    assert_pose_close(ahead_there.world_from_body, way.of_pose(ahead.world_from_body), **exactly)

    def error_there(error: Array) -> Array:
        truth = carried(displaced(state, error), way)
        turned = log_so3(truth.world_from_ned @ there.world_from_ned.T)
        sample = there.world_from_ned.T @ there.world_from_body.rotation
        left = truth.world_from_ned.T @ truth.world_from_body.rotation
        return np.concatenate(
            [
                truth.world_from_body.translation - there.world_from_body.translation,
                turned,
                truth.velocity_world - there.velocity_world,
                log_so3(sample.T @ left),
            ]
        )

    moving = numeric_jacobian(error_there, np.zeros(12))
    own = state.covariance[:12, :12]
    np.testing.assert_allclose(there.covariance[:12, :12], moving @ own @ moving.T, atol=1e-7)


@pytest.mark.parametrize("before", [matrix_from_euler(0.2, 0.1, -0.7), None])
@pytest.mark.parametrize("after", [matrix_from_euler(-0.1, 0.3, -0.5), None])
def test_the_transition_is_the_numeric_one(before: Array | None, after: Array | None) -> None:
    """Predicting a displaced state is predicting the state, displaced by the transition."""
    rng = np.random.default_rng(10)
    quiet = FilterOptions(
        acceleration_m_s2=1e-9,
        attitude_sigma_deg=1e-9,
        attitude_drift_deg_s=1e-9,
        attitude_turn_error=0.0,
        turn_rate_deg_s=1e-9,
    )
    state = moving_state(rng, before)
    predicted = predict(state, STEP_NS, after, quiet)
    assert predicted is not None

    def carried(error: Array) -> Array:
        moved = predict(displaced(state, error), STEP_NS, after, quiet)
        assert moved is not None
        return np.concatenate(
            [
                moved.world_from_body.translation - predicted.world_from_body.translation,
                log_so3(moved.world_from_ned @ predicted.world_from_ned.T),
                moved.velocity_world - predicted.velocity_world,
            ]
        )

    transition = np.zeros((24, 24))
    transition[:9, :12] = numeric_jacobian(carried, np.zeros(12))
    transition[12:, 12:] = np.eye(12)
    expected = transition @ state.covariance @ transition.T
    np.testing.assert_allclose(predicted.covariance, expected, atol=1e-7)


@pytest.mark.parametrize("attitude", [matrix_from_euler(0.2, 0.1, -0.7), None])
def test_a_step_of_the_update_moves_pose_and_error_alike(attitude: Array | None) -> None:
    """A fix of great weight is reached whatever the covariance says."""
    rng = np.random.default_rng(11)
    state = moving_state(rng, attitude)
    step = np.array([0.05, -0.02, 0.03, 0.01, 0.02, -0.015])
    wanted = state.world_from_body.retracted(step)
    sharp = fix_at(wanted, np.full(6, 1e-5), keyframe_covariance=state.covariance[12:, 12:])
    after = updated(state, sharp)
    assert after.n_jumps == 0
    assert_pose_close(after.world_from_body, wanted, within_m=1e-4, within_rad=5e-4)


_events = st.lists(
    st.tuples(
        st.sampled_from([-0.1, 0.0, 0.02, 0.2, 3.0, 20.0]),  # seconds to the next frame
        st.booleans(),  # attitude
        st.sampled_from(["none", "near", "far", "turned", "sharp", "new map"]),
    ),
    min_size=1,
    max_size=25,
)


@given(_events, st.integers(0, 2**32))
@settings(max_examples=100)
def test_the_covariance_stays_one_whatever_happens(
    events: list[tuple[float, bool, str]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    covariance, draw = keyframe_errors(rng)
    truth = Pose(matrix_from_euler(0.2, 0.1, 1.0), np.array([5.0, 1.0, -2.0]))
    fix = fix_at(truth, lever=lever_in(truth), keyframe_covariance=covariance)
    state: FilterState = started(fix, 0, truth.rotation, FilterOptions())
    at_ns = 0
    for gap_s, has_attitude, kind in events:
        at_ns += round(gap_s * 1e9)
        turn = exp_so3(0.2 * rng.standard_normal(3))
        truth = Pose(truth.rotation @ turn, truth.translation + rng.standard_normal(3))
        if kind == "new map":
            covariance, draw = keyframe_errors(rng)
        attitude = truth.rotation if has_attitude else None
        predicted = predict(state, at_ns, attitude, FilterOptions())
        found = truth.retracted(lever_in(truth) @ draw)
        if kind == "far":
            found = Pose(found.rotation, found.translation + 30.0 * rng.standard_normal(3))
        if kind == "turned":
            found = Pose(found.rotation @ exp_so3(rng.standard_normal(3)), found.translation)
        sigma = FIX_SIGMA * (1e-4 if kind == "sharp" else 1.0)
        fix = fix_at(found, sigma, lever=lever_in(found), keyframe_covariance=covariance)
        if predicted is None:
            state = started(fix, at_ns, attitude, FilterOptions())
        elif kind == "none":
            state = predicted
        else:
            after = update(predicted, fix)
            state = predicted if isinstance(after, NotLocalized) else after
        told = state.pose_covariance()
        np.testing.assert_array_equal(told, told.T)
        assert np.linalg.eigvalsh(told)[0] > 0
        np.testing.assert_allclose(state.covariance, state.covariance.T, rtol=1e-9, atol=1e-12)
        size = np.sqrt(np.maximum(np.diag(state.covariance), 1e-30))
        assert np.linalg.eigvalsh(state.covariance / np.outer(size, size))[0] > -1e-6
        # The map's part is the map's, to the last bit: that is how it is recognised.
        if kind not in ("none", "new map") and state.fixed_at_ns == state.at_ns:
            known = state.covariance[12:, 12:]
            assert np.array_equal(known, covariance) or state is predicted
        rotation = state.world_from_body.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize(
    "name",
    [
        "acceleration_m_s2",
        "speed_m_s",
        "attitude_sigma_deg",
        "attitude_drift_deg_s",
        "turn_rate_deg_s",
    ],
)
def test_options_must_be_positive(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        FilterOptions(**{name: 0.0})
    with pytest.raises(ValueError, match="attitude_turn_error must lie in"):
        FilterOptions(attitude_turn_error=1.0)
