"""The filter on maps that err: never surer than the map, whichever comes next."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent, assert_pose_close, nees
from tests.localization.filter_flights import (
    FIX_SIGMA,
    STEADY,
    STEP_NS,
    STEP_S,
    Flight,
    filtered,
    fix_at,
    fly,
    keyframe_errors,
    lever_in,
    updated,
)
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.pose_filter import predict, started

TINY = 0.2 * FIX_SIGMA


def on_maps_that_err(
    rng: np.random.Generator, n_frames: int
) -> Iterator[tuple[Array, Flight, Callable[[Pose], Localized]]]:
    """Yield sixty flights: the covariance of what keyframes are off, and what fixes they give."""
    for _ in range(60):
        covariance, draw = keyframe_errors(rng)

        def fix_of(pose: Pose, covariance: Array = covariance, draw: Array = draw) -> Localized:
            found = pose.retracted(lever_in(pose) @ draw)
            found = found.retracted(TINY * rng.standard_normal(6))
            return fix_at(found, TINY, lever=lever_in(found), keyframe_covariance=covariance)

        yield covariance, fly(rng, n_frames, STEADY), fix_of


def test_the_map_s_error_is_common_to_all_frames_and_does_not_average_out() -> None:
    errors, sigma, shares = [], [], []
    for covariance, flight, fix_of in on_maps_that_err(np.random.default_rng(4), 40):
        state = filtered(flight, fix_of, STEADY)[-1]
        errors.append(state.world_from_body.local(flight.poses[-1]))
        sigma.append(state.pose_covariance())
        lever = lever_in(flight.poses[-1])
        shares.append(np.trace(sigma[-1]) / np.trace(lever @ covariance @ lever.T))
    assert_consistent(errors, sigma)
    # Forty frames later the map's error is still all there, and the noise nearly gone.
    assert min(shares) > 0.999
    assert max(shares) < 1.05


def test_where_a_map_shows_things_is_no_less_certain_for_what_it_is_off() -> None:
    """Predictions against what the map says next: sharp, though both are off by decimetres."""
    missed, among, whole = [], [], []
    for _, flight, fix_of in on_maps_that_err(np.random.default_rng(14), 20):
        before = filtered(replace(flight, poses=flight.poses[:-1]), fix_of, STEADY)[-1]
        predicted = predict(before, before.at_ns + STEP_NS, flight.attitudes[-1], STEADY)
        assert predicted is not None
        surest, surely = (prior.covariance for prior in predicted.priors_on_own_views())
        missed.append(predicted.world_from_body.local(fix_of(flight.poses[-1]).world_from_body))
        among.append(surest + np.diag(TINY**2))
        whole.append(surely + np.diag(TINY**2))
    # Of six degrees of freedom.
    assert 3.0 < np.mean(nees(missed, among)) < 8.0
    assert np.mean(nees(missed, whole)) < 2.0


def test_a_new_map_s_error_is_a_new_one() -> None:
    rng = np.random.default_rng(5)
    pose = Pose.identity()
    covariance, _ = keyframe_errors(rng)
    first = fix_at(pose, lever=lever_in(pose), keyframe_covariance=covariance)
    state = started(first, 0, np.eye(3), STEADY)
    before = np.trace(state.pose_covariance())
    larger = np.zeros((18, 18))
    larger[6:, 6:] = np.diag([0.04] * 3 + [1e-4] * 3 + [0.04] * 3 + [1e-4] * 3)
    lever = np.hstack([lever_in(pose), np.zeros((6, 6))])
    second = fix_at(pose, lever=lever, keyframe_covariance=larger)
    after = updated(predict(state, STEP_NS, np.eye(3), STEADY), second)
    assert after.covariance.shape == (30, 30)
    np.testing.assert_array_equal(after.covariance[12:, 12:], larger)
    # The one map is surer of how it is turned, the other one of where.
    assert np.trace(after.pose_covariance()) < before


def one_by_one(fixes: list[Localized]) -> Callable[[Pose], Localized]:
    order = iter(fixes)
    return lambda _: next(order)


@pytest.mark.parametrize("change", ["as it was", "off by more", "off by less"])
def test_another_revision_of_a_map_is_no_second_witness(change: str) -> None:
    """It is made from where the last one put its views, and errs as that one does."""
    n_revisions, per_revision = 8, 5
    counts = {
        "as it was": np.ones(n_revisions, int),
        "off by more": np.arange(1, n_revisions + 1),
        "off by less": np.arange(n_revisions, 0, -1),
    }[change]
    errors, sigma = [], []
    rng = np.random.default_rng(15)
    for each, flight, _ in on_maps_that_err(rng, n_revisions * per_revision):
        # What the first revisions are off the next ones are as well, and more, or less.
        root = np.vstack([np.zeros((6, 6)), np.linalg.cholesky(each[6:, 6:])])
        parts = rng.standard_normal((n_revisions, 6)) @ root.T
        fixes = []
        for k, pose in enumerate(flight.poses):
            revision = k // per_revision
            found = pose.retracted(lever_in(pose) @ parts[: counts[revision]].sum(axis=0))
            found = found.retracted(TINY * rng.standard_normal(6))
            # Another map, though it may be off by as much: it is known by its very numbers.
            known = counts[revision] * (1.0 + 1e-9 * revision) * each
            fixes.append(fix_at(found, TINY, lever=lever_in(found), keyframe_covariance=known))
        state = filtered(flight, one_by_one(fixes), STEADY)[-1]
        errors.append(state.world_from_body.local(flight.poses[-1]))
        sigma.append(state.pose_covariance())
    assert_consistent(errors, sigma)


def test_the_landmarks_own_errors_are_part_of_what_is_told() -> None:
    own = np.diag([0.01] * 3 + [1e-4] * 3)
    state = started(fix_at(Pose.identity(), own_map_covariance=own), 0, np.eye(3), STEADY)
    for k in range(1, 50):
        predicted = predict(state, k * STEP_NS, np.eye(3), STEADY)
        state = updated(predicted, fix_at(Pose.identity(), own_map_covariance=own))
    assert np.all(np.linalg.eigvalsh(state.pose_covariance() - own) > 0)
    # In body axes: it turns with the body.
    turned = predict(state, 51 * STEP_NS, exp_so3(np.array([0.0, 0.0, np.pi / 2])), STEADY)
    assert turned is not None
    np.testing.assert_allclose(np.diag(turned.own_map_covariance), np.diag(own), atol=1e-12)
    uneven = np.diag([0.04, 0.01, 0.01, 1e-4, 1e-4, 1e-4])
    state = started(fix_at(Pose.identity(), own_map_covariance=uneven), 0, np.eye(3), STEADY)
    turned = predict(state, STEP_NS, exp_so3(np.array([0.0, 0.0, np.pi / 2])), STEADY)
    assert turned is not None
    np.testing.assert_allclose(
        np.diag(turned.own_map_covariance)[:3], [0.01, 0.04, 0.01], atol=1e-12
    )


def test_maps_of_own_views_are_no_witnesses_of_where_they_are() -> None:
    """A drone goes on from one to the next: it errs as they do, no less for how many they are."""
    known = np.zeros((12, 12))
    known[6:, 6:] = np.diag([0.2**2] * 3 + [0.01**2] * 3)
    lever = np.hstack([np.zeros((6, 6)), np.eye(6)])
    sharp = np.repeat([0.003, 0.0005], 3)
    pose, velocity = Pose.identity(), np.array([2.0, -1.0, 0.0])
    first = fix_at(pose, sharp, lever=lever, keyframe_covariance=known)
    state = started(first, 0, pose.rotation, STEADY)
    for k in range(1, 41):
        pose = Pose(np.eye(3), k * STEP_S * velocity)
        # Another map each time: of one's own views it is as vague as the last one.
        keyframes = known * (1.0 + 1e-9 * k)
        fix = fix_at(pose, sharp, lever=lever, keyframe_covariance=keyframes)
        predicted = predict(state, k * STEP_NS, pose.rotation, STEADY)
        state = updated(predicted, replace(fix, by="odometry"))
    sigma_m = np.sqrt(np.diag(state.pose_covariance())[:3])
    assert np.all(np.abs(sigma_m - 0.2) < 0.005)
    # Frame by frame these err alike, so that how fast it flies is known all the same.
    np.testing.assert_allclose(state.velocity_world, velocity, atol=0.05)
    assert np.all(np.sqrt(np.diag(state.velocity_covariance())) < 0.2)


def test_a_map_of_own_views_is_followed_where_the_state_knows_better() -> None:
    """Found by the swarm's map again for a moment, then on by own views that have drifted."""
    surer = np.zeros((12, 12))
    surer[6:, 6:] = np.diag([0.01**2] * 3 + [0.001**2] * 3)
    vague = np.zeros((12, 12))
    vague[6:, 6:] = np.diag([0.3**2] * 3 + [0.002**2] * 3)
    lever = np.hstack([np.zeros((6, 6)), np.eye(6)])
    sharp = np.repeat([0.003, 0.0005], 3)
    velocity = np.array([2.0, -1.0, 0.0])
    on_map = fix_at(Pose.identity(), sharp, lever=lever, keyframe_covariance=surer)
    state = started(on_map, 0, np.eye(3), STEADY)
    for k in range(1, 8):
        pose = Pose(np.eye(3), k * STEP_S * velocity)
        fix = fix_at(pose, sharp, lever=lever, keyframe_covariance=surer)
        state = updated(predict(state, k * STEP_NS, np.eye(3), STEADY), fix)
    drifted = Pose(np.eye(3), 8 * STEP_S * velocity + np.array([0.3, 0.2, 0.0]))
    own = replace(fix_at(drifted, sharp, lever=lever, keyframe_covariance=vague), by="odometry")
    after = updated(predict(state, 8 * STEP_NS, np.eye(3), STEADY), own)
    assert after.n_jumps == state.n_jumps
    assert_pose_close(after.world_from_body, drifted, within_m=0.02, within_rad=0.01)
    assert np.all(np.sqrt(np.diag(after.pose_covariance())[:3]) > 0.25)
    np.testing.assert_allclose(after.velocity_world, velocity, atol=0.05)
    assert np.all(np.sqrt(np.diag(after.velocity_covariance())) < 0.5)
