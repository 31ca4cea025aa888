"""Packed integers: any column comes back, and only its shortest form is accepted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.errors import WireError
from vcl_companion.wire.columns import (
    encode_bits,
    encode_column,
    encode_residuals,
    take_bits,
    take_column,
    take_residuals,
)
from vcl_companion.wire.reader import Reader


@given(st.lists(st.integers(-(2**31), 2**31 - 1), max_size=50))
def test_columns_come_back(numbers: list[int]) -> None:
    values = np.array(numbers, dtype=np.int64)
    data = encode_column(values)
    reader = Reader(data, "column")
    assert np.array_equal(take_column(reader, len(values)), values)
    reader.finish()
    spread = int(values.max() - values.min()) if numbers else 0
    assert len(data) == 5 + (len(numbers) * spread.bit_length() + 7) // 8


@given(st.binary(max_size=40), st.integers(0, 20))
def test_any_bytes_are_a_column_with_exactly_these_bytes_or_a_wire_error(
    data: bytes, n_values: int
) -> None:
    reader = Reader(data, "column")
    try:
        values = take_column(reader, n_values)
        reader.finish()
    except WireError:
        return
    assert encode_column(values) == data


@given(
    st.lists(
        st.one_of(
            st.integers(-3, 3),
            st.integers(-(2**31), 2**31 - 1),
            st.sampled_from([-(2**31), 2**31 - 1]),
        ),
        max_size=50,
    )
)
def test_residuals_come_back(numbers: list[int]) -> None:
    values = np.array(numbers, dtype=np.int64)
    data = encode_residuals(values)
    reader = Reader(data, "residuals")
    assert np.array_equal(take_residuals(reader, len(values)), values)
    reader.finish()
    assert len(data) <= 1 + len(encode_column(values))


@given(st.binary(max_size=40), st.integers(0, 20))
def test_any_bytes_are_residuals_with_exactly_these_bytes_or_a_wire_error(
    data: bytes, n_values: int
) -> None:
    reader = Reader(data, "residuals")
    try:
        values = take_residuals(reader, n_values)
        reader.finish()
    except WireError:
        return
    assert encode_residuals(values) == data


def test_a_few_far_off_residuals_cost_the_others_nothing() -> None:
    rng = np.random.default_rng(2)
    values = np.rint(4.0 * rng.standard_normal(2000)).astype(np.int64)
    near = len(encode_residuals(values))
    assert near < 2000 * 5 / 8 + 100
    values[::200] = rng.integers(-20_000, 20_000, 10)
    assert len(encode_residuals(values)) < 1.2 * near
    assert len(encode_column(values)) > 2000 * 15 / 8


@given(st.lists(st.booleans(), max_size=40))
def test_bits_come_back(flags: list[bool]) -> None:
    reader = Reader(encode_bits(np.array(flags, dtype=np.bool_)), "bits")
    assert take_bits(reader, len(flags)).tolist() == flags
    reader.finish()


def test_padding_must_be_zero() -> None:
    with pytest.raises(WireError, match="padding"):
        take_bits(Reader(b"\x01", "bits"), 7)
