"""Blobs on their way in, from many peers: reassembly, integrity, quotas.

A receiver only ever answers: it sends nothing that a chunk did not ask for. It
keeps an unfinished blob for a while, so that a sender that comes back (after a
gap, or restarted) goes on where it was, and remembers finished ones, so that
late chunks do not begin them anew. A blob begins with a chunk that was sent to
us alone: of what is sent to all, the rest is not meant for us, and costs nothing.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

from vcl_companion.errors import WireError
from vcl_companion.swarm.owed_answers import MAX_STATUSES, Key, OwedAnswers
from vcl_companion.swarm.reassembly import (
    CHUNK_COST_BYTES,
    FIXED_COST_BYTES,
    SUM_COST_BYTES,
    Incoming,
)
from vcl_companion.swarm.transfer_options import TransferOptions
from vcl_companion.wire.chunks import (
    CHUNK_DATA_BYTES,
    FIRST_SUM,
    Chunk,
    Descriptor,
    Reply,
    TransferStatus,
    decode_descriptor,
    lacking_statuses,
    receiving_statuses,
)
from vcl_companion.wire.header import BlobKind

_MAX_DAMAGED = 3  # whole blobs with a wrong hash before a transfer is refused
# Remembered finished transfers, of all peers and of one: in 120 s two a second.
_MAX_SETTLED, _MAX_SETTLED_OF_ONE = 1024, 240
_IDLE_SHARE = 0.25  # of the give-up time: silent for this long, and memory may be taken
# A sender that still means a blob asks every five status intervals at the least.
_SUPERSEDED_INTERVALS = 10.0
# Of these a sender has one for us at a time, the newest; a map is sent in one form of three.
_ONE_AT_A_TIME = {
    BlobKind.MAP: BlobKind.MAP,
    BlobKind.MAP_UPDATE: BlobKind.MAP,
    BlobKind.MAP_PART: BlobKind.MAP,
    BlobKind.FRAME_ANSWER: BlobKind.FRAME_ANSWER,
    BlobKind.POSE_REQUEST: BlobKind.POSE_REQUEST,
}


@dataclass(frozen=True)
class BlobReceived:
    """A peer's blob arrived whole and undamaged."""

    peer: int
    kind: BlobKind
    blob: bytes


@dataclass(frozen=True)
class ReceptionAbandoned:
    """A blob that a peer began will not be finished; ``kind`` is None if it never said."""

    peer: int
    kind: BlobKind | None
    reason: str


ReceptionEvent = BlobReceived | ReceptionAbandoned


@dataclass(frozen=True)
class _Settled:
    """How a transfer ended here, for chunks that still come."""

    reply: Reply
    digest: bytes
    until_s: float  # remembered for so long


