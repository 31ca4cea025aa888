"""A covariance in one number."""

from __future__ import annotations

import numpy as np
import pytest

from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.geometry.worst_sigma import worst_sigma


def test_it_is_that_of_the_longest_axis_however_that_lies() -> None:
    turned = exp_so3(np.array([0.4, -0.9, 0.3]))
    covariance = turned @ np.diag([0.04, 0.25, 0.01]) @ turned.T
    assert worst_sigma(covariance) == pytest.approx(0.5)
    assert worst_sigma(covariance) > np.sqrt(np.diag(covariance)).max()


def test_what_is_known_exactly_is_0_whatever_rounding_says() -> None:
    assert worst_sigma(np.zeros((3, 3))) == 0.0
    assert worst_sigma(-1e-20 * np.eye(3)) == 0.0
