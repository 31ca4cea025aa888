"""A map is checked once, when it is made, and cannot be changed afterwards."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.mapping.views import map_of
from tests.scenes import facade_scene
from vcl_companion.mapping.landmark_map import KnownDistance, LandmarkMap


@pytest.fixture
def small() -> LandmarkMap:
    return map_of(facade_scene(np.random.default_rng(0), 20, missed=0.1))


def test_arrays_are_copied_and_read_only(small: LandmarkMap) -> None:
    points = small.points_world.copy()
    made = replace(small, points_world=points)
    points[0] = 99.0
    assert made.points_world[0, 0] != 99.0
    for array in (made.points_world, made.observed_px):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


def test_seen_tells_which_keyframe_saw_what() -> None:
    scene = facade_scene(np.random.default_rng(0), 40, missed=0.3)
    placed = scene.seen.sum(axis=1) >= 2
    np.testing.assert_array_equal(map_of(scene).seen, scene.seen[placed])


def test_a_malformed_map_is_refused(small: LandmarkMap) -> None:
    n = len(small.points_world)
    infinite = small.points_world.copy()
    infinite[3, 1] = np.inf
    cases: dict[str, dict[str, Any]] = {
        rf"points_world has shape \({n}, 2\)": {"points_world": np.zeros((n, 2))},
        r"observed_px has shape \(5, 2, 2\)": {"observed_px": np.zeros((5, 2, 2))},
        rf"observed_px has shape \({n}, 3, 2\)": {"observed_px": np.zeros((n, 3, 2))},
        "points_world must be finite": {"points_world": infinite},
        "pixel_noise_px must be positive: 0": {"pixel_noise_px": 0.0},
        "pixel_noise_px must be positive: nan": {"pixel_noise_px": float("nan")},
        "pixel_noise_px must be positive: inf": {"pixel_noise_px": float("inf")},
        "names no keyframe": {"distances": (KnownDistance(0, 2, 1.0, 0.1),)},
        "names no keyframe.*-1": {"distances": (KnownDistance(-1, 0, 1.0, 0.1),)},
    }
    for reason, changes in cases.items():
        with pytest.raises(ValueError, match=reason):
            replace(small, **changes)