class Receptions:
    """All blobs on their way in."""

    def __init__(self, options: TransferOptions) -> None:
        self._options = options
        self._incoming: dict[Key, Incoming] = {}
        self._settled: dict[Key, _Settled] = {}
        self._answers = OwedAnswers(options.pace)
        self._newest: dict[tuple[int, BlobKind], int] = {}  # tag of what a peer began last

    @property
    def memory_bytes(self) -> int:
        """Memory that unfinished blobs take."""
        return sum(incoming.cost_bytes for incoming in self._incoming.values())

    def receive(
        self, peer: int, chunk: Chunk, now_s: float, *, to_all: bool = False
    ) -> list[ReceptionEvent]:
        """Take in a chunk that was sent to us, or to all; return what ended by it."""
        key = (peer, chunk.tag)
        if to_all and not self._is_begun(key):
            return []
        settled = self._settled.get(key)
        if settled is not None and now_s < settled.until_s:
            if chunk.ask:
                self._answers.owe_now(key, chunk.ask, now_s)
            return []
        self._settled.pop(key, None)
        events: list[ReceptionEvent] = []
        incoming = self._open(key, now_s, events)
        if incoming is not None:
            incoming.is_for_several |= to_all
            self._store(key, incoming, chunk, now_s, events)
        if key in self._settled:
            self._answers.owe_now(key, max(chunk.ask, 1), now_s)  # news: no need to be asked
        else:
            answered_at_s = -math.inf if incoming is None else incoming.answered_at_s
            self._answers.note_ask(key, chunk, now_s, answered_at_s)
        return events

    def forget(self, peer: int, tag: int, at_s: float) -> None:
        """Remember only until then that a blob has come: it may be of use later."""
        settled = self._settled.get((peer, tag))
        if settled is not None:
            until_s = min(settled.until_s, at_s)
            self._settled[peer, tag] = replace(settled, until_s=until_s)

    def is_receiving(self, kind: BlobKind, now_s: float) -> bool:
        """Whether an unfinished blob of a kind was heard of within the give-up time.

        A map is coming in whatever its form.
        """
        return any(
            incoming.descriptor is not None
            and kind in (incoming.descriptor.kind, _ONE_AT_A_TIME.get(incoming.descriptor.kind))
            and now_s - incoming.heard_at_s < self._options.pace.give_up_s
            for incoming in self._incoming.values()
        )

    def answers(self, now_s: float) -> list[tuple[int, TransferStatus]]:
        """Return the (peer, status) that are due; what is returned counts as sent."""

        def answered(key: Key, ask: int) -> list[TransferStatus]:
            statuses = self._statuses(key, ask)
            if key in self._incoming:
                self._incoming[key].answered_at_s = now_s
            return statuses

        return self._answers.take_due(now_s, answered)

    def expire(self, now_s: float) -> list[ReceptionEvent]:
        """Drop unfinished blobs that nobody goes on with."""
        old = [key for key in self._incoming if now_s >= self._expires_at_s(key)]
        return [
            self._abandon(
                key,
                "its sender has begun a newer one"
                if self._is_superseded(key)
                else f"nothing came for {self._options.keep_partial_s:g} s",
            )
            for key in old
        ]

    def next_s(self) -> float:
        """Return when an answer is due or a blob expires; infinity for never."""
        return min([self._answers.next_s(), *map(self._expires_at_s, self._incoming)])

    def _expires_at_s(self, key: Key) -> float:
        """Return when an unfinished blob is dropped if nothing comes of it until then."""
        keep_s = self._options.keep_partial_s
        if self._is_superseded(key):
            keep_s = min(keep_s, _SUPERSEDED_INTERVALS * self._options.pace.status_interval_s)
        return self._incoming[key].heard_at_s + keep_s

    def _is_superseded(self, key: Key) -> bool:
        """Whether the sender has begun another blob of which it has one at a time for us.

        It may be that this one is the newer, of which a late chunk has come after the
        other began: so neither is dropped while it is heard of.
        """
        descriptor = self._incoming[key].descriptor
        kind = None if descriptor is None else _ONE_AT_A_TIME.get(descriptor.kind)
        return kind is not None and self._newest.get((key[0], kind)) != key[1]

    def _is_begun(self, key: Key) -> bool:
        """Whether an unfinished blob is meant for us, and which chunks it has."""
        incoming = self._incoming.get(key)
        return incoming is not None and incoming.descriptor is not None

    def _open(self, key: Key, now_s: float, events: list[ReceptionEvent]) -> Incoming | None:
        """Return the unfinished blob of a chunk, a new one if need be; None if too many are."""
        incoming = self._incoming.get(key)
        if incoming is not None:
            return incoming
        of_peer = [other for other in self._incoming if other[0] == key[0]]
        if len(of_peer) >= self._options.max_incoming_per_peer and not self._evict(
            of_peer, now_s, events
        ):
            return None
        if not self._fits(key, FIXED_COST_BYTES, now_s, events):
            return None
        incoming = Incoming(now_s)
        self._incoming[key] = incoming
        return incoming

    def _store(
        self,
        key: Key,
        incoming: Incoming,
        chunk: Chunk,
        now_s: float,
        events: list[ReceptionEvent],
    ) -> None:
        """Keep a chunk of an unfinished blob; finish the blob if that was the last."""
        descriptor = incoming.descriptor
        if descriptor is None and chunk.index == 0:
            descriptor = _descriptor_of(chunk)
            if descriptor is None:
                return
            if descriptor.length_bytes > self._options.max_blob_bytes:
                events.append(self._refuse(key, Reply.TOO_LARGE, "longer than allowed", now_s))
                return
        is_sum = chunk.index >= FIRST_SUM
        if is_sum and descriptor is None:
            incoming.heard_at_s = now_s
            return
        # Without a descriptor nobody knows which chunk is the last, the only one that is short.
        full = CHUNK_DATA_BYTES
        if descriptor is not None and not is_sum:
            full = descriptor.chunk_bytes(chunk.index)
        if len(chunk.data) != full:
            return
        room = incoming.room_for(chunk.index + 1) if descriptor is None else descriptor.n_chunks
        more_bytes = (room - len(incoming.arrived)) * CHUNK_COST_BYTES + is_sum * SUM_COST_BYTES
        incoming.starved = not self._fits(key, more_bytes, now_s, events)
        if incoming.starved:
            return
        if descriptor is not None and incoming.end > descriptor.n_chunks:
            incoming.begin_again()
        if descriptor is not None and incoming.descriptor is None:
            self._newest[key[0], _ONE_AT_A_TIME.get(descriptor.kind, descriptor.kind)] = key[1]
        incoming.descriptor = descriptor
        incoming.make_room(room)
        if is_sum and descriptor is not None:
            incoming.put_sum(chunk, descriptor.n_chunks)
        else:
            incoming.put(chunk)
        incoming.heard_at_s = now_s
        if descriptor is not None and incoming.n_arrived == descriptor.n_chunks:
            self._finish(key, incoming, descriptor, now_s, events)

    def _finish(
        self,
        key: Key,
        incoming: Incoming,
        descriptor: Descriptor,
        now_s: float,
        events: list[ReceptionEvent],
    ) -> None:
        """Hand out a whole blob, or begin it again if its hash is wrong."""
        blob = descriptor.blob_of(incoming.stream)
        if blob is not None:
            until_s = now_s + self._options.keep_partial_s
            self._settle(key, _Settled(Reply.COMPLETE, descriptor.short_digest, until_s))
            events.append(BlobReceived(key[0], descriptor.kind, blob))
            return
        incoming.begin_again()
        if incoming.n_damaged >= _MAX_DAMAGED:
            events.append(self._refuse(key, Reply.CORRUPT, "damaged every time", now_s))

    def _fits(self, key: Key, more_bytes: int, now_s: float, events: list[ReceptionEvent]) -> bool:
        """Return whether the quotas grant a blob more, if need be by dropping idle ones."""
        if more_bytes <= 0:
            return True
        quota_bytes = self._options.memory_quota_bytes
        while True:
            others = [other for other in self._incoming if other != key]
            of_peer = [other for other in others if other[0] == key[0]]
            own_bytes = self._cost_bytes([k for k in self._incoming if k == key]) + more_bytes
            if own_bytes + self._cost_bytes(of_peer) > quota_bytes // 2:
                evictable = of_peer
            elif own_bytes + self._cost_bytes(others) > quota_bytes:
                evictable = others
            else:
                return True
            if not self._evict(evictable, now_s, events):
                return False

    def _cost_bytes(self, keys: list[Key]) -> int:
        """Return the memory that some unfinished blobs take."""
        return sum(self._incoming[key].cost_bytes for key in keys)

    def _evict(self, keys: list[Key], now_s: float, events: list[ReceptionEvent]) -> bool:
        """Drop the one of these unfinished blobs that is idle longest, if it is idle at all."""
        if not keys:
            return False
        idlest = min(keys, key=lambda key: self._incoming[key].heard_at_s)
        if now_s - self._incoming[idlest].heard_at_s < _IDLE_SHARE * self._options.pace.give_up_s:
            return False
        events.append(self._abandon(idlest, "idle, and its memory was needed"))
        return True

    def _abandon(self, key: Key, reason: str) -> ReceptionAbandoned:
        """Drop an unfinished blob."""
        descriptor = self._incoming.pop(key).descriptor
        return ReceptionAbandoned(key[0], descriptor.kind if descriptor else None, reason)

    def _refuse(self, key: Key, reply: Reply, reason: str, now_s: float) -> ReceptionAbandoned:
        """Drop an unfinished blob and tell its sender not to go on."""
        event = self._abandon(key, reason)
        self._settle(key, _Settled(reply, b"", now_s + self._options.keep_partial_s))
        return event

    def _settle(self, key: Key, settled: _Settled) -> None:
        """Remember how a transfer ended; of too many forget the oldest, first the peer's own."""
        self._incoming.pop(key, None)
        self._settled[key] = settled
        of_peer = [other for other in self._settled if other[0] == key[0]]
        if len(of_peer) > _MAX_SETTLED_OF_ONE:
            del self._settled[of_peer[0]]
        while len(self._settled) > _MAX_SETTLED:
            del self._settled[next(iter(self._settled))]

    def _statuses(self, key: Key, ask: int) -> list[TransferStatus]:
        """Return what there is to say about a transfer."""
        tag = key[1]
        settled = self._settled.get(key)
        if settled is not None:
            return [TransferStatus(tag, settled.reply, ask, digest=settled.digest)]
        incoming = self._incoming.get(key)
        if incoming is None or incoming.starved:
            return [TransferStatus(tag, Reply.BUSY, ask)]
        if incoming.is_for_several and incoming.descriptor is not None:
            return list(lacking_statuses(tag, ask, incoming.lacking_counts()))
        statuses = receiving_statuses(tag, ask, incoming.known_end(), incoming.missing())
        return list(itertools.islice(statuses, MAX_STATUSES))


def _descriptor_of(chunk: Chunk) -> Descriptor | None:
    """Return the descriptor in a stream's first chunk; None if it was damaged on the way."""
    try:
        descriptor = decode_descriptor(chunk.data)
    except WireError:
        return None
    return descriptor if descriptor.tag == chunk.tag else None
