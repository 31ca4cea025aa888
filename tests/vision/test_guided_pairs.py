"""Features matched along epipolar lines: right, with their depth, and refused when ambiguous."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.vision.features import Features
from vcl_companion.vision.guided_pairs import match_epipolar

FOCAL_PX = 320.0
B_FROM_A = Pose(exp_so3(np.array([0.02, -0.1, 0.05])), np.array([-1.5, 0.2, 0.3]))
DEPTHS = (1.0 / 60.0, 1.0 / 3.0)


def scene(rng: np.random.Generator, n: int = 120) -> tuple[Features, Features, Array, Array, Array]:
    """Two views of points 5 to 40 m away, the second one's features shuffled."""
    z = rng.uniform(5.0, 40.0, n)
    points = np.column_stack([rng.uniform(-0.7, 0.7, (n, 2)) * z[:, None], z])
    moved = B_FROM_A.apply(points)
    ideal_a, ideal_b = points[:, :2] / z[:, None], moved[:, :2] / moved[:, 2:]
    descriptors = rng.integers(0, 256, (n, 61), dtype=np.uint8)
    a = Features(ideal_a * FOCAL_PX, descriptors)
    return a, Features(ideal_b * FOCAL_PX, descriptors), ideal_a, ideal_b, 1.0 / z


def test_every_feature_finds_its_own_and_its_depth() -> None:
    rng = np.random.default_rng(0)
    a, b, ideal_a, ideal_b, inverse = scene(rng)
    order = rng.permutation(len(a))
    i, k, depth = match_epipolar(
        a, b.subset(order), ideal_a, ideal_b[order], B_FROM_A, DEPTHS, FOCAL_PX
    )
    assert len(i) == len(a)
    np.testing.assert_array_equal(order[k], i)
    np.testing.assert_allclose(depth, inverse[i], rtol=1e-6)


def test_real_valued_descriptors_match_alike() -> None:
    rng = np.random.default_rng(1)
    a, b, ideal_a, ideal_b, _ = scene(rng)
    vectors = rng.normal(size=(len(a), 128)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    i, k, _ = match_epipolar(
        Features(a.pixels, vectors),
        Features(b.pixels, vectors),
        ideal_a,
        ideal_b,
        B_FROM_A,
        DEPTHS,
        FOCAL_PX,
    )
    assert len(i) == len(a)
    np.testing.assert_array_equal(i, k)


def test_what_looks_alike_along_the_line_is_left_out_and_elsewhere_does_not_matter() -> None:
    a, b, ideal_a, ideal_b, inverse = scene(np.random.default_rng(2))
    ray = np.append(ideal_a[0], 1.0)
    twin = B_FROM_A.apply(ray / (0.4 * inverse[0] + 0.6 * DEPTHS[1]))
    for place, matched in ((twin[:2] / twin[2], False), (ideal_b[0] + [0.0, 0.2], True)):
        more = Features(
            np.vstack([b.pixels, place * FOCAL_PX]),
            np.asarray(np.vstack([b.descriptors, b.descriptors[:1]]), dtype=np.uint8),
        )
        i, _, _ = match_epipolar(
            a, more, ideal_a, np.vstack([ideal_b, place]), B_FROM_A, DEPTHS, FOCAL_PX
        )
        assert (0 in i) == matched


def test_depths_out_of_range_and_points_behind_are_not_matched() -> None:
    a, b, ideal_a, ideal_b, inverse = scene(np.random.default_rng(3))
    i, _, _ = match_epipolar(a, b, ideal_a, ideal_b, B_FROM_A, (1 / 15.0, 1 / 3.0), FOCAL_PX)
    assert 0 < len(i) < len(a)
    assert inverse[i].min() > 1 / 18.0
    back = Pose(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    assert len(match_epipolar(a, b, ideal_a, ideal_b, back, DEPTHS, FOCAL_PX)[0]) == 0
    none = a.subset(np.zeros(0, np.intp))
    empty = np.zeros((0, 2))
    assert len(match_epipolar(none, b, empty, ideal_b, B_FROM_A, DEPTHS, FOCAL_PX)[0]) == 0
