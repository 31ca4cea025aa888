import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import random_rotation
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, skew
from vcl_companion.vision.five_point import MAX_MODELS, five_point


def views(rng: np.random.Generator, flat: bool = False) -> tuple[Array, Array, Array]:
    """Return five matches and their essential matrix, of norm 1."""
    depth = np.full(5, 5.0) if flat else rng.uniform(3.0, 9.0, 5)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (5, 2)), np.ones(5)]) * depth[:, None]
    translation = rng.standard_normal(3)
    pose = Pose(exp_so3(0.3 * rng.standard_normal(3)), translation / np.linalg.norm(translation))
    moved = pose.apply(points)
    essential = skew(pose.translation) @ pose.rotation / np.sqrt(2.0)
    return points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:], essential


def apart(one: Array, other: Array) -> float:
    """Return the largest difference of two matrices of norm 1 up to sign."""
    return float(min(np.abs(one - other).max(), np.abs(one + other).max()))


@pytest.mark.parametrize("flat", [False, True])
def test_the_truth_is_among_the_solutions(flat: bool) -> None:
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(500):
        a, b, truth = views(rng, flat)
        found = five_point(a, b)
        assert len(found) <= MAX_MODELS
        errors.append(min((apart(essential, truth) for essential in found), default=1.0))
    assert np.median(errors) < 1e-11
    # Two solutions that nearly meet are known to half the digits.
    assert np.mean(np.array(errors) > 1e-5) < 0.02


def test_every_solution_is_an_essential_matrix_of_the_matches() -> None:
    rng = np.random.default_rng(2)
    worst = []
    for _ in range(200):
        a, b, _ = views(rng)
        for essential in five_point(a, b):
            values = np.linalg.svd(essential, compute_uv=False)
            ha, hb = np.column_stack([a, np.ones(5)]), np.column_stack([b, np.ones(5)])
            epipolar = np.abs(np.einsum("ni,ij,nj->n", hb, essential, ha)).max()
            worst.append(max(abs(values[0] - values[1]), values[2], epipolar))
            assert np.linalg.norm(essential) == pytest.approx(1.0)
    assert np.quantile(worst, 0.98) < 1e-7


@pytest.mark.parametrize(("flat", "least"), [(False, 285), (True, 275)])
def test_agrees_with_poselib(flat: bool, least: int) -> None:
    poselib = pytest.importorskip("poselib", exc_type=ImportError)
    rng = np.random.default_rng(3)
    same = 0
    for _ in range(300):
        a, b, _ = views(rng, flat)
        ours = five_point(a, b)
        rays = [np.column_stack([side, np.ones(5)]) for side in (a, b)]
        rays = [side / np.linalg.norm(side, axis=1, keepdims=True) for side in rays]
        theirs = [e / np.linalg.norm(e) for e in poselib.essential_matrix_5pt(*rays)]
        same += len(ours) == len(theirs) and all(
            min(apart(e, other) for other in ours) < 1e-4 for e in theirs
        )
    # The rest are near-double roots, of which either may miss a pair.
    assert same >= least


def test_an_image_that_only_turned_does_not_break_it() -> None:
    rng = np.random.default_rng(4)
    a, _, _ = views(rng)
    rays = np.column_stack([a, np.ones(5)]) @ exp_so3(np.array([0.1, -0.05, 0.2])).T
    for essential in five_point(a, rays[:, :2] / rays[:, 2:]):
        assert np.all(np.isfinite(essential))


def test_repeated_matches_give_nothing_that_is_no_number() -> None:
    a, b, _ = views(np.random.default_rng(5))
    for rows in ([0, 0, 1, 2, 3], [0, 0, 0, 0, 0]):
        assert np.all(np.isfinite(five_point(a[rows], b[rows])))


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=20, max_size=20),
    st.sampled_from([1e-200, 1.0, 1e100]),
)
def test_any_numbers_give_finite_matrices(numbers: list[float], scale: float) -> None:
    a, b = scale * np.array(numbers).reshape(2, 5, 2)
    found = five_point(a, b)
    assert len(found) <= MAX_MODELS
    assert np.all(np.isfinite(found))


def test_wide_motions_are_found_too() -> None:
    rng = np.random.default_rng(6)
    good = 0
    for _ in range(100):
        pose = Pose(random_rotation(rng), rng.standard_normal(3))
        points = rng.uniform(-5.0, 5.0, (5, 3))
        moved = pose.apply(points)
        truth = skew(pose.translation) @ pose.rotation
        truth = truth / np.linalg.norm(truth)
        found = five_point(points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:])
        good += min((apart(e, truth) for e in found), default=1.0) < 1e-5
    assert good >= 97
