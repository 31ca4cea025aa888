"""One unfinished blob: the chunks that arrived, in the memory they take."""

from __future__ import annotations

import math

import numpy as np

from vcl_companion.wire.chunks import CHUNK_DATA_BYTES, MAX_CHUNKS, Chunk, Descriptor

CHUNK_COST_BYTES = CHUNK_DATA_BYTES + 1  # its data and its flag
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

    @property
    def cost_bytes(self) -> int:
        """Memory it takes."""
        return len(self.arrived) * CHUNK_COST_BYTES + FIXED_COST_BYTES

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
        start = chunk.index * CHUNK_DATA_BYTES
        self.stream[start : start + len(chunk.data)] = chunk.data
        self.arrived[chunk.index] = 1
        self.n_arrived += 1

    def begin_again(self) -> None:
        """Forget all chunks, as one of them is wrong and none says which."""
        self.stream, self.arrived = bytearray(), bytearray()
        self.n_arrived = self.end = 0
        self.n_damaged += 1

    def known_end(self) -> int:
        """Return one past the last chunk that certainly exists."""
        return self.end if self.descriptor is None else self.descriptor.n_chunks

    def missing(self) -> list[tuple[int, int]]:
        """Return the half-open ranges of chunks below ``known_end`` that did not arrive."""
        end = self.known_end()
        flags = np.zeros(end + 2, dtype=np.int8)
        flags[0] = flags[-1] = 1
        have = np.frombuffer(self.arrived, dtype=np.int8)[:end]
        flags[1 : 1 + len(have)] = have
        edges = np.flatnonzero(np.diff(flags))
        return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
