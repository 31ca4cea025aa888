"""Who hears a frame that was asked for: who has asked, and all who will need its image."""

from __future__ import annotations

from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.outbox import Outbox
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import BlobKind, Transfers


class AnswerHearers:
    """Sends answers to who has asked, and to all others where that costs nothing.

    Args:
        group: who is believed, and has a map.
        transfers: whether all hear what is sent to one.
        maps: whether we have a map ourselves.
        outbox: sends.
    """

    def __init__(self, group: Group, transfers: Transfers, maps: MapStore, outbox: Outbox) -> None:
        self._group = group
        self._transfers = transfers
        self._maps = maps
        self._outbox = outbox

    def hand(self, asker: int, blob: bytes) -> tuple[int, ...]:
        """Send an encoded answer; return the transfers' ids, that to who has asked first."""
        return tuple(
            self._outbox.hand(BlobKind.FRAME_ANSWER, peer, blob)
            for peer in (asker, *self._others(asker))
        )

    def _others(self, asker: int) -> list[int]:
        """Return who extends the map that it has by what it hears, or is about to have a first."""
        group = self._group
        hears = group.trusted_teammates if self._transfers.shares_network else ()
        is_first = self._maps.current is None
        others = [peer for peer in hears if peer not in (asker, group.own_id)]
        return [peer for peer in others if is_first or group.maps.has_map(peer)]
