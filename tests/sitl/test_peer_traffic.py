"""What a flight's daemons send, told apart message by message, by frames as they really are."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.peer_traffic import PeerTraffic, Traffic
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import COMPONENT_COMPANION
from vcl_companion.wire.chunks import Chunk, Reply, TransferStatus, describe
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.messages import FrameRequest, MapState
from vcl_companion.wire.pose_messages import PoseRefused
from vcl_companion.wire.tunnel import PayloadType, TunnelPayload, encode_payload

BLOB = bytes(range(250))


def codec() -> Codec:
    return Codec(1, COMPONENT_COMPANION, LinkTally())


def frame(message: TunnelPayload) -> bytes:
    return codec().tunnel(2, *encode_payload(message))


def signed(message: TunnelPayload) -> bytes:
    payload_type, payload = encode_payload(message)
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=COMPONENT_COMPANION)
    mav.signing.secret_key = bytes(range(32))
    mav.signing.sign_outgoing = True
    tunnel = dialect.MAVLink_tunnel_message(
        2, COMPONENT_COMPANION, payload_type, len(payload), payload.ljust(128, b"\0")
    )
    return bytes(tunnel.pack(mav))


def names(*datagrams: bytes) -> list[str]:
    """Return what each of some datagrams of one drone is called."""
    out = []
    for datagram in datagrams:
        traffic = PeerTraffic()
        traffic.count("mav0", datagram)
        out += list(traffic.sent["mav0"])
    return out


def chunks(kind: BlobKind) -> list[Chunk]:
    descriptor = describe(kind, BLOB)
    return [
        Chunk(descriptor.tag, n, 0, descriptor.cut(BLOB, n)) for n in range(descriptor.n_chunks)
    ]


def test_every_message_has_its_name() -> None:
    assert names(
        frame(MapState(b"", 0, False)),
        frame(FrameRequest(7, 1_000, 0.5)),
        frame(PoseRefused(7, "no overlap")),
        frame(TransferStatus(9, Reply.BUSY, 1)),
        codec().heartbeat(4),
        codec().timesync(0, 12345),
        codec().status_text(4, b"hello", 0, 0),
    ) == [
        "map state", "frame request", "pose refused", "transfer status", "heartbeat", "timesync",
        "statustext",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", list(BlobKind))
def test_chunks_go_by_what_their_blob_holds(kind: BlobKind) -> None:
    traffic = PeerTraffic()
    sent = chunks(kind)
    assert len(sent) == 3
    for chunk in sent:
        traffic.count("mav1", frame(chunk))
    stream = 37 + len(BLOB)
    expected = Traffic(3, stream + 3 * 9, sum(len(frame(chunk)) for chunk in sent))
    assert traffic.sent == {"mav1": {f"chunk: {kind.name.lower().replace('_', ' ')}": expected}}


def test_copies_to_several_peers_and_of_several_drones_are_counted_each() -> None:
    traffic = PeerTraffic()
    heartbeat, state = codec().heartbeat(4), frame(MapState(b"", 0, False))
    for sender in ("mav0", "mav0", "mav1"):
        traffic.count(sender, heartbeat)
    traffic.count("mav1", state)
    assert traffic.sent["mav0"] == {"heartbeat": Traffic(2, 0, 2 * len(heartbeat))}
    assert traffic.sent["mav1"]["heartbeat"].messages == 1
    assert traffic.sent["mav1"]["map state"] == Traffic(1, 33, len(state))


def test_a_signature_is_thirteen_bytes_more_and_changes_nothing_else() -> None:
    traffic = PeerTraffic()
    messages: list[TunnelPayload] = [MapState(b"", 0, False), *chunks(BlobKind.MAP)]
    for message in messages:
        traffic.count("plain", frame(message))
        traffic.count("signed", signed(message))
    plain, with_signature = traffic.sent["plain"], traffic.sent["signed"]
    assert plain.keys() == with_signature.keys() == {"map state", "chunk: map"}
    for name, one in plain.items():
        other = with_signature[name]
        assert (other.messages, other.payload_bytes) == (one.messages, one.payload_bytes)
        assert other.wire_bytes == one.wire_bytes + 13 * one.messages


def test_what_cannot_be_told_has_a_name_as_well() -> None:
    broken = bytearray(frame(MapState(b"", 0, False)))
    broken[-1] ^= 0xFF
    assert names(
        frame(chunks(BlobKind.MAP)[1]),
        frame(Chunk(5, 0, 0, b"no descriptor")),
        codec().tunnel(2, PayloadType.MESSAGE, b"\x09\x09"),
        codec().tunnel(2, PayloadType.MESSAGE, b""),
        codec().tunnel(2, 40000, b"somebody else's"),
        bytes(broken),
        codec().heartbeat(4) * 2,
        b"",
    ) == [
        "chunk: not known", "malformed", "malformed", "malformed", "other", "other", "other",
        "other",
    ]  # fmt: skip


@given(st.lists(st.binary(max_size=300), max_size=20))
def test_any_bytes_are_counted_whole(datagrams: list[bytes]) -> None:
    traffic = PeerTraffic()
    for datagram in datagrams:
        traffic.count("mav0", datagram)
    counted = traffic.sent.get("mav0", {}).values()
    assert sum(one.messages for one in counted) == len(datagrams)
    assert sum(one.wire_bytes for one in counted) == sum(map(len, datagrams))
