"""What lies far before its neighbours: a post stands there, a window was taken for the next one."""

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.mapping.rendered import CAMERA
from tests.mapping.windows import CAMS, Bent, bent_by_windows
from vcl_companion.mapping.apart import ambiguous, like_neighbours
from vcl_companion.mapping.patch_table import EXACTLY, PatchTable, decoded_pyramid


@pytest.fixture(scope="module")
def bent() -> Bent:
    return bent_by_windows()


def told(some: Bent, cut_from: NDArray[np.intp], rows: NDArray[np.intp]) -> NDArray[np.bool_]:
    """(M, 2) what is ambiguous of some landmarks of the facade."""
    keyframes = some.landmark_map.keyframes
    table = PatchTable([CAMERA] * 2, [decoded_pyramid(k.image_bytes, k.camera) for k in keyframes])
    points, observed = some.landmark_map.points_world, some.landmark_map.observed_px
    return ambiguous(table, points[rows], observed[rows], cut_from, [CAMERA] * 2, CAMS, EXACTLY)


@pytest.mark.parametrize("cut_from", [0, 1])
def test_a_window_taken_for_the_next_one_is_found_where_it_should_be(
    bent: Bent, cut_from: int
) -> None:
    rows = np.arange(len(bent.kind))
    found = told(bent, np.full(len(rows), cut_from, dtype=np.intp), rows)

    assert not found[:, cut_from].any()
    other = found[:, 1 - cut_from]
    assert other[bent.kind == 2].mean() > 0.8
    assert not other[bent.kind != 2].any()


def test_where_most_are_found_so_the_others_are_not_believed(bent: Bent) -> None:
    # A few of the post's: too few for it to be one.
    rows = np.concatenate([np.flatnonzero(bent.kind != 1), np.flatnonzero(bent.kind == 1)[:5]])
    found = told(bent, np.zeros(len(rows), dtype=np.intp), rows)[:, 1]

    assert found[bent.kind[rows] != 0].all()
    assert not found[bent.kind[rows] == 0].any()


def test_who_is_not_asked_about_is_not_told(bent: Bent) -> None:
    rows = np.arange(len(bent.kind))
    cut_from = np.where(bent.kind == 2, -1, 0).astype(np.intp)

    assert not told(bent, cut_from, rows)[bent.kind == 2].any()


def test_neighbours_are_of_several_cells_and_a_wall_may_slant() -> None:
    rng = np.random.default_rng(4)
    pixels = rng.uniform(5.0, [315.0, 235.0], (400, 2))
    depth = 8.0 + 0.02 * pixels[:, 0]
    crowd = np.array([160.0, 120.0]) + rng.uniform(-6.0, 6.0, (40, 2))

    like, usual = like_neighbours(
        np.concatenate([pixels, crowd]), np.append(depth, np.full(40, 30.0)), CAMERA
    )

    assert like[:400].all()
    assert not like[400:].any()
    np.testing.assert_allclose(usual[400:], 8.0 + 0.02 * 160.0, rtol=0.1)
