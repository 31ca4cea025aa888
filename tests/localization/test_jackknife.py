import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.checks import nees
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.jackknife import jackknife, no_less_than

N = 240
SIGMA = 0.01


def measured(rng: np.random.Generator, grouped: bool) -> tuple[Array, Array, Array]:
    """Return places in an image, slopes by the pose, and errors of measurements there.

    Grouped errors are the same for all who lie in one corner of the image.
    """
    places = rng.uniform(0.0, 1.0, (N, 2))
    slopes = 0.3 * rng.standard_normal((N, 6))
    slopes[:, :3] += np.column_stack([np.ones(N), places])
    own = rng.standard_normal(N)
    if grouped:
        own[(places < 0.35).all(axis=1)] += 3.0 * rng.standard_normal()
    return places, slopes, SIGMA * own


def fitted(slopes: Array, errors: Array, kept: NDArray[np.bool_]) -> Array:
    return np.asarray(np.linalg.lstsq(slopes[kept], errors[kept], rcond=None)[0])


@pytest.mark.parametrize("grouped", [False, True])
def test_errors_of_a_pose_are_covered_also_where_neighbours_share_theirs(grouped: bool) -> None:
    rng = np.random.default_rng(5)
    everyone = np.ones(N, dtype=np.bool_)
    told, by_slopes, errors = [], [], []
    for _ in range(60):
        places, slopes, noise = measured(rng, grouped)
        off = fitted(slopes, noise, everyone)
        pose = Pose.identity().retracted(off)
        by_slopes.append(noise.var() * np.linalg.inv(slopes.T @ slopes))
        spread = jackknife(
            pose, places, everyone,
            lambda kept, slopes=slopes, noise=noise:  # type: ignore[misc]
                Pose.identity().retracted(fitted(slopes, noise, kept)),
        )  # fmt: skip
        told.append(no_less_than(by_slopes[-1], spread))
        errors.append(off)
    values = nees(errors, np.array(told))
    assert 3.0 < np.mean(values) < 7.0
    if grouped:
        assert np.mean(nees(errors, np.array(by_slopes))) > 20.0


def test_parts_without_which_there_is_no_pose_are_left_out() -> None:
    places = np.random.default_rng(0).uniform(0.0, 1.0, (30, 2))
    assert not jackknife(Pose.identity(), places, np.ones(30, np.bool_), lambda _: None).any()


def test_each_part_has_as_many_of_those_that_count() -> None:
    rng = np.random.default_rng(1)
    places, used = rng.uniform(0.0, 1.0, (300, 2)) ** 4, rng.random(300) < 0.5
    left_out = []

    def without(kept: NDArray[np.bool_]) -> Pose:
        left_out.append(int((used & ~kept).sum()))
        return Pose.identity()

    jackknife(Pose.identity(), places, used, without)
    assert len(left_out) == 6
    assert max(left_out) - min(left_out) <= 1


@given(seed=st.integers(0, 2**32 - 1))
def test_no_less_than_is_no_less_than_either(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (root @ root.T for root in rng.standard_normal((2, 6, 6)))
    a += 0.1 * np.eye(6)
    b = b if rng.random() < 0.5 else b * 0.0
    both = no_less_than(a, b)
    assert np.linalg.eigvalsh(both - a)[0] > -1e-9
    assert np.linalg.eigvalsh(both - b)[0] > -1e-9
    np.testing.assert_allclose(no_less_than(a, 0.0 * b), a, rtol=1e-9, atol=1e-12)
