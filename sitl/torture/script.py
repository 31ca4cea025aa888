"""What hostile peers send, datagram by datagram: transfers that overlap, messages, and noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

from sitl.torture.dice import Dice
from sitl.torture.frames import Payload, frame, hostile, tunnel
from sitl.torture.mutations import mutated
from sitl.torture.valid import Overheard, Valid
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.chunks import Chunk, Descriptor, describe
from vcl_companion.wire.tunnel import encode_payload

_N_OVERLAPPING = 4
# Shares of what is sent.
_HEARTBEATS, _MESSAGES = 0.02, 0.35
_HOSTILE_MESSAGES, _HOSTILE_CHUNKS = 0.3, 0.002
_WRONG_MESSAGES, _WRONG_CHUNKS, _WRONG_BLOBS = 0.65, 0.01, 0.7
_WRONG_DESCRIPTORS, _SHUFFLED, _REPEATED, _INCOMPLETE = 0.04, 0.3, 0.2, 0.04
_ASKS = 0.05
# Of the blobs: only who coordinates is heard on maps.
_COORDINATORS = 0.4
# Of the chunks that were sent wrong: as a sender does that is told what is missing.
_AGAIN = 0.9


@dataclass
class _Stream:
    """Chunks of a blob that are still to be sent, the next one last."""

    peer: int
    chunks: list[Payload]


class Script:
    """Makes one datagram after the other; see the module.

    Args:
        dice: decides.
        own: the drone that it all goes to.
        peers: who speak.
        heard: what they know of the drone.
    """

    def __init__(self, dice: Dice, own: int, peers: tuple[int, ...], heard: Overheard) -> None:
        self._dice = dice
        self._own = own
        self._peers = peers
        self.valid = Valid(dice, peers, heard)
        self._streams: list[_Stream] = []
        self._last: Payload = self.valid.message(peers[0])
        self._last_blob = self.valid.blob(peers[0])[1]

    def next(self) -> bytes:
        """Return the next datagram."""
        dice = self._dice
        if dice.chance(_HEARTBEATS):
            return frame(0, dice.rng.bytes(9), dice.pick(self._peers))
        is_message = dice.chance(_MESSAGES)
        peer, payload = self._message() if is_message else self._chunk()
        target = self._own if dice.below(4) else 0
        self._last = payload
        if dice.chance(_HOSTILE_MESSAGES if is_message else _HOSTILE_CHUNKS):
            return hostile(payload, peer, target, dice)
        return tunnel(payload, peer, target)

    def _message(self) -> tuple[int, Payload]:
        dice = self._dice
        peer = dice.pick(self._peers)
        payload_type, data = self.valid.message(peer)
        if dice.chance(_WRONG_MESSAGES):
            data = mutated(data, dice, self._last[1])[:128]
        return peer, (payload_type, data)

    def _chunk(self) -> tuple[int, Payload]:
        dice = self._dice
        while len(self._streams) < _N_OVERLAPPING:
            self._begin()
        stream = dice.pick(self._streams)
        payload_type, data = stream.chunks.pop()
        if dice.chance(_WRONG_CHUNKS):
            if dice.chance(_AGAIN):
                stream.chunks.insert(0, (payload_type, data))
            data = mutated(data, dice, self._last[1])[:128]
        if not stream.chunks:
            self._streams.remove(stream)
        return stream.peer, (payload_type, data)

    def _begin(self) -> None:
        """Begin to send a blob, mutated or not, whole or not, in order or not."""
        dice = self._dice
        peer = self._peers[0] if dice.chance(_COORDINATORS) else dice.pick(self._peers)
        kind, blob = self.valid.blob(peer)
        if dice.chance(_WRONG_BLOBS):
            blob, self._last_blob = mutated(blob, dice, self._last_blob), blob
        chunks = self._disordered(self._chunks_of(kind, blob))
        if chunks:
            self._streams.append(_Stream(peer, chunks[::-1]))

    def _chunks_of(self, kind: BlobKind, blob: bytes) -> list[Payload]:
        dice = self._dice
        descriptor = describe(kind, blob)
        n = descriptor.n_chunks
        if dice.chance(_WRONG_DESCRIPTORS):
            descriptor = _lying(descriptor, dice)
        chunks: list[Payload] = []
        for index in range(n):
            ask = 1 + dice.below(127) if index in (0, n - 1) or dice.chance(_ASKS) else 0
            data = descriptor.cut(blob, index)
            chunks.append(encode_payload(Chunk(descriptor.tag, index, ask, data)))
        return chunks

    def _disordered(self, chunks: list[Payload]) -> list[Payload]:
        dice = self._dice
        if dice.chance(_SHUFFLED):
            dice.rng.shuffle(chunks)
        if dice.chance(_REPEATED):
            for _ in range(1 + dice.below(4)):
                chunks.insert(dice.below(len(chunks)), dice.pick(chunks))
        if dice.chance(_INCOMPLETE):
            del chunks[dice.below(len(chunks))]
        return chunks


def _lying(descriptor: Descriptor, dice: Dice) -> Descriptor:
    """Return a descriptor that is not the blob's, by itself without fault."""
    match dice.below(3):
        case 0:
            length = dice.pick((0, 1, 82, 83, 120, 1 << 16, 1 << 20, 8 << 20, dice.below(4096)))
            return replace(descriptor, length_bytes=length)
        case 1:
            return replace(descriptor, kind=dice.pick(tuple(BlobKind)))
    return replace(descriptor, digest=dice.rng.bytes(32))
