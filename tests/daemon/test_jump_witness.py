"""A fix that contradicts a fresh one is believed when the next frame says the same."""

from __future__ import annotations

import numpy as np
import pytest

from tests.localization.filter_flights import fix_at
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import NotLocalized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions

STEP_NS = 100_000_000
SPEED_M_S = 2.0
SAID_BY_ONE = "3.0 m from where it was expected, by one frame alone"


class Drone:
    """Flies north at 2 m/s, ten frames a second; what it is told of jumps is kept."""

    def __init__(self, attitude: bool = True) -> None:
        self.jumps: list[str] = []
        self.estimator = Estimator(FilterOptions(), LocalizationOptions(), self.jumps.append)
        self.attitude = np.eye(3) if attitude else None
        for k in range(20):
            assert self.takes(k)

    def takes(self, k: int, aside_m: float = 0.0) -> FilterState | None:
        """Take the k-th fix, so far aside of the truth; None, with its reason, when refused."""
        at_ns = k * STEP_NS
        there = Pose(np.eye(3), np.array([SPEED_M_S * 0.1 * k, aside_m, 0.0]))
        predicted = self.estimator.predicted(at_ns, self.attitude)
        taken = self.estimator.take_fix(predicted, fix_at(there), at_ns, self.attitude)
        if isinstance(taken, FilterState):
            return taken
        self.why: NotLocalized = taken
        return None


@pytest.mark.parametrize("attitude", [True, False])
def test_one_wrong_frame_costs_that_frame_alone(attitude: bool) -> None:
    drone = Drone(attitude)
    for k in (20, 23, 26):
        assert drone.takes(k, aside_m=3.0) is None
        assert drone.why.reason == SAID_BY_ONE
        assert (drone.why.n_matched, drone.why.n_inliers) == (100, 90)
        state = drone.takes(k + 1)
        assert state is not None
        assert abs(state.world_from_body.translation[1]) < 0.1
        assert drone.takes(k + 2)
    assert drone.jumps == []
    assert drone.estimator.n_resets == 0


@pytest.mark.parametrize("attitude", [True, False])
def test_a_place_that_two_frames_say_is_believed(attitude: bool) -> None:
    drone = Drone(attitude)
    assert drone.takes(20, aside_m=3.0) is None
    state = drone.takes(21, aside_m=3.0)
    assert state is not None
    assert abs(state.world_from_body.translation[1] - 3.0) < 0.05
    # By both: no surer than two such fixes are.
    sigma_m = np.sqrt(np.diag(state.pose_covariance())[:3].max())
    assert 0.02 < sigma_m < 0.06
    assert drone.jumps == ["relocalized with 90 landmarks"]
    assert drone.takes(22, aside_m=3.0)
    assert drone.estimator.n_resets == 1


def test_frames_that_say_each_another_place_are_believed_when_the_last_fix_is_old() -> None:
    drone = Drone()
    places = [3.0, -3.0, 6.0, -6.0, 9.0, -9.0, 12.0, -12.0, 15.0]
    assert [drone.takes(20 + i, place) for i, place in enumerate(places)] == [None] * len(places)
    assert drone.takes(29, aside_m=-15.0) is None
    state = drone.takes(30, aside_m=18.0)
    assert state is not None
    assert abs(state.world_from_body.translation[1] - 18.0) < 0.05


def test_who_had_no_fix_for_a_second_is_where_the_next_one_says() -> None:
    drone = Drone()
    assert drone.takes(30, aside_m=12.0)
    assert drone.estimator.n_resets == 1


def test_a_frame_that_is_looked_at_again_is_no_witness_of_itself() -> None:
    drone = Drone()
    assert drone.takes(20, aside_m=3.0) is None
    assert drone.takes(21)
    assert drone.takes(20, aside_m=3.0) is None
    assert drone.why.reason == SAID_BY_ONE
    state = drone.takes(20)
    assert state is not None
    assert state.at_ns == 20 * STEP_NS
    assert drone.jumps == []


def test_a_late_fix_of_one_who_was_lost_for_long_is_believed() -> None:
    drone = Drone()
    for k in range(20, 34):
        at_ns = k * STEP_NS
        predicted = drone.estimator.predicted(at_ns, drone.attitude)
        drone.estimator.take_nothing(predicted, at_ns, drone.attitude)
    state = drone.takes(31, aside_m=12.0)
    assert state is not None
    assert abs(state.world_from_body.translation[1] - 12.0) < 0.05
    assert drone.estimator.n_resets == 1


def test_what_is_forgotten_is_no_witness() -> None:
    drone = Drone()
    assert drone.takes(20, aside_m=3.0) is None
    drone.estimator.forget()
    assert drone.takes(21)
    assert drone.takes(22, aside_m=3.0) is None
