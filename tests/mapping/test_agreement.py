"""Maps of a real flight beside each other: honest revisions agree, and bent ones do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.bent import bent
from vcl_companion.mapping.agreement import contradiction, have_common_keyframes
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.wire.map_codec import decode_map


def first() -> LandmarkMap:
    return decode_map(demo.encoded_map(1, 2))


def revision() -> LandmarkMap:
    return decode_map(demo.encoded_update())


def against_first(other: LandmarkMap) -> str:
    return contradiction(first(), map_uncertainty(first()), other)


def test_honest_maps_of_the_same_drones_agree_whichever_came_first() -> None:
    maps = [first(), decode_map(demo.encoded_map(1, 2, 3)), revision()]
    for old in maps:
        for new in maps:
            assert contradiction(old, map_uncertainty(old), new) == ""
            assert have_common_keyframes(old, new)


@pytest.mark.parametrize("scale", [0.8, 0.95, 1.05, 1.2])
def test_another_scale_is_seen(scale: float) -> None:
    assert "known keyframes moved by" in against_first(bent(revision(), scale=scale))


def test_another_frame_is_seen() -> None:
    shifted = against_first(bent(revision(), shift_m=(3.0, 0.0, 0.0)))
    assert shifted == "2 of 2 known keyframes moved by 3.00 m"
    assert "known keyframes moved" in against_first(bent(revision(), shift_m=(0.0, 0.0, 0.2)))


def test_landmarks_that_moved_alone_are_seen() -> None:
    honest = revision()
    moved = replace(honest, points_world=honest.points_world + np.array([0.5, 0.0, 0.0]))
    assert "known landmarks moved by 0." in against_first(moved)


def test_a_few_that_moved_are_the_other_maps_right() -> None:
    """It has seen more of them; an honest update corrects what was wrong."""
    honest = revision()
    points = honest.points_world.copy()
    points[::10] += np.array([0.0, 0.0, 2.0])
    assert against_first(replace(honest, points_world=points)) == ""


def test_a_known_distance_that_is_another_is_seen() -> None:
    honest = revision()
    (distance,) = honest.distances
    longer = replace(distance, distance_m=1.2 * distance.distance_m, sigma_m=10.0)
    assert against_first(replace(honest, distances=(longer,))) == (
        "a distance of 2.55 m is 3.06 m there"
    )


def test_what_has_nothing_in_common_is_not_compared() -> None:
    other = first()
    keyframes = tuple(replace(k, captured_at_ns=k.captured_at_ns + 1) for k in other.keyframes)
    other = bent(replace(other, keyframes=keyframes), scale=2.0)
    assert not have_common_keyframes(first(), other)
    assert against_first(other) == ""
