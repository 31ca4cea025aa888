"""The overlap graph: what it takes for two members to overlap, and for how long they do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.swarm.overlap import OverlapGraph, OverlapOptions
from vcl_companion.vision.signature import SIGNATURE_BYTES

OPTIONS = OverlapOptions(threshold=5.0, most=7.0, apart_s=20.0, fresh_s=7.0)
ROUND_S = 3.0


def place(number: int) -> bytes:
    return np.random.default_rng(number).bytes(SIGNATURE_BYTES)


def tell(graph: OverlapGraph, places: dict[int, int], from_s: float, until_s: float) -> None:
    """Have members tell what they see, each once in three seconds."""
    for now_s in np.arange(from_s, until_s, ROUND_S):
        for member, number in places.items():
            graph.note(member, place(number), float(now_s))
        graph.poll(float(now_s))


@pytest.mark.parametrize(
    "fields", [{"threshold": 0.0}, {"apart_s": float("nan")}, {"fresh_s": -1.0}, {"most": 1.0}]
)
def test_options_that_cannot_be_right_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        OverlapOptions(**fields)


def test_one_pair_of_frames_is_not_enough_and_some_seconds_are() -> None:
    graph = OverlapGraph((1, 2, 3), OPTIONS)
    tell(graph, {1: 7, 2: 7, 3: 8}, 0.0, 1.0)
    assert not graph.overlap((1,), (2,))
    tell(graph, {1: 7, 2: 7, 3: 8}, 3.0, 10.0)
    assert graph.overlap((1,), (2,))
    assert graph.overlap((3, 2), (3, 1))
    assert not graph.overlap((3,), (1, 2))
    assert graph.components((1, 2, 3)) == (frozenset((1, 2)), frozenset((3,)))


def test_what_is_not_confirmed_holds_for_a_while_and_then_no_more() -> None:
    graph = OverlapGraph((1, 2), OPTIONS)
    tell(graph, {1: 7, 2: 7}, 0.0, 31.0)
    tell(graph, {1: 7, 2: 8}, 33.0, 48.0)
    assert graph.overlap((1,), (2,))
    tell(graph, {1: 7, 2: 8}, 48.0, 55.0)
    assert not graph.overlap((1,), (2,))
    # Silence confirms nothing either.
    tell(graph, {1: 7, 2: 7}, 60.0, 70.0)
    assert graph.is_told_of(1, 70.0)
    graph.poll(100.0)
    assert not graph.overlap((1,), (2,))
    assert not graph.is_told_of(1, 100.0)


def test_who_is_lost_sees_nothing_that_anybody_knows_of() -> None:
    graph = OverlapGraph((1, 2, 3), OPTIONS)
    tell(graph, {1: 7, 2: 7, 3: 7}, 0.0, 10.0)
    graph.forget(2)
    assert not graph.overlap((2,), (1, 3))
    assert not graph.is_told_of(2, 10.0)
    tell(graph, {1: 7, 2: 7}, 12.0, 13.0)
    assert not graph.overlap((2,), (1, 3))  # from the beginning


def test_frames_of_different_times_are_not_compared() -> None:
    graph = OverlapGraph((1, 2), OPTIONS)
    for i in range(20):
        graph.note(1 + i % 2, place(7), 10.0 * i)
    assert not graph.overlap((1,), (2,))


def test_a_part_hangs_together_by_those_who_are_asked_about() -> None:
    graph = OverlapGraph((1, 2, 3), OPTIONS)
    tell(graph, {1: 7, 2: 7}, 0.0, 10.0)
    tell(graph, {2: 8, 3: 8}, 10.0, 20.0)
    assert graph.component(1, (1, 2, 3)) == {1, 2, 3}
    assert graph.component(1, (1, 3)) == {1}


@given(st.lists(st.tuples(st.integers(0, 6), st.binary(max_size=50)), max_size=30))
def test_whatever_is_told_the_parts_hold_everybody_once(told: list[tuple[int, bytes]]) -> None:
    graph = OverlapGraph((1, 2, 3, 4), OPTIONS)
    for i, (member, signature) in enumerate(told):
        graph.note(member, signature, 0.5 * i)
        graph.poll(0.5 * i)
    parts = graph.components((4, 2, 1))
    assert sorted(m for part in parts for m in part) == [1, 2, 4]
    assert all(graph.component(m, (1, 2, 4)) == part for part in parts for m in part)


def test_signatures_that_are_told_more_rarely_count_for_longer() -> None:
    options = OverlapOptions()
    assert options.stretched(0.5) == options
    longer = options.stretched(1.5)
    assert (longer.fresh_s, longer.apart_s) == (1.5 * options.fresh_s, 1.5 * options.apart_s)
    assert (longer.threshold, longer.most) == (options.threshold, options.most)
