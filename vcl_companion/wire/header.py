"""What every payload and every blob starts with: protocol version and kind.

Version and kind stay the first two bytes in every version to come, so that a
peer of another version is recognised as such and never misread.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from vcl_companion.errors import WireError

PROTOCOL_VERSION = 3
MAX_PAYLOAD_BYTES = 128  # of one MAVLink TUNNEL
MAX_BLOB_BYTES = 8 * 1024 * 1024

# | offset | type | field                                  |
# | 0      | u8   | protocol version                       |
# | 1      | u8   | kind (``PayloadKind`` or ``BlobKind``) |
_HEADER = struct.Struct("<BB")
HEADER_BYTES = _HEADER.size


class PayloadKind(IntEnum):
    """What one TUNNEL payload holds."""

    CHUNK = 1
    TRANSFER_STATUS = 2
    FRAME_REQUEST = 3
    MAP_STATE = 4
    MAP_REFUSED = 5
    POSE_PROPOSAL = 6
    POSE_REFUSED = 7


class BlobKind(IntEnum):
    """What a blob holds; the numbers are disjoint from ``PayloadKind``."""

    FRAME_ANSWER = 65
    MAP = 66
    POSE_REQUEST = 67
    MAP_UPDATE = 68
    PASSED_FRAME = 69
    MAP_PART = 70


class VersionMismatchError(WireError):
    """The bytes are of another protocol version; ``version`` says which."""

    def __init__(self, version: int) -> None:
        super().__init__(f"peer speaks protocol version {version}, this is {PROTOCOL_VERSION}")
        self.version = version


def encode_header(kind: PayloadKind | BlobKind) -> bytes:
    """Return the two bytes that go before a payload's or a blob's body."""
    return _HEADER.pack(PROTOCOL_VERSION, kind)


def decode_header(data: bytes) -> int:
    """Return the kind of a payload or blob, unchecked; the body starts at ``HEADER_BYTES``.

    Raises:
        VersionMismatchError: the bytes are of another version.
        WireError: too short for a header.
    """
    if not data:
        raise WireError("empty payload")
    if data[0] != PROTOCOL_VERSION:
        raise VersionMismatchError(data[0])
    if len(data) < HEADER_BYTES:
        raise WireError("payload ends within its header")
    return data[1]
