"""Kernels that take less memory than numba gives them."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numba
import numpy as np

from vcl_companion.compiled import pack_kernels
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.joint_kernels import seen_aside


def angles_deg(points: Array, centres: Array) -> Array:
    """Call a kernel."""
    first, view = np.array([0, 2]), np.array([0, 1])
    return np.asarray(np.rad2deg(seen_aside(points, centres, first, view)[0]))


def test_packed_kernels_work_and_others_are_linked_with_them() -> None:
    points, centres = np.array([[0.0, 0.0, 1.0]]), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    first, view = np.array([0, 2]), np.array([0, 1])
    before, moved = seen_aside(points, centres, first, view)
    pack_kernels()
    again, moved_again = seen_aside(points, centres, first, view)
    np.testing.assert_array_equal(again, before)
    np.testing.assert_array_equal(moved_again, moved)
    # Kept nowhere: it is compiled, and linked, here.
    caller = cast("Callable[[Array, Array], Array]", numba.njit(angles_deg))
    np.testing.assert_allclose(caller(points, centres), [45.0, 45.0])
    pack_kernels()
