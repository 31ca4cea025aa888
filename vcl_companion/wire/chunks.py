"""Pieces of a blob, and what a receiver says about them.

A blob travels as a stream: its descriptor, then its bytes, cut into chunks of
119 bytes. A chunk names its stream by a tag, which is a hash of the
descriptor: the same blob has the same tag from any sender at any time, so a
transfer can be taken up again, and a damaged descriptor is noticed at once.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import WireError
from vcl_companion.wire.header import HEADER_BYTES, MAX_BLOB_BYTES, MAX_PAYLOAD_BYTES, BlobKind
from vcl_companion.wire.reader import Reader

# Chunk body
# | 0 | u32  | tag: first 4 bytes of the SHA-256 of the descriptor               |
# | 4 | u16  | index, low 16 bits                                                |
# | 6 | u8   | bit 0: index, bit 16; bits 1 to 7: ask number, 0 when not asking  |
# | 7 | rest | 1 to 119 bytes of the stream, from index * 119 on                 |
_CHUNK = struct.Struct("<IHB")
CHUNK_DATA_BYTES = MAX_PAYLOAD_BYTES - HEADER_BYTES - _CHUNK.size
MAX_CHUNKS = 1 << 17
MAX_ASK = 127
# Sums are over so many chunks; larger ones lose less to chance, and take longer to solve.
BLOCK_CHUNKS = 1024
_MAX_BLOCKS = MAX_CHUNKS // BLOCK_CHUNKS

# Descriptor, the first 37 bytes of every stream
# | 0 | u8       | blob kind             |
# | 1 | u32      | blob length, bytes    |
# | 5 | 32 bytes | SHA-256 of the blob   |
_DESCRIPTOR = struct.Struct("<BI32s")

# Sums of chunks are numbered after the last chunk of the longest stream.
FIRST_SUM = -(-(_DESCRIPTOR.size + MAX_BLOB_BYTES) // CHUNK_DATA_BYTES)

# TransferStatus body
# | 0  | u32     | tag                                                                   |
# | 4  | u8      | reply                                                                 |
# | 5  | u8      | number of the newest ask heard, 1 to 127                              |
# reply RECEIVING: what arrived of the chunks first to end - 1
# | 6  | u32     | first                                                                 |
# | 10 | u32     | end                                                                   |
# | 14 | rest    | missing ranges: pairs of varints (chunks since the last range, length) |
# reply LACKING: how many more are needed of the blocks from ``first`` on
# | 6  | u8      | first                                                                 |
# | 7  | rest    | a varint for each block, up to 1024                                   |
# reply COMPLETE:
# | 6  | 8 bytes | first of the SHA-256 of the blob                                      |
_STATUS = struct.Struct("<IBB")
_WINDOW = struct.Struct("<2I")
_DIGEST_BYTES = 8
_MAX_RANGE_BYTES = MAX_PAYLOAD_BYTES - HEADER_BYTES - _STATUS.size - _WINDOW.size
_MAX_VARINT_BYTES = 3
_MAX_COUNT_BYTES = MAX_PAYLOAD_BYTES - HEADER_BYTES - _STATUS.size - 1


class Reply(IntEnum):
    """What a receiver says about a transfer."""

    RECEIVING = 1
    COMPLETE = 2
    BUSY = 3
    TOO_LARGE = 4
    CORRUPT = 5
    LACKING = 6


@dataclass(frozen=True)
class Chunk:
    """One piece of a stream.

    Attributes:
        tag: which stream.
        index: which piece.
        ask: 0, or a number of 1 to 127 that asks for a status which repeats it.
        data: the piece.
    """

    tag: int
    index: int
    ask: int
    data: bytes

    def __post_init__(self) -> None:
        if not (0 <= self.tag < 1 << 32 and 0 <= self.index < MAX_CHUNKS):
            raise ValueError(f"a chunk out of range: tag {self.tag}, index {self.index}")
        if not 0 <= self.ask <= MAX_ASK:
            raise ValueError(f"an ask number of 0 to {MAX_ASK}: {self.ask}")
        if not 1 <= len(self.data) <= CHUNK_DATA_BYTES:
            raise ValueError(f"a chunk of {len(self.data)} bytes")


@dataclass(frozen=True)
class TransferStatus:
    """What a receiver has of a stream.

    Attributes:
        tag: which stream.
        reply: how the transfer stands.
        ask: the newest ask number heard.
        first, end: RECEIVING: the chunks this status tells of; LACKING: the blocks; of others
            it says nothing.
        missing: RECEIVING: half-open ranges among them that did not arrive, ascending and
            apart from each other; all others did.
        counts: LACKING: how many more chunks or sums are needed of each of these blocks.
        digest: COMPLETE: first 8 bytes of the SHA-256 of the blob that arrived.
    """

    tag: int
    reply: Reply
    ask: int
    first: int = 0
    end: int = 0
    missing: tuple[tuple[int, int], ...] = ()
    counts: tuple[int, ...] = ()
    digest: bytes = b""

    def __post_init__(self) -> None:
        if not 0 <= self.tag < 1 << 32 or not 1 <= self.ask <= MAX_ASK:
            raise ValueError(f"a status out of range: tag {self.tag}, ask {self.ask}")
        if len(self.digest) != (_DIGEST_BYTES if self.reply == Reply.COMPLETE else 0):
            raise ValueError(f"{self.reply.name} with a digest of {len(self.digest)} bytes")
        if self.reply == Reply.LACKING:
            self._check_counts()
            return
        if self.counts:
            raise ValueError(f"{self.reply.name} with counts")
        if self.reply != Reply.RECEIVING and (self.first, self.end, self.missing) != (0, 0, ()):
            raise ValueError(f"{self.reply.name} with a window of chunks")
        if not 0 <= self.first <= self.end <= MAX_CHUNKS:
            raise ValueError(f"a window of chunks {self.first} to {self.end}")
        at = self.first - 1
        for start, stop in self.missing:
            if not at < start < stop <= self.end:
                raise ValueError(f"missing ranges out of order: {self.missing}")
            at = stop
        if len(_encode_ranges(self.first, self.missing)) > _MAX_RANGE_BYTES:
            raise ValueError(f"{len(self.missing)} missing ranges do not fit one status")

    def _check_counts(self) -> None:
        if not self.counts or self.missing or self.end != self.first + len(self.counts):
            raise ValueError(f"{len(self.counts)} counts of blocks {self.first} to {self.end}")
        if not 0 <= self.first < self.end <= _MAX_BLOCKS:
            raise ValueError(f"blocks {self.first} to {self.end}")
        if not all(0 <= count <= BLOCK_CHUNKS for count in self.counts):
            raise ValueError("a block lacks more than it has")
        if len(_encode_varints(self.counts)) > _MAX_COUNT_BYTES:
            raise ValueError(f"{len(self.counts)} counts do not fit one status")


@dataclass(frozen=True)
class Descriptor:
    """What a stream holds, told in its first chunk.

    Attributes:
        kind: of the blob.
        length_bytes: of the blob.
        digest: its SHA-256.
    """

    kind: BlobKind
    length_bytes: int
    digest: bytes

    @property
    def tag(self) -> int:
        """The stream's name in every chunk."""
        return int.from_bytes(hashlib.sha256(self.encode()).digest()[:4], "little")

    @property
    def short_digest(self) -> bytes:
        """What a receiver that has the whole blob answers; the revision, if it is a map."""
        return self.digest[:_DIGEST_BYTES]

    @property
    def n_chunks(self) -> int:
        """Number of chunks of the stream."""
        return -(-(_DESCRIPTOR.size + self.length_bytes) // CHUNK_DATA_BYTES)

    def encode(self) -> bytes:
        """Return the 37 bytes of the descriptor."""
        return _DESCRIPTOR.pack(self.kind, self.length_bytes, self.digest)

    def chunk_bytes(self, index: int) -> int:
        """Return the length of a chunk's data: all but the last are full."""
        return min(
            CHUNK_DATA_BYTES, _DESCRIPTOR.size + self.length_bytes - index * CHUNK_DATA_BYTES
        )

    def cut(self, blob: bytes, index: int) -> bytes:
        """Return the data of one chunk of the stream of ``blob``."""
        start = index * CHUNK_DATA_BYTES - _DESCRIPTOR.size
        if index == 0:
            return self.encode() + blob[: start + CHUNK_DATA_BYTES]
        return blob[start : start + CHUNK_DATA_BYTES]

    def rows(self, blob: bytes) -> NDArray[np.uint8]:
        """Return the data of all chunks, (n_chunks, 119), the last one filled with zeros."""
        stream = (self.encode() + blob).ljust(self.n_chunks * CHUNK_DATA_BYTES, b"\0")
        return np.frombuffer(stream, dtype=np.uint8).reshape(-1, CHUNK_DATA_BYTES)

    def blob_of(self, stream: bytearray) -> bytes | None:
        """Return the blob of a stream whose chunks all arrived; None when its hash is wrong."""
        blob = bytes(stream[_DESCRIPTOR.size : _DESCRIPTOR.size + self.length_bytes])
        return blob if hashlib.sha256(blob).digest() == self.digest else None


def describe(kind: BlobKind, blob: bytes) -> Descriptor:
    """Return the descriptor of a blob.

    Raises:
        ValueError: the blob is longer than any receiver accepts.
    """
    if len(blob) > MAX_BLOB_BYTES:
        raise ValueError(f"a blob of {len(blob)} bytes, at most {MAX_BLOB_BYTES}")
    return Descriptor(kind, len(blob), hashlib.sha256(blob).digest())


def decode_descriptor(stream: bytes) -> Descriptor:
    """Return the descriptor at the start of a stream's first chunk, or raise WireError."""
    kind, length, digest = Reader(stream, "descriptor").unpack(_DESCRIPTOR)
    if kind not in tuple(BlobKind):
        raise WireError(f"unknown blob kind {kind}")
    if length > MAX_BLOB_BYTES:
        raise WireError(f"a blob of {length} bytes, at most {MAX_BLOB_BYTES}")
    return Descriptor(BlobKind(kind), length, digest)


def encode_chunk(chunk: Chunk) -> bytes:
    """Return the body of a chunk."""
    head = _CHUNK.pack(chunk.tag, chunk.index & 0xFFFF, chunk.ask << 1 | chunk.index >> 16)
    return head + chunk.data


def decode_chunk(body: bytes) -> Chunk:
    """Return the chunk of a body, or raise WireError."""
    tag, index_low, rest = Reader(body, "chunk").unpack(_CHUNK)
    try:
        return Chunk(tag, (rest & 1) << 16 | index_low, rest >> 1, body[_CHUNK.size :])
    except ValueError as error:
        raise WireError(str(error)) from None


def encode_status(status: TransferStatus) -> bytes:
    """Return the body of a status."""
    head = _STATUS.pack(status.tag, status.reply, status.ask)
    if status.reply == Reply.RECEIVING:
        window = _WINDOW.pack(status.first, status.end)
        return head + window + _encode_ranges(status.first, status.missing)
    if status.reply == Reply.LACKING:
        return head + bytes([status.first]) + _encode_varints(status.counts)
    return head + status.digest


def decode_status(body: bytes) -> TransferStatus:
    """Return the status of a body, or raise WireError."""
    reader = Reader(body, "transfer status")
    tag, reply, ask = reader.unpack(_STATUS)
    if reply not in tuple(Reply):
        raise WireError(f"unknown transfer reply {reply}")
    first, end, digest = 0, 0, b""
    missing: tuple[tuple[int, int], ...] = ()
    counts: tuple[int, ...] = ()
    if reply == Reply.RECEIVING:
        first, end = reader.unpack(_WINDOW)
        missing = _decode_ranges(first, body[_STATUS.size + _WINDOW.size :])
    elif reply == Reply.LACKING:
        (first,) = reader.take(1)
        counts = tuple(_decode_varints(body[_STATUS.size + 1 :]))
        end = first + len(counts)
    else:
        digest = reader.take(_DIGEST_BYTES if reply == Reply.COMPLETE else 0)
        reader.finish()
    try:
        return TransferStatus(tag, Reply(reply), ask, first, end, missing, counts, digest)
    except ValueError as error:
        raise WireError(str(error)) from None


def receiving_statuses(
    tag: int, ask: int, end: int, missing: list[tuple[int, int]]
) -> Iterator[TransferStatus]:
    """Yield the statuses that tell of the chunks 0 to ``end`` - 1, each fitting one payload.

    Args:
        tag: which stream.
        ask: the newest ask number heard.
        end: one past the last chunk told of.
        missing: half-open ranges that did not arrive, ascending and apart.
    """
    first, size = 0, 0
    fitting: list[tuple[int, int]] = []
    for start, stop in missing:
        since = fitting[-1][1] if fitting else first
        added = len(_encode_ranges(since, ((start, stop),)))
        if size + added > _MAX_RANGE_BYTES:
            yield TransferStatus(tag, Reply.RECEIVING, ask, first, start, tuple(fitting))
            first, fitting = start, []
            size, added = 0, len(_encode_ranges(start, ((start, stop),)))
        fitting.append((start, stop))
        size += added
    yield TransferStatus(tag, Reply.RECEIVING, ask, first, end, tuple(fitting))


def lacking_statuses(tag: int, ask: int, counts: list[int]) -> Iterator[TransferStatus]:
    """Yield the statuses that tell how many more are needed of every block."""
    most = _MAX_COUNT_BYTES // 2  # a count of up to 1024 takes two bytes
    for first in range(0, len(counts), most):
        told = tuple(counts[first : first + most])
        end = first + len(told)
        yield TransferStatus(tag, Reply.LACKING, ask, first, end, counts=told)


def _encode_ranges(first: int, missing: tuple[tuple[int, int], ...]) -> bytes:
    """Return the varint pairs of the missing ranges of a window that starts at ``first``."""
    values, at = [], first
    for start, stop in missing:
        values += [start - at, stop - start]
        at = stop
    return _encode_varints(values)


def _encode_varints(values: Sequence[int]) -> bytes:
    out = bytearray()
    for value in values:
        rest = value
        while rest > 0x7F:
            out.append(0x80 | rest & 0x7F)
            rest >>= 7
        out.append(rest)
    return bytes(out)


def _decode_ranges(first: int, data: bytes) -> tuple[tuple[int, int], ...]:
    """Return the missing ranges of varint pairs; their order is checked by ``TransferStatus``."""
    values = _decode_varints(data)
    if len(values) % 2:
        raise WireError("missing ranges end early")
    missing, at = [], first
    for gap, length in zip(values[::2], values[1::2], strict=True):
        missing.append((at + gap, at + gap + length))
        at += gap + length
    return tuple(missing)


def _decode_varints(data: bytes) -> list[int]:
    values: list[int] = []
    value = n_bytes = 0
    for byte in data:
        value |= (byte & 0x7F) << 7 * n_bytes
        n_bytes += 1
        if n_bytes > _MAX_VARINT_BYTES or (byte == 0 and n_bytes > 1):
            raise WireError("transfer status: a number is not in its shortest form")
        if byte < 0x80:
            values.append(value)
            value = n_bytes = 0
    if n_bytes:
        raise WireError("transfer status ends within a number")
    return values
