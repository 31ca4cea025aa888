"""Columns of integers in as few bits as their range needs.

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
    values = np.zeros(n_values, dtype=np.int64)
    bits = take_bits(reader, n_values * width).reshape(n_values, width)
    for k in range(width):  # one bit of all values at a time keeps the work area small
        values = (values << 1) | bits[:, k]
    spread = int(values.max()).bit_length() if n_values else 0
    if spread != width or (n_values and values.min() != 0) or (not n_values and smallest != 0):
        raise WireError("a column is not in its shortest form")
    return np.asarray(values + smallest)


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
