"""What a peer's proposal may do to a drone that has not seen the map for long."""

from __future__ import annotations

import numpy as np
import pytest

from tests.daemon import demo
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.proposals import NotFused

SURE = np.diag([0.02] * 3 + [0.002] * 3) ** 2
SPEED_M_S = FilterOptions().speed_m_s


def fix_at(metres: float) -> Localized:
    """A fix of the drone's own, so far along the x axis."""
    return Localized(
        Pose(np.eye(3), np.array([metres, 0.0, 0.0])), SURE, 1e-6 * np.eye(6), np.zeros((6, 0)),
        np.zeros((0, 0)), 50, 50, False, 0.5,
    )  # fmt: skip


def after_a_fix(silent_s: float) -> tuple[Estimator, int]:
    """A drone that saw the map at the origin, and for so long nothing since."""
    estimator = Estimator(FilterOptions(), LocalizationOptions(), lambda _: None)
    estimator.take_fix(None, fix_at(0.0), 0, None)
    at_ns = round(silent_s * 1e9)
    estimator.take_nothing(estimator.predicted(at_ns, None), at_ns, None)
    return estimator, at_ns


def proposed(estimator: Estimator, at_ns: int, metres: float) -> FilterState | NotFused:
    there = Pose(np.eye(3), np.array([metres, 0.0, 0.0]))
    points = demo.map_index(1, 2).landmark_map.points_world
    return estimator.take_proposal(at_ns, None, there, SURE, points)


@pytest.mark.parametrize("silent_s", [20.0, 59.0, 90.0])
def test_nobody_is_taken_for_faster_than_he_flies(silent_s: float) -> None:
    """By its covariance alone, or for want of any, the filter would believe a kilometre."""
    estimator, at_ns = after_a_fix(silent_s)
    assert not estimator.last_own_fix.is_near(at_ns)
    reach_m = 5.0 * SPEED_M_S * silent_s
    far = proposed(estimator, at_ns, 1.1 * reach_m)
    assert isinstance(far, NotFused)
    assert far.contradicts
    assert far.reason.endswith(f"m from our last own fix, {silent_s:.1f} s away from it")
    near = proposed(estimator, at_ns, 0.2 * reach_m)
    assert isinstance(near, FilterState)
    assert abs(near.world_from_body.translation[0] - 0.2 * reach_m) < 0.1


def test_no_peer_knows_better_where_we_are_than_our_own_frames_have_shown() -> None:
    """Or our next frames would count for nothing beside what it has said."""
    estimator, at_ns = after_a_fix(20.0)
    points = demo.map_index(1, 2).landmark_map.points_world
    there = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    oversure = np.diag([1e-4] * 3 + [1e-5] * 3) ** 2
    fused = estimator.take_proposal(at_ns, None, there, oversure, points)
    assert isinstance(fused, FilterState)
    sigmas = np.sqrt(np.diag(fused.pose_covariance()))
    assert (sigmas >= 0.99 * np.sqrt(np.diag(SURE))).all()
    # What is no surer is taken as it is, however its errors hang together.
    mixed = SURE.copy()
    mixed[0, 4] = mixed[4, 0] = 0.9 * 0.04 * 0.004
    mixed[0, 0], mixed[4, 4] = 0.04**2 * 6, 0.004**2 * 6
    np.testing.assert_array_equal(estimator.last_own_fix.no_surer(4.0 * mixed), 4.0 * mixed)


def test_what_comes_too_late_contradicts_nothing() -> None:
    estimator, at_ns = after_a_fix(1.0)
    late = proposed(estimator, at_ns - 500_000_000, 0.0)
    assert isinstance(late, NotFused)
    assert not late.contradicts
    off = proposed(estimator, 0, 5.0)
    assert isinstance(off, NotFused)
    assert off.contradicts
    assert estimator.last_own_fix.is_near(0)


def test_a_drone_that_has_seen_nothing_yet_is_placed_by_its_peers() -> None:
    estimator = Estimator(FilterOptions(), LocalizationOptions(), lambda _: None)
    assert isinstance(proposed(estimator, 0, 900.0), FilterState)
    assert not estimator.last_own_fix.is_near(0)


def test_a_fix_that_comes_late_says_where_a_drone_was_too() -> None:
    """Where every frame has to be searched for, there are no others."""
    estimator = Estimator(FilterOptions(), LocalizationOptions(), lambda _: None)
    assert isinstance(proposed(estimator, 0, 0.0), FilterState)
    for at_ns in (1_000_000_000, 2_000_000_000, 3_000_000_000):
        estimator.take_nothing(estimator.predicted(at_ns, None), at_ns, None)
    for at_ns in (2_000_000_000, 1_000_000_000):
        assert isinstance(estimator.take_fix(None, fix_at(0.1), at_ns, None), FilterState)
    assert estimator.last_own_fix.is_near(4_000_000_000)
    assert not estimator.last_own_fix.is_near(4_000_000_001)
