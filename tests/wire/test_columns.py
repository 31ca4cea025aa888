"""Packed integers: any column comes back, and only its shortest form is accepted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.errors import WireError
from vcl_companion.wire.columns import encode_bits, encode_column, take_bits, take_column
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


@given(st.lists(st.booleans(), max_size=40))
def test_bits_come_back(flags: list[bool]) -> None:
    reader = Reader(encode_bits(np.array(flags, dtype=np.bool_)), "bits")
    assert take_bits(reader, len(flags)).tolist() == flags
    reader.finish()


def test_padding_must_be_zero() -> None:
    with pytest.raises(WireError, match="padding"):
        take_bits(Reader(b"\x01", "bits"), 7)
