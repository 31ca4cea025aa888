"""Maps between peers: taken in from those who may give one, handed to those who lack it.

The coordinator hands its map to everybody. One without a map (it is back, or
late) is handed that of the first holder instead of building another.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.mailbox import PeerMailbox
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.errors import WireError
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import BlobKind, Transfers
from vcl_companion.vision.features import Detector, FeatureOptions
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of

_log = logging.getLogger(__name__)

# A peer needs this long to take a map in and to say so; a failed transfer begins anew.
_HAND_AGAIN_S = 10.0


@dataclass(frozen=True)
class _Handed:
    """A map that was handed to a peer."""

    revision: bytes
    at_s: float
    transfer_id: int


class MapSharing:
    """One drone's part in everybody flying on the same map.

    Args:
        group: who is there.
        transfers: blobs on their way.
        maps: the current map.
        log: told of every map flown on.
        executor: runs decoding, indexing and writing.
        tell_state: tells peers which map we fly on.
        refuse: counts what a peer sent in vain: peer, kind, detail.
        detector: the localization's own.
        features: how they are found.
    """

    def __init__(
        self,
        group: Group,
        transfers: Transfers,
        maps: MapStore,
        log: FlightLog,
        executor: Executor,
        tell_state: Callable[[], None],
        refuse: Callable[[int, str, str], None],
        detector: Detector,
        features: FeatureOptions,
    ) -> None:
        self._group = group
        self._transfers = transfers
        self._maps = maps
        self._log = log
        self._executor = executor
        self._tell_state = tell_state
        self._refuse = refuse
        self._detector: Detector = detector
        self._features = features
        self._offered: PeerMailbox[bytes] = PeerMailbox()
        self._handed: dict[int, _Handed] = {}

    def offer(self, peer: int, data: bytes) -> None:
        """Take a peer's encoded map; looked at when its turn comes."""
        self._offered.put(peer, data)

    def forgot(self, peer: int) -> None:
        """Note that a peer may have lost the map it was handed: it was restarted, or away."""
        self._handed.pop(peer, None)

    async def run(self) -> None:
        """Take in what peers offer, one map after the other, until cancelled."""
        while True:
            peer, data = await self._offered.take()
            current = self._maps.current
            if current is not None and current.revision == revision_of(data):
                self._tell_state()  # it did not know that we have it
                continue
            if not self._may_replace(peer):
                self._refuse(peer, "map, but not from the coordinator", "")
                continue
            index = await self._prepared(data)
            if isinstance(index, NoMap):
                self._refuse(peer, "map", index.reason)
            elif self._may_replace(peer):  # still: preparing took a while
                await self._install(data, index)

    async def adopt(self, built: LandmarkMap) -> NoMap | None:
        """Fly on a first map of our own, exactly as peers will decode it.

        Returns:
            None, or why it cannot be used. A map that came meanwhile stays.
        """
        loop = asyncio.get_running_loop()
        try:
            data = await loop.run_in_executor(self._executor, encode_map, built)
        except ValueError as error:
            return NoMap(str(error))
        index = await self._prepared(data)
        if isinstance(index, NoMap):
            return index
        if self._maps.current is None:
            await self._install(data, index)
        return None

    def hand_out(self, now_s: float) -> None:
        """Send the map to those who lack it: as coordinator, or to a coordinator without one."""
        stored = self._maps.current
        if stored is None:
            return
        for peer in self._lacking(stored.revision):
            last = self._handed.get(peer)
            if last is not None and last.revision != stored.revision:
                self._transfers.cancel(last.transfer_id)
            elif last is not None and now_s - last.at_s < _HAND_AGAIN_S:
                continue
            sent_id = self._transfers.submit(peer, BlobKind.MAP, stored.data, now_s)
            self._handed[peer] = _Handed(stored.revision, now_s, sent_id)

    def _lacking(self, revision: bytes) -> list[int]:
        group = self._group
        if group.is_coordinator:
            return [peer for peer in group.lacking() if peer != group.own_id]
        if group.newest_revision or group.state_of(group.coordinator) is None:
            return []
        is_first_holder = group.holders(revision)[:1] == (group.own_id,)
        return [group.coordinator] if is_first_holder else []

    def _may_replace(self, peer: int) -> bool:
        """Whether we fly on a peer's map: the coordinator's, or anybody's while we have none."""
        return peer == self._group.coordinator or self._maps.current is None

    async def _prepared(self, data: bytes) -> MapIndex | NoMap:
        """Make a map ready for use, beside the event loop; or say why it cannot be used."""
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(self._executor, self._index, data)
        except (WireError, ValueError) as error:
            return NoMap(str(error))
        except Exception as error:
            # Peers' images and numbers went in: none of them may end the flight.
            _log.exception("a map cannot be used")
            return NoMap(f"using it failed: {type(error).__name__}")

    def _index(self, data: bytes) -> MapIndex:
        """Decode and index; runs in the executor and touches nothing that changes."""
        return index_map(decode_map(data), self._detector, self._features)

    async def _install(self, data: bytes, index: MapIndex) -> None:
        stored = self._maps.replace(data, index)
        n_keyframes = len(index.landmark_map.keyframes)
        self._log.map(
            stored.revision,
            stored.n_landmarks,
            len(data),
            n_keyframes,
            index.landmark_map.parent,
        )
        self._log.event("map", f"{stored.n_landmarks} landmarks in {n_keyframes} keyframes")
        _log.info("map %s: %d landmarks", stored.revision.hex(), stored.n_landmarks)
        self._tell_state()
        await asyncio.get_running_loop().run_in_executor(self._executor, self._maps.keep, stored)
