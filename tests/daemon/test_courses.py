"""Where a drone will be that flies on, and that turns on as well."""

from __future__ import annotations

import numpy as np
import pytest

from vcl_companion.daemon.estimator import Estimator
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, log_so3
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions

SURE = np.diag([0.002] * 3 + [0.0005] * 3) ** 2
FLIES_M_S = 1.5


def flown(turns_deg_s: float, for_s: float, per_s: int = 10) -> Estimator:
    """A drone that has flown north, and turned to the right, for so long."""
    estimator = Estimator(FilterOptions(), LocalizationOptions(), lambda _: None)
    for k in range(round(for_s * per_s) + 1):
        at_ns, at_s = round(k * 1e9 / per_s), k / per_s
        turned = exp_so3(np.array([0.0, 0.0, np.deg2rad(turns_deg_s * at_s)]))
        pose = Pose(turned, np.array([FLIES_M_S * at_s, 0.0, 0.0]))
        fix = Localized(
            pose, SURE, 1e-8 * np.eye(6), np.zeros((6, 0)), np.zeros((0, 0)), 50, 50, False, 0.5
        )
        estimator.take_fix(estimator.predicted(at_ns, turned), fix, at_ns, turned)
    return estimator


def heading_deg(pose: Pose | None) -> float:
    assert pose is not None
    return float(np.rad2deg(log_so3(pose.rotation)[2]))


@pytest.mark.parametrize("turns_deg_s", [0.0, 20.0, -20.0])
def test_who_flies_and_turns_on(turns_deg_s: float) -> None:
    estimator, now_s, ahead_s = flown(turns_deg_s, 2.0), 2.0, 1.5
    straight, turning = estimator.course(ahead_s), estimator.turning_course(ahead_s)
    assert straight is not None
    assert turning is not None
    for there in (straight, turning):
        assert there.translation[0] == pytest.approx(FLIES_M_S * (now_s + ahead_s), abs=0.1)
    assert heading_deg(straight) == pytest.approx(turns_deg_s * now_s, abs=0.5)
    assert heading_deg(turning) == pytest.approx(turns_deg_s * (now_s + ahead_s), abs=1.0)


def test_who_turns_fast_is_not_expected_to_turn_for_ever() -> None:
    estimator = flown(60.0, 1.0)
    assert heading_deg(estimator.turning_course(3.0)) == pytest.approx(120.0, abs=1.0)


def test_without_a_past_nobody_turns() -> None:
    assert flown(20.0, 0.1).turning_course(1.0) is None
    assert Estimator(FilterOptions(), LocalizationOptions(), lambda _: None).course(1.0) is None
