"""Columns of integers in as few bits as their range needs, or as most of them need.

Chosen over a general compressor: landmark coordinates have no repetition for
one to find, the bytes are the same on every machine (so a content hash is
too), and a few hostile bytes cannot unfold into many.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import WireError
from vcl_companion.wire.reader import Reader

Integers = NDArray[np.int64]

# Column of n integers (n is known from elsewhere)
# | 0 | i32              | smallest value                                        |
# | 4 | u8               | width: bits of (largest - smallest), 0 to 32          |
# | 5 | ceil(n*width/8)  | value - smallest, most significant bit first, 0-padded |
_COLUMN = struct.Struct("<iB")
_MAX_WIDTH_BITS = 32


def encode_column(values: Integers) -> bytes:
    """Return the bytes of (n,) integers that fit 32 bits, signed."""
    if len(values) == 0:
        return _COLUMN.pack(0, 0)
    smallest, largest = int(values.min()), int(values.max())
    width = (largest - smallest).bit_length()
    shifts = np.arange(width - 1, -1, -1)
    bits = ((values[:, None] - smallest) >> shifts) & 1
    return _COLUMN.pack(smallest, width) + np.packbits(bits.astype(np.uint8)).tobytes()


def take_column(reader: Reader, n_values: int) -> Integers:
    """Return the (n,) integers that come next; only ``encode_column``'s own form is accepted."""
    smallest, width = reader.unpack(_COLUMN)
    if width > _MAX_WIDTH_BITS:
        raise WireError(f"a column of {width} bits a value")
    values = _take_fixed(reader, n_values, width)
    spread = int(values.max()).bit_length() if n_values else 0
    if spread != width or (n_values and values.min() != 0) or (not n_values and smallest != 0):
        raise WireError("a column is not in its shortest form")
    return np.asarray(values + smallest)


def _take_fixed(reader: Reader, n_values: int, width: int) -> Integers:
    """Return the (n,) integers of so many bits each that come next."""
    values = np.zeros(n_values, dtype=np.int64)
    bits = take_bits(reader, n_values * width).reshape(n_values, width)
    for k in range(width):  # one bit of all values at a time keeps the work area small
        values = (values << 1) | bits[:, k]
    return values


# Residuals: n integers most of which are near zero (n is known from elsewhere)
# | 0 | u8             | width: bits of a value, 0 to 32                                  |
# | 1 | ceil(n*width/8) | 2 value, or -2 value - 1 below zero; all ones: it stands below  |
# |   | column         | the values of all ones, if there are any                         |
_WIDTH = struct.Struct("<B")
_COLUMN_BITS = 8 * _COLUMN.size


def encode_residuals(values: Integers) -> bytes:
    """Return the bytes of (n,) integers that fit 32 bits, signed, and are mostly near zero."""
    folded = _folded(values)
    width = _best_width(values, folded)
    escaped = folded >= (1 << width) - 1
    shown = np.where(escaped, (1 << width) - 1, folded)
    bits = (shown[:, None] >> np.arange(width - 1, -1, -1)) & 1
    packed = _WIDTH.pack(width) + np.packbits(bits.astype(np.uint8)).tobytes()
    return packed + encode_column(values[escaped]) if escaped.any() else packed


def take_residuals(reader: Reader, n_values: int) -> Integers:
    """Return the (n,) integers that come next; only ``encode_residuals``' own form is accepted."""
    (width,) = reader.unpack(_WIDTH)
    if width > _MAX_WIDTH_BITS:
        raise WireError(f"residuals of {width} bits a value")
    folded = _take_fixed(reader, n_values, width)
    escaped = folded == (1 << width) - 1
    values = np.where(folded & 1, -(folded + 1) // 2, folded // 2)
    if escaped.any():
        values[escaped] = take_column(reader, int(escaped.sum()))
        if (_folded(values[escaped]) < (1 << width) - 1).any():
            raise WireError("residuals are not in their shortest form")
    if _best_width(values, _folded(values)) != width:
        raise WireError("residuals are not in their shortest form")
    return np.asarray(values)


def _folded(values: Integers) -> Integers:
    """Return signed integers as 0 1 2 3 4 for 0 -1 1 -2 2."""
    return np.where(values < 0, -2 * values - 1, 2 * values)


def _best_width(values: Integers, folded: Integers) -> int:
    """Return the width that takes the fewest bits, the narrowest of several."""
    order = np.argsort(folded, kind="stable")
    sorted_values, sorted_folded, n = values[order], folded[order], len(values)
    # Of the values from each place on: what a column of them would span.
    largest = np.maximum.accumulate(sorted_values[::-1])[::-1]
    smallest = np.minimum.accumulate(sorted_values[::-1])[::-1]
    best, least = 0, np.inf
    for width in range(_MAX_WIDTH_BITS + 1):
        first = int(np.searchsorted(sorted_folded, (1 << width) - 1))
        bits = n * width
        if first < n:
            spread = int(largest[first] - smallest[first]).bit_length()
            bits += _COLUMN_BITS + (n - first) * spread
        if bits < least:
            best, least = width, bits
    return best


def encode_bits(bits: NDArray[np.bool_]) -> bytes:
    """Return (n,) booleans, eight a byte, most significant first, 0-padded."""
    return np.packbits(bits).tobytes()


def take_bits(reader: Reader, n_bits: int) -> NDArray[np.bool_]:
    """Return the (n,) booleans that come next; the padding must be zero."""
    packed = np.frombuffer(reader.take((n_bits + 7) // 8), dtype=np.uint8)
    bits = np.unpackbits(packed)
    if bits[n_bits:].any():
        raise WireError("padding bits are not zero")
    return bits[:n_bits].astype(np.bool_)
