"""Reliable transfer of blobs over 128-byte payloads, to and from many peers.

No socket and no clock: the owner hands in what it heard (``receive``), sends
what it is given (``poll``), and says what time it is. ``sending`` holds one
blob on its way out, ``receiving`` all on their way in; here they share one
byte budget, answers before chunks, and the transfers take turns.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from vcl_companion.swarm.budget import ByteBudget
from vcl_companion.swarm.receiving import BlobReceived, ReceptionAbandoned, Receptions
from vcl_companion.swarm.sending import BlobDelivered, Sending, TransferFailed
from vcl_companion.swarm.transfer_options import TransferOptions
from vcl_companion.wire.chunks import Chunk, TransferStatus, describe
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.tunnel import PayloadType, encode_payload

__all__ = [
    "BlobDelivered",
    "BlobKind",
    "BlobReceived",
    "Event",
    "Outgoing",
    "ReceptionAbandoned",
    "TransferFailed",
    "TransferOptions",
    "Transfers",
]

Event = BlobReceived | BlobDelivered | TransferFailed | ReceptionAbandoned


@dataclass(frozen=True)
class Outgoing:
    """One payload to send to one peer now."""

    peer: int
    payload_type: PayloadType
    payload: bytes


class Transfers:
    """All transfers of one drone."""

    def __init__(self, options: TransferOptions, rng: np.random.Generator) -> None:
        self._options = options
        self._rng = rng
        self._budget = ByteBudget(options.rate_bytes_per_s, options.burst_bytes)
        self._sendings: dict[int, Sending] = {}  # in the order of their submission
        self._receptions = Receptions(options)
        self._owed: deque[tuple[int, TransferStatus]] = deque()  # waits for the budget
        self._next_id = itertools.count(1)
        self._next_turn = itertools.count(1)

    @property
    def incoming_memory_bytes(self) -> int:
        """Memory that unfinished incoming blobs take."""
        return self._receptions.memory_bytes

    def submit(self, peer: int, kind: BlobKind, blob: bytes, now_s: float) -> int:
        """Begin to send a blob to a peer; return the transfer's id.

        The same blob to the same peer, while it is still on its way, is the
        same transfer. A peer that finished it less than ``keep_partial_s`` ago
        answers that it has it and is not handed it again.

        Raises:
            ValueError: the blob is longer than any receiver accepts.
        """
        descriptor = describe(kind, blob)
        for sending in self._sendings.values():
            if sending.peer == peer and sending.descriptor == descriptor:
                return sending.transfer_id
        transfer_id = next(self._next_id)
        self._sendings[transfer_id] = Sending(
            transfer_id, peer, descriptor, blob, self._options, self._rng
        )
        return transfer_id

    def cancel(self, transfer_id: int) -> None:
        """Stop sending a blob, without an event; an id that is over already is fine."""
        self._sendings.pop(transfer_id, None)

    def forget(self, peer: int, kind: BlobKind, blob: bytes, at_s: float) -> None:
        """Take a blob that was received in vain as never received: it may be sent again.

        Not before ``at_s``: its sender, told at once, would begin again at once.
        """
        self._receptions.forget(peer, describe(kind, blob).tag, at_s)

    def is_receiving(self, kind: BlobKind, now_s: float) -> bool:
        """Whether an unfinished blob of a kind has been coming in lately, from anybody."""
        return self._receptions.is_receiving(kind, now_s)

    def receive(self, peer: int, message: Chunk | TransferStatus, now_s: float) -> list[Event]:
        """Take in what a peer sent; ask ``next_poll_s`` again after it."""
        if isinstance(message, Chunk):
            return list(self._receptions.receive(peer, message, now_s))
        for sending in self._sendings.values():
            if (sending.peer, sending.tag) == (peer, message.tag):
                end = sending.receive(message, now_s)
                if end is None:
                    return []
                del self._sendings[sending.transfer_id]
                return [end]
        return []

    def poll(self, now_s: float) -> tuple[list[Outgoing], list[Event]]:
        """Return what to send now, as much as the budget allows, and what ended by time."""
        events: list[Event] = list(self._receptions.expire(now_s))
        for sending in list(self._sendings.values()):
            reason = sending.failure(now_s)
            if reason is not None:
                del self._sendings[sending.transfer_id]
                events.append(TransferFailed(sending.peer, sending.transfer_id, reason))

        outgoing: list[Outgoing] = []
        self._budget.refill(now_s)
        if not self._owed:
            # Asked for only when the last ones are gone, so that what waits stays bounded.
            self._owed.extend(self._receptions.answers(now_s))
        while self._owed and self._budget.allows_one():
            outgoing.append(self._spend(*self._owed.popleft()))
        ready = deque(
            sorted(
                (sending for sending in self._active() if sending.is_ready(now_s)),
                key=lambda sending: sending.last_turn,
            )
        )
        while ready and self._budget.allows_one():
            sending = ready.popleft()
            outgoing.append(self._spend(sending.peer, sending.next_chunk(now_s)))
            sending.last_turn = next(self._next_turn)
            if sending.is_ready(now_s):
                ready.append(sending)
        return outgoing, events

    def next_poll_s(self) -> float | None:
        """Return when ``poll`` has something to do (in the past: now), or None for never."""
        active = self._active()
        payload_s = min([sending.ready_at_s() for sending in active], default=math.inf)
        payload_s = -math.inf if self._owed else min(payload_s, self._receptions.next_s())
        give_up_s = min([sending.gives_up_at_s() for sending in active], default=math.inf)
        at_s = min(max(payload_s, self._budget.ready_at_s()), give_up_s)
        return None if at_s == math.inf else at_s

    def _active(self) -> list[Sending]:
        """Return the transfers whose turn it is: per peer the first few submitted."""
        per_peer: dict[int, int] = {}
        active = []
        for sending in self._sendings.values():
            per_peer[sending.peer] = per_peer.get(sending.peer, 0) + 1
            if per_peer[sending.peer] <= self._options.max_incoming_per_peer:
                active.append(sending)
        return active

    def _spend(self, peer: int, message: Chunk | TransferStatus) -> Outgoing:
        """Return the payload of a message, taken from the budget."""
        payload_type, payload = encode_payload(message)
        self._budget.spend(len(payload))
        return Outgoing(peer, payload_type, payload)
