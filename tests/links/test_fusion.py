"""What becomes of our poses, by what an autopilot says of itself."""

import math

import numpy as np
import pytest

from vcl_companion.geometry.rotation import Array
from vcl_companion.links.fusion import FusionMonitor, FusionState
from vcl_companion.links.messages import EstimatorStatus
from vcl_companion.links.vision_pose import Firmware

MS = 1_000_000
S = 1_000 * MS
SIGMA_M = 0.02


def position_at(at_ns: float) -> Array:
    """Where the drone is: on a circle of 5 m, at 2.5 m/s."""
    angle = 0.5 * at_ns * 1e-9
    return np.array([5.0 * math.cos(angle), 5.0 * math.sin(angle), -3.0])


def velocity_at(at_ns: float) -> Array:
    return (position_at(at_ns + MS) - position_at(at_ns - MS)) / (2e-9 * MS)


class Flight:
    """A drone that is sent poses at 10 Hz and says where it believes to be, as often."""

    def __init__(self) -> None:
        self.monitor = FusionMonitor()
        self.now_ns = S
        self.sends = self.tells = self.reports = True
        self.off = np.zeros(3)
        self.told_off, self.n_resets = np.zeros(3), 0
        self.sinks_m_s = 0.0
        self.ahead_s = 0.0
        self.has_position, self.holds_position = True, False
        self.ratio: float | None = 0.1

    def fly(self, seconds: float) -> list[FusionState]:
        """Go on for so long; return the states that it was told, each once."""
        states: list[FusionState] = []
        for _ in range(round(seconds * 10)):
            self.now_ns += 100 * MS
            if self.sends:
                of_ns = self.now_ns - 40 * MS
                told = position_at(of_ns) + self.told_off
                self.monitor.sent(of_ns, told, SIGMA_M, self.n_resets)
            if self.reports:
                status = EstimatorStatus(1, 1, self.has_position, self.holds_position, self.ratio)
                self.monitor.reported(status, self.now_ns)
            if self.tells:
                seen_ns = self.now_ns + self.ahead_s * 1e9
                self.off = self.off + np.array([0.0, 0.0, 0.1 * self.sinks_m_s])
                there = position_at(seen_ns) + self.off
                self.monitor.believes(self.now_ns, there, velocity_at(seen_ns))
            state = self.monitor.state(self.now_ns).state
            if not states or states[-1] is not state:
                states.append(state)
        return states

    @property
    def reason(self) -> str:
        return self.monitor.state(self.now_ns).reason


def test_where_it_takes_us_to_be_is_known_while_it_has_a_position_and_says_so() -> None:
    flight = Flight()
    assert flight.monitor.expected_at(flight.now_ns) is None
    flight.off = np.array([3.0, 0.0, 0.0])
    flight.fly(3.0)
    for late_ns in (-80 * MS, 0, 80 * MS):
        expected = flight.monitor.expected_at(flight.now_ns + late_ns)
        assert expected is not None
        there = position_at(flight.now_ns + late_ns) + flight.off
        assert np.allclose(expected, there, atol=0.01)
    assert flight.monitor.expected_at(flight.now_ns + 501 * MS) is None
    flight.holds_position = True
    flight.fly(0.1)
    assert flight.monitor.expected_at(flight.now_ns) is None
    flight.holds_position, flight.has_position = False, False
    flight.fly(0.1)
    assert flight.monitor.expected_at(flight.now_ns) is None


def test_poses_between_frames_are_no_silence_and_are_not_compared() -> None:
    flight = Flight()
    flight.fly(5.0)
    flight.sends = False
    states = []
    for _ in range(30):
        states += flight.fly(0.1)
        flight.monitor.sent_between(flight.now_ns)
    assert FusionState.LOST not in states
    assert FusionState.LOST in flight.fly(3.0)


def test_nothing_is_expected_of_it_before_the_first_pose() -> None:
    flight = Flight()
    flight.sends = False
    assert flight.fly(20.0) == [FusionState.WAITING]


def test_who_follows_us_has_fused_us() -> None:
    flight = Flight()
    assert flight.fly(10.0)[-1] is FusionState.FUSED
    assert flight.reason == ""


def test_it_is_fused_as_soon_as_it_says_so() -> None:
    flight = Flight()
    flight.has_position = False
    assert flight.fly(2.0) == [FusionState.SENDING]
    flight.has_position = True
    assert flight.fly(0.2)[-1] is FusionState.FUSED


