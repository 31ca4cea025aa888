"""A part of the map first, for those who have none where the whole takes long to send.

On a radio of 57,600 baud a map of a dozen keyframes takes most of a minute. Who comes late, or
was restarted, is sent the newest keyframes and what they show (``MAP_PART``), flies on them, and
gets the rest as an update of that part: of whatever revision is the newest by then.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

from vcl_companion.daemon.map_offer import HandOut
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork

_log = logging.getLogger(__name__)

# Rests are of one revision at a time, and everybody who comes has one of the last parts.
_N_RESTS = 8
# A peer, however busy, has taken in what it was sent and said so after this, or refused it.
TAKE_IN_S = 20.0


@dataclass(frozen=True)
class _Sent:
    """The part that a peer was sent first: its blob, the transfer, and whether it has arrived."""

    blob: bytes
    transfer_id: int
    arrived_at_s: float | None = None

    @property
    def has_arrived(self) -> bool:
        """Whether the peer has it, though perhaps not in use yet."""
        return self.arrived_at_s is not None


class MapParts:
    """Knows who was sent which part, and has parts and rests made.

    Args:
        maps: the current map, which parts are of.
        work: makes parts and rests.
        submit: sends a part to a peer, or goes on with it; returns the transfer's id.
        quick_bytes: a map up to this long is sent whole, a part is no longer.
    """

    def __init__(
        self,
        maps: MapStore,
        work: MapWork,
        submit: Callable[[int, bytes], int],
        quick_bytes: int,
    ) -> None:
        self._maps = maps
        self._work = work
        self._submit = submit
        self._quick_bytes = quick_bytes
        self._sent: dict[int, _Sent] = {}
        self._of: tuple[bytes, bytes] = (b"", b"")  # a revision, and its part; empty: it has none
        self._rests: dict[tuple[bytes, bytes], bytes] = {}  # by revision and part
        self._wanted: asyncio.Queue[bytes] = asyncio.Queue(1)  # the part of a rest; empty: a part
        self._making: bytes | None = None  # what was wanted, likewise

    def _is_long(self, stored: HandOut) -> bool:
        """Whether a map has parts; a first one is a frame of each drone: less of it is none."""
        return bool(stored.parent) and len(stored.data) > self._quick_bytes

    def comes_first(self, peer: int, stored: HandOut, *, is_on_part: bool) -> bool:
        """Send a peer without a map a part of ours; whether that has to arrive before the rest.

        Who is on a part of somebody else's takes none of ours, and knows nothing of its rest.
        """
        sent = self._sent.get(peer)
        if sent is None and is_on_part:
            return False
        if sent is not None:
            if not sent.has_arrived:
                # Goes on, or begins again when it was given up.
                self._sent[peer] = replace(sent, transfer_id=self._submit(peer, sent.blob))
                self._rest(stored, sent)  # is needed as soon as it has arrived
            return not sent.has_arrived
        if not self._is_long(stored):
            return False
        if self._of[0] != stored.revision:
            self._want(stored, b"")
            return True
        blob = self._of[1]
        if blob:
            self._sent[peer] = _Sent(blob, self._submit(peer, blob))
        return bool(blob)

    def rest_for(
        self, peer: int, stored: HandOut, now_s: float, *, is_on_part: bool
    ) -> bytes | None:
        """Return what a map has beyond the part that a peer has; empty if it has none of ours.

        None while it is being made, or the part on its way. Who has the part but does not fly on
        it yet takes what comes behind it afterwards.
        """
        sent = self._sent.get(peer)
        if sent is None:
            return b""
        if not is_on_part:
            if sent.arrived_at_s is None:
                return None
            if now_s >= sent.arrived_at_s + TAKE_IN_S:
                return b""
        return self._rest(stored, sent)

    def _rest(self, stored: HandOut, sent: _Sent) -> bytes | None:
        """Return what a map has beyond a part; None while it is being made."""
        rest = self._rests.get((stored.revision, sent.blob))
        if rest is None:
            self._want(stored, sent.blob)
        return rest

    def delivered(self, peer: int, transfer_id: int, now_s: float) -> None:
        """Note that a transfer has arrived at a peer, one of ours or any other."""
        sent = self._sent.get(peer)
        if sent is not None and sent.transfer_id == transfer_id:
            self._sent[peer] = replace(sent, arrived_at_s=now_s)

    def forgot(self, peer: int) -> None:
        """Note that a peer may have lost what it was sent, or has the whole."""
        self._sent.pop(peer, None)

    async def run(self) -> None:
        """Make the parts and rests that are wanted until cancelled."""
        while True:
            part = await self._wanted.get()
            stored = self._maps.current
            if stored is None or stored.part_of:
                continue
            self._making = part
            try:
                await self._make(stored, part)
            except Exception:
                # Peers' images and numbers went in: none of them may end the flight.
                _log.exception("no part of the map can be made")
                self._of = stored.revision, b""
                self._rests[stored.revision, part] = b""
            finally:
                self._making = None

    async def _make(self, stored: StoredMap, part: bytes) -> None:
        if not part:
            self._of = stored.revision, await self._work.part(stored, self._quick_bytes)
            return
        self._rests[stored.revision, part] = await self._work.rest(stored, part)
        while len(self._rests) > _N_RESTS:
            del self._rests[next(iter(self._rests))]

    def _want(self, stored: HandOut, part: bytes) -> None:
        """Have a part, or a rest, of a map made; not before that is in use, as it soon is."""
        current = self._maps.current
        is_in_use = current is not None and current.revision == stored.revision
        if is_in_use and part != self._making and not self._wanted.full():
            self._wanted.put_nowait(part)
