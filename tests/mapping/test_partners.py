"""Whom a new view is matched with: who shows what is new in it, not who knows most landmarks."""

from __future__ import annotations

import numpy as np
import pytest

from tests.mapping.rendered import CAMERA
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_euler
from vcl_companion.mapping.new_landmarks import Shown, shown
from vcl_companion.mapping.partners import partners
from vcl_companion.vision.features import Features

HERE = Pose(np.eye(3), np.array([0.0, 0.0, 20.0]))
TURNED = np.diag([-1.0, 1.0, -1.0])


def street(rng: np.random.Generator, n: int) -> tuple[Shown, Array, Array]:
    """Return features of a view along a street, and landmarks between them: pixels and points."""
    points = np.column_stack(
        [rng.choice([-4.0, 4.0], n), rng.uniform(-3.0, 3.0, n), rng.uniform(28.0, 60.0, n)]
    )
    pixels = CAMERA.project(HERE.inverse().apply(points))
    inside = CAMERA.shows(pixels, 0.0)
    pixels, points = pixels[inside], points[inside]
    free = np.arange(len(pixels)) % 5 > 0
    features = Features(pixels[free], np.zeros((int(free.sum()), 61), np.uint8))
    return shown(features, CAMERA), pixels[~free], points[~free]


def chosen(keyframes: list[Pose], n: int = 3) -> list[int]:
    view, known_px, known = street(np.random.default_rng(1), 400)
    assert len(view.features) > 100
    return partners(view, known_px, known, HERE, keyframes, [CAMERA] * len(keyframes), n)


def back(metres: float, aside: float = 0.0) -> Pose:
    return Pose(np.eye(3), np.array([aside, 0.0, 20.0 - metres]))


def test_in_flight_along_a_street_the_oldest_come_last() -> None:
    ages = [back(metres) for metres in (20.0, 16.0, 12.0, 8.0, 4.0)]
    assert chosen(ages, 1) == [3]
    assert 4 in chosen(ages)
    assert 0 not in chosen(ages)
    assert len(chosen(ages, 9)) == 5


def test_who_shows_the_same_from_next_to_another_comes_after_who_shows_the_rest() -> None:
    left = Pose(matrix_from_euler(0.0, np.deg2rad(-40.0), 0.0), np.array([1.0, 0.0, 18.0]))
    right = Pose(matrix_from_euler(0.0, np.deg2rad(40.0), 0.0), np.array([1.0, 0.0, 18.0]))
    beside = Pose(left.rotation, np.array([1.05, 0.0, 18.0]))
    assert set(chosen([left, beside, right], 2)) in ({0, 2}, {1, 2})


def test_who_stood_here_shows_no_depth_and_who_stood_aside_does() -> None:
    assert chosen([back(0.001), back(0.0, 1.0)], 1) == [1]


def test_who_looks_elsewhere_shows_nothing_of_it() -> None:
    assert chosen([Pose(TURNED, back(4.0).translation), back(4.0)]) == [1]
    assert chosen([Pose(TURNED, back(4.0).translation)]) == []


@pytest.mark.parametrize("what", ["features", "landmarks"])
def test_without_features_or_landmarks_there_is_nobody(what: str) -> None:
    view, known_px, known = street(np.random.default_rng(1), 400)
    if what == "features":
        view = Shown(view.features.subset(np.zeros(0, np.intp)), view.ideal[:0])
    else:
        known_px, known = known_px[:0], known[:0]
    assert partners(view, known_px, known, HERE, [back(4.0)], [CAMERA], 3) == []
