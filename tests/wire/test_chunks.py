"""Streams and their chunks, and statuses that share what one payload cannot hold."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.wire.chunks import (
    CHUNK_DATA_BYTES,
    Reply,
    decode_descriptor,
    describe,
    receiving_statuses,
)
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.tunnel import decode_payload, encode_payload


@given(st.binary(max_size=600))
def test_chunks_put_together_are_the_blob(blob: bytes) -> None:
    descriptor = describe(BlobKind.MAP, blob)
    pieces = [descriptor.cut(blob, i) for i in range(descriptor.n_chunks)]
    assert [len(piece) for piece in pieces] == [
        descriptor.chunk_bytes(i) for i in range(descriptor.n_chunks)
    ]
    assert all(0 < len(piece) <= CHUNK_DATA_BYTES for piece in pieces)
    assert decode_descriptor(pieces[0]) == descriptor
    assert descriptor.blob_of(bytearray(b"".join(pieces))) == blob


@given(st.binary(min_size=1, max_size=600), st.data())
def test_a_changed_byte_is_noticed(blob: bytes, data: st.DataObject) -> None:
    descriptor = describe(BlobKind.FRAME_ANSWER, blob)
    stream = bytearray(descriptor.encode() + blob)
    stream[37 + data.draw(st.integers(0, len(blob) - 1))] ^= data.draw(st.integers(1, 255))
    assert descriptor.blob_of(stream) is None


def test_the_tag_depends_on_kind_and_content_only() -> None:
    tags = {describe(kind, blob).tag for kind in BlobKind for blob in (b"", b"a", b"b", b"aa")}
    assert len(tags) == 4 * len(BlobKind)
    assert describe(BlobKind.MAP, b"abc").tag == describe(BlobKind.MAP, b"abc").tag


@given(st.sets(st.integers(0, 3000), max_size=800), st.integers(0, 500))
def test_statuses_tell_of_every_chunk_exactly_once(lost: set[int], beyond: int) -> None:
    end = max(lost, default=0) + 1 + beyond
    flags = [index in lost for index in range(end)]
    missing = []
    for index in range(end):
        if flags[index] and (index == 0 or not flags[index - 1]):
            stop = next((k for k in range(index, end) if not flags[k]), end)
            missing.append((index, stop))
    told: list[bool] = []
    for status in receiving_statuses(7, 3, end, missing):
        assert decode_payload(*encode_payload(status)) == status
        assert (status.reply, status.first) == (Reply.RECEIVING, len(told))
        told += [False] * (status.end - status.first)
        for start, stop in status.missing:
            told[start:stop] = [True] * (stop - start)
    assert told == flags
