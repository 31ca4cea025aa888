"""Carrying errors view by view is the dense product."""

from __future__ import annotations

import numpy as np

from vcl_companion.vision.schur import carried


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
