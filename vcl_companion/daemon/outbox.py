"""What is said to peers: one way out for messages, blobs and questions for the time."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from vcl_companion.links.peers import PeerLink
from vcl_companion.swarm.transfer import BlobKind, Event, Transfers
from vcl_companion.swarm.urgency import Message

_STEP_S = 0.1


class Outbox:
    """Takes what is to be said, and says what is due; silent until it has a link.

    Args:
        transfers: blobs on their way.
    """

    def __init__(self, transfers: Transfers) -> None:
        self._transfers = transfers
        self._link: PeerLink | None = None
        self._wake = asyncio.Event()

    def attach(self, link: PeerLink) -> None:
        """Give the link to speak on."""
        self._link = link
        self._transfers.reaches_all_with(link.copies_to_all)

    def send(self, message: Message, peer: int) -> None:
        """Have a message to a peer, or to all (0), go before all that is less urgent."""
        self._transfers.post(peer, message)
        self.wake()

    def hand(self, kind: BlobKind, peer: int, blob: bytes) -> int:
        """Begin to send a blob to a peer; return the transfer's id."""
        self.wake()
        return self._transfers.submit(peer, kind, blob, self._now_s())

    def ask_time(self, ts1_ns: int, peer: int) -> None:
        """Ask a peer what its clock says, at once: an answer is worth what it was on its way."""
        if self._link is not None:
            self._link.ask_time(ts1_ns, peer)

    def poll(self) -> list[Event]:
        """Say what is due; return what became of transfers."""
        outgoing, events = self._transfers.poll(self._now_s())
        for payload in outgoing:
            if self._link is not None:
                self._link.send(payload.payload_type, payload.payload, payload.peer)
        return events

    def wake(self) -> None:
        """End a pause: there may be something to say."""
        self._wake.set()

    async def pause(self, since_s: float) -> None:
        """Wait until something is due or new, a tenth of a second at most.

        Args:
            since_s: the loop's time when what was due was looked for.
        """
        due_s = self._transfers.next_poll_s()
        pause_s = _STEP_S if due_s is None else min(max(due_s - since_s, 0.001), _STEP_S)
        self._wake.clear()
        with suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                await self._wake.wait()

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
