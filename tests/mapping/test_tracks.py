"""Pairwise matches become tracks: nothing lost, nothing seen twice in one image."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import EQUIDISTANT, PINHOLE
from vcl_companion.geometry.camera import Camera
from vcl_companion.mapping.tracks import (
    PairMatches,
    ideal_of_pixels,
    join_tracks,
    pixels_of_tracks,
)


def matches(*pairs: tuple[int, int]) -> PairMatches:
    index = np.array(pairs, dtype=np.intp).reshape(-1, 2)
    return PairMatches(index[:, 0], index[:, 1])


def rows(tracks: np.ndarray[tuple[int, ...], np.dtype[np.intp]]) -> set[tuple[int, ...]]:
    return {tuple(map(int, row)) for row in tracks}


def test_matches_of_three_views_join_to_one_track() -> None:
    pairs = {(0, 1): matches((4, 2), (0, 0)), (1, 2): matches((2, 7))}
    assert rows(join_tracks([5, 3, 8], pairs)) == {(4, 2, 7), (0, 0, -1)}


def test_a_track_with_two_features_of_a_view_loses_that_view() -> None:
    pairs = {
        (0, 1): matches((0, 0)),
        (1, 2): matches((0, 0)),
        (0, 2): matches((0, 1)),  # closes on another feature of view 2
    }
    assert rows(join_tracks([1, 1, 2], pairs)) == {(0, 0, -1)}


def test_a_track_that_contradicts_itself_everywhere_is_gone() -> None:
    pairs = {(0, 1): matches((0, 0), (1, 0))}
    assert len(join_tracks([2, 1], pairs)) == 0


def test_no_matches_are_no_tracks() -> None:
    assert join_tracks([3, 4], {(0, 1): matches()}).shape == (0, 2)
    assert join_tracks([0, 0], {(0, 1): matches()}).shape == (0, 2)


@st.composite
def visibility(draw: st.DrawFn) -> tuple[list[int], dict[tuple[int, int], PairMatches]]:
    """Return features of some views and one-to-one matches between them, right and wrong ones."""
    sizes = draw(st.lists(st.integers(0, 8), min_size=2, max_size=4))
    pairs = {}
    for i in range(len(sizes)):
        for k in range(i + 1, len(sizes)):
            n = draw(st.integers(0, min(sizes[i], sizes[k])))
            a = draw(st.permutations(range(sizes[i])))[:n]
            b = draw(st.permutations(range(sizes[k])))[:n]
            pairs[(i, k)] = matches(*zip(a, b, strict=True))
    return sizes, pairs


@given(visibility())
def test_tracks_are_the_connected_features(
    graph: tuple[list[int], dict[tuple[int, int], PairMatches]],
) -> None:
    sizes, pairs = graph
    tracks = join_tracks(sizes, pairs)
    assert tracks.shape[1] == len(sizes)
    assert np.all((tracks >= 0).sum(axis=1) >= 2)
    # Each feature in one track at most.
    for i, n in enumerate(sizes):
        used = tracks[tracks[:, i] >= 0, i]
        assert len(set(used.tolist())) == len(used)
        assert np.all(used < n)
    # Joined by brute force: the same groups, without the views they contradict themselves in.
    group = {(i, f): {(i, f)} for i, n in enumerate(sizes) for f in range(n)}
    for (i, k), found in pairs.items():
        for a, b in zip(found.a.tolist(), found.b.tolist(), strict=True):
            merged = group[(i, a)] | group[(k, b)]
            for member in merged:
                group[member] = merged
    expected = set()
    for members in {frozenset(g) for g in group.values()}:
        row = []
        for i in range(len(sizes)):
            here = [f for view, f in members if view == i]
            row.append(here[0] if len(here) == 1 else -1)
        if sum(f >= 0 for f in row) >= 2:
            expected.add(tuple(row))
    assert rows(tracks) == expected


def test_pixels_of_tracks_are_those_of_their_features() -> None:
    tracks = np.array([[1, -1, 0], [0, 1, -1]], dtype=np.intp)
    pixels = [
        np.array([[1.0, 2.0], [3.0, 4.0]]),
        np.array([[5.0, 6.0], [7.0, 8.0]]),
        np.ones((1, 2)),
    ]
    nan = [np.nan, np.nan]
    np.testing.assert_array_equal(
        pixels_of_tracks(tracks, pixels),
        [[[3.0, 4.0], nan, [1.0, 1.0]], [[1.0, 2.0], [7.0, 8.0], nan]],
    )


def test_ideal_coordinates_undo_each_view_s_own_camera() -> None:
    ideal = np.array([[[0.1, -0.2], [0.3, 0.1]], [[0.0, 0.0], [np.nan, np.nan]]])
    cameras = [PINHOLE, EQUIDISTANT]
    pixels = np.stack([c.pixels_from_ideal(ideal[:, i]) for i, c in enumerate(cameras)], axis=1)
    np.testing.assert_allclose(ideal_of_pixels(pixels, cameras), ideal, atol=1e-9)


def test_a_pixel_outside_of_the_lens_model_is_unseen_and_warns_nobody() -> None:
    barrel = Camera(640, 480, 320.0, 320.0, 319.5, 239.5, "radial-tangential", (-0.4, 0, 0, 0))
    observed = np.array([[[0.0, 0.0], [np.nan, np.nan]], [[319.5, 239.5], [np.nan, np.nan]]])
    ideal = ideal_of_pixels(observed, [barrel, barrel])
    assert np.all(np.isnan(ideal[0, 0]))
    np.testing.assert_allclose(ideal[1, 0], 0.0, atol=1e-12)
    assert np.all(np.isnan(ideal[:, 1]))
