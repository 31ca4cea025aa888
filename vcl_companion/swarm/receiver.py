"""One receiver of a blob on its way out: what it has, and whether it owes an answer."""

from __future__ import annotations

import math

import numpy as np

from vcl_companion.swarm.repairs import n_blocks, per_block
from vcl_companion.swarm.transfer_options import Pace

_BACKOFF = 1.25
# Before it is given up it has been asked this often at the least: at 50 % loss one of four is
# answered.
_LEAST_ASKS = 30
_MAX_SENDS_PER_CHUNK = 100  # at 95 % loss twenty are expected
_MIN_SENDS = 1000
# While others wait for its answer it is asked often, a few times.
_SHORT_TRIES = 4


class Receiver:
    """What the sender knows of one receiver."""

    def __init__(
        self, transfer_id: int, peer: int, n_chunks: int, pace: Pace, rng: np.random.Generator
    ) -> None:
        self.transfer_id = transfer_id
        self.peer = peer
        self.arrived = np.zeros(n_chunks, dtype=np.bool_)
        # Of each block: how much will have been sent of it when it can have enough.
        self.goal = np.zeros(n_blocks(n_chunks), dtype=np.int64)
        self.lacking = per_block(~self.arrived)  # of each block, by its own count
        self.newest_answer = 0  # segment of the ask that it answered
        self.is_open = False  # it has said what it has, so it takes what is sent to all
        self.is_busy = False
        self.owes_answer = False
        self.obstacle = "no answer"
        self.ask_again_at_s = -math.inf
        self._pace = pace
        self._rng = rng
        self._backoff = 1.0
        self.n_asked = 0  # in vain so far
        self._n_arrived = 0
        self._n_sent = 0
        self._progress_at_s: float | None = None  # None until something was sent to it

    @property
    def was_sent_something(self) -> bool:
        """Whether it can have an opinion."""
        return self._progress_at_s is not None

    @property
    def is_awaited(self) -> bool:
        """Whether an answer is about to come, as far as one can tell."""
        return self.owes_answer and self.n_asked < _SHORT_TRIES

    def gives_up_at_s(self) -> float:
        """Return when patience ends if nothing progresses until then."""
        if self._progress_at_s is None:
            return math.inf
        return self._progress_at_s + self._pace.give_up_s

    def failure(self, now_s: float) -> str | None:
        """Return why it is time to give up, or None while it is not."""
        if now_s >= self.gives_up_at_s():
            return f"{self.obstacle} from peer {self.peer} for {self._pace.give_up_s:g} s"
        if self._n_sent > _MIN_SENDS + _MAX_SENDS_PER_CHUNK * len(self.arrived):
            return f"peer {self.peer} is still missing parts after {self._n_sent} payloads"
        return None

    def sent(self, now_s: float) -> None:
        """Note that a chunk has been sent for its sake."""
        self._n_sent += 1
        if self._progress_at_s is None:
            self._progress_at_s = now_s

    def asked_alone(self) -> None:
        """Note that it was asked by itself, since it had not answered."""
        self.n_asked += 1
        most_s = max(self._pace.give_up_s / _LEAST_ASKS, self._pace.status_interval_s)
        self._backoff = min(_BACKOFF * self._backoff, most_s / self._pace.status_interval_s)

    def wait_shortly(self, now_s: float) -> None:
        """Wait for the first answer, which others wait for; after a few times as usual."""
        self.wait(now_s)
        if self.n_asked <= _SHORT_TRIES:
            self.ask_again_at_s = now_s + self._pace.status_interval_s / _SHORT_TRIES

    def wait(self, now_s: float) -> None:
        """Wait for an answer; the jitter keeps many senders from asking in step."""
        interval_s = self._pace.status_interval_s * self._backoff
        self.ask_again_at_s = now_s + interval_s * float(self._rng.uniform(0.9, 1.1))

    def answered(self, now_s: float) -> None:
        """Note a look at what it has."""
        self.is_open, self.is_busy, self.owes_answer = True, False, False
        self._backoff, self.n_asked = 1.0, 0
        self.obstacle = "no progress"

    def share_arrived(self, n_sent: int) -> float:
        """Return how much of what was sent has arrived, at most 1: as far as one can tell."""
        return min(self._n_arrived / max(n_sent, 1), 1.0) if self._n_arrived > 1 else 1.0

    def has(self, n_chunks: int, now_s: float) -> None:
        """Note how much it has, which is progress if it is more than before."""
        if n_chunks > self._n_arrived:
            self._progress_at_s = now_s
        self._n_arrived = n_chunks
