"""The coder of landmarks: what was written is read, and nothing else reads as the same."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.wire.samples import random_map, scene_map
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.wire.landmark_coder import Rows, Stream
from vcl_companion.wire.landmark_grid import Views, steps_of_pixels
from vcl_companion.wire.landmark_kernels import Integers
from vcl_companion.wire.map_landmarks import code_new, rows_of_new

_maps = st.one_of(
    [
        st.builds(
            make,
            st.integers(0, 2**32).map(np.random.default_rng),
            st.integers(0, 30),
            st.integers(1, 4),
        )
        for make in (random_map, scene_map)
    ]
)


def written(rows: Rows, counts: Integers, views: Views) -> bytes:
    stream = Stream.writing(1 << 16)
    code_new(stream, rows, counts, views)
    assert not stream.failed
    return stream.written()


def read(data: bytes, n: int, views: Views) -> tuple[Stream, Rows, Integers]:
    stream, rows = Stream.reading(data), Rows.blank(n, len(views.largest))
    counts = np.zeros(len(views.largest), dtype=np.int64)
    code_new(stream, rows, counts, views)
    return stream, rows, counts


@given(_maps)
@settings(max_examples=60)
def test_what_was_written_is_read(landmark_map: LandmarkMap) -> None:
    views = Views(landmark_map.keyframes)
    pixels = steps_of_pixels(landmark_map.observed_px)
    rows, counts = rows_of_new(landmark_map.points_world, pixels, views)
    data = written(rows, counts, views)
    stream, again, counts_again = read(data, len(pixels), views)
    assert stream.is_all_read
    assert np.array_equal(counts, counts_again)
    for field in fields(Rows):
        assert np.array_equal(getattr(rows, field.name), getattr(again, field.name)), field.name
    for other in (data[:-1], data + b"\0", data[:-1] + bytes([data[-1] ^ 1])):
        assert not read(other, len(pixels), views)[0].is_all_read


@given(_maps, st.data())
@settings(max_examples=100)
def test_what_reads_to_its_end_is_what_would_be_written(
    landmark_map: LandmarkMap, data: st.DataObject
) -> None:
    views = Views(landmark_map.keyframes)
    pixels = steps_of_pixels(landmark_map.observed_px)
    whole = bytearray(written(*rows_of_new(landmark_map.points_world, pixels, views), views))
    at = data.draw(st.integers(0, len(whole) - 1))
    whole[at] = data.draw(st.integers(0, 255))
    n = data.draw(st.integers(max(len(pixels) - 1, 0), len(pixels) + 1))
    stream, rows, counts = read(bytes(whole), n, views)
    if stream.is_all_read:
        assert written(rows, counts, views) == bytes(whole)


@given(st.binary(max_size=60), st.integers(0, 40), st.integers(0, 3))
@settings(max_examples=100)
def test_any_bytes_can_be_read(data: bytes, n: int, seed: int) -> None:
    views = Views(scene_map(np.random.default_rng(seed), 1, 3).keyframes)
    stream, rows, counts = read(data, n, views)
    if stream.is_all_read:
        assert written(rows, counts, views) == data


def test_one_that_has_too_little_room_says_so() -> None:
    m = scene_map(np.random.default_rng(0), 40, 3)
    views = Views(m.keyframes)
    rows, counts = rows_of_new(m.points_world, steps_of_pixels(m.observed_px), views)
    stream = Stream.writing(100)
    code_new(stream, rows, counts, views)
    assert stream.failed
