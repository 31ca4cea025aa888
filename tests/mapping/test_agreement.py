"""Maps of a real flight beside each other: honest revisions agree, and bent ones do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.bent import bent
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.agreement import broken_descent, contradiction, moved_frame
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
    assert broken_descent(first(), revision()) == ""


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
    assert against_first(other) == ""
    assert broken_descent(first(), other) == "made from ours, it has 0 of its 2 keyframes"


def test_one_made_from_ours_that_keeps_little_of_it_is_none() -> None:
    """Whoever makes it names what is compared: a few honest ones would vouch for all others."""
    honest = revision()
    renamed = [
        k if i == 0 else replace(k, captured_at_ns=k.captured_at_ns + 1)
        for i, k in enumerate(honest.keyframes)
    ]
    pixels = np.tile(honest.observed_px, (1, 2, 1))
    several = replace(honest, keyframes=honest.keyframes * 2, observed_px=pixels)
    one_of_many = replace(honest, keyframes=tuple(renamed))
    reason = broken_descent(several, one_of_many)
    assert reason == f"made from ours, it has 1 of its {len(several.keyframes)} keyframes"
    pixels = honest.observed_px.copy()
    pixels[10:] += 1e-3  # all but a few are other landmarks now
    few = broken_descent(first(), replace(honest, observed_px=pixels))
    assert few.endswith("landmarks in its keyframes")


def test_a_frame_is_held_against_both_errors_and_never_far_off() -> None:
    map_, covariance = first(), 1e-4 * np.eye(6)
    known = map_.keyframes[0].world_from_body

    def off(metres: float) -> Pose:
        return Pose(known.rotation, known.translation + np.array([metres, 0.0, 0.0]))

    assert moved_frame(known, covariance, off(0.05), covariance, map_) == ""
    assert moved_frame(known, covariance, off(0.5), covariance, map_) == (
        "a frame of ours was taken 0.50 m off by it"
    )
    vague = 0.1**2 * np.eye(6)
    assert moved_frame(known, covariance, off(0.4), vague, map_) == ""
    assert moved_frame(known, 1e4 * np.eye(6), off(30.0), covariance, map_) != ""
    assert moved_frame(known, covariance, off(30.0), 1e4 * np.eye(6), map_) == ""
