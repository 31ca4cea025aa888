"""What a wrong or hostile peer can send must cost it, not us."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.swarm.network import Network
from tests.wire.strategies import chunks, statuses
from vcl_companion.swarm.budget import FRAME_OVERHEAD_BYTES
from vcl_companion.swarm.transfer import (
    BlobHeld,
    BlobKind,
    BlobReceived,
    Event,
    ReceptionAbandoned,
    TransferFailed,
    TransferOptions,
    Transfers,
)
from vcl_companion.wire.chunks import (
    CHUNK_DATA_BYTES,
    MAX_CHUNKS,
    Chunk,
    Descriptor,
    Reply,
    TransferStatus,
    describe,
)
from vcl_companion.wire.tunnel import decode_payload

MIB = 1 << 20
SMALL = TransferOptions(max_blob_bytes=MIB, memory_quota_bytes=4 * MIB)
BLOB = np.random.default_rng(0).bytes(5_000)


def transfers_with(options: TransferOptions) -> Transfers:
    return Transfers(options, np.random.default_rng(0))


def full_chunk(tag: int, index: int, ask: int = 0) -> Chunk:
    return Chunk(tag, index, ask, bytes(CHUNK_DATA_BYTES))


def replies(transfers: Transfers, now_s: float) -> list[Reply]:
    outgoing, _ = transfers.poll(now_s)
    messages = [decode_payload(sent.payload_type, sent.payload) for sent in outgoing]
    return [message.reply for message in messages if isinstance(message, TransferStatus)]


def test_memory_stays_within_the_quota_whatever_is_begun() -> None:
    transfers = transfers_with(SMALL)
    tracemalloc.start()
    for peer in range(1, 251, 6):
        for tag in range(12):
            for index in (0, 1, 5, 60, 2_000, MAX_CHUNKS - 1):
                transfers.receive(peer, full_chunk(tag, index, ask=1), 0.0)
                assert transfers.incoming_memory_bytes <= 4 * MIB
        transfers.poll(0.0)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert MIB < peak_bytes < 9 * MIB  # the quota, a copy while one grows, answers owed


def test_what_one_peer_has_finished_does_not_make_another_s_be_forgotten() -> None:
    """Its late chunks would begin it anew, and it would be taken twice."""
    transfers = transfers_with(SMALL)

    def give(peer: int, blob: bytes) -> list[Event]:
        descriptor = describe(BlobKind.MAP, blob)
        chunks = range(descriptor.n_chunks)
        return [
            event
            for i in chunks
            for event in transfers.receive(
                peer, Chunk(descriptor.tag, i, 0, descriptor.cut(blob, i)), 0.0
            )
        ]

    assert give(2, BLOB) == [BlobReceived(2, BlobKind.MAP, BLOB)]
    for n in range(3000):
        assert give(1, b"junk %d" % n)
    assert give(2, BLOB) == []
    assert give(1, b"junk 2999") == []


def test_one_peer_gets_half_of_the_memory_and_others_still_get_through() -> None:
    transfers = transfers_with(SMALL)
    for tag in range(4):
        liar = Descriptor(BlobKind.MAP, MIB, bytes([tag]) * 32)
        transfers.receive(1, Chunk(liar.tag, 0, 0, liar.encode() + bytes(82)), 0.0)
    assert MIB < transfers.incoming_memory_bytes <= 2 * MIB
    honest = describe(BlobKind.MAP, BLOB)
    events = []
    for index in range(honest.n_chunks):
        events += transfers.receive(2, Chunk(honest.tag, index, 0, honest.cut(BLOB, index)), 0.1)
    assert events == [BlobReceived(2, BlobKind.MAP, BLOB)]


def test_unfinished_blobs_are_bounded_per_peer_and_make_room_when_idle() -> None:
    transfers = transfers_with(TransferOptions())
    for tag in range(4):
        transfers.receive(1, full_chunk(tag, 1), 0.0)
    before = transfers.incoming_memory_bytes
    transfers.receive(1, full_chunk(99, 1, ask=1), 0.1)
    assert transfers.incoming_memory_bytes == before
    assert replies(transfers, 1.0) == [Reply.BUSY]
    events = transfers.receive(1, full_chunk(99, 1, ask=1), 20.0)
    assert [type(event) for event in events] == [ReceptionAbandoned]
    assert replies(transfers, 21.0) == [Reply.RECEIVING]


def test_an_unfinished_blob_expires() -> None:
    transfers = transfers_with(TransferOptions(keep_partial_s=10.0))
    transfers.receive(1, full_chunk(5, 3), 0.0)
    assert transfers.next_poll_s() == 10.0
    assert transfers.poll(9.9) == ([], [])
    assert transfers.poll(10.0)[1] == [ReceptionAbandoned(1, None, "nothing came for 10 s")]
    assert transfers.incoming_memory_bytes == 0
    assert transfers.next_poll_s() is None


def test_a_blob_longer_than_allowed_is_refused_at_its_first_chunk() -> None:
    transfers = transfers_with(SMALL)
    long = Descriptor(BlobKind.MAP, MIB + 1, bytes(32))
    events = transfers.receive(1, Chunk(long.tag, 0, 1, long.encode() + bytes(82)), 0.0)
    assert events == [ReceptionAbandoned(1, None, "longer than allowed")]
    assert replies(transfers, 1.0) == [Reply.TOO_LARGE]
    assert transfers.incoming_memory_bytes == 0


def test_a_refusal_ends_the_transfer_at_its_sender() -> None:
    network = Network()
    sender = network.add(1)
    network.drones[2] = transfers_with(SMALL)
    sender.submit(2, BlobKind.MAP, bytes(MIB + 1), network.now_s)
    network.run(200.0, stop=lambda: bool(network.ends()))
    assert network.ends() == [TransferFailed(2, 1, "peer 2 refuses the blob: too large")]
    assert network.n_bytes < 100_000


def test_a_peer_that_never_has_enough_is_given_up() -> None:
    """It says all is missing, then all but one, and so on: progress for ever, but no end."""
    transfers = transfers_with(TransferOptions())
    transfers.submit(2, BlobKind.MAP, BLOB[:100], 0.0)
    now_s, n_sent = 0.0, 0
    failures: list[Event] = []
    while not failures and now_s < 10_000.0:
        at_s = transfers.next_poll_s()
        assert at_s is not None
        now_s = max(now_s, at_s)
        outgoing, events = transfers.poll(now_s)
        failures += events
        n_sent += len(outgoing)
        for sent in outgoing:
            chunk = decode_payload(sent.payload_type, sent.payload)
            if isinstance(chunk, Chunk) and chunk.ask:
                missing = ((0, 2),) if n_sent % 2 else ((1, 2),)
                status = TransferStatus(chunk.tag, Reply.RECEIVING, chunk.ask, 0, 2, missing)
                failures += transfers.receive(2, status, now_s)
    assert failures == [TransferFailed(2, 1, "peer 2 is still missing parts after 1201 payloads")]


def test_answers_of_a_stranger_change_nothing() -> None:
    network = Network(options=TransferOptions(rate_bytes_per_s=2_000.0, burst_bytes=158))
    sender = network.add(1)
    network.add(2)
    sender.submit(2, BlobKind.MAP, BLOB, network.now_s)
    tag = describe(BlobKind.MAP, BLOB).tag
    digest = describe(BlobKind.MAP, BLOB).short_digest
    network.run(101.0)
    assert network.ends() == []
    for status in (
        TransferStatus(tag, Reply.COMPLETE, 1, digest=digest),
        TransferStatus(tag, Reply.CORRUPT, 1),
    ):
        events = sender.receive(3, status, network.now_s)
        assert all(isinstance(event, BlobHeld) for event in events)  # what it says of itself
    assert network.ends() == []
    wrong = TransferStatus(tag, Reply.COMPLETE, 1, digest=bytes(8))
    assert sender.receive(2, wrong, network.now_s) == []
    network.run(200.0, stop=lambda: bool(network.ends()))
    assert network.blobs(2) == [BLOB]


def whole_blob(transfers: Transfers, peer: int) -> list[Event]:
    """Hand in every chunk of ``BLOB``."""
    descriptor = describe(BlobKind.MAP, BLOB)
    events: list[Event] = []
    for index in range(descriptor.n_chunks):
        chunk = Chunk(descriptor.tag, index, 0, descriptor.cut(BLOB, index))
        events += transfers.receive(peer, chunk, 1.0)
    return events


def test_a_damaged_descriptor_is_dropped_and_a_good_one_still_counts() -> None:
    transfers = transfers_with(TransferOptions())
    descriptor = describe(BlobKind.MAP, BLOB)
    begins = bytearray(descriptor.cut(BLOB, 0))
    for at in (0, 3, 20):  # kind, length, hash
        begins[at] ^= 0x03
        assert transfers.receive(1, Chunk(descriptor.tag, 0, 0, bytes(begins)), 0.0) == []
        begins[at] ^= 0x03
    assert whole_blob(transfers, 1) == [BlobReceived(1, BlobKind.MAP, BLOB)]


def test_a_chunk_that_cannot_be_of_this_blob_does_not_stop_it() -> None:
    transfers = transfers_with(TransferOptions())
    tag = describe(BlobKind.MAP, BLOB).tag
    transfers.receive(1, full_chunk(tag, 5_000), 0.0)
    assert whole_blob(transfers, 1) == [BlobReceived(1, BlobKind.MAP, BLOB)]


def test_an_answer_overtaken_by_a_newer_one_repeats_nothing() -> None:
    transfers = transfers_with(TransferOptions())
    transfers.submit(2, BlobKind.MAP, BLOB, 0.0)
    tag, n_chunks = describe(BlobKind.MAP, BLOB).tag, describe(BlobKind.MAP, BLOB).n_chunks
    outgoing, _ = transfers.poll(0.0)
    sent = [decode_payload(out.payload_type, out.payload) for out in outgoing]
    asks = [chunk.ask for chunk in sent if isinstance(chunk, Chunk) and chunk.ask]
    assert len(sent) == n_chunks
    assert len(asks) == 2
    newer = TransferStatus(tag, Reply.RECEIVING, asks[1], 0, n_chunks, ((7, 8),))
    older = TransferStatus(tag, Reply.RECEIVING, asks[0], 0, n_chunks, ((0, 1),))
    assert transfers.receive(2, newer, 0.1) == transfers.receive(2, older, 0.1) == []
    repeated = [decode_payload(out.payload_type, out.payload) for out in transfers.poll(0.1)[0]]
    assert [chunk.index for chunk in repeated if isinstance(chunk, Chunk)] == [7]


@given(st.lists(st.tuples(st.integers(1, 3), st.one_of(chunks, statuses)), max_size=40))
@settings(max_examples=60)
def test_any_messages_between_honest_ones_do_no_harm(
    messages: list[tuple[int, Chunk | TransferStatus]],
) -> None:
    """Strangers 3 to 5 say anything; peers 1 and 2 still get their blob across."""
    network = Network(options=SMALL)
    network.add(1)
    network.add(2)
    network.drones[1].submit(2, BlobKind.MAP, BLOB, network.now_s)
    for k, (stranger, message) in enumerate(messages):
        for drone in (1, 2):
            network.drones[drone].receive(stranger + 2, message, network.now_s)
        network.run(100.0 + 0.001 * k)
    network.run(500.0)
    assert network.blobs(2) == [BLOB]
    assert network.drones[2].incoming_memory_bytes == 0


def beginning(kind: BlobKind, blob: bytes) -> Chunk:
    descriptor = describe(kind, blob)
    return Chunk(descriptor.tag, 0, 0, descriptor.cut(blob, 0))


@pytest.mark.parametrize(
    ("older", "newer"),
    [
        (BlobKind.MAP, BlobKind.MAP_UPDATE),
        (BlobKind.MAP_UPDATE, BlobKind.MAP),
        (BlobKind.POSE_REQUEST, BlobKind.POSE_REQUEST),
        (BlobKind.FRAME_ANSWER, BlobKind.FRAME_ANSWER),
    ],
)
def test_what_a_sender_began_before_its_newest_is_dropped_when_silent(
    older: BlobKind, newer: BlobKind
) -> None:
    transfers = transfers_with(TransferOptions())
    transfers.receive(1, beginning(older, BLOB), 0.0)
    transfers.receive(2, beginning(older, BLOB), 0.0)  # another sender's, which it still means
    transfers.receive(1, beginning(newer, BLOB[1:]), 1.0)
    assert transfers.poll(1.9) == ([], [])
    assert transfers.next_poll_s() == 2.0
    assert transfers.poll(2.0)[1] == [
        ReceptionAbandoned(1, older, "its sender has begun a newer one")
    ]
    assert transfers.poll(60.0) == ([], [])


def test_frames_that_are_passed_on_come_several_at_a_time() -> None:
    transfers = transfers_with(TransferOptions())
    for k in range(3):
        transfers.receive(1, beginning(BlobKind.PASSED_FRAME, BLOB[k:]), 0.0)
    assert transfers.poll(60.0) == ([], [])


def test_an_older_map_that_still_comes_in_is_kept() -> None:
    transfers = transfers_with(TransferOptions())
    transfers.receive(1, beginning(BlobKind.MAP, BLOB), 0.0)
    transfers.receive(1, beginning(BlobKind.MAP, BLOB[1:]), 0.1)
    descriptor = describe(BlobKind.MAP, BLOB)
    events: list[Event] = []
    for index in range(1, descriptor.n_chunks):
        assert transfers.poll(float(index))[1] == (
            [ReceptionAbandoned(1, BlobKind.MAP, "nothing came for 120 s")] if index > 120 else []
        )
        chunk = Chunk(descriptor.tag, index, 0, descriptor.cut(BLOB, index))
        events += transfers.receive(1, chunk, float(index))
    assert events == [BlobReceived(1, BlobKind.MAP, BLOB)]


@pytest.mark.parametrize("n_tags", [50, 10_000])
def test_who_asks_all_the_time_gets_a_quarter_of_what_may_be_said(n_tags: int) -> None:
    options = TransferOptions(profile="radio-57k")
    transfers = transfers_with(options)
    n_bytes, ends_s = {1: 0, 2: 0}, 100.0
    answered: list[float] = []
    whole = describe(BlobKind.MAP, BLOB)
    for index in range(whole.n_chunks):
        transfers.receive(1, Chunk(whole.tag, index, 0, whole.cut(BLOB, index)), 0.0)
    for step in range(10_000):
        now_s = step * ends_s / 10_000
        transfers.receive(1, full_chunk(step % n_tags, 3, ask=1), now_s)
        transfers.receive(1, Chunk(whole.tag, 0, 1, whole.cut(BLOB, 0)), now_s)
        if step % 100 == 0:
            transfers.receive(2, full_chunk(7, step // 100, ask=1), now_s)
        for sent in transfers.poll(now_s)[0]:
            n_bytes[sent.peer] += len(sent.payload) + FRAME_OVERHEAD_BYTES
            answered += [now_s] if sent.peer == 2 else []
    assert 0.2 < n_bytes[1] / (options.pace.rate_bytes_per_s * ends_s) < 0.3
    assert len(answered) > 60


def test_what_is_sent_to_all_begins_nothing() -> None:
    transfers = transfers_with(TransferOptions())
    descriptor = describe(BlobKind.MAP, BLOB)
    for index in range(descriptor.n_chunks):
        chunk = Chunk(descriptor.tag, index, 1, descriptor.cut(BLOB, index))
        assert transfers.receive(1, chunk, 0.0, to_all=True) == []
    assert transfers.incoming_memory_bytes == 0
    assert transfers.next_poll_s() is None
