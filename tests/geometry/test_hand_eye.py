"""Axes are found from turns, exactly without noise and in spite of outliers."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.geometry.hand_eye import fit_axes, turned_about
from vcl_companion.geometry.rotation import exp_so3, log_so3

SIGMA_RAD = np.deg2rad(0.1)


@given(st.integers(0, 2**32 - 1))
def test_without_noise_axes_are_exact(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = exp_so3(rng.normal(0.0, 1.5, 3))
    turns = rng.normal(0.0, 0.1, (30, 3))
    fit = fit_axes(turns, turns @ truth.T)
    np.testing.assert_allclose(fit.rotation, truth, atol=1e-9)
    assert fit.misfit < 1e-9


def test_a_fifth_of_outliers_does_not_turn_them() -> None:
    rng = np.random.default_rng(5)
    off_deg = []
    for _ in range(50):
        truth = exp_so3(rng.normal(0.0, 1.5, 3))
        turns = rng.normal(0.0, 0.1, (60, 3))
        said = turns @ truth.T + rng.normal(0.0, SIGMA_RAD, (60, 3))
        said[:12] = rng.normal(0.0, 0.3, (12, 3))
        fit = fit_axes(turns, said)
        off_deg.append(np.rad2deg(np.linalg.norm(log_so3(fit.rotation.T @ truth))))
    # A tenth of a degree in turns of ten, over 48 of them.
    assert 0.05 < np.median(off_deg) < 0.5
    assert max(off_deg) < 1.5


def test_mirrored_turns_leave_a_misfit() -> None:
    turns = np.random.default_rng(6).normal(0.0, 0.1, (60, 3))
    assert fit_axes(turns, turns * (1.0, -1.0, 1.0)).misfit > 0.4


def test_how_far_was_turned_about_each_axis() -> None:
    axes = exp_so3(np.array([0.3, -0.8, 0.5]))
    turns = np.array([[0.2, 0, 0], [-0.2, 0, 0], [0, 0.1, 0], [0, -0.05, 0]]) @ axes.T
    np.testing.assert_allclose(turned_about(turns), [0.4, 0.15, 0.0], atol=1e-12)
