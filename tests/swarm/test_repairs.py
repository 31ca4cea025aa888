"""Sums of chunks: exactly as documented, and every one that says something new is of use."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcl_companion.swarm.reassembly import Incoming
from vcl_companion.swarm.repairs import (
    block_of,
    n_blocks,
    per_block,
    selection,
    sum_of,
    sums_per_block,
)
from vcl_companion.swarm.transfer import (
    BlobKind,
    Event,
    ReceptionAbandoned,
    TransferOptions,
    Transfers,
)
from vcl_companion.wire.chunks import FIRST_SUM, MAX_CHUNKS, Chunk, describe
from vcl_companion.wire.header import MAX_BLOB_BYTES

BLOB = np.random.default_rng(0).bytes(250_000)  # 2102 chunks: three blocks


def sum_chunk(blob: bytes, number: int) -> Chunk:
    descriptor = describe(BlobKind.MAP, blob)
    n = descriptor.n_chunks
    rows = descriptor.rows(blob)[block_of(number, n)]
    data = sum_of(rows[selection(descriptor.tag, number, n)])
    return Chunk(descriptor.tag, FIRST_SUM + number, 0, data)


def begun(blob: bytes) -> Incoming:
    incoming = Incoming(0.0)
    incoming.descriptor = describe(BlobKind.MAP, blob)
    incoming.make_room(incoming.descriptor.n_chunks)
    return incoming


def test_a_sum_is_what_the_protocol_says() -> None:
    descriptor = describe(BlobKind.MAP, BLOB)
    stream = (descriptor.encode() + BLOB).ljust(descriptor.n_chunks * 119, b"\0")
    number = 3 * 5 + 2  # of the last block, the short one
    name = descriptor.tag.to_bytes(4, "little") + number.to_bytes(4, "little")
    bits = int.from_bytes(hashlib.shake_256(name).digest(7), "little")
    expected = 0
    for i, index in enumerate(range(2048, descriptor.n_chunks)):
        if bits >> i & 1:
            expected ^= int.from_bytes(stream[index * 119 : (index + 1) * 119], "little")
    assert descriptor.n_chunks == 2102
    assert sum_chunk(BLOB, number).data == expected.to_bytes(119, "little")


def test_which_chunks_are_in_a_sum_never_changes() -> None:
    flags = selection(0x12345678, 1000, 20)
    assert "".join("01"[int(flag)] for flag in flags) == "10010110111010100011"


def test_the_longest_blob_has_sums_too() -> None:
    n = describe(BlobKind.MAP, bytes(MAX_BLOB_BYTES)).n_chunks
    assert n == FIRST_SUM
    assert n_blocks(n) == 69
    assert sums_per_block(n) == (MAX_CHUNKS - n) // 69 > 800


@given(
    n_bytes=st.integers(1, 20_000),
    lost=st.floats(0.0, 1.0),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_it_takes_as_many_sums_as_chunks_are_lacking_and_a_few(
    n_bytes: int, lost: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    blob = BLOB[:n_bytes]
    descriptor = describe(BlobKind.MAP, blob)
    incoming = begun(blob)
    pieces = [
        Chunk(descriptor.tag, i, 0, descriptor.cut(blob, i)) for i in range(descriptor.n_chunks)
    ]
    for piece in pieces:
        if rng.uniform() > lost:
            incoming.put(piece)
    n_lacking = sum(incoming.lacking_counts())
    assert n_lacking == descriptor.n_chunks - incoming.n_arrived
    n_sums = 0
    while incoming.n_arrived < descriptor.n_chunks:
        before = sum(incoming.lacking_counts())
        if rng.uniform() < 0.2:  # chunks may come between, of what is lacking or not
            incoming.put(pieces[int(rng.integers(len(pieces)))])
        incoming.put_sum(sum_chunk(blob, n_sums), descriptor.n_chunks)
        after = sum(incoming.lacking_counts())
        assert after <= before
        told = sum(stop - start for start, stop in incoming.missing())
        assert told == after
        n_sums += 1
    assert n_sums <= n_lacking + 20
    assert descriptor.blob_of(incoming.stream) == blob
    assert incoming.cost_bytes == descriptor.n_chunks * 120 + 1024  # no sum is left


def test_blocks_are_counted_each_by_itself() -> None:
    flags = np.zeros(2102, dtype=np.bool_)
    flags[[0, 1023, 1024, 2101]] = True
    assert list(per_block(flags)) == [2, 1, 1]


@pytest.mark.parametrize("n_known", [0, 1])
def test_sums_take_memory_of_the_quota_and_none_without_the_beginning(n_known: int) -> None:
    options = TransferOptions(max_blob_bytes=1 << 20, memory_quota_bytes=4 << 20)
    transfers = Transfers(options, np.random.default_rng(0))
    blob = BLOB[:100_000]
    descriptor = describe(BlobKind.MAP, blob)
    for index in range(n_known):
        transfers.receive(1, Chunk(descriptor.tag, index, 0, descriptor.cut(blob, index)), 0.0)
    for number in range(300):
        transfers.receive(1, sum_chunk(blob, number), 0.0)
    least = n_known * (descriptor.n_chunks * 120 + 300 * 512)
    assert least <= transfers.incoming_memory_bytes <= least + 1024


def test_a_sum_damaged_unnoticed_is_noticed_by_the_blob_s_hash() -> None:
    transfers = Transfers(TransferOptions(), np.random.default_rng(0))
    blob = BLOB[:1000]
    descriptor = describe(BlobKind.MAP, blob)
    transfers.receive(1, Chunk(descriptor.tag, 0, 0, descriptor.cut(blob, 0)), 0.0)
    events: list[Event] = []
    n_sums = 0
    while not events and n_sums < 200:
        good = sum_chunk(blob, n_sums)
        events += transfers.receive(1, Chunk(good.tag, good.index, 0, bytes(119)), 0.0)
        n_sums += 1
    assert events == [ReceptionAbandoned(1, BlobKind.MAP, "damaged every time")]
    assert 3 * 8 < n_sums < 100
    assert transfers.incoming_memory_bytes == 0
