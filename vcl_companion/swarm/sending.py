"""One blob on its way to one peer or several: what to send next, by what they say is missing.

The sender sends every chunk once and asks what arrived: with its first chunk
(the peer may have most of it already), every five status intervals, and with its last.
Every ask ends a *segment* of sent chunks and is numbered; the answer repeats
the number, so that a chunk counts as lost only if it was sent before the ask
that the answer answers. An answer that stays out is asked for again, ever more
rarely, until the sender gives up.

To several receivers a chunk goes once, to all, unless a single one lacks it. What
is lost is not repeated: each loses other chunks, and sums of many help them all
(``repairs``); so they only tell how many they lack. Each is first sent the beginning
by itself: only a stream that began so is meant for it. Who does not answer then holds
the others up for no longer than a status interval.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.swarm.receiver import Receiver
from vcl_companion.swarm.repairs import (
    Counts,
    Rows,
    block_of,
    n_blocks,
    per_block,
    selection,
    sum_of,
    sums_per_block,
)
from vcl_companion.swarm.transfer_options import Pace
from vcl_companion.swarm.urgency import URGENCY_OF_BLOB
from vcl_companion.wire.chunks import (
    BLOCK_CHUNKS,
    FIRST_SUM,
    MAX_ASK,
    Chunk,
    Descriptor,
    Reply,
    TransferStatus,
)

ALL = 0  # the target of what everybody hears
_ASK_EVERY_INTERVALS = 5.0  # while there is still something to send
_ASK_SEVERAL_INTERVALS = 2.0  # their answers are short, and nobody is asked alone meanwhile
# Several answer one ask one after the other.
_MERGE_SHARE = 0.25  # of the status interval
# However much is lost, no more is sent at once than twice of what is lacking.
_LEAST_SHARE = 0.5


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
        # For several: what is repeated are sums, of each block as many as one lacks of it.
        self._is_for_several = False
        self._n_sent_of = np.zeros(n_blocks(n), dtype=np.int64)  # chunks and sums of each block
        self._n_sent_by: dict[int, Counts] = {}  # until the ask of this number, the last of it
        self._n_waiting_of = per_block(self._waiting)
        # One that has been restarted begins with others than those that are there already.
        self._next_sum_number = int(rng.integers(sums_per_block(n)))
        self._rows: Rows | None = None  # all chunks, once a sum of them is sent

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
        if len(self._receivers) > 1 and not self._is_for_several:
            self._is_for_several = True
            for receiver in self._receivers.values():
                receiver.goal[:] = self._n_sent_of + per_block(~receiver.arrived)

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
                return self._ask_alone(receiver, now_s)
        if self._n_waiting:
            index, lacking = self._next_waiting()
        else:
            index, lacking = self._next_sum(self._due()), list(self._receivers.values())
        self._count(index)
        asks = self._is_time_to_ask(now_s)
        target = self._target(lacking, asks)
        heard_by = self._receivers.values() if target == ALL else [self._receivers[target]]
        for receiver in heard_by:
            receiver.owes_answer |= asks
            if target != ALL or receiver in lacking:
                receiver.sent(now_s)
        chunk = self._chunk(index, now_s, asks=asks)
        if not self._is_due():
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
            case Reply.LACKING:
                self._take_counts(receiver, status, now_s)
            case Reply.RECEIVING:
                self._take_window(receiver, status, now_s)
        self._end_hold()
        return None

    def _to_ask_alone(self) -> list[Receiver]:
        """Return whom to ask by itself when it is time: all if there is nothing else to send."""
        everybody = list(self._receivers.values())
        if not self._is_due():
            return everybody
        return [r for r in everybody if not r.is_open] if len(everybody) > 1 else []

    def _streams_at_s(self) -> float:
        """Return when the next chunk may go that waits, or the next sum."""
        if not self._is_due():
            return math.inf
        if len(self._receivers) == 1:
            return -math.inf
        if not any(receiver.is_open for receiver in self._receivers.values()):
            return math.inf  # nobody would take it
        return self._hold_until_s

    def _is_due(self) -> bool:
        """Whether there are chunks or sums to be sent unasked."""
        return self._n_waiting > 0 or bool((self._due() > 0).any())

    def _due(self) -> Counts:
        """Return how many sums are to be sent, of each block."""
        takers = [r.goal for r in self._receivers.values() if r.is_open and not r.is_busy]
        if not (self._is_for_several and takers):
            return np.zeros_like(self._n_sent_of)
        goal: Counts = np.maximum.reduce(takers)
        return goal - self._n_sent_of - self._n_waiting_of

    def _next_waiting(self) -> tuple[int, list[Receiver]]:
        """Take the lowest chunk that waits; and who lacks it."""
        index = self._lowest_waiting + int(np.argmax(self._waiting[self._lowest_waiting :]))
        self._take(index)
        return index, [r for r in self._receivers.values() if not (r.arrived[index] or r.is_busy)]

    def _next_sum(self, wanted: Counts) -> int:
        """Return the index of a new sum of the block of which most is wanted."""
        n = len(self._waiting)
        number = self._next_sum_number % sums_per_block(n)
        self._next_sum_number += 1
        return FIRST_SUM + int(np.argmax(wanted)) + n_blocks(n) * number

    def _count(self, index: int) -> None:
        """Note that a chunk or sum is sent, which brings everybody nearer to its goal."""
        n = n_blocks(len(self._waiting))
        is_sum = index >= FIRST_SUM
        self._n_sent_of[(index - FIRST_SUM) % n if is_sum else index // BLOCK_CHUNKS] += 1

    def _ask_alone(self, receiver: Receiver, now_s: float) -> tuple[int, Chunk]:
        """Ask one that has not answered, with what may be of use to it.

        Of several, one that has answered before is first asked together with the others.
        """
        several = len(self._receivers) > 1
        target, index = receiver.peer, int(np.argmin(receiver.arrived))
        if self._is_for_several and receiver.is_open and receiver.arrived[0]:
            index = self._next_sum(receiver.goal - self._n_sent_of)
            target = ALL if several and not receiver.n_asked else target
        asked = list(self._receivers.values()) if target == ALL else [receiver]
        for other in asked:
            other.asked_alone()
            other.owes_answer = True
            other.sent(now_s)
            if several and not other.is_open:
                if not math.isfinite(self._hold_until_s):
                    self._hold_until_s = now_s + self._pace.status_interval_s
                other.wait_shortly(now_s)
            else:
                other.wait(now_s)
        if index < FIRST_SUM and self._waiting[index]:
            self._take(index)
        self._count(index)
        return target, self._chunk(index, now_s, asks=True)

    def _is_time_to_ask(self, now_s: float) -> bool:
        """Whether to ask with what was just taken: the last, or after a while."""
        intervals = _ASK_SEVERAL_INTERVALS if self._is_for_several else _ASK_EVERY_INTERVALS
        every_s = intervals * self._pace.status_interval_s
        return not self._is_due() or now_s - self._asked_at_s >= every_s

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
        self._n_waiting_of[index // BLOCK_CHUNKS] -= 1
        if index == self._lowest_waiting:
            self._lowest_waiting = index + 1

    def _chunk(self, index: int, now_s: float, *, asks: bool) -> Chunk:
        ask = 0
        if index < FIRST_SUM:
            self._sent_in[index] = self._segment
        if asks:
            ask = 1 + self._segment % MAX_ASK
            self._n_sent_by[ask] = self._n_sent_of.copy()
            self._segment += 1
            self._asked_at_s = now_s
        return Chunk(self.tag, index, ask, self._data(index))

    def _data(self, index: int) -> bytes:
        """Return what a chunk holds, or a sum."""
        if index < FIRST_SUM:
            return self.descriptor.cut(self._blob, index)
        if self._rows is None:
            self._rows = self.descriptor.rows(self._blob)
        number, n = index - FIRST_SUM, len(self._waiting)
        return sum_of(self._rows[block_of(number, n)][selection(self.tag, number, n)])

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
        receiver.has(int(receiver.arrived.sum()), now_s)
        waiting = self._waiting.copy()
        # Without the first one it knows nothing of the rest, or not any more: it was restarted.
        if self._is_for_several:
            lacking = per_block(~receiver.arrived)
            self._aim(receiver, now_s, status.ask, slice(0, len(lacking)), lacking)
            receiver.arrived[0] &= status.end > 0
            waiting[0] |= not receiver.arrived[0]
        else:
            waiting[window] |= lost
            if status.end == 0 and self._sent_in[0] <= answered:
                receiver.arrived[0], waiting[0] = False, True
        self._queue(waiting)
        if not self._is_due():
            receiver.wait(now_s)

    def _take_counts(self, receiver: Receiver, status: TransferStatus, now_s: float) -> None:
        """Note how many a receiver lacks of some blocks."""
        answered = self._answered_segment(status.ask)
        if answered < receiver.newest_answer or status.end > len(self._n_sent_of):
            return
        receiver.newest_answer = answered
        receiver.answered(now_s)
        self._is_for_several = True  # it thinks so: somebody else was meant, too, before
        blocks = slice(status.first, status.end)
        receiver.lacking[blocks] = status.counts
        receiver.has(len(self._waiting) - int(receiver.lacking.sum()), now_s)
        self._aim(receiver, now_s, status.ask, blocks, receiver.lacking[blocks])
        if not self._is_due():
            receiver.wait(now_s)

    def _aim(
        self, receiver: Receiver, now_s: float, ask: int, blocks: slice, lacking: Counts
    ) -> None:
        """Note how much has to be sent until a receiver has enough, if nothing is lost."""
        was_due = self._is_due()
        # As much as before will be lost of it.
        arrives = max(receiver.share_arrived(int(self._n_sent_of.sum())), _LEAST_SHARE)
        needed = (lacking / arrives).astype(np.int64)
        receiver.goal[blocks] = self._n_sent_by.get(ask, self._n_sent_of)[blocks] + needed
        if not was_due and self._is_due() and len(self._receivers) > 1:
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
        self._n_waiting_of = per_block(self._waiting)

    def _answered_segment(self, ask: int) -> int:
        """Return the newest asked segment with this ask number; 0 if there is none."""
        newest = self._segment - 1
        return max(newest - (newest - (ask - 1)) % MAX_ASK, 0)