@pytest.mark.parametrize(
    ("attribute", "value", "reason"),
    [
        ("has_position", False, "has no position"),
        ("holds_position", True, "holds its position for constant"),
        ("ratio", 1.7, "fails the test"),
        ("off", np.array([0.0, 3.0, 0.0]), "3.0 m from ours"),
        ("ahead_s", 2.0, "m from ours"),
    ],
)
def test_who_does_not_follow_us_has_not_fused_us(
    attribute: str, value: object, reason: str
) -> None:
    flight = Flight()
    flight.fly(12.0)
    setattr(flight, attribute, value)
    # Not at once: one report is a hiccup.
    assert flight.fly(0.8) == [FusionState.FUSED]
    assert flight.fly(4.0)[-1] is FusionState.REJECTED
    assert reason in flight.reason


def test_a_height_that_counts_from_elsewhere_is_not_wrong_unless_it_goes_elsewhere() -> None:
    flight = Flight()
    flight.off = np.array([0.0, 0.0, -12.0])
    flight.sinks_m_s = 0.1
    assert flight.fly(12.0)[-1] is FusionState.FUSED
    assert flight.fly(30.0) == [FusionState.FUSED]
    flight.sinks_m_s = 2.0
    assert flight.fly(4.0)[-1] is FusionState.REJECTED


def test_a_jump_of_ours_in_height_that_a_barometer_does_not_follow_is_no_refusal() -> None:
    flight = Flight()
    flight.fly(12.0)
    flight.told_off, flight.n_resets = np.array([0.0, 0.0, 5.0]), 1
    assert flight.fly(10.0) == [FusionState.FUSED]


def test_who_tests_no_position_says_nothing_of_it() -> None:
    flight = Flight()
    flight.ratio = None
    assert flight.fly(10.0)[-1] is FusionState.FUSED


@pytest.mark.parametrize(
    ("firmware", "every_ms", "is_told"),
    [(Firmware.PX4, 200, True), (Firmware.PX4, 150, False), (Firmware.ARDUPILOT, 200, False)],
)
def test_poses_too_seldom_for_px4_to_begin_are_told(
    firmware: Firmware, every_ms: int, is_told: bool
) -> None:
    monitor = FusionMonitor()
    monitor.firmware = firmware
    for k in range(60):
        at_ns = S + k * every_ms * MS
        monitor.sent(at_ns, position_at(at_ns), SIGMA_M)
        monitor.reported(EstimatorStatus(1, 1, False, False, None), at_ns)
        reason = monitor.state(at_ns).reason
    assert "has no position" in reason
    assert ("ours come 5.0 times a second" in reason) is is_told


def test_an_estimator_that_never_takes_us_is_told_of_after_a_while() -> None:
    flight = Flight()
    flight.has_position = False
    assert flight.fly(9.0) == [FusionState.SENDING]
    assert flight.fly(4.0)[-1] is FusionState.REJECTED


def test_a_second_without_vision_is_harmless_and_two_are_told() -> None:
    flight = Flight()
    flight.fly(5.0)
    flight.sends = False
    assert flight.fly(1.0) == [FusionState.FUSED]
    flight.sends = True
    assert flight.fly(5.0) == [FusionState.FUSED]
    flight.sends = False
    assert flight.fly(4.0)[-1] is FusionState.LOST
    flight.sends = True
    assert flight.fly(1.0)[-1] is FusionState.FUSED


@pytest.mark.parametrize(("silent", "reason"), [("reports", "estimator"), ("tells", "where it is")])
def test_who_says_nothing_is_not_taken_for_following(silent: str, reason: str) -> None:
    flight = Flight()
    setattr(flight, silent, False)
    assert flight.fly(30.0)[-1] is FusionState.SENDING
    assert reason in flight.reason


@pytest.mark.parametrize("ahead_s", [-0.08, 0.0, 0.03, 0.15])
def test_how_late_it_takes_our_poses_to_be_is_measured(ahead_s: float) -> None:
    flight = Flight()
    flight.ahead_s = ahead_s
    assert flight.monitor.ahead_s is None
    flight.fly(30.0)
    assert flight.monitor.ahead_s is not None
    assert flight.monitor.ahead_s == pytest.approx(ahead_s, abs=0.003)


def test_who_hovers_tells_nothing_of_delay() -> None:
    monitor = FusionMonitor()
    for k in range(600):
        at_ns = S + k * 100 * MS
        monitor.sent(at_ns, np.zeros(3), SIGMA_M)
        monitor.reported(EstimatorStatus(1, 1, True, False, 0.1), at_ns)
        monitor.believes(at_ns, np.array([0.01, 0.0, 0.0]), np.array([0.01, 0.0, 0.0]))
        monitor.state(at_ns)
    assert monitor.ahead_s is None


def test_positions_that_overtake_each_other_are_left_out() -> None:
    flight = Flight()
    flight.fly(5.0)
    flight.monitor.believes(flight.now_ns - S, np.full(3, 100.0), np.zeros(3))
    assert flight.fly(2.0) == [FusionState.FUSED]
