"""One blob on its way to one peer or several: what to send next, by what they say is missing.

The sender sends every chunk once and asks what arrived: with its first chunk
(the peer may have most of it already), about once a second, and with its last.
Every ask ends a *segment* of sent chunks and is numbered; the answer repeats
the number, so that a chunk counts as lost only if it was sent before the ask
that the answer answers. An answer that stays out is asked for again, ever more
rarely, until the sender gives up.

To several receivers a chunk goes once, to all, unless a single one lacks it. Each
is first sent the beginning by itself: only a stream that began so is meant for it.
Who does not answer holds the others up for no longer than one status interval at
the beginning, and is asked by itself from then on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.swarm.receiver import Receiver
from vcl_companion.swarm.transfer_options import Pace
from vcl_companion.swarm.urgency import URGENCY_OF_BLOB
from vcl_companion.wire.chunks import MAX_ASK, Chunk, Descriptor, Reply, TransferStatus

ALL = 0  # the target of what everybody hears
_ASK_EVERY_INTERVALS = 5.0  # while there is still something to send
# Answers of several receivers to one ask come one after the other; in one repetition
# there is what all of them miss.
_MERGE_SHARE = 0.25  # of the status interval


@dataclass(frozen=True)
class BlobDelivered:
    """The peer has the whole blob."""

    peer: int
    transfer_id: int


@dataclass(frozen=True)
class TransferFailed:
    """The blob did not get across; ``reason`` is one line."""

    peer: int
    transfer_id: int
    reason: str


class Sending:
    """State of one blob towards its receivers."""

    def __init__(
        self, descriptor: Descriptor, blob: bytes, pace: Pace, rng: np.random.Generator
    ) -> None:
        n = descriptor.n_chunks
        self.descriptor = descriptor
        self.tag = descriptor.tag
        self.urgency = URGENCY_OF_BLOB[descriptor.kind]
        self.last_turn = 0  # when the scheduler last let it send, see ``Transfers.poll``
        self._blob = blob
        self._pace = pace
        self._rng = rng
        self._receivers: dict[int, Receiver] = {}
        self._waiting = np.ones(n, dtype=np.bool_)  # to be sent
        self._n_waiting = n
        self._lowest_waiting = 0
        self._sent_in = np.zeros(n, dtype=np.int32)  # segment of the last sending, 0 for never
        self._segment = 1
        self._asked_at_s = -math.inf
        self._hold_until_s = -math.inf  # answers are about to come

    @property
    def peers(self) -> tuple[int, ...]:
        """Who does not have it yet, as far as known."""
        return tuple(self._receivers)

    def transfer_id_to(self, peer: int) -> int | None:
        """Return the transfer's id towards a receiver, None when it is none."""
        receiver = self._receivers.get(peer)
        return None if receiver is None else receiver.transfer_id

    def add(self, transfer_id: int, peer: int) -> None:
        """Send it to one more receiver."""
        n = len(self._waiting)
        self._receivers[peer] = Receiver(transfer_id, peer, n, self._pace, self._rng)

    def remove(self, peer: int) -> None:
        """Send it no more to a receiver."""
        del self._receivers[peer]
        self._queue(self._waiting)

    def is_ready(self, now_s: float) -> bool:
        """Return whether there is a chunk to send now."""
        return now_s >= self.ready_at_s()

    def ready_at_s(self) -> float:
        """Return when there is a chunk to send: minus infinity for at once."""
        asks = [receiver.ask_again_at_s for receiver in self._to_ask_alone()]
        return min([self._streams_at_s(), *asks])

    def gives_up_at_s(self) -> float:
        """Return when patience with a receiver ends if nothing progresses until then."""
        return min(
            [receiver.gives_up_at_s() for receiver in self._receivers.values()], default=math.inf
        )

    def failures(self, now_s: float) -> list[TransferFailed]:
        """Give up those that it is time to give up."""
        failed = []
        for peer, receiver in list(self._receivers.items()):
            reason = receiver.failure(now_s)
            if reason is not None:
                self.remove(peer)
                failed.append(TransferFailed(peer, receiver.transfer_id, reason))
        return failed

    def next_chunk(self, now_s: float) -> tuple[int, Chunk]:
        """Return whom to send which chunk now (0: all); call it only when ready."""
        for receiver in self._to_ask_alone():
            if now_s >= receiver.ask_again_at_s:
                return receiver.peer, self._ask_alone(receiver, now_s)
        index = self._lowest_waiting + int(np.argmax(self._waiting[self._lowest_waiting :]))
        self._take(index)
        asks = self._is_time_to_ask(now_s)
        lacking = [r for r in self._receivers.values() if not (r.arrived[index] or r.is_busy)]
        target = self._target(lacking, asks)
        heard_by = self._receivers.values() if target == ALL else [self._receivers[target]]
        for receiver in heard_by:
            receiver.owes_answer |= asks
            if target != ALL or receiver in lacking:
                receiver.sent(now_s)
        chunk = self._chunk(index, now_s, asks=asks)
        if not self._n_waiting:
            for receiver in self._receivers.values():
                receiver.wait(now_s)
        return target, chunk

    def receive(
        self, peer: int, status: TransferStatus, now_s: float
    ) -> BlobDelivered | TransferFailed | None:
        """Take in what a receiver says; return how the transfer to it ended, if it did."""
        receiver = self._receivers[peer]
        if not receiver.was_sent_something:
            return None  # so this answers somebody else
        match status.reply:
            case Reply.COMPLETE:
                if status.digest == self.descriptor.short_digest:
                    self.remove(peer)
                    return BlobDelivered(peer, receiver.transfer_id)
                receiver.obstacle = "another blob under the same tag"
            case Reply.TOO_LARGE | Reply.CORRUPT:
                self.remove(peer)
                why = "too large" if status.reply == Reply.TOO_LARGE else "damaged on the way"
                reason = f"peer {peer} refuses the blob: {why}"
                return TransferFailed(peer, receiver.transfer_id, reason)
            case Reply.BUSY:
                receiver.obstacle = "nothing but 'busy'"
                receiver.is_busy, receiver.owes_answer = True, False
                self._queue(self._waiting)
                receiver.wait(now_s)
            case Reply.RECEIVING:
                self._take_window(receiver, status, now_s)
        self._end_hold()
        return None

    def _to_ask_alone(self) -> list[Receiver]:
        """Return whom to ask by itself when it is time: all if there is nothing else to send."""
        everybody = list(self._receivers.values())
        if not self._n_waiting:
            return everybody
        return [r for r in everybody if not r.is_open] if len(everybody) > 1 else []

    def _streams_at_s(self) -> float:
        """Return when the next waiting chunk may go."""
        if not self._n_waiting:
            return math.inf
        if len(self._receivers) == 1:
            return -math.inf
        if not any(receiver.is_open for receiver in self._receivers.values()):
            return math.inf  # nobody would take it
        return self._hold_until_s

    def _ask_alone(self, receiver: Receiver, now_s: float) -> Chunk:
        """Ask with what is certainly of use: the first chunk not known to be there."""
        index = int(np.argmin(receiver.arrived))
        receiver.asked_alone()
        receiver.owes_answer = True
        receiver.sent(now_s)
        if receiver.is_open or len(self._receivers) == 1:
            receiver.wait(now_s)
        else:
            if not math.isfinite(self._hold_until_s):
                self._hold_until_s = now_s + self._pace.status_interval_s
            receiver.wait_for_first(now_s)
        if self._waiting[index]:
            self._take(index)
        return self._chunk(index, now_s, asks=True)

    def _is_time_to_ask(self, now_s: float) -> bool:
        since_s = now_s - self._asked_at_s
        return not self._n_waiting or since_s >= _ASK_EVERY_INTERVALS * self._pace.status_interval_s

    def _target(self, lacking: list[Receiver], asks: bool) -> int:
        """Return who is sent a chunk: all if several lack it, or several are to answer."""
        several = len(self._receivers) > 1 if asks else len(lacking) > 1
        if several and any(receiver.is_open for receiver in lacking):
            return ALL
        return lacking[0].peer

    def _take(self, index: int) -> None:
        """Take a chunk out of those that wait."""
        self._waiting[index] = False
        self._n_waiting -= 1
        if index == self._lowest_waiting:
            self._lowest_waiting = index + 1

    def _chunk(self, index: int, now_s: float, *, asks: bool) -> Chunk:
        ask = 0
        self._sent_in[index] = self._segment
        if asks:
            ask = 1 + self._segment % MAX_ASK
            self._segment += 1
            self._asked_at_s = now_s
        return Chunk(self.tag, index, ask, self.descriptor.cut(self._blob, index))

    def _take_window(self, receiver: Receiver, status: TransferStatus, now_s: float) -> None:
        """Note what arrived and queue what was lost, of the chunks the status tells of."""
        answered = self._answered_segment(status.ask)
        if answered < receiver.newest_answer:
            return
        receiver.newest_answer = answered
        n = len(self._waiting)
        window = slice(min(status.first, n), min(status.end, n))
        missing = np.zeros(n, dtype=np.bool_)
        for start, stop in status.missing:
            missing[start:stop] = True
        missing = missing[window]
        lost = missing & (self._sent_in[window] <= answered)
        receiver.arrived[window] = ~missing | (receiver.arrived[window] & ~lost)
        receiver.answered(now_s)
        had_none = not self._n_waiting
        waiting = self._waiting.copy()
        waiting[window] |= lost
        self._queue(waiting)
        if not self._n_waiting:
            receiver.wait(now_s)
        elif had_none:
            self._hold_until_s = now_s + _MERGE_SHARE * self._pace.status_interval_s

    def _end_hold(self) -> None:
        """Go on as soon as no more answers are about to come."""
        if not any(receiver.is_awaited for receiver in self._receivers.values()):
            self._hold_until_s = -math.inf

    def _queue(self, waiting: NDArray[np.bool_]) -> None:
        """Have these chunks wait, but for those that nobody lacks who would take them."""
        takers = [r.arrived for r in self._receivers.values() if not r.is_busy]
        at_all = np.logical_and.reduce(takers) if takers else np.ones_like(waiting)
        self._waiting = waiting & ~at_all
        self._n_waiting = int(self._waiting.sum())
        self._lowest_waiting = int(np.argmax(self._waiting))

    def _answered_segment(self, ask: int) -> int:
        """Return the newest asked segment with this ask number; 0 if there is none."""
        newest = self._segment - 1
        return max(newest - (newest - (ask - 1)) % MAX_ASK, 0)
