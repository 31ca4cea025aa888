"""What one drone sends to its peers: messages, and blobs over 128-byte payloads, reliably.

No socket and no clock: the owner hands in what it heard (``receive``), sends
what it is given (``poll``), and says what time it is. ``sending`` holds one
blob on its way out, ``receiving`` all on their way in; here they share one
byte budget with everything else that is said, the most urgent first
(``urgency``), and the blobs of one urgency take turns.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from vcl_companion.swarm.budget import ByteBudget
from vcl_companion.swarm.receiving import BlobReceived, ReceptionAbandoned, Receptions
from vcl_companion.swarm.sending import ALL, BlobDelivered, Sending, TransferFailed
from vcl_companion.swarm.transfer_options import TransferOptions
from vcl_companion.swarm.urgency import Message, Turns, Urgency, urgency_of
from vcl_companion.wire.chunks import Chunk, Descriptor, Reply, TransferStatus, describe
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.tunnel import PayloadType, TunnelPayload, encode_payload

# At the usual quality, 640 x 480 with sensor noise; without, three quarters of it.
_USUAL_IMAGE_BYTES = 40_000

__all__ = [
    "BlobDelivered",
    "BlobHeld",
    "BlobKind",
    "BlobReceived",
    "Event",
    "Outgoing",
    "ReceptionAbandoned",
    "TransferFailed",
    "TransferOptions",
    "Transfers",
]


@dataclass(frozen=True)
class BlobHeld:
    """A peer has told somebody else that it has a blob whole; ``digest`` as in its status."""

    peer: int
    digest: bytes


Event = BlobReceived | BlobDelivered | BlobHeld | TransferFailed | ReceptionAbandoned


@dataclass(frozen=True)
class Outgoing:
    """One payload to send to one peer, or to all (0), now."""

    peer: int
    payload_type: PayloadType
    payload: bytes


class Transfers:
    """All that one drone sends to its peers, and the blobs that they send to it."""

    def __init__(self, options: TransferOptions, rng: np.random.Generator) -> None:
        self._options = options
        self._rng = rng
        self._budget = ByteBudget(options.pace.rate_bytes_per_s, options.pace.burst_bytes)
        self._copies_to_all: int | None = None
        self._sendings: list[Sending] = []  # in the order of their submission
        self._receptions = Receptions(options)
        self._owed: deque[tuple[int, TransferStatus]] = deque()  # waits for the budget
        self._posted: dict[Urgency, dict[tuple[type[Message], int], Message]] = {
            urgency: {} for urgency in Urgency
        }
        self._turns = Turns()
        self._next_id = itertools.count(1)
        self._next_turn = itertools.count(1)

    @property
    def image_bytes(self) -> int:
        """Of a keyframe's image, at most: see ``Pace``."""
        return self._options.pace.image_bytes

    @property
    def quick_bytes(self) -> int:
        """What may be sent at once of something long: see ``Pace``."""
        return self._options.pace.quick_bytes

    def carried_in_s(self, n_bytes: int) -> float:
        """Return how long a blob takes to a peer if nothing else is said meanwhile."""
        return self._options.pace.carried_in_s(n_bytes)

    def frames_carried_in_s(self, n_frames: int) -> float:
        """Return how long frames for a map take, one after the other."""
        return self.carried_in_s(n_frames * min(self.image_bytes, _USUAL_IMAGE_BYTES))

    @property
    def incoming_memory_bytes(self) -> int:
        """Memory that unfinished incoming blobs take."""
        return self._receptions.memory_bytes

    def reaches_all_with(self, n_copies: int) -> None:
        """Tell how often the link sends what is for everybody.

        Where once is enough the group shares a network, and a blob for several goes
        to all of them at once, from the next submitted on.
        """
        self._copies_to_all = n_copies

    @property
    def shares_network(self) -> bool:
        """Whether all hear what one sends, at the cost of one."""
        return self._copies_to_all == 1

    def post(self, peer: int, message: Message) -> None:
        """Send a message to a peer, or to all (0), when it is its turn.

        What still waits to be sent is replaced by a newer one of its kind to the same peer.
        """
        self._posted[urgency_of(message)][type(message), peer] = message

    def submit(self, peer: int, kind: BlobKind, blob: bytes, now_s: float) -> int:
        """Begin to send a blob to a peer; return the transfer's id.

        The same blob to the same peer, while it is still on its way, is the
        same transfer; to another peer it is one more receiver, where the group
        shares a network. A peer that finished it less than ``keep_partial_s`` ago
        answers that it has it and is not handed it again.

        Raises:
            ValueError: the blob is longer than any receiver accepts.
        """
        descriptor = describe(kind, blob)
        same = [sending for sending in self._sendings if sending.descriptor == descriptor]
        for sending in same:
            known_id = sending.transfer_id_to(peer)
            if known_id is not None:
                return known_id
        transfer_id = next(self._next_id)
        self._sending_of(descriptor, blob, same).add(transfer_id, peer)
        return transfer_id

    def _sending_of(self, descriptor: Descriptor, blob: bytes, same: list[Sending]) -> Sending:
        """Return what one more receiver of a blob is added to."""
        if same and self.shares_network:
            return same[0]
        sending = Sending(descriptor, blob, self._options.pace, self._rng)
        self._sendings.append(sending)
        return sending

    def cancel(self, transfer_id: int) -> None:
        """Stop sending a blob to its peer, without an event; an id that is over already is fine."""
        for sending in self._sendings:
            for peer in sending.peers:
                if sending.transfer_id_to(peer) == transfer_id:
                    sending.remove(peer)
        self._drop_ended()

    def forget(self, peer: int, kind: BlobKind, blob: bytes, at_s: float) -> None:
        """Take a blob that was received in vain as never received: it may be sent again.

        Not before ``at_s``: its sender, told at once, would begin again at once.
        """
        self._receptions.forget(peer, describe(kind, blob).tag, at_s)

    def is_receiving(self, kind: BlobKind, now_s: float) -> bool:
        """Whether an unfinished blob of a kind has been coming in lately, from anybody."""
        return self._receptions.is_receiving(kind, now_s)

    def receive(
        self, peer: int, message: Chunk | TransferStatus, now_s: float, *, to_all: bool = False
    ) -> list[Event]:
        """Take in what a peer sent, to us or to all; ask ``next_poll_s`` again after it."""
        if isinstance(message, Chunk):
            return list(self._receptions.receive(peer, message, now_s, to_all=to_all))
        for sending in self._sendings:
            if sending.tag == message.tag and peer in sending.peers:
                end = sending.receive(peer, message, now_s)
                self._drop_ended()
                return [] if end is None else [end]
        return [BlobHeld(peer, message.digest)] if message.reply == Reply.COMPLETE else []

    def poll(self, now_s: float) -> tuple[list[Outgoing], list[Event]]:
        """Return what to send now, as much as the budget allows, and what ended by time."""
        events: list[Event] = list(self._receptions.expire(now_s))
        for sending in self._sendings:
            events += sending.failures(now_s)
        self._drop_ended()

        outgoing: list[Outgoing] = []
        self._budget.refill(now_s)
        if not self._owed:
            # Asked for only when the last ones are gone, so that what waits stays bounded.
            self._owed.extend(self._receptions.answers(now_s))
        turns = sorted(self._active(), key=lambda sending: sending.last_turn)
        ready: dict[Urgency, deque[Sending]] = {urgency: deque() for urgency in Urgency}
        for sending in turns:
            if sending.is_ready(now_s):
                ready[sending.urgency].append(sending)
        while self._budget.allows_one():
            waiting = [urgency for urgency in Urgency if self._posted[urgency] or ready[urgency]]
            if self._owed:
                waiting.append(Urgency.STATUS)
            if not waiting:
                break
            outgoing.append(self._next(self._turns.next(waiting), ready, now_s))
        return outgoing, events

    def next_poll_s(self) -> float | None:
        """Return when ``poll`` has something to do (in the past: now), or None for never."""
        active = self._active()
        payload_s = min([sending.ready_at_s() for sending in active], default=math.inf)
        payload_s = min(payload_s, self._receptions.next_s())
        if self._owed or any(self._posted.values()):
            payload_s = -math.inf
        give_up_s = min([sending.gives_up_at_s() for sending in active], default=math.inf)
        at_s = min(max(payload_s, self._budget.ready_at_s()), give_up_s)
        return None if at_s == math.inf else at_s

    def _next(
        self, urgency: Urgency, ready: dict[Urgency, deque[Sending]], now_s: float
    ) -> Outgoing:
        """Take the next payload of those of one urgency: messages, then chunks by turns."""
        if self._posted[urgency]:
            key = next(iter(self._posted[urgency]))
            return self._spend(key[1], self._posted[urgency].pop(key))
        if urgency == Urgency.STATUS:
            peer, status = self._owed.popleft()
            # Others may have the same for us.
            is_news = status.reply == Reply.COMPLETE and self.shares_network
            return self._spend(ALL if is_news else peer, status)
        sending = ready[urgency].popleft()
        out = self._spend(*sending.next_chunk(now_s))
        sending.last_turn = next(self._next_turn)
        if sending.is_ready(now_s):
            ready[urgency].append(sending)
        return out

    def _active(self) -> list[Sending]:
        """Return the transfers whose turn it is: of the first few submitted to a peer.

        One of those few is kept for what cannot wait until a map is across.
        """
        most = self._options.max_incoming_per_peer
        n_all: dict[int, int] = {}
        n_maps: dict[int, int] = {}
        active = []
        for sending in self._sendings:
            is_map = sending.urgency == Urgency.MAP
            of_kind, bound = (n_maps, max(most - 1, 1)) if is_map else (n_all, most)
            if any(
                n_all.get(peer, 0) < most and of_kind.get(peer, 0) < bound for peer in sending.peers
            ):
                active.append(sending)
                for peer in sending.peers:
                    n_all[peer] = n_all.get(peer, 0) + 1
                    n_maps[peer] = n_maps.get(peer, 0) + is_map
        return active

    def _drop_ended(self) -> None:
        self._sendings = [sending for sending in self._sendings if sending.peers]

    def _spend(self, peer: int, message: TunnelPayload) -> Outgoing:
        """Return the payload of a message, taken from the budget."""
        payload_type, payload = encode_payload(message)
        self._budget.spend(len(payload), (self._copies_to_all or 1) if peer == ALL else 1)
        return Outgoing(peer, payload_type, payload)
