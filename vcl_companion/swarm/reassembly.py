"""One unfinished blob: the chunks that arrived, and sums of others, in the memory they take."""

from __future__ import annotations

import math

import numpy as np

from vcl_companion.swarm.repairs import (
    Rows,
    Selection,
    Sums,
    block_of,
    per_block,
    selection,
    sum_of,
)
from vcl_companion.wire.chunks import (
    BLOCK_CHUNKS,
    CHUNK_DATA_BYTES,
    FIRST_SUM,
    MAX_CHUNKS,
    Chunk,
    Descriptor,
)

CHUNK_COST_BYTES = CHUNK_DATA_BYTES + 1  # its data and its flag
SUM_COST_BYTES = 512  # two long integers and what holds them
FIXED_COST_BYTES = 1024  # the objects around an unfinished blob, generously


class Incoming:
    """One unfinished blob."""

    def __init__(self, now_s: float) -> None:
        self.descriptor: Descriptor | None = None
        self.stream = bytearray()
        self.arrived = bytearray()  # a flag per chunk that ``stream`` has room for
        self.n_arrived = 0
        self.end = 0  # one past the highest chunk heard of
        self.n_damaged = 0
        self.heard_at_s = now_s
        self.answered_at_s = -math.inf
        self.starved = False  # the quota refused its last chunk
        self.is_for_several = False  # some of it was sent to all
        self._sums: dict[int, Sums] = {}  # by the first chunk of their block

    @property
    def cost_bytes(self) -> int:
        """Memory it takes."""
        n_sums = sum(len(sums) for sums in self._sums.values())
        return len(self.arrived) * CHUNK_COST_BYTES + n_sums * SUM_COST_BYTES + FIXED_COST_BYTES

    def room_for(self, n_chunks: int) -> int:
        """Return how many chunks to make room for while the number of all is unknown."""
        if n_chunks <= len(self.arrived):
            return len(self.arrived)
        return min(max(n_chunks, 2 * len(self.arrived)), MAX_CHUNKS)

    def make_room(self, n_chunks: int) -> None:
        """Reallocate for ``n_chunks`` (never grown in place: that would take hidden slack)."""
        if n_chunks == len(self.arrived):
            return
        stream, arrived = bytearray(n_chunks * CHUNK_DATA_BYTES), bytearray(n_chunks)
        keep = min(n_chunks, len(self.arrived))
        stream[: keep * CHUNK_DATA_BYTES] = self.stream[: keep * CHUNK_DATA_BYTES]
        arrived[:keep] = self.arrived[:keep]
        self.stream, self.arrived = stream, arrived

    def put(self, chunk: Chunk) -> None:
        """Keep a chunk there is room for; one that is there already stays as it is."""
        self.end = max(self.end, chunk.index + 1)
        if self.arrived[chunk.index]:
            return
        self._keep(chunk.index, chunk.data)
        start = chunk.index // BLOCK_CHUNKS * BLOCK_CHUNKS
        if start in self._sums:
            self._sums[start].learn(chunk.index - start, int.from_bytes(chunk.data, "little"))
            self._solve(start)

    def put_sum(self, chunk: Chunk, n_chunks: int) -> None:
        """Take a sum of some of the ``n_chunks`` that there is room for."""
        number = chunk.index - FIRST_SUM
        block = block_of(number, n_chunks)
        is_in = selection(chunk.tag, number, n_chunks)
        is_here = np.frombuffer(self.arrived, dtype=np.bool_)[block]
        lacking = np.packbits(is_in & ~is_here, bitorder="little")
        if not lacking.any():
            return
        rows: Rows = np.frombuffer(self.stream, dtype=np.uint8).reshape(-1, CHUNK_DATA_BYTES)
        known = sum_of(rows[block][is_in & is_here])
        value = int.from_bytes(chunk.data, "little") ^ int.from_bytes(known, "little")
        sums = self._sums.setdefault(block.start, Sums())
        sums.add(int.from_bytes(lacking.tobytes(), "little"), value)
        self._solve(block.start)

    def begin_again(self) -> None:
        """Forget all chunks, as one of them is wrong and none says which."""
        self.stream, self.arrived = bytearray(), bytearray()
        self.n_arrived = self.end = 0
        self.n_damaged += 1
        self._sums.clear()

    def known_end(self) -> int:
        """Return one past the last chunk that certainly exists."""
        return self.end if self.descriptor is None else self.descriptor.n_chunks

    def missing(self) -> list[tuple[int, int]]:
        """Return the half-open ranges of chunks below ``known_end`` that have to come yet."""
        flags = np.ones(self.known_end() + 2, dtype=np.bool_)
        flags[1:-1] = ~self._lacking()
        edges = np.flatnonzero(np.diff(flags))
        return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]

    def lacking_counts(self) -> list[int]:
        """Return how many more chunks or sums each block needs; the descriptor is known."""
        return [int(count) for count in per_block(self._lacking())]

    def _lacking(self) -> Selection:
        """Return which chunks below ``known_end`` have to come yet.

        What will follow from others by the sums that are here is not among them.
        """
        end = self.known_end()
        lacking = np.ones(end, dtype=np.bool_)
        have = np.frombuffer(self.arrived, dtype=np.bool_)[:end]
        lacking[: len(have)] = ~have
        for start, sums in self._sums.items():
            lacking[[start + own for own in sums.own]] = False
        return lacking

    def _keep(self, index: int, data: bytes) -> None:
        start = index * CHUNK_DATA_BYTES
        self.stream[start : start + len(data)] = data
        self.arrived[index] = 1
        self.n_arrived += 1

    def _solve(self, start: int) -> None:
        """Keep what follows by now from the sums of a block."""
        for own, data in self._sums[start].solved():
            self._keep(start + own, data)
        if not len(self._sums[start]):
            del self._sums[start]
