"""What a map shows from a pose, by its geometry alone."""

from __future__ import annotations

import numpy as np
import pytest

from tests.localization.painted import BODIES, MOUNTING, carried_on, found_in, painted_map
from tests.scenes import PINHOLE
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.localization.outlook import held_share, novelty_from, share_left
from vcl_companion.mapping.landmark_map import LandmarkMap

# Back, aside and turned.
THERE = Pose(exp_so3(np.array([0.03, 0.02, -0.05])), np.array([-2.5, 0.8, -0.4]))
AWAY = Pose(exp_so3(np.array([0.0, 0.0, np.pi])), np.zeros(3))


@pytest.fixture(scope="module")
def landmark_map() -> LandmarkMap:
    return painted_map(np.random.default_rng(3))


def test_how_new_a_map_looks_is_known_before_one_is_there(landmark_map: LandmarkMap) -> None:
    def novelty(body: Pose) -> float | None:
        return novelty_from(landmark_map, body @ MOUNTING, PINHOLE)

    assert novelty(BODIES[0]) == pytest.approx(0.0, abs=0.01)
    there = novelty(THERE)
    seen = found_in(landmark_map, THERE)
    assert there is not None
    assert seen.novelty_deg > 2.0
    assert there == pytest.approx(seen.novelty_deg, rel=0.25)
    assert novelty(AWAY) is None


def test_of_all_keyframes_the_one_that_saw_it_most_alike_counts(landmark_map: LandmarkMap) -> None:
    """A pose between the second and the third is no farther than either is."""
    for body in BODIES[1:]:
        novelty = novelty_from(landmark_map, body @ MOUNTING, PINHOLE)
        assert novelty is not None
        assert novelty < 1.0


def test_a_pose_that_is_nonsense_tells_nothing(landmark_map: LandmarkMap) -> None:
    for far_m in (1e6, 1e200):
        nowhere = Pose(np.eye(3), np.full(3, far_m)) @ MOUNTING
        assert novelty_from(landmark_map, nowhere, PINHOLE) is None
        assert held_share(landmark_map, nowhere, PINHOLE) == 0.0


def test_held_is_what_is_in_view_only(landmark_map: LandmarkMap) -> None:
    some = carried_on(landmark_map, 0.4)
    assert held_share(some, THERE @ MOUNTING, PINHOLE) == pytest.approx(0.4, abs=0.05)
    assert held_share(some, AWAY @ MOUNTING, PINHOLE) == 0.0


def test_what_is_left_in_view_of_who_turns_away(landmark_map: LandmarkMap) -> None:
    here = BODIES[0] @ MOUNTING

    def left(turned_deg: float) -> float | None:
        turned = Pose(exp_so3(np.array([0.0, 0.0, np.deg2rad(turned_deg)])), np.zeros(3))
        return share_left(landmark_map, here, BODIES[0] @ turned @ MOUNTING, PINHOLE)

    shares = [left(turned_deg) for turned_deg in (0.0, 20.0, 40.0, 180.0)]
    assert shares[0] == 1.0
    assert shares[3] == 0.0
    assert shares[1] is not None
    assert shares[2] is not None
    assert 0.1 < shares[2] < shares[1] < 0.9
    assert share_left(landmark_map, AWAY @ MOUNTING, here, PINHOLE) is None
