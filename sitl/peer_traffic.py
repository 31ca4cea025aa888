"""What drones send each other, counted by message: by name, its payload, and on the wire.

A chunk goes by what its blob holds, told in the first chunk of every transfer; which
name a payload has is the protocol's own (``PayloadKind``, ``BlobKind``). A signature is
counted as bytes and not looked at. *Payload* is what a TUNNEL carries, without its
padding; *on the wire* is the whole MAVLink frame, as a serial radio would send it
(UDP and IP add 28 bytes).
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache

from vcl_companion.errors import WireError
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import COMPONENT_COMPANION, Tunnel
from vcl_companion.wire.chunks import Chunk, decode_descriptor
from vcl_companion.wire.header import PayloadKind, decode_header
from vcl_companion.wire.tunnel import decode_payload, is_ours

# Copies of one frame to several peers come close together; transfers under way are few.
_REMEMBERED_FRAMES = 256
_REMEMBERED_TAGS = 4096


@dataclass
class Traffic:
    """How much of one kind of message was sent."""

    messages: int = 0
    payload_bytes: int = 0
    wire_bytes: int = 0


class PeerTraffic:
    """Counts what each drone sends; bytes that are no message of ours have a name as well.

    Attributes:
        sent: drone to name of a message to how much of it.
    """

    def __init__(self) -> None:
        self.sent: dict[str, dict[str, Traffic]] = {}
        self._codec = Codec(0, COMPONENT_COMPANION, LinkTally())
        self._blobs: OrderedDict[int, str] = OrderedDict()
        self._read_once = lru_cache(_REMEMBERED_FRAMES)(self._read)

    def count(self, sender: str, datagram: bytes) -> None:
        """Count one datagram that a drone sent to one peer."""
        name, payload_bytes = self._read_once(datagram)
        traffic = self.sent.setdefault(sender, {}).setdefault(name, Traffic())
        traffic.messages += 1
        traffic.payload_bytes += payload_bytes
        traffic.wire_bytes += len(datagram)

    def _read(self, datagram: bytes) -> tuple[str, int]:
        """Return the name and the payload's length of the one message in a datagram."""
        match self._codec.decode_datagram(datagram):
            case [Tunnel() as tunnel]:
                return self._name(tunnel), len(tunnel.payload)
            case [message]:
                return type(message).__name__.lower(), 0
        return "other", 0

    def _name(self, tunnel: Tunnel) -> str:
        if not is_ours(tunnel.payload_type):
            return "other"
        try:
            message = decode_payload(tunnel.payload_type, tunnel.payload)
            if isinstance(message, Chunk):
                return f"chunk: {self._blob(message)}"
            return _readable(PayloadKind(decode_header(tunnel.payload)).name)
        except WireError:
            return "malformed"

    def _blob(self, chunk: Chunk) -> str:
        """Return what the blob of a chunk holds; the tag alone does not tell."""
        if chunk.index == 0:
            self._blobs[chunk.tag] = _readable(decode_descriptor(chunk.data).kind.name)
            self._blobs.move_to_end(chunk.tag)
            if len(self._blobs) > _REMEMBERED_TAGS:
                self._blobs.popitem(last=False)
        return self._blobs.get(chunk.tag, "not known")


def _readable(name: str) -> str:
    return name.lower().replace("_", " ")
