"""How much detail an image needs that a map is extended by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.localization.painted import MOUNTING, carried_on, found_in, painted_map
from tests.scenes import PINHOLE
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.localization.detail import needed_detail
from vcl_companion.localization.fix import Localized
from vcl_companion.mapping.landmark_map import LandmarkMap

NEAR = Pose(exp_so3(np.array([0.0, 0.0, -0.02])), np.array([-0.5, 0.3, -0.1]))


@pytest.fixture(scope="module")
def landmark_map() -> LandmarkMap:
    return painted_map(np.random.default_rng(3))


@pytest.fixture(scope="module")
def fix(landmark_map: LandmarkMap) -> Localized:
    return found_in(landmark_map, NEAR)


def test_what_is_not_recognised_is_all_of_use(landmark_map: LandmarkMap) -> None:
    assert needed_detail(None, landmark_map, PINHOLE, MOUNTING) == "all"


def test_near_by_and_while_the_first_views_are_in_sight_it_may_be_coarse(
    landmark_map: LandmarkMap, fix: Localized
) -> None:
    for one in (fix, replace(fix, novelty_deg=9.5)):
        assert needed_detail(one, landmark_map, PINHOLE, MOUNTING) == "coarse"
    for seen in (landmark_map, carried_on(landmark_map, 0.6)):
        assert needed_detail(fix, seen, PINHOLE, MOUNTING) == "coarse"
    assert needed_detail(fix, carried_on(landmark_map, 0.4), PINHOLE, MOUNTING) == "fine"


def test_from_far_apart_it_may_not(landmark_map: LandmarkMap, fix: Localized) -> None:
    for one in (replace(fix, novelty_deg=10.5), replace(fix, by="features", novelty_deg=0.0)):
        assert needed_detail(one, landmark_map, PINHOLE, MOUNTING) == "fine"
