"""One TUNNEL payload to one message and back; the one place of payload types."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

from vcl_companion.errors import WireError
from vcl_companion.wire.chunks import (
    Chunk,
    TransferStatus,
    decode_chunk,
    decode_status,
    encode_chunk,
    encode_status,
)
from vcl_companion.wire.header import (
    HEADER_BYTES,
    MAX_PAYLOAD_BYTES,
    PayloadKind,
    decode_header,
    encode_header,
)
from vcl_companion.wire.messages import (
    FrameRequest,
    MapRefused,
    MapState,
    decode_frame_request,
    decode_map_refused,
    decode_map_state,
    encode_frame_request,
    encode_map_refused,
    encode_map_state,
)
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRefused,
    decode_pose_proposal,
    decode_pose_refused,
    encode_pose_proposal,
    encode_pose_refused,
)


class PayloadType(IntEnum):
    """MAVLink TUNNEL payload types, from the range for private use (32768 and above).

    Two of them, so that a router or a link can tell bulk from the rest.
    """

    TRANSFER_DATA = 33100
    MESSAGE = 33101


TunnelPayload = (
    Chunk | TransferStatus | FrameRequest | MapState | MapRefused | PoseProposal | PoseRefused
)

_DECODERS: dict[int, tuple[PayloadType, Callable[[bytes], TunnelPayload]]] = {
    PayloadKind.CHUNK: (PayloadType.TRANSFER_DATA, decode_chunk),
    PayloadKind.TRANSFER_STATUS: (PayloadType.MESSAGE, decode_status),
    PayloadKind.FRAME_REQUEST: (PayloadType.MESSAGE, decode_frame_request),
    PayloadKind.MAP_STATE: (PayloadType.MESSAGE, decode_map_state),
    PayloadKind.MAP_REFUSED: (PayloadType.MESSAGE, decode_map_refused),
    PayloadKind.POSE_PROPOSAL: (PayloadType.MESSAGE, decode_pose_proposal),
    PayloadKind.POSE_REFUSED: (PayloadType.MESSAGE, decode_pose_refused),
}


def is_ours(payload_type: int) -> bool:
    """Return whether a TUNNEL of this payload type is for us at all; others are not wrong."""
    return payload_type in tuple(PayloadType)


def encode_payload(message: TunnelPayload) -> tuple[PayloadType, bytes]:
    """Return payload type and payload of one message, at most 128 bytes."""
    match message:
        case Chunk():
            kind, body = PayloadKind.CHUNK, encode_chunk(message)
        case TransferStatus():
            kind, body = PayloadKind.TRANSFER_STATUS, encode_status(message)
        case FrameRequest():
            kind, body = PayloadKind.FRAME_REQUEST, encode_frame_request(message)
        case MapState():
            kind, body = PayloadKind.MAP_STATE, encode_map_state(message)
        case MapRefused():
            kind, body = PayloadKind.MAP_REFUSED, encode_map_refused(message)
        case PoseProposal():
            kind, body = PayloadKind.POSE_PROPOSAL, encode_pose_proposal(message)
        case PoseRefused():
            kind, body = PayloadKind.POSE_REFUSED, encode_pose_refused(message)
    return _DECODERS[kind][0], encode_header(kind) + body


def decode_payload(payload_type: int, payload: bytes) -> TunnelPayload:
    """Return the message of one TUNNEL payload.

    Raises:
        VersionMismatchError: the peer speaks another protocol version.
        WireError: anything else that is wrong with it.
    """
    if not is_ours(payload_type):
        raise WireError(f"payload type {payload_type} is not ours")
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise WireError(f"a payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    kind = decode_header(payload)
    expected_type, decode = _DECODERS.get(kind, (None, None))
    if decode is None:
        raise WireError(f"unknown payload kind {kind}")
    if payload_type != expected_type:
        raise WireError(f"payload kind {kind} came as payload type {payload_type}")
    return decode(payload[HEADER_BYTES:])
