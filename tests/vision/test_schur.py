"""Eliminating landmarks view by view is the dense product."""

from __future__ import annotations

import numpy as np

from vcl_companion.vision.schur import carried, eliminated


def test_the_sum_over_seeing_views_is_the_dense_product() -> None:
    rng = np.random.default_rng(0)
    n, v = 40, 5
    seen = rng.random((n, v)) < 0.5
    cross = rng.standard_normal((n, v, 6, 3)) * seen[:, :, None, None]
    cross = cross.reshape(n, 6 * v, 3)
    half = rng.standard_normal((n, 3, 3))
    inverse = half @ np.swapaxes(half, 1, 2)
    dense = np.einsum("nij,njk,nlk->il", cross, inverse, cross)
    np.testing.assert_allclose(eliminated(cross, inverse, seen), dense, atol=1e-10)


def test_views_that_share_no_landmark_stay_apart() -> None:
    seen = np.array([[True, False], [False, True]])
    cross = np.ones((2, 12, 3))
    out = eliminated(cross, np.broadcast_to(np.eye(3), (2, 3, 3)).copy(), seen)
    np.testing.assert_array_equal(out[:6, 6:], 0.0)
    np.testing.assert_array_equal(out[:6, :6], 3.0)


def test_what_views_are_off_by_is_carried_to_the_landmarks_that_they_see() -> None:
    rng = np.random.default_rng(1)
    n, v = 40, 5
    seen = rng.random((n, v)) < 0.5
    seen[0] = False
    lever = rng.standard_normal((n, 3, v, 6)) * seen[:, None, :, None]
    single = lever.reshape(n, 3, 6 * v).astype(np.float32)
    half = rng.standard_normal((6 * v, 6 * v))
    covariance, rows = half @ half.T, np.array([3, 0, 3, 39])
    exact = single[rows].astype(np.float64)
    dense = exact @ covariance @ np.swapaxes(exact, 1, 2)
    np.testing.assert_allclose(carried(single, covariance, rows), dense, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(carried(single, covariance, rows)[1], 0.0)
