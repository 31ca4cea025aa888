"""Answers that receivers of blobs owe their senders: when each is due, and what all may cost."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from vcl_companion.swarm.budget import MAX_FRAME_BYTES, ByteBudget
from vcl_companion.swarm.transfer_options import Pace
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.tunnel import encode_payload

MAX_STATUSES = 8  # payloads in one answer
_MAX_ANSWERS = 64  # answers owed at one time, to one peer
_QUIET_SHARE = 0.1  # of the status interval: no chunk for this long, and an answer goes out
# Of the budget, for answers to one peer: who asks all the time shall not have all of it.
_ANSWERS_SHARE = 0.25

Key = tuple[int, int]  # peer, tag


@dataclass(frozen=True)
class _Answer:
    """A status owed to a peer."""

    due_s: float
    asked_at_s: float
    ask: int


class OwedAnswers:
    """What is owed to all peers."""

    def __init__(self, pace: Pace) -> None:
        self._pace = pace
        self._answers: dict[Key, _Answer] = {}
        self._n_owed: Counter[int] = Counter()  # of these, to each peer
        self._budgets: dict[int, ByteBudget] = {}  # by peer

    def owe_now(self, key: Key, ask: int, now_s: float) -> None:
        """Note an answer that is due at once."""
        self._owe(key, _Answer(now_s, now_s, ask))

    def note_ask(self, key: Key, chunk: Chunk, now_s: float, answered_at_s: float) -> None:
        """Owe an answer if the chunk asks, and put it off while chunks still come in.

        Chunks overtake each other: an answer given at once would call those
        lost that are still on their way. Only a sender that begins (nothing is
        on its way yet) learns at once what is here already.

        Args:
            key: of the transfer.
            chunk: that has come.
            now_s: when.
            answered_at_s: when an answer about this transfer went out last.
        """
        owed = self._answers.get(key)
        if owed is None and not chunk.ask:
            return
        interval_s = self._pace.status_interval_s
        asked_at_s = now_s if owed is None else owed.asked_at_s
        due_s = min(asked_at_s + interval_s, now_s + _QUIET_SHARE * interval_s)
        if chunk.ask and chunk.index == 0 and now_s - answered_at_s >= interval_s:
            due_s = now_s
        elif owed is not None and owed.due_s <= now_s:
            due_s = owed.due_s
        self._owe(key, _Answer(due_s, asked_at_s, chunk.ask or (owed.ask if owed else 1)))

    def take_due(
        self, now_s: float, answered: Callable[[Key, int], list[TransferStatus]]
    ) -> list[tuple[int, TransferStatus]]:
        """Return the (peer, status) that are due; what is returned counts as sent.

        Args:
            now_s: the time.
            answered: what there is to say about a transfer, to an ask.
        """
        out: list[tuple[int, TransferStatus]] = []
        for key in [key for key, answer in self._answers.items() if answer.due_s <= now_s]:
            budget = self._budget(key[0])
            budget.refill(now_s)
            if not budget.allows_one():
                continue
            answer = self._answers.pop(key)
            self._n_owed[key[0]] -= 1
            for status in answered(key, answer.ask):
                budget.spend(len(encode_payload(status)[1]))
                out.append((key[0], status))
        return out

    def next_s(self) -> float:
        """Return when an answer is due; infinity for never."""
        return min(
            (
                max(answer.due_s, self._budget(peer).ready_at_s())
                for (peer, _), answer in self._answers.items()
            ),
            default=math.inf,
        )

    def _owe(self, key: Key, answer: _Answer) -> None:
        """Note an answer; beyond a bound it is left out, and the sender asks again."""
        if key not in self._answers:
            peer = key[0]
            if self._n_owed[peer] >= _MAX_ANSWERS:
                return
            self._n_owed[peer] += 1
        self._answers[key] = answer

    def _budget(self, peer: int) -> ByteBudget:
        """Return what may be spent on answers to a peer."""
        if peer not in self._budgets:
            rate = _ANSWERS_SHARE * self._pace.rate_bytes_per_s
            self._budgets[peer] = ByteBudget(rate, MAX_STATUSES * MAX_FRAME_BYTES)
        return self._budgets[peer]
