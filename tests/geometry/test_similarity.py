"""Similarities: named like poses, found from points, perturbed as their covariance says."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.checks import assert_pose_close
from tests.scenes import random_rotation
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.similarity import Similarity

seeds = st.integers(0, 2**32 - 1)


def random_similarity(rng: np.random.Generator) -> Similarity:
    scale = float(np.exp(rng.uniform(-1.0, 1.0)))
    return Similarity(random_rotation(rng), 10.0 * rng.standard_normal(3), scale)


def assert_same(found: Similarity, wanted: Similarity, within: float = 1e-9) -> None:
    np.testing.assert_allclose(wanted.difference(found), np.zeros(7), atol=within)


@given(seeds)
def test_composition_names_cancel(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a_from_b, b_from_c = random_similarity(rng), random_similarity(rng)
    points = rng.standard_normal((4, 2, 3))
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).apply(points), a_from_b.apply(b_from_c.apply(points)), atol=1e-9
    )
    assert_same(a_from_b.inverse() @ a_from_b, Similarity.identity())
    assert_same(a_from_b @ a_from_b.inverse(), Similarity.identity())


@given(seeds)
def test_a_pose_is_taken_along_with_what_it_sees(seed: int) -> None:
    """A camera's bearing of a point is the same before and after; its range is scaled."""
    rng = np.random.default_rng(seed)
    a_from_b = random_similarity(rng)
    b_from_c = Pose(random_rotation(rng), rng.standard_normal(3))
    point = 5.0 * rng.standard_normal(3)
    seen = a_from_b.of_pose(b_from_c).inverse().apply(a_from_b.apply(point))
    np.testing.assert_allclose(seen, a_from_b.scale * b_from_c.inverse().apply(point), atol=1e-9)
    same = Similarity.identity().of_pose(b_from_c)
    assert_pose_close(same, b_from_c, within_m=1e-12, within_rad=1e-7)


@given(seeds)
def test_difference_undoes_moved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = random_similarity(rng)
    delta = 0.3 * rng.standard_normal(7)
    np.testing.assert_allclose(start.difference(start.moved(delta)), delta, atol=1e-8)


@given(seeds, st.integers(3, 20))
def test_points_tell_it_exactly(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    truth = random_similarity(rng)
    points = rng.standard_normal((n, 3))
    found = Similarity.of_points(points, truth.apply(points), rng.uniform(0.1, 1.0, n))
    assert found is not None
    assert_same(found, truth, 1e-6)


def test_what_weighs_nothing_has_no_say() -> None:
    rng = np.random.default_rng(1)
    truth = random_similarity(rng)
    points = rng.standard_normal((10, 3))
    there = truth.apply(points)
    there[0] += 100.0
    found = Similarity.of_points(points, there, np.array([0.0] + [1.0] * 9))
    assert found is not None
    assert_same(found, truth, 1e-6)
    pulled = Similarity.of_points(points, there)
    assert pulled is not None
    assert np.abs(truth.difference(pulled)).max() > 0.1


def test_points_in_a_line_tell_none() -> None:
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert Similarity.of_points(line, line) is None
    assert Similarity.of_points(np.zeros((4, 3)), np.zeros((4, 3))) is None


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_is_none_is_refused(scale: float) -> None:
    with pytest.raises(ValueError, match="scale must be positive"):
        Similarity(np.eye(3), np.zeros(3), scale)


def test_what_is_not_finite_or_of_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="rotation"):
        Similarity(np.full((3, 3), np.nan), np.zeros(3))
    with pytest.raises(ValueError, match="translation"):
        Similarity(np.eye(3), np.zeros(2))
    with pytest.raises(ValueError, match="read-only"):
        Similarity.identity().translation[0] = 1.0
