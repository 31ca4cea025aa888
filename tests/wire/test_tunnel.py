"""One payload: round trips, any bytes, other versions, and bytes that never change."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.wire.golden import assert_golden
from tests.wire.samples import small_proposal
from tests.wire.strategies import payload_values
from vcl_companion.errors import WireError
from vcl_companion.wire.chunks import CHUNK_DATA_BYTES, FIRST_SUM, Chunk, Reply, TransferStatus
from vcl_companion.wire.header import PROTOCOL_VERSION, PayloadKind, VersionMismatchError
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import PoseRefused
from vcl_companion.wire.tunnel import (
    PayloadType,
    TunnelPayload,
    decode_payload,
    encode_payload,
    is_ours,
)

_GOLDEN: dict[str, TunnelPayload] = {
    "chunk": Chunk(0x12345678, 70_000, 5, b"data of a chunk"),
    "status_receiving": TransferStatus(
        0xCAFE, Reply.RECEIVING, 9, 10, 70_000, ((10, 11), (300, 500), (69_999, 70_000))
    ),
    "status_complete": TransferStatus(0xCAFE, Reply.COMPLETE, 127, digest=bytes(range(8))),
    "chunk_sum": Chunk(0x12345678, FIRST_SUM + 1000, 0, bytes(range(119))),
    "status_lacking": TransferStatus(
        0xCAFE, Reply.LACKING, 9, first=2, end=6, counts=(0, 127, 128, 1024)
    ),
    "status_busy": TransferStatus(0xCAFE, Reply.BUSY, 1),
    "frame_request": FrameRequest(77, 123_456_789_012, 0.125),
    "map_state": MapState(bytes(range(8)), 1000, True, 517, False),
    "map_state_wants_update": MapState(bytes(range(8)), 1000, False, 0, True),
    "map_state_none": MapState(b"", 0, False),
    "map_state_of_a_team": MapState(
        bytes(range(8)),
        1000,
        True,
        517,
        False,
        7,
        0x01020307,
        bytes(range(8, 16)),
        bytes(range(48)),
    ),
    "map_refused": MapRefused(78, "zu wenig Überlappung"),
    "pose_proposal": small_proposal(),
    "pose_refused": PoseRefused(79, "3 landmarks in common"),
}


@pytest.mark.parametrize("name", _GOLDEN)
def test_golden_bytes(name: str) -> None:
    payload_type, payload = encode_payload(_GOLDEN[name])
    assert_golden(name, payload)
    assert decode_payload(payload_type, payload) == _GOLDEN[name]


@given(payload_values)
def test_round_trip(value: TunnelPayload) -> None:
    payload_type, payload = encode_payload(value)
    assert payload_type >= 32768
    assert payload[0] == PROTOCOL_VERSION
    assert len(payload) <= 128
    assert decode_payload(payload_type, payload) == value


@given(
    st.sampled_from(list(PayloadType)),
    st.sampled_from([b"", bytes([PROTOCOL_VERSION])]),
    st.one_of(st.just(b""), st.sampled_from(list(PayloadKind)).map(lambda kind: bytes([kind]))),
    st.binary(max_size=130),
)
def test_any_bytes_are_a_value_or_a_wire_error(
    payload_type: PayloadType, version: bytes, kind: bytes, body: bytes
) -> None:
    payload = version + kind + body
    try:
        value = decode_payload(payload_type, payload)
    except WireError:
        return
    assert encode_payload(value) == (payload_type, payload)


@given(payload_values, st.data())
def test_mutated_payloads_are_a_value_or_a_wire_error(
    value: TunnelPayload, data: st.DataObject
) -> None:
    payload_type, payload = encode_payload(value)
    at = data.draw(st.integers(0, len(payload) - 1))
    mutated = payload[:at] + data.draw(st.binary(max_size=4)) + payload[at + 1 :]
    try:
        again = decode_payload(payload_type, mutated)
    except WireError:
        return
    assert encode_payload(again) == (payload_type, mutated)


@given(payload_values, st.integers(0, 255).filter(lambda v: v != PROTOCOL_VERSION))
def test_another_version_is_recognised_whatever_follows(value: TunnelPayload, version: int) -> None:
    payload_type, payload = encode_payload(value)
    for theirs in (bytes([version]) + payload[1:], bytes([version])):
        with pytest.raises(VersionMismatchError, match=f"version {version}") as caught:
            decode_payload(payload_type, theirs)
        assert caught.value.version == version


def test_foreign_payload_types_and_crossed_kinds_are_refused() -> None:
    payload_type, payload = encode_payload(FrameRequest(1, 0, 0.0))
    assert is_ours(payload_type)
    assert not is_ours(0)
    with pytest.raises(WireError, match="not ours"):
        decode_payload(0, payload)
    with pytest.raises(WireError, match="came as payload type"):
        decode_payload(PayloadType.TRANSFER_DATA, payload)


def test_a_full_chunk_fills_the_payload_and_a_longer_one_is_no_chunk() -> None:
    _, payload = encode_payload(Chunk(1, 2, 0, bytes(CHUNK_DATA_BYTES)))
    assert len(payload) == 128
    with pytest.raises(ValueError, match="120 bytes"):
        Chunk(1, 2, 0, bytes(CHUNK_DATA_BYTES + 1))


@given(st.text(), st.integers(0, (1 << 32) - 1))
def test_any_text_makes_a_reason(text: str, request_id: int) -> None:
    reason = MapRefused.because(request_id, text).reason
    assert 1 <= len(reason.encode()) <= 90
    assert reason.isprintable()
    if text.isprintable() and text == text.strip() and 0 < len(text.encode()) <= 90:
        assert reason == text


@pytest.mark.parametrize(
    "make",
    [
        lambda: FrameRequest(1, 0, float("nan")),
        lambda: FrameRequest(1, 0, -0.1),
        lambda: FrameRequest(1 << 32, 0, 0.0),
        lambda: FrameRequest(1, 1 << 63, 0.0),
        lambda: FrameRequest(1, -(1 << 63) - 1, 0.0),
        lambda: MapState(b"123", 0, True),
        lambda: MapState(b"", 1 << 20, True),
        lambda: MapState(b"", 0, True, 1 << 16),
        lambda: MapState(b"", 0, True, -1),
        lambda: MapState(b"", 0, True, team=256),
        lambda: MapState(b"", 0, True, epoch=1 << 32),
        lambda: MapState(b"", 0, True, epoch=-1),
        lambda: MapState(b"", 0, True, world=b"123"),
        lambda: MapState(b"", 0, True, world=bytes(8)),
        lambda: MapState(b"", 0, True, signature=bytes(49)),
        lambda: MapRefused(1, "two\nlines"),
        lambda: MapRefused(1, ""),
        lambda: PoseRefused(1, "two\nlines"),
        lambda: PoseRefused(-1, "why"),
        lambda: TransferStatus(1, Reply.RECEIVING, 1, 0, 10, ((5, 5),)),
        lambda: TransferStatus(1, Reply.RECEIVING, 1, 0, 10, ((5, 6), (6, 7))),
        lambda: TransferStatus(1, Reply.RECEIVING, 1, 0, 10, ((5, 11),)),
        lambda: TransferStatus(1, Reply.COMPLETE, 1),
        lambda: TransferStatus(1, Reply.BUSY, 0),
    ],
)
def test_values_out_of_bounds_cannot_be_made(make: object) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=r"\w"):
        make()


def test_a_state_that_differs_only_in_how_much_is_seen_is_no_news() -> None:
    said = MapState(bytes(range(8)), 1000, True, 517, world=bytes(range(1, 9)))
    assert not replace(said, tracked=3, n_landmarks=7, signature=b"seen").is_news_after(said)
    for changed in (
        replace(said, revision=bytes(8)),
        replace(said, localized=False),
        replace(said, wants_update=True),
        replace(said, team=2),
        replace(said, epoch=1),
        replace(said, world=b""),
    ):
        assert changed.is_news_after(said)
