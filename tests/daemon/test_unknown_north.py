"""A drone whose autopilot takes its heading from us says how it turns, not where it looks."""

from __future__ import annotations

import numpy as np
import pytest

from tests.daemon import demo
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import (
    about_down,
    exp_so3,
    heading_of,
    matrix_from_euler,
    matrix_from_quaternion,
)
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.proposals import NotFused

SURE = np.diag([0.02] * 3 + [0.002] * 3) ** 2
BODY = matrix_from_euler(0.05, -0.04, 0.3)
NORTH_RAD = 2.1


def estimator(*, has_heading: bool) -> Estimator:
    return Estimator(
        FilterOptions(), LocalizationOptions(), lambda _: None, has_heading=lambda: has_heading
    )


def fix() -> Localized:
    return Localized(
        Pose(BODY, np.zeros(3)), SURE, 1e-6 * np.eye(6), np.zeros((6, 0)), np.zeros((0, 0)),
        50, 50, False, 0.5,
    )  # fmt: skip


@pytest.mark.parametrize("has_heading", [True, False])
def test_peers_are_told_attitudes_by_the_map_s_north_once_it_is_known(has_heading: bool) -> None:
    mine = estimator(has_heading=has_heading)
    said = about_down(NORTH_RAD) @ BODY
    told, tells = mine.for_peers(0, said)
    assert told is not None
    np.testing.assert_allclose(matrix_from_quaternion(told), said, atol=1e-9)
    assert tells is has_heading
    assert isinstance(mine.take_fix(None, fix(), 0, said), FilterState)
    later = said @ exp_so3(np.array([0.02, 0.1, 0.4]))
    told, tells = mine.for_peers(50_000_000, later)
    assert told is not None
    assert tells
    expected = BODY @ exp_so3(np.array([0.02, 0.1, 0.4]))
    np.testing.assert_allclose(matrix_from_quaternion(told), expected, atol=1e-6)
    mine.forget()
    assert mine.for_peers(60_000_000, later)[1] is has_heading
    assert mine.for_peers(60_000_000, None) == (None, True)


def test_a_peer_s_word_is_not_judged_by_a_heading_that_is_none() -> None:
    said = about_down(NORTH_RAD) @ BODY
    for has_heading in (True, False):
        mine = estimator(has_heading=has_heading)
        taken = mine.take_proposal(
            0, said, Pose(BODY, np.zeros(3)), SURE, demo.map_index(1, 2).landmark_map.points_world
        )
        if has_heading:
            assert isinstance(taken, NotFused)
            assert "heading" in taken.reason
        else:
            assert isinstance(taken, FilterState)
            assert heading_of(taken.world_from_ned.T) == pytest.approx(NORTH_RAD, abs=1e-6)
        tilted = Pose(BODY @ exp_so3(np.array([0.4, 0.0, 0.0])), np.zeros(3))
        refused = estimator(has_heading=has_heading).take_proposal(
            0, said, tilted, SURE, demo.map_index(1, 2).landmark_map.points_world
        )
        assert isinstance(refused, NotFused)
        assert "roll and pitch" in refused.reason


def test_fixes_that_all_come_late_are_believed_at_last_when_they_contradict() -> None:
    """Where every frame has to be searched for, newer ones are looked at meanwhile."""
    mine = estimator(has_heading=False)
    said = about_down(NORTH_RAD) @ BODY
    assert isinstance(mine.take_fix(None, fix(), 0, said), FilterState)
    # A turn of the autopilot's north that was taken for the drone's.
    wrong = about_down(NORTH_RAD + 0.15) @ BODY
    taken = []
    for k in range(1, 6):
        at_ns = k * 100_000_000
        for ns in (at_ns, at_ns + 33_000_000):
            mine.take_nothing(mine.predicted(ns, wrong), ns, wrong)
        taken.append(mine.take_fix(None, fix(), at_ns, wrong))
    assert all(isinstance(one, NotLocalized) and "turned" in one.reason for one in taken[:4])
    assert isinstance(taken[4], FilterState)
    assert mine.n_resets == 1
    # What has come since leads on from there.
    newest = mine._history.newest
    assert newest is not None
    assert newest.at_ns == 533_000_000
    goes_on = mine.predicted(600_000_000, wrong)
    assert goes_on is not None
    np.testing.assert_allclose(goes_on.world_from_body.rotation, BODY, atol=1e-6)
