"""Maps that peers offer: flown on when they come from who may give one, and fit what we know.

Whom ours is handed to is the matter of ``map_handing``, maps that went apart that of
``map_merging``.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.mailbox import PeerMailbox
from vcl_companion.daemon.map_branches import MapBranches, way_into
from vcl_companion.daemon.map_handing import MapHanding
from vcl_companion.daemon.map_merging import MapMerging
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_trial import MapTrial
from vcl_companion.daemon.map_use import MapUse
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import BadBytes, survived
from vcl_companion.daemon.own_maps import OwnMaps
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_trust import PeerTrust
from vcl_companion.errors import WireError
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.landmark_map import JoinedMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.quarantine import Evidence
from vcl_companion.swarm.transfer import BlobKind, Transfers

# A map that was refused may come again after this: we may know better by then.
_LOOK_AGAIN_S = 5.0
# Maps remembered as such; one that is forgotten counts once more.
_N_CONTRADICTING = 64


class MapSharing:
    """One drone's part in everybody flying on the same map.

    Args:
        group: who is there.
        transfers: blobs on their way.
        maps: the current map.
        log: told of every map flown on, and of worlds joined.
        work: does decoding and indexing.
        disk: runs the writing.
        tell_state: tells peers which map we fly on.
        refuse: counts what a peer sent in vain: peer, kind, detail.
        trust: told whose maps contradict ours, says whose are not taken.
        passed: who was sent which image ahead.
        delivery_wait_s: how long a coordinator that is back with a map which we
            have left may take to be brought up to date; then it has its way.
        falls_back: whether maps are indexed by other detectors too, sooner or later.
        trial: holds maps against what our own frames have shown.
        carry: takes what is believed of our pose to another map's world.
        is_updating: whether a round of ours is under way that updates the map.

    Attributes:
        handing: whom ours is handed to.
        own_maps: those that no peer has given us.
        merging: of those that went apart from ours.
    """

    def __init__(
        self,
        group: Group,
        transfers: Transfers,
        maps: MapStore,
        log: FlightLog,
        work: MapWork,
        disk: Executor,
        tell_state: Callable[[], None],
        refuse: Callable[[int, str, str], None],
        trust: PeerTrust,
        passed: PassedFrames,
        delivery_wait_s: float,
        falls_back: bool,
        trial: MapTrial,
        carry: Callable[[Similarity], None],
        is_updating: Callable[[], bool],
    ) -> None:
        self._group = group
        self._transfers = transfers
        self._maps = maps
        self._log = log
        self._tell_state = tell_state
        self._refuse = refuse
        self._trust = trust
        self._delivery_wait_s = delivery_wait_s
        self._contradicting: deque[tuple[int, bytes]] = deque(maxlen=_N_CONTRADICTING)
        self._passed = passed
        self._trial = trial
        self._carry = carry
        self._branches = MapBranches(group, maps, self._is_receiving, delivery_wait_s)
        self._offered: PeerMailbox[MapOffer] = PeerMailbox()
        self._use = MapUse(group, maps, log, work, disk, passed, tell_state, falls_back)
        self.handing = MapHanding(group, transfers, maps, work, passed, self._branches)
        self.own_maps = OwnMaps(group, maps, work, self._branches, self.handing, self._use)
        self.merging = MapMerging(
            maps, log, work, self._branches, self.own_maps, is_updating, self._bad_bytes
        )

    def offer(self, peer: int, kind: BlobKind, blob: bytes) -> None:
        """Take a peer's encoded map, whole or without its parent's images.

        It is looked at when its turn comes.
        """
        try:
            self._offered.put(peer, MapOffer.of(kind, blob))
        except WireError as error:
            self._trust.malformed(peer, "map", error)

    async def run(self) -> None:
        """Take in what peers offer, and index what is in use, until cancelled."""
        async with asyncio.TaskGroup() as parts:
            parts.create_task(self._take_offers())
            parts.create_task(self._use.index_more())
            parts.create_task(self.handing.run())

    async def _take_offers(self) -> None:
        """Look at one map after the other."""
        while True:
            peer, offer = await self._offered.take()
            with survived("taking a map"):
                await self._take_offer(peer, offer)

    async def _take_offer(self, peer: int, offer: MapOffer) -> None:
        current = self._maps.current
        if current is not None and current.revision == offer.revision:
            self._tell_state()  # it did not know that we have it
            return
        if self._may_merge(peer, offer):
            wait_s = self.merging.wait_s(peer)
            if wait_s > 0:
                self._offered.put_later(peer, offer, wait_s)
                return
            held = offer.images_here(self._passed.held, self._maps.current)
            if offer.images_missing() - held.keys():  # it comes whole, then
                self._reject(peer, offer, "map", "an image of it is not here")
                return
            if await self.merging.merge(peer, offer, held):
                return
        refusal = await self._taken(peer, offer)
        if refusal is not None:
            self._reject(peer, offer, *refusal)

    async def _taken(self, peer: int, offer: MapOffer) -> tuple[str, str] | None:
        """Fly on a peer's map; or say what is refused, and why."""
        why_not = self._why_not(peer, offer)
        if why_not is not None:
            return why_not, ""
        ready = await self._use.made_ready(offer)
        if isinstance(ready, NoMap):
            # What an update lacks, its parent or an image, honest drones do not know.
            if isinstance(ready, BadBytes) and offer.kind != BlobKind.MAP_UPDATE:
                self._bad_bytes(peer, ready.reason)
            return "map", ready.reason
        ready = await self._tried(ready, offer.revision)
        why_not = self._why_not(peer, offer)  # again: preparing took a while
        if why_not is not None:
            return why_not, ""
        if self._contradicts(peer, offer, ready):
            return "map that contradicts ours", ready.contradicts
        way = self._way_into(peer, ready, offer.revision)
        if isinstance(way, str):
            return "map that is not joined with ours", way
        self.handing.was_given(peer, offer.revision)
        self._join(peer, way)
        await self._use.fly_on(ready)
        return None

    async def _tried(self, ready: ReadyMap, revision: bytes) -> ReadyMap:
        """Try a map that does not contradict ours on what our own frames have shown."""
        current = self._maps.current
        if ready.contradicts or current is None:
            return ready
        way = way_into(current, ready.index.landmark_map, revision)
        if isinstance(way, str):
            return ready
        into = None if way is None else way.world_from_other
        tried = await self._trial.tried(ready, into)
        unproven = "" if tried.shows else ready.unproven
        return replace(ready, contradicts=tried.contradicts, unproven=unproven)

    def _may_merge(self, peer: int, offer: MapOffer) -> bool:
        return not self._trust.why_not(peer) and self._branches.is_to_merge(peer, offer)

    def _way_into(self, peer: int, ready: ReadyMap, revision: bytes) -> JoinedMap | str | None:
        """Say how we get onto a map; see ``way_into``. A senior team's must have ours in it.

        What a map says of where our world lies is not believed where neither what it has of ours
        nor a frame of our own shows it. That speaks against nobody: a map that was extended long
        enough has nothing of ours any more.

        Who is lost on its own map, or flies on one that most others say is wrong, has no way
        to look for.
        """
        current = self._maps.current
        if current is None:
            return None
        new = ready.index.landmark_map
        if self._branches.comes_from_senior(peer) and not any(
            other.revision == current.revision or self._maps.has_left(other.revision)
            for other in new.joined
        ):
            return "ours is not in it"
        way = way_into(current, new, revision)
        if isinstance(way, JoinedMap) and ready.unproven:
            way = ready.unproven
        own = self._group.state_of(self._group.own_id)
        is_of_no_use = own is None or not own.localized or bool(ready.contradicts)
        return None if isinstance(way, str) and is_of_no_use else way

    def _join(self, peer: int, way: JoinedMap | None) -> None:
        """Go over to a map that is another team's, or of another world."""
        if self._branches.comes_from_senior(peer):
            self._group.join(self._group.team_of(peer))
        if way is not None:
            self._log.event("world", f"ours is joined with {way.world.hex()}'s")
            self._carry(way.world_from_other)

    def _is_receiving(self) -> bool:
        kinds = (BlobKind.MAP, BlobKind.MAP_UPDATE)
        return any(self._transfers.is_receiving(kind, self._now_s()) for kind in kinds)

    def _contradicts(self, peer: int, offer: MapOffer, ready: ReadyMap) -> bool:
        """Whether a map is not taken for what it says; that speaks against who offers it.

        Where most others fly on it, it is ours that is wrong. The same map, offered again,
        says nothing new of the peer. Nor does one of another world that ours is not joined with,
        though a third part of the swarm has brought it keyframes of ours: there they lie elsewhere.
        """
        if not ready.contradicts or self._group.maps.most_others_hold(offer.revision):
            self._trust.note(peer, Evidence.MAP_TAKEN)
            return False
        current = self._maps.current
        is_apart = current is not None and isinstance(
            way_into(current, ready.index.landmark_map, offer.revision), str
        )
        if not is_apart and (peer, offer.revision) not in self._contradicting:
            self._contradicting.append((peer, offer.revision))
            self._trust.note(peer, Evidence.MAP_CONTRADICTED, f"map: {ready.contradicts}")
        return True

    def _bad_bytes(self, peer: int, why: str) -> None:
        self._trust.note(peer, Evidence.MALFORMED, f"map: {why}")

    def _why_not(self, peer: int, offer: MapOffer) -> str | None:
        """Return why we do not fly on a peer's map, or None if we do.

        Anybody's who is believed is taken while we have none, later only the coordinator's. The
        coordinator itself takes one that goes on from its own, or that most fly on. Of a senior
        team's coordinator one is taken that has ours in it, which is not known here.
        """
        group, current = self._group, self._maps.current
        if self._trust.why_not(peer):
            return "map of a quarantined drone"
        if current is None:
            return None
        if offer.part_of:
            return "part of a map, but there is one"
        if current.part_of:
            return None
        if group.is_coordinator:
            holders = group.maps.holders(offer.revision)
            trusted = group.trusted_teammates
            n_holders = sum(member in trusted for member in holders)
            if 2 * n_holders > len(trusted) or offer.parent == current.revision:
                return None
        if self._branches.comes_from_senior(peer):
            return None
        if peer != group.coordinator:
            if offer.parent == current.revision and self._branches.goes_on_by(peer, self._now_s()):
                return None
            return "map, but not from the coordinator"
        if not group.leadership.may_lead(peer):
            return "map of a coordinator that was away"
        if self._maps.has_left(offer.revision) and not self.handing.has_been_behind(
            self._delivery_wait_s
        ):
            return "map that was left"
        return None

    def _reject(self, peer: int, offer: MapOffer, kind: str, detail: str = "") -> None:
        """Count a map that is not taken; when it comes again it is looked at again."""
        self._refuse(peer, kind, detail)
        self._transfers.forget(peer, offer.kind, offer.blob, self._now_s() + _LOOK_AGAIN_S)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
