"""Proposals fused into the state at their own time, whenever they come."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_pose_close
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_euler
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_filter import FilterOptions, predict, started, update
from vcl_companion.localization.pose_history import PoseHistory
from vcl_companion.localization.proposals import NotFused, fuse, started_from_proposal

OPTIONS = FilterOptions()
FRAME_NS = 200_000_000
ARM_M = 12.0


def truth_at(k: int) -> Pose:
    return Pose(matrix_from_euler(0.01, 0.02, 0.03 * k), np.array([0.3 * k, 0.1 * k, -2.0]))


def fix_at(pose: Pose, sigma_m: float = 0.02, own_m: float = 0.0) -> Localized:
    noise = np.diag([sigma_m**2] * 3 + [(sigma_m / ARM_M) ** 2] * 3)
    own = np.diag([own_m**2] * 3 + [(own_m / ARM_M) ** 2] * 3)
    lever, keyframes = np.zeros((6, 12)), np.zeros((12, 12))
    lever[:, 6:] = np.eye(6)
    keyframes[6:, 6:] = np.diag([1e-4] * 3 + [1e-6] * 3)
    return Localized(pose, noise, own, lever, keyframes, 100, 90, True, 0.4)


def flown(
    rng: np.random.Generator, n: int, sigma_m: float = 0.02, own_m: float = 0.0
) -> tuple[PoseHistory, list[Localized]]:
    history = PoseHistory(5.0, OPTIONS)
    fixes = []
    for k in range(n):
        truth = truth_at(k)
        off = rng.normal(0.0, sigma_m, 6) / np.array([1, 1, 1, ARM_M, ARM_M, ARM_M])
        fix = fix_at(truth.retracted(off), sigma_m, own_m)
        fixes.append(fix)
        advance(history, k, fix)
    return history, fixes


def advance(history: PoseHistory, k: int, fix: Localized) -> None:
    attitude = truth_at(k).rotation
    if history.newest is None:
        state = started(fix, k * FRAME_NS, attitude, OPTIONS)
    else:
        predicted = predict(history.newest, k * FRAME_NS, attitude, OPTIONS)
        assert predicted is not None
        updated = update(predicted, fix)
        assert isinstance(updated, FilterState)
        state = updated
    history.append(state, fix, attitude)


def newest(history: PoseHistory) -> FilterState:
    assert history.newest is not None
    return history.newest


def test_what_own_frames_told_gives_way_to_the_map_whenever_that_comes() -> None:
    """A drone beyond the map goes on by its own frames, which drift; then a map shows the place."""
    history, _ = flown(np.random.default_rng(3), 5)
    drift = np.array([0.3, 0.2, 0.0])
    for k in range(5, 10):
        truth = truth_at(k)
        drifted = fix_at(Pose(truth.rotation, truth.translation + drift))
        vague = drifted.keyframe_covariance * 1e3
        advance(history, k, replace(drifted, by="odometry", keyframe_covariance=vague))
    assert history.own_fix_at(4 * FRAME_NS) is not None
    # It is not the map that it was found by there.
    assert history.fix_at(7 * FRAME_NS) is None
    assert history.own_fix_at(7 * FRAME_NS) is None
    before = newest(history)
    for k in range(5, 10):
        found = history.refit(k * FRAME_NS, fix_at(truth_at(k), 0.005))
        assert isinstance(found, FilterState)
        assert_pose_close(found.world_from_body, truth_at(k), within_m=0.02, within_rad=0.01)
        assert history.own_fix_at(k * FRAME_NS) is not None
        # What the map has said once is not said again.
        assert history.refit(k * FRAME_NS, fix_at(truth_at(k))) is None
    after = newest(history)
    assert_pose_close(after.world_from_body, truth_at(9), within_m=0.02, within_rad=0.01)
    assert after.n_jumps == before.n_jumps
    # And how fast it flies is known by it: five places in a second.
    speed = np.sqrt(np.diag(after.velocity_covariance()))
    assert np.all(speed < 0.6)
    np.testing.assert_allclose(after.velocity_world, [1.5, 0.5, 0.0], atol=0.1)


def test_who_begins_anew_in_the_past_goes_on_from_there_by_own_frames() -> None:
    """A map that comes late has them a metre off: the newest state is not as old as its frame."""
    history, _ = flown(np.random.default_rng(3), 5)
    for k in range(5, 10):
        vague = fix_at(truth_at(k)).keyframe_covariance * 1e3
        advance(history, k, replace(fix_at(truth_at(k)), by="odometry", keyframe_covariance=vague))
    off = np.array([1.0, 0.0, 0.0])
    there = fix_at(Pose(truth_at(6).rotation, truth_at(6).translation + off), 0.005)
    state = started(there, 6 * FRAME_NS, truth_at(6).rotation, OPTIONS)
    assert history.restart(state, there)
    begun = history.own_fix_at(6 * FRAME_NS)
    assert begun is not None
    assert_pose_close(begun.world_from_body, there.world_from_body, within_m=1e-9, within_rad=1e-9)
    assert newest(history).at_ns == 9 * FRAME_NS
    assert newest(history).pose_covariance()[:3, :3].max() < 0.5**2
    unknown = replace(state, at_ns=6 * FRAME_NS + FRAME_NS // 2)
    assert not history.restart(unknown, there)


def sharp(sigma_m: float = 0.005) -> Array:
    return np.diag([sigma_m**2] * 3 + [(sigma_m / ARM_M) ** 2] * 3)


def test_a_late_proposal_is_worth_as_much_as_one_in_time() -> None:
    """Fused at once and flown on, or flown on and fused late: the same state."""
    rng = np.random.default_rng(1)
    late, fixes = flown(rng, 8, sigma_m=0.3)
    proposal = truth_at(3).retracted(rng.normal(0.0, 0.004, 6) / np.array([1, 1, 1, 12, 12, 12]))
    in_time = PoseHistory(5.0, OPTIONS)
    for k, fix in enumerate(fixes):
        advance(in_time, k, fix)
        if k == 3:
            assert isinstance(in_time.fuse(3 * FRAME_NS, proposal, sharp(), ARM_M), FilterState)
    fused = late.fuse(3 * FRAME_NS, proposal, sharp(), ARM_M)
    assert isinstance(fused, FilterState)
    assert fused is newest(late)
    assert_pose_close(
        fused.world_from_body, newest(in_time).world_from_body, within_m=1e-12, within_rad=1e-12
    )
    np.testing.assert_allclose(fused.covariance, newest(in_time).covariance, atol=1e-12)


def test_what_a_peer_has_said_stays_when_something_older_comes() -> None:
    """Another's word about an earlier frame, or that frame's own fix, found late."""
    history, _ = flown(np.random.default_rng(5), 4)
    for k in range(4, 12):
        predicted = predict(newest(history), k * FRAME_NS, truth_at(k).rotation, OPTIONS)
        assert predicted is not None
        history.append(predicted, None, truth_at(k).rotation)
    assert isinstance(history.fuse(10 * FRAME_NS, truth_at(10), sharp(0.05), ARM_M), FilterState)

    def sigma_m() -> float:
        return float(np.sqrt(np.trace(newest(history).pose_covariance()[:3, :3])))

    told_m = sigma_m()
    assert isinstance(history.fuse(5 * FRAME_NS, truth_at(5), sharp(0.05), ARM_M), FilterState)
    assert sigma_m() < 1.01 * told_m
    assert newest(history).fixed_at_ns == 10 * FRAME_NS
    assert isinstance(history.refit(6 * FRAME_NS, fix_at(truth_at(6))), FilterState)
    assert sigma_m() < 1.01 * told_m
    assert newest(history).fixed_at_ns == 10 * FRAME_NS


def test_a_late_fix_is_worth_as_much_as_one_in_time() -> None:
    """Of a frame that was looked for by its features while others were tracked."""
    in_time, fixes = flown(np.random.default_rng(3), 8)
    late = PoseHistory(5.0, OPTIONS)
    for k, fix in enumerate(fixes):
        if k == 3:
            predicted = predict(newest(late), k * FRAME_NS, truth_at(k).rotation, OPTIONS)
            assert predicted is not None
            late.append(predicted, None, truth_at(k).rotation)
            continue
        advance(late, k, fix)
    state = late.refit(3 * FRAME_NS, fixes[3])
    assert isinstance(state, FilterState)
    assert late.own_fix_at(3 * FRAME_NS) is state
    assert state.at_ns == 3 * FRAME_NS
    one, other = newest(late), newest(in_time)
    assert_pose_close(one.world_from_body, other.world_from_body, within_m=1e-12, within_rad=1e-12)
    np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-12)


def test_a_late_fix_of_what_is_not_kept_or_was_found_or_cannot_be_is_refused() -> None:
    history, fixes = flown(np.random.default_rng(4), 4)
    before = newest(history)
    for at_ns, fix in ((2 * FRAME_NS, fixes[2]), (FRAME_NS // 2, fixes[0])):
        assert history.refit(at_ns, fix) is None
    predicted = predict(before, 4 * FRAME_NS, truth_at(4).rotation, OPTIONS)
    assert predicted is not None
    history.append(predicted, None, truth_at(4).rotation)
    turned = Pose(truth_at(4).rotation @ matrix_from_euler(0.0, 0.0, 1.0), np.zeros(3))
    assert isinstance(history.refit(4 * FRAME_NS, fix_at(turned)), NotLocalized)
    assert newest(history) is predicted


def test_the_last_frame_looked_at_again_takes_its_own_place() -> None:
    history, _ = flown(np.random.default_rng(5), 3)
    predicted = predict(newest(history), 3 * FRAME_NS, truth_at(3).rotation, OPTIONS)
    assert predicted is not None
    history.append(predicted, None, truth_at(3).rotation)
    assert history.own_fix_at(3 * FRAME_NS) is None
    advance(history, 3, fix_at(truth_at(3)))
    assert history.own_fix_at(3 * FRAME_NS) is newest(history)


def test_a_starved_drone_takes_what_the_peer_knows() -> None:
    rng = np.random.default_rng(2)
    history, _ = flown(rng, 4, sigma_m=0.8, own_m=0.5)
    before = newest(history)
    fused = history.fuse(3 * FRAME_NS, truth_at(3), sharp(), ARM_M)
    assert isinstance(fused, FilterState)
    off_before = np.linalg.norm(before.world_from_body.local(truth_at(3))[:3])
    assert off_before > 0.1
    assert_pose_close(fused.world_from_body, truth_at(3), within_m=0.03, within_rad=0.003)
    sigma_m = np.sqrt(np.diag(fused.pose_covariance())[:3])
    assert np.all(sigma_m < 0.02)
    assert np.all(sigma_m > 0.002)


def test_a_proposal_widens_of_the_speed_only_what_follows_from_the_place() -> None:
    """A first place a moment ago, a proposal now: between them the speed is known."""
    far = np.eye(6) * 1e-3
    state = started_from_proposal(truth_at(0), far, 0, truth_at(0).rotation, OPTIONS)
    fused = None
    for k in range(1, 6):
        predicted = predict(state, k * FRAME_NS, truth_at(k).rotation, OPTIONS)
        assert predicted is not None
        fused = fuse(predicted, truth_at(k), sharp(), ARM_M)
        assert isinstance(fused, FilterState)
        assert fused.fixed_at_ns == k * FRAME_NS
        # Never surer of the place than the proposal: all of that may be one error.
        assert np.all(np.diag(fused.pose_covariance())[:3] > 0.9 * 0.005**2)
        state = fused
    speed_sigma = np.sqrt(np.diag(state.covariance)[6:9])
    # A constant acceleration over the step: 5 mm of place tell it to 0.25 m/s^2.
    assert np.all(speed_sigma < 1.0)
    assert np.all(speed_sigma > 0.05)
    np.testing.assert_allclose(state.velocity_world[:2], [1.5, 0.5], atol=3.0 * speed_sigma.max())


def test_without_a_fix_the_frame_of_a_confirming_proposal_is_no_coasting() -> None:
    history, _ = flown(np.random.default_rng(3), 6)
    predicted = predict(newest(history), 6 * FRAME_NS, truth_at(6).rotation, OPTIONS)
    assert predicted is not None
    history.append(predicted, None, truth_at(6).rotation)
    assert history.own_fix_at(6 * FRAME_NS) is None
    assert history.own_fix_at(5 * FRAME_NS) is not None
    confirmed = history.fuse(6 * FRAME_NS, truth_at(6), np.eye(6), ARM_M)
    assert isinstance(confirmed, FilterState)
    assert (predicted.fixed_at_ns, confirmed.fixed_at_ns) == (5 * FRAME_NS, 6 * FRAME_NS)
    np.testing.assert_array_equal(confirmed.covariance, predicted.covariance)
    assert history.at(6 * FRAME_NS) is confirmed
    assert history.at(7 * FRAME_NS) is None


def test_the_same_opinion_twice_is_no_news() -> None:
    """A Kalman update would halve the covariance each time that an echo comes back."""
    history, _ = flown(np.random.default_rng(3), 6)
    state = newest(history)
    for _ in range(20):
        echo = fuse(state, state.world_from_body, state.pose_covariance(), ARM_M)
        assert isinstance(echo, FilterState)
        state = echo
    assert state is newest(history)


def test_a_proposal_worse_than_our_own_changes_nothing() -> None:
    history, _ = flown(np.random.default_rng(4), 6)
    before = newest(history)
    off = truth_at(5).retracted(np.array([0.4, -0.3, 0.2, 0.02, 0.0, -0.02]))
    fused = history.fuse(5 * FRAME_NS, off, np.eye(6) * 4.0, ARM_M)
    assert isinstance(fused, FilterState)
    assert_pose_close(fused.world_from_body, before.world_from_body, within_m=1e-9, within_rad=1e-9)
    np.testing.assert_array_equal(fused.covariance, before.covariance)


def test_what_no_sigma_explains_is_refused_and_changes_nothing() -> None:
    history, _ = flown(np.random.default_rng(5), 6)
    before = newest(history)
    far = truth_at(5).retracted(np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    refused = history.fuse(5 * FRAME_NS, far, sharp(), ARM_M)
    assert isinstance(refused, NotFused)
    assert "5.0 m from where we are" in refused.reason
    assert newest(history) is before


def test_what_is_older_than_the_history_is_refused() -> None:
    history, _ = flown(np.random.default_rng(6), 40)
    refused = history.fuse(2 * FRAME_NS, truth_at(2), sharp(), ARM_M)
    assert isinstance(refused, NotFused)
    assert "7.4 s ago" in refused.reason
    assert isinstance(history.fuse(30 * FRAME_NS, truth_at(30), sharp(), ARM_M), FilterState)
    between = history.fuse(30 * FRAME_NS + FRAME_NS // 2, truth_at(30), sharp(), ARM_M)
    assert isinstance(between, NotFused)


def test_of_who_is_lost_the_states_since_the_last_fix_stay_while_their_frames_do() -> None:
    step_ns, n_found, n_lost = FRAME_NS // 2, 10, 60
    history = PoseHistory(1.0, OPTIONS, lost_s=4.0)
    history.has_frame = lambda at_ns: at_ns // step_ns % 3 == 0
    fix = fix_at(truth_at(0))
    first = started(fix, 0, np.eye(3), OPTIONS)
    history.append(first, fix, None)
    for k in range(1, n_found + n_lost):
        state = predict(first, k * step_ns, np.eye(3), OPTIONS)
        assert state is not None
        history.append(state, fix if k < n_found else None, None)
        kept = [n for n in range(k + 1) if history.at(n * step_ns) is not None]
        since = max(n_found - 1 if k >= n_found else k, k - 40)
        assert kept == [n for n in range(k + 1) if n >= k - 10 or (n >= since and n % 3 == 0)]
    # Found again, nothing that old is of interest.
    history.append(newest(history), fix, None)
    assert all(history.at(n * step_ns) is None for n in range(n_found + n_lost - 11))


def test_without_any_state_there_is_nothing_to_fuse_with() -> None:
    history, _ = flown(np.random.default_rng(7), 2)
    history.clear()
    assert isinstance(history.fuse(0, truth_at(0), sharp(), ARM_M), NotFused)


@pytest.mark.parametrize("broken", [np.full((6, 6), np.nan), np.zeros((6, 6)), -np.eye(6)])
def test_a_covariance_that_is_none_is_refused(broken: Array) -> None:
    history, _ = flown(np.random.default_rng(8), 2)
    assert isinstance(history.fuse(FRAME_NS, truth_at(1), broken, ARM_M), NotFused)


def test_states_come_in_order() -> None:
    history, fixes = flown(np.random.default_rng(9), 3)
    with pytest.raises(ValueError, match="order"):
        history.append(started(fixes[0], 0, None, OPTIONS), fixes[0], None)
    with pytest.raises(ValueError, match="length_s"):
        PoseHistory(0.0, OPTIONS)


def test_the_last_state_before_an_instant_is_found_wherever_that_lies() -> None:
    history, _ = flown(np.random.default_rng(8), 4)
    for at_ns, k in ((3 * FRAME_NS + 70, 3), (3 * FRAME_NS, 3), (3 * FRAME_NS - 1, 2), (0, 0)):
        before = history.before(at_ns)
        assert before is not None
        assert before.at_ns == k * FRAME_NS
    assert history.before(-1) is None
    history.clear()
    assert history.before(FRAME_NS) is None
