"""The stand-in's estimator does with our poses what ArduPilot's was seen to do."""

import numpy as np
import pytest

from sitl.autopilots.fusing import FUSED_FLAGS, UNFUSED_FLAGS, Fusing, VisionPose
from vcl_companion.geometry.rotation import Array

S = 1_000_000_000
PERIOD = S // 10


def pose(at_ns: int, position: Array, resets: int = 1, variance: float = 4e-4) -> VisionPose:
    upper = np.zeros(21)
    upper[[0, 6, 11]] = variance / 3.0
    upper[[15, 18, 20]] = 1e-4
    return VisionPose(at_ns, position, upper.tolist(), resets)


def flown(fusing: Fusing, begin_s: float, seconds: float, off: Array, resets: int = 1) -> float:
    """Fly 1 m/s north; return how far it is from what it was told at the end, m."""
    told = np.zeros(3)
    at_ns = 0
    for k in range(round(begin_s * 10), round((begin_s + seconds) * 10)):
        at_ns = S + k * PERIOD
        told = np.array([0.1 * k, 0.0, -2.0]) + off
        fusing.take(pose(at_ns, told, resets))
    believed = fusing.at(at_ns)
    assert believed is not None
    return float(np.linalg.norm(believed[0] - told))


def test_it_follows_and_says_so() -> None:
    fusing = Fusing()
    assert fusing.flags(0) == UNFUSED_FLAGS
    assert fusing.at(0) is None
    assert flown(fusing, 0.0, 5.0, np.zeros(3)) < 0.02
    assert fusing.flags(6 * S) == FUSED_FLAGS
    assert 0.0 <= fusing.test_ratio < 1.0


def test_a_first_pose_that_counts_no_reset_is_a_step_from_the_origin() -> None:
    for resets, speed_m_s in ((0, 75.6), (1, 0.0)):
        fusing = Fusing()
        fusing.take(pose(S, np.array([0.0, 2.7, 0.0]), resets))
        believed = fusing.at(S)
        assert believed is not None
        assert np.linalg.norm(believed[1]) == pytest.approx(speed_m_s)


def test_a_jump_is_followed_at_once_with_a_reset_and_later_without() -> None:
    for resets, far_for_s in ((2, 0.0), (1, 0.3)):
        fusing = Fusing()
        flown(fusing, 0.0, 5.0, np.zeros(3))
        jump = np.array([0.0, 5.0, 0.0])
        if far_for_s:
            assert flown(fusing, 5.0, far_for_s, jump, resets) > 3.0
            assert fusing.test_ratio > 1.0
        assert flown(fusing, 5.0 + far_for_s, 5.0 if far_for_s else 0.1, jump, resets) < 0.05


def test_its_position_is_forgotten_seven_seconds_after_the_last_pose() -> None:
    fusing = Fusing()
    flown(fusing, 0.0, 5.0, np.zeros(3))
    last_ns = S + 49 * PERIOD
    assert fusing.flags(last_ns + 6 * S) == FUSED_FLAGS
    assert fusing.flags(last_ns + 8 * S) == UNFUSED_FLAGS


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1.0])
def test_a_covariance_that_is_none_is_its_own_error(bad: float) -> None:
    fusing = Fusing()
    broken = pose(S, np.zeros(3))
    upper = list(broken.upper)
    upper[11] = bad
    fusing.take(VisionPose(S, np.zeros(3), upper, 1))
    assert fusing.internal_error
    assert fusing.at(S) is None
    fusing = Fusing()
    fusing.take(VisionPose(S, np.zeros(3), [float("nan")] * 21, 1))  # none at all is none
    assert not fusing.internal_error
    assert fusing.at(S) is not None
