"""One blob on its way to one peer: what to send next, by what the peer says is missing.

The sender sends every chunk once and asks what arrived: with its first chunk
(the peer may have most of it already), about once a second, and with its last.
Every ask ends a *segment* of sent chunks and is numbered; the answer repeats
the number, so that a chunk counts as lost only if it was sent before the ask
that the answer answers. An answer that stays out is asked for again, ever more
rarely, until the sender gives up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.swarm.transfer_options import TransferOptions
from vcl_companion.wire.chunks import MAX_ASK, Chunk, Descriptor, Reply, TransferStatus

_ASK_EVERY_INTERVALS = 5.0  # while there is still something to send
_BACKOFF = 1.25
_MAX_BACKOFF = 5.0
_MAX_SENDS_PER_CHUNK = 100  # at 95 % loss twenty are expected
_MIN_SENDS = 1000


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
    """State of one blob towards one peer."""

    def __init__(
        self,
        transfer_id: int,
        peer: int,
        descriptor: Descriptor,
        blob: bytes,
        options: TransferOptions,
        rng: np.random.Generator,
    ) -> None:
        n = descriptor.n_chunks
        self.transfer_id = transfer_id
        self.peer = peer
        self.descriptor = descriptor
        self.tag = descriptor.tag
        self.last_turn = 0  # when the scheduler last let it send, see ``Transfers.poll``
        self._blob = blob
        self._options = options
        self._rng = rng
        self._waiting = np.ones(n, dtype=np.bool_)  # to be sent
        self._n_waiting = n
        self._lowest_waiting = 0
        self._arrived = np.zeros(n, dtype=np.bool_)
        self._n_arrived = 0
        self._sent_in = np.zeros(n, dtype=np.int32)  # segment of the last sending, 0 for never
        self._segment = 1
        self._newest_answer = 0
        self._n_sent = 0
        self._asked_at_s = -np.inf
        self._ask_again_at_s = 0.0
        self._backoff = 1.0
        self._progress_at_s: float | None = None  # None until the first chunk goes out
        self._obstacle = "no answer"

    def is_ready(self, now_s: float) -> bool:
        """Return whether there is a chunk to send now."""
        return self._n_waiting > 0 or now_s >= self._ask_again_at_s

    def ready_at_s(self) -> float:
        """Return when there is a chunk to send: minus infinity for at once."""
        return -np.inf if self._n_waiting else self._ask_again_at_s

    def gives_up_at_s(self) -> float:
        """Return when patience ends if nothing progresses until then."""
        if self._progress_at_s is None:
            return np.inf
        return self._progress_at_s + self._options.give_up_s

    def failure(self, now_s: float) -> str | None:
        """Return why it is time to give up, or None while it is not."""
        if now_s >= self.gives_up_at_s():
            return f"{self._obstacle} from peer {self.peer} for {self._options.give_up_s:g} s"
        if self._n_sent > _MIN_SENDS + _MAX_SENDS_PER_CHUNK * len(self._waiting):
            return f"peer {self.peer} is still missing parts after {self._n_sent} payloads"
        return None

    def next_chunk(self, now_s: float) -> Chunk:
        """Return the chunk to send now; call it only when ready."""
        if self._progress_at_s is None:
            self._progress_at_s = now_s
        if self._n_waiting:
            index = self._lowest_waiting + int(np.argmax(self._waiting[self._lowest_waiting :]))
            self._waiting[index] = False
            self._n_waiting -= 1
            self._lowest_waiting = index + 1
        else:
            # Ask again with what is certainly of use: the first chunk not known to be there.
            index = int(np.argmin(self._arrived))
            self._backoff = min(_BACKOFF * self._backoff, _MAX_BACKOFF)
        interval_s = self._options.status_interval_s
        ask = 0
        self._sent_in[index] = self._segment
        if not self._n_waiting or now_s - self._asked_at_s >= _ASK_EVERY_INTERVALS * interval_s:
            ask = 1 + self._segment % MAX_ASK
            self._segment += 1
            self._asked_at_s = now_s
        if not self._n_waiting:
            self._wait(now_s)
        self._n_sent += 1
        return Chunk(self.tag, index, ask, self.descriptor.cut(self._blob, index))

    def receive(
        self, status: TransferStatus, now_s: float
    ) -> BlobDelivered | TransferFailed | None:
        """Take in what the peer says; return how the transfer ended, if it did."""
        if self._progress_at_s is None:
            return None  # nothing was sent yet, so this answers somebody else
        match status.reply:
            case Reply.COMPLETE:
                if status.digest == self.descriptor.short_digest:
                    return BlobDelivered(self.peer, self.transfer_id)
                self._obstacle = "another blob under the same tag"
            case Reply.TOO_LARGE | Reply.CORRUPT:
                why = "too large" if status.reply == Reply.TOO_LARGE else "damaged on the way"
                reason = f"peer {self.peer} refuses the blob: {why}"
                return TransferFailed(self.peer, self.transfer_id, reason)
            case Reply.BUSY:
                self._obstacle = "nothing but 'busy'"
                self._waiting[:] = False
                self._n_waiting = 0
                self._wait(now_s)
            case Reply.RECEIVING:
                self._take_window(status, now_s)
        return None

    def _take_window(self, status: TransferStatus, now_s: float) -> None:
        """Note what arrived and queue what was lost, of the chunks the status tells of."""
        answered = self._answered_segment(status.ask)
        if answered < self._newest_answer:
            return
        self._newest_answer = answered
        window = slice(min(status.first, len(self._waiting)), min(status.end, len(self._waiting)))
        missing = np.zeros(len(self._waiting), dtype=np.bool_)
        for start, stop in status.missing:
            missing[start:stop] = True
        missing = missing[window]
        lost = missing & (self._sent_in[window] <= answered)
        self._arrived[window] = ~missing | (self._arrived[window] & ~lost)
        self._waiting[window] = lost | (self._waiting[window] & missing)
        self._n_waiting = int(self._waiting.sum())
        self._lowest_waiting = int(np.argmax(self._waiting))
        self._backoff = 1.0
        n_arrived = int(self._arrived.sum())
        if n_arrived > self._n_arrived:
            self._progress_at_s = now_s
        self._n_arrived = n_arrived
        self._obstacle = "no progress"
        if not self._n_waiting:
            self._wait(now_s)

    def _answered_segment(self, ask: int) -> int:
        """Return the newest asked segment with this ask number; 0 if there is none."""
        newest = self._segment - 1
        return max(newest - (newest - (ask - 1)) % MAX_ASK, 0)

    def _wait(self, now_s: float) -> None:
        """Wait for an answer; the jitter keeps many senders from asking in step."""
        interval_s = self._options.status_interval_s * self._backoff
        self._ask_again_at_s = now_s + interval_s * float(self._rng.uniform(0.9, 1.1))
