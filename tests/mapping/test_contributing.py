"""Whose views an update asks for: of like ones two, and whoever may see something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.views import map_of
from tests.scenes import facade_scene
from vcl_companion.mapping.contributing import without_alike
from vcl_companion.mapping.landmark_map import LandmarkMap


@pytest.fixture
def alike() -> LandmarkMap:
    """Four keyframes that see the same: of drones 1, 2, 3 and again of 1."""
    made = map_of(facade_scene(np.random.default_rng(0), 200))
    one, two = made.keyframes
    keyframes = (
        one,
        replace(two, drone_id=2),
        replace(two, drone_id=3),
        replace(one, drone_id=1, captured_at_ns=one.captured_at_ns + 1),
    )
    observed = made.observed_px[:, [0, 1, 1, 0]]
    return replace(made, keyframes=keyframes, observed_px=observed, distances=())


def test_of_like_views_two_suffice_the_first_ones(alike: LandmarkMap) -> None:
    assert without_alike((1, 2, 3), alike, ()) == (1, 2)
    assert without_alike((3, 1, 2), alike, ()) == (3, 1)


def test_the_newest_is_the_last_one_whatever_a_restarted_clock_says(alike: LandmarkMap) -> None:
    *before, last = alike.keyframes
    restarted = replace(alike, keyframes=(*before, replace(last, captured_at_ns=0)))
    observed = restarted.observed_px.copy()
    observed[:, 3] = np.nan  # where drone 1 is now nobody else was
    assert without_alike((2, 3, 1), restarted, ()) == (2, 3)
    elsewhere = replace(restarted, observed_px=observed)
    assert without_alike((2, 3, 1), elsewhere, ()) == (2, 3, 1)


def test_who_is_needed_or_was_never_in_the_map_is_not_left_out(alike: LandmarkMap) -> None:
    assert without_alike((1, 2, 3), alike, (3,)) == (1, 2, 3)
    assert without_alike((1, 2, 4, 5, 3), alike, ()) == (1, 2, 4, 5)
    # Nobody knows what it sees now: it is none of the two.
    assert without_alike((1, 3, 2), alike, (3,)) == (1, 3, 2)


def test_who_sees_something_else_is_not_left_out(alike: LandmarkMap) -> None:
    observed = alike.observed_px.copy()
    shown = np.flatnonzero(alike.seen[:, 2])
    elsewhere = shown[: round(0.6 * len(shown))]
    observed[elsewhere, :2] = np.nan
    observed[elsewhere, 3] = np.nan
    observed[elsewhere, 0] = alike.observed_px[elsewhere, 0]  # an older keyframe of drone 1
    both = [k for k in range(len(observed)) if np.isfinite(observed[k, :, 0]).sum() >= 2]
    apart = replace(
        alike, points_world=alike.points_world[both], observed_px=observed[both], distances=()
    )
    assert without_alike((1, 2, 3), apart, ()) == (1, 2, 3)
