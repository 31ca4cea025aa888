"""Poses of a drone's last views together: what they share, and what each is off by itself."""

from __future__ import annotations

import numpy as np
import pytest

from tests.checks import assert_pose_close
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.pose_window import PoseWindow
from vcl_companion.mapping.view_adjustment import Placement

N_MAP, N_DRAWN = 12, 200_000
RNG = np.random.default_rng(8)
LEVERS = {name: 0.4 * RNG.standard_normal((6, N_MAP)) for name in "abc"}
OF_VIEWS = 0.5 * RNG.standard_normal((6, 12))


def spread(seed: int, n: int) -> Array:
    root = 0.01 * np.random.default_rng(seed).standard_normal((n, n))
    return np.asarray(root @ root.T)


KEYS = spread(1, N_MAP)
NOISE, OWN = spread(2, 6), spread(3, 6)


def found(lever: Array, keyframe_covariance: Array) -> Localized:
    """A fix that errs by its keyframes, by its pixels and by its landmarks."""
    return Localized(
        Pose.identity(), NOISE, OWN, lever, keyframe_covariance, 100, 90, True, 0.1, by="patches"
    )


def window() -> PoseWindow[str]:
    """Two views found by the swarm's map, then one by a map of these two."""
    out: PoseWindow[str] = PoseWindow()
    out.add_by_map("a", found(LEVERS["a"], KEYS))
    out.add_by_map("b", found(LEVERS["b"], KEYS))
    out.add_by_views("v", found(OF_VIEWS, out.covariance_of("ba")), "ba")
    return out


def drawn() -> dict[str, Array]:
    """Return (N_DRAWN, 6) of what each view of that window is off, drawn as it is said to be."""
    rng = np.random.default_rng(4)

    def some(covariance: Array) -> Array:
        return rng.multivariate_normal(np.zeros(len(covariance)), covariance, N_DRAWN)

    keys = some(KEYS)
    out = {name: keys @ LEVERS[name].T + some(NOISE + OWN) for name in "abc"}
    out["v"] = np.hstack([out["b"], out["a"]]) @ OF_VIEWS.T + some(NOISE + OWN)
    return out


def assert_covers(covariance: Array, errors: Array) -> None:
    expected = np.cov(errors.T)
    np.testing.assert_allclose(covariance, expected, atol=0.02 * np.abs(expected).max())


def test_views_err_together_as_what_they_were_found_by() -> None:
    errors = drawn()
    assert_covers(window().covariance_of("abv"), np.hstack([errors[name] for name in "abv"]))


def test_who_is_found_by_the_map_again_errs_as_those_before() -> None:
    again = window()
    again.add_by_map("c", found(LEVERS["c"], KEYS))
    errors = drawn()
    assert again.views == ["a", "b", "v", "c"]
    assert_covers(again.covariance_of("vca"), np.hstack([errors[name] for name in "vca"]))


def test_a_later_map_errs_by_itself_as_far_as_anybody_knows() -> None:
    later = window()
    before = later.covariance_of("abv")
    later.add_by_map("c", found(LEVERS["c"], KEYS.copy()))
    joint = later.covariance_of("abvc")
    np.testing.assert_allclose(joint[:18, :18], before)
    assert not joint[18:, :18].any()
    np.testing.assert_allclose(joint[18:, 18:], LEVERS["c"] @ KEYS @ LEVERS["c"].T + NOISE + OWN)


def test_who_was_elsewhere_takes_all_views_along() -> None:
    moved, rng = window(), np.random.default_rng(6)
    moved.poses = [Pose(exp_so3(rng.normal(size=3)), rng.normal(size=3)) for _ in moved.poses]
    before, known = list(moved.poses), moved.covariance_of("abv")
    by = Pose(exp_so3(np.array([0.1, -0.2, 0.7])), np.array([3.0, -1.0, 0.5]))
    at, off = by @ before[1], spread(9, 6)
    moved.displace(by, at, off)
    for old, new in zip(before, moved.poses, strict=True):
        assert_pose_close(by @ old, new, within_m=1e-12, within_rad=1e-12)
    joint = moved.covariance_of("abv") - known
    # What it was found at is off by that, the others with it: how they lie to it is as before.
    np.testing.assert_allclose(joint[6:12, 6:12], off, atol=1e-12)
    error = 1e-6 * rng.standard_normal(6)
    shifted = at.retracted(error) @ at.inverse()
    errors = np.concatenate([pose.local(shifted @ pose) for pose in moved.poses])
    lever = joint[:, 6:12] @ np.linalg.inv(off)
    np.testing.assert_allclose(lever @ error, errors, atol=1e-10)
    moved.clear()
    moved.displace(by, at, off)
    assert moved.poses == []


@pytest.mark.parametrize("is_placed_anew", [False, True])
def test_who_flew_otherwise_than_believed_was_where_the_map_had_put_it(
    *, is_placed_anew: bool
) -> None:
    """Off was the way from the last view, whatever the ones before it were found by."""
    flown = window()
    flown.add_by_map("c", found(LEVERS["c"], KEYS))
    flown.drop(1)
    if is_placed_anew:
        poses = [Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (2.0, 1.0, 0.0)]
        flown.settle("cva", Placement(poses, spread(5, 18), 0, np.eye(18)))
    before, known = list(flown.poses), flown.covariance_of("avc")
    flown.displace(Pose(np.eye(3), np.ones(3)), Pose.identity(), spread(9, 6))
    assert flown.poses == before
    np.testing.assert_array_equal(flown.covariance_of("avc"), known)
    flown.drop(2)
    flown.displace(Pose(np.eye(3), np.ones(3)), Pose.identity(), spread(9, 6))
    assert flown.poses != before[:2]


def test_what_is_dropped_leaves_the_others_as_they_are() -> None:
    less = window()
    before = less.covariance_of("av")
    less.drop(1)
    assert less.views == ["a", "v"]
    np.testing.assert_allclose(less.covariance_of("av"), before)
    with pytest.raises(ValueError, match="b"):
        less.pose_of("b")
    less.clear()
    assert (less.views, less.poses) == ([], [])


def test_views_that_were_placed_together_err_as_that_says() -> None:
    """What is found by the map later errs with them as they err by what they were off before."""
    settled = window()
    by_before = np.vstack([0.5 * np.eye(6, 12, 6), np.eye(6, 12, 6)])
    covariance = by_before @ settled.covariance_of("va") @ by_before.T + spread(5, 12)
    moved = [Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (2.0, 1.0)]
    settled.settle("va", Placement(moved, covariance, 1, by_before))
    assert settled.views == ["a", "v"]
    assert [pose.translation[0] for pose in settled.poses] == [1.0, 2.0]
    np.testing.assert_allclose(settled.covariance_of("va"), covariance)
    settled.add_by_map("c", found(LEVERS["c"], KEYS))
    joint = settled.covariance_of("vac")
    with_a = LEVERS["a"] @ KEYS @ LEVERS["c"].T
    np.testing.assert_allclose(joint[:12, 12:], np.vstack([0.5 * with_a, with_a]), atol=1e-12)
