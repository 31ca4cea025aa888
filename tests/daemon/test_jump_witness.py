"""A fix that puts a drone back where it has just been is believed when the next frame agrees."""

from __future__ import annotations

import numpy as np
import pytest

from tests.localization.filter_flights import FIX_SIGMA, fix_at
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import NotLocalized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions

STEP_NS = 100_000_000
STEP_M = 2.0
BACK = "2.0 m back, where an earlier frame was"


class Drone:
    """Flies north at 20 m/s, ten frames a second; what it is told of jumps is kept."""

    def __init__(self, attitude: bool = True) -> None:
        self.jumps: list[str] = []
        self.estimator = Estimator(FilterOptions(), LocalizationOptions(), self.jumps.append)
        self.attitude = np.eye(3) if attitude else None
        self.why = NotLocalized("")
        for k in range(20):
            assert self.takes(k)

    def takes(self, k: int, shows: float | None = None, east_m: float = 0.0) -> FilterState | None:
        """Take the fix of the k-th frame, that shows what another would; None when refused."""
        at_ns = k * STEP_NS
        there = Pose(np.eye(3), np.array([STEP_M * (k if shows is None else shows), east_m, 0.0]))
        predicted = self.estimator.predicted(at_ns, self.attitude)
        taken = self.estimator.take_fix(predicted, fix_at(there), at_ns, self.attitude)
        if isinstance(taken, FilterState):
            return taken
        self.why = taken
        return None


@pytest.mark.parametrize("attitude", [True, False])
def test_one_image_of_before_costs_that_frame_alone(attitude: bool) -> None:
    drone = Drone(attitude)
    for k in (20, 23, 26):
        assert drone.takes(k, shows=k - 1) is None
        assert (drone.why.reason, drone.why.n_matched, drone.why.n_inliers) == (BACK, 100, 90)
        state = drone.takes(k + 1)
        assert state is not None
        assert abs(state.world_from_body.translation[0] - STEP_M * (k + 1)) < 0.1
        assert drone.takes(k + 2)
    assert drone.jumps == []
    assert drone.estimator.n_resets == 0


@pytest.mark.parametrize("attitude", [True, False])
def test_who_has_braked_is_where_two_frames_say(attitude: bool) -> None:
    drone = Drone(attitude)
    assert drone.takes(20, shows=19) is None
    state = drone.takes(21, shows=19)
    assert state is not None
    assert abs(state.world_from_body.translation[0] - STEP_M * 19) < 0.05
    # By both: no surer than two such fixes are.
    sigma_m = np.sqrt(np.diag(state.pose_covariance())[:3].max())
    assert 0.5 * FIX_SIGMA[:3].max() < sigma_m < 1.1 * FIX_SIGMA[:3].max()
    assert drone.jumps == ["relocalized with 90 landmarks"]
    assert drone.takes(22, shows=19)
    assert drone.estimator.n_resets == 1


@pytest.mark.parametrize(("shows", "east_m"), [(15.4, 0.0), (19.0, 1.5), (33.0, 0.0)])
def test_a_place_where_no_frame_was_is_believed_at_once(shows: float, east_m: float) -> None:
    """Photographs taken 10 m apart: each is a jump, and shows what it shows."""
    drone = Drone()
    assert drone.takes(20, shows, east_m)
    assert drone.estimator.n_resets == 1


def test_a_place_of_more_than_a_second_ago_is_no_image_of_then() -> None:
    drone = Drone()
    assert drone.takes(20, shows=10) is None
    assert Drone().takes(20, shows=9) is not None


def test_who_comes_back_from_a_jump_that_was_wrong_is_believed_at_once() -> None:
    drone = Drone()
    assert drone.takes(20, east_m=30.0)
    assert drone.takes(21, shows=19)
    assert drone.estimator.n_resets == 2


def test_a_frame_that_is_looked_at_again_is_no_witness_of_itself() -> None:
    drone = Drone()
    assert drone.takes(20, shows=19) is None
    assert drone.takes(21)
    assert drone.takes(20, shows=19) is None
    assert drone.why.reason == BACK
    state = drone.takes(20)
    assert state is not None
    assert state.at_ns == 20 * STEP_NS
    assert drone.jumps == []


def test_a_late_fix_of_one_who_was_lost_is_believed() -> None:
    drone = Drone()
    for k in range(20, 34):
        at_ns = k * STEP_NS
        predicted = drone.estimator.predicted(at_ns, drone.attitude)
        drone.estimator.take_nothing(predicted, at_ns, drone.attitude)
    state = drone.takes(31, shows=17)
    assert state is not None
    assert abs(state.world_from_body.translation[0] - STEP_M * 17) < 0.05
    assert drone.estimator.n_resets == 1


def test_what_is_forgotten_is_no_witness() -> None:
    drone = Drone()
    assert drone.takes(20, shows=19) is None
    drone.estimator.forget()
    assert drone.takes(21)
    assert drone.takes(22)
    assert drone.takes(23, shows=22) is None
