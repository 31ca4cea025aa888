"""Landmarks that decide the poses all by themselves are told apart from those that help."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.views import map_of
from tests.scenes import facade_scene, observe
from vcl_companion.mapping.culling import of_landmarks
from vcl_companion.mapping.leverage import leverages
from vcl_companion.mapping.uncertainty import views_of


def test_landmarks_alike_share_the_decision() -> None:
    scene = facade_scene(np.random.default_rng(1), 300, relief_m=4.0, n_views=3)
    shares = leverages(views_of(map_of(scene)))
    assert shares.max() < 0.2
    assert shares.min() >= 0.0


def test_a_landmark_close_to_the_cameras_decides() -> None:
    rng = np.random.default_rng(2)
    scene = facade_scene(rng, 150)
    near = np.array([[1.5, 0.7, 0.2]])
    points = np.vstack([scene.points_world, near])
    scene = observe(rng, points, scene.bodies, scene.mountings, scene.camera)
    assert scene.seen[-1].all()
    shares = leverages(views_of(map_of(scene)))
    assert shares[-1] > 0.5
    assert np.delete(shares, -1).max() < 0.25


def test_shares_of_two_views_add_up_to_what_they_determine() -> None:
    """Two views fix five numbers, and each landmark has one equation: trace of the projector."""
    scene = facade_scene(np.random.default_rng(3), 60)
    assert abs(float(leverages(views_of(map_of(scene))).sum()) - 5.0) < 0.05


def test_too_few_landmarks_decide_everything() -> None:
    views = views_of(map_of(facade_scene(np.random.default_rng(4), 30)))
    seen = np.flatnonzero(np.isfinite(views.ideal[..., 0]).all(axis=1))[:3]
    few = of_landmarks(views, np.isin(np.arange(len(views.points)), seen))
    np.testing.assert_array_equal(leverages(few), 1.0)


@pytest.mark.parametrize("n_seen", [0, 1, 2])
def test_a_view_that_sees_hardly_any_takes_nobody_with_it(n_seen: int) -> None:
    scene = facade_scene(np.random.default_rng(5), 150, relief_m=4.0, n_views=3)
    views = views_of(map_of(scene))
    ideal = views.ideal.copy()
    ideal[n_seen:, 2] = np.nan
    enough = np.isfinite(ideal[..., 0]).sum(axis=1) >= 2
    weak = replace(
        views, ideal=ideal[enough], points=views.points[enough], slopes=views.slopes[enough]
    )
    shares = leverages(weak)
    assert shares.max() < 0.25
    assert np.median(shares) > 0.0
