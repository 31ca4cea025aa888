"""Eliminating landmarks view by view is the dense product."""

from __future__ import annotations

import numpy as np

from vcl_companion.vision.schur import eliminated


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
