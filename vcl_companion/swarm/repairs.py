"""Chunks that help every receiver, whichever it lacks: sums of many, modulo 2.

Three receivers that each lose a fifth lack half of all chunks between them, and
sending those again would take three times as long as one of them needs. Of sums
over a block each receiver needs as many as it lacks itself, and one or two more
(random linear network coding; Ho et al. 2006, https://doi.org/10.1109/TIT.2006.881746).

Which chunks are in a sum follows from the stream's tag and the sum's number alone,
so that a sum travels as a chunk like any other, with an index that no chunk has.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from vcl_companion.wire.chunks import BLOCK_CHUNKS, CHUNK_DATA_BYTES, FIRST_SUM, MAX_CHUNKS

_NAME = struct.Struct("<2I")

Selection = NDArray[np.bool_]
Rows = NDArray[np.uint8]
Counts = NDArray[np.int64]


def n_blocks(n_chunks: int) -> int:
    """Return how many blocks a stream has."""
    return -(-n_chunks // BLOCK_CHUNKS)


def sums_per_block(n_chunks: int) -> int:
    """Return how many different sums there are of each block."""
    return (MAX_CHUNKS - FIRST_SUM) // n_blocks(n_chunks)


def block_of(number: int, n_chunks: int) -> slice:
    """Return the chunks of the block that a sum is over; sums go round the blocks."""
    start = number % n_blocks(n_chunks) * BLOCK_CHUNKS
    return slice(start, min(start + BLOCK_CHUNKS, n_chunks))


def selection(tag: int, number: int, n_chunks: int) -> Selection:
    """Return which chunks of its block are in a sum."""
    block = block_of(number, n_chunks)
    n = block.stop - block.start
    bits = hashlib.shake_256(_NAME.pack(tag, number)).digest(-(-n // 8))
    packed = np.frombuffer(bits, dtype=np.uint8)
    return np.unpackbits(packed, count=n, bitorder="little").astype(np.bool_)


def per_block(flags: Selection) -> Counts:
    """Return how many chunks are flagged, of each block."""
    starts = np.arange(0, len(flags), BLOCK_CHUNKS)
    return np.add.reduceat(flags, starts, dtype=np.int64)


def sum_of(rows: Rows) -> bytes:
    """Return the sum of chunks, (n, 119), modulo 2."""
    return bytes(np.bitwise_xor.reduce(rows, axis=0, initial=0, dtype=np.uint8))


class Sums:
    """Sums of one block that are not solved yet: linear equations, reduced as they come.

    Each has a chunk of its own, which is in no other; the rest of what it holds is lacking
    still. So it takes as many more chunks or sums as there are chunks lacking without one.
    """

    def __init__(self) -> None:
        self._of: dict[int, tuple[int, int]] = {}  # by its own chunk: members, and their sum

    def __len__(self) -> int:
        return len(self._of)

    @property
    def own(self) -> Iterator[int]:
        """The chunks, counted from the block's first, that follow from the others."""
        return iter(self._of)

    def add(self, members: int, value: int) -> None:
        """Take a sum of chunks that are all lacking; bit i of ``members`` is chunk i."""
        for own, (theirs, sum_) in self._of.items():
            if members >> own & 1:
                members ^= theirs
                value ^= sum_
        if not members:
            return  # says nothing new
        own = (members & -members).bit_length() - 1
        for other, (theirs, sum_) in self._of.items():
            if theirs >> own & 1:
                self._of[other] = theirs ^ members, sum_ ^ value
        self._of[own] = members, value

    def learn(self, chunk: int, value: int) -> None:
        """Take a chunk that is not lacking any more out of all sums."""
        bit = 1 << chunk
        if chunk in self._of:
            members, sum_ = self._of.pop(chunk)
            if members != bit:
                self.add(members ^ bit, sum_ ^ value)
            return
        for own, (members, sum_) in self._of.items():
            if members & bit:
                self._of[own] = members ^ bit, sum_ ^ value

    def solved(self) -> list[tuple[int, bytes]]:
        """Take out what is known by now: chunks, with their bytes."""
        done = [own for own, (members, _) in self._of.items() if members == 1 << own]
        return [(own, self._of.pop(own)[1].to_bytes(CHUNK_DATA_BYTES, "little")) for own in done]
