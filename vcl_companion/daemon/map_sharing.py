"""Maps between peers: taken in from those who may give one, merged where they went apart.

Whom ours is handed to is the matter of ``map_handing``.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import replace

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.mailbox import PeerMailbox
from vcl_companion.daemon.map_branches import MapBranches, way_into
from vcl_companion.daemon.map_handing import MapHanding
from vcl_companion.daemon.map_offer import MapOffer, ReadyMap
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_trust import PeerTrust
from vcl_companion.daemon.usage import give_back_freed
from vcl_companion.errors import WireError
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.mapping.landmark_map import JoinedMap, LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.quarantine import Evidence
from vcl_companion.swarm.transfer import BlobKind, Transfers
from vcl_companion.wire.map_update import images_missing_in

_log = logging.getLogger(__name__)

# A map that has stayed for so long is likely to stay: it is indexed by all detectors, before
# somebody is lost in it. In fast flight the next one comes sooner.
_STAYS_S = 3.0
_BETWEEN_MERGES_S = 0.5
# A round that ours is being updated in is let end before ours is merged, but not for longer.
_ROUND_S, _LOOK_S = 5.0, 0.05
# A map that was refused may come again after this: we may know better by then.
_LOOK_AGAIN_S = 5.0
# Ours changes while it is merged with another one, but hardly so often.
_MERGE_ATTEMPTS = 3
# Maps remembered as such; one that is forgotten counts once more.
_N_CONTRADICTING = 64


class MapSharing:
    """One drone's part in everybody flying on the same map.

    Args:
        group: who is there.
        transfers: blobs on their way.
        maps: the current map.
        log: told of every map flown on.
        work: does decoding and indexing.
        disk: runs the writing.
        tell_state: tells peers which map we fly on.
        refuse: counts what a peer sent in vain: peer, kind, detail.
        trust: told whose maps contradict ours, says whose are not taken.
        passed: who was sent which image ahead.
        delivery_wait_s: how long a coordinator that is back with a map which we
            have left may take to be brought up to date; then it has its way.
        falls_back: whether maps are indexed by other detectors too, sooner or later.
        carry: takes what is believed of our pose to another map's world.
        is_updating: whether a round of ours is under way that updates the map.

    Attributes:
        handing: whom ours is handed to.
        is_merging: whether another map is being merged into ours.
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
        carry: Callable[[Similarity], None],
        is_updating: Callable[[], bool],
    ) -> None:
        self._group = group
        self._transfers = transfers
        self._maps = maps
        self._log = log
        self._work = work
        self._disk = disk
        self._tell_state = tell_state
        self._refuse = refuse
        self._trust = trust
        self._passed = passed
        self._delivery_wait_s = delivery_wait_s
        self._falls_back = falls_back
        self._contradicting: deque[tuple[int, bytes]] = deque(maxlen=_N_CONTRADICTING)
        self._carry = carry
        self._is_updating = is_updating
        self._branches = MapBranches(group, maps, self._is_receiving, delivery_wait_s)
        self._offered: PeerMailbox[MapOffer] = PeerMailbox()
        self.is_merging = False
        self.handing = MapHanding(group, transfers, maps, work, passed, self._branches)

    def offer(self, peer: int, kind: BlobKind, blob: bytes) -> None:
        """Take a peer's encoded map, whole or without its parent's images.

        It is looked at when its turn comes.
        """
        try:
            self._offered.put(peer, MapOffer.of(kind, blob))
        except WireError as error:
            self._refuse(peer, "map", str(error))

    async def run(self) -> None:
        """Take in what peers offer, and index what is in use, until cancelled."""
        async with asyncio.TaskGroup() as parts:
            parts.create_task(self._take_offers())
            parts.create_task(self._index_more())
            parts.create_task(self.handing.run())

    async def _take_offers(self) -> None:
        """Look at one map after the other."""
        while True:
            await self._take_offer(*await self._offered.take())

    async def _take_offer(self, peer: int, offer: MapOffer) -> None:
        current = self._maps.current
        if current is not None and current.revision == offer.revision:
            self._tell_state()  # it did not know that we have it
            return
        if self._may_merge(peer, offer) and await self._merge(peer, offer):
            return
        refusal = await self._taken(peer, offer)
        if refusal is not None:
            self._reject(peer, offer, *refusal)

    async def _taken(self, peer: int, offer: MapOffer) -> tuple[str, str] | None:
        """Fly on a peer's map; or say what is refused, and why."""
        why_not = self._why_not(peer, offer)
        if why_not is not None:
            return why_not, ""
        ready = await self._prepared(offer)
        if isinstance(ready, NoMap):
            return "map", ready.reason
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
        await self._install(ready)
        return None

    def _may_merge(self, peer: int, offer: MapOffer) -> bool:
        return not self._trust.why_not(peer) and self._branches.is_to_merge(peer, offer)

    async def _merge(self, peer: int, offer: MapOffer) -> bool:
        """Make our next revision of ours and a peer's that went apart; whether that was done."""
        self.is_merging = True
        try:
            await self._round_is_over()
            is_merged = await self._merge_into_current(peer, offer)
        finally:
            self.is_merging = False
        # Whoever offers one after the other does not keep ours from being extended.
        await asyncio.sleep(_BETWEEN_MERGES_S)
        return is_merged

    async def _round_is_over(self) -> None:
        """Wait for the round that is under way: merged with what it replaces, all would be in vain.

        Another one does not begin meanwhile.
        """
        with suppress(TimeoutError):
            async with asyncio.timeout(_ROUND_S):
                while self._is_updating():
                    await asyncio.sleep(_LOOK_S)

    async def _merge_into_current(self, peer: int, offer: MapOffer) -> bool:
        self._log.event("merge", f"map {offer.revision.hex()} of drone {peer} into ours")
        made: LandmarkMap | NoMap = NoMap("ours changed meanwhile, again and again")
        for _ in range(_MERGE_ATTEMPTS):
            current = self._maps.current
            if current is None:
                break
            made = await self._merged(current, offer)
            if isinstance(made, LandmarkMap):
                made = await self.adopt(made, current) or made
            if isinstance(made, NoMap):
                break
            now = self._maps.current
            if now is not None and now.parent == current.revision and now.has_in_it(offer.revision):
                self._branches.merged(peer)
                self._log.event("merged", f"map {offer.revision.hex()} of drone {peer}")
                _log.info("the map of drone %d is merged into ours", peer)
                return True
        reason = made.reason if isinstance(made, NoMap) else "ours changed meanwhile"
        self._branches.refused(offer.revision)
        self._log.event("not merged", f"map of drone {peer}: {reason}")
        _log.warning("the map of drone %d is not merged into ours: %s", peer, reason)
        return False

    async def _merged(self, current: StoredMap, offer: MapOffer) -> LandmarkMap | NoMap:
        try:
            return await self._work.merged(current, offer.blob)
        except (WireError, ValueError) as error:
            return NoMap(str(error))
        except Exception as error:
            # A peer's images and numbers went in: none of them may end the flight.
            _log.exception("a map cannot be merged")
            return NoMap(f"merging failed: {type(error).__name__}")

    def _way_into(self, peer: int, ready: ReadyMap, revision: bytes) -> JoinedMap | str | None:
        """Say how we get onto a map; see ``way_into``. A senior team's must have ours in it.

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
        says nothing new of the peer.
        """
        if not ready.contradicts or self._group.most_others_hold(offer.revision):
            self._trust.note(peer, Evidence.MAP_TAKEN)
            return False
        if (peer, offer.revision) not in self._contradicting:
            self._contradicting.append((peer, offer.revision))
            self._trust.note(peer, Evidence.MAP_CONTRADICTED, f"map: {ready.contradicts}")
        return True

    async def adopt(self, built: LandmarkMap, instead_of: StoredMap | None) -> NoMap | None:
        """Fly on a map of our own, exactly as peers will decode it, and hand it out meanwhile.

        Args:
            built: a first map, or a revision of the one in use.
            instead_of: the map in use when it was begun; None for a first map.

        Returns:
            None, or why it cannot be used. A map that came meanwhile stays.
        """
        try:
            ahead = await self._work.encoded(built, instead_of)
        except (WireError, ValueError) as error:
            return NoMap(str(error))
        except Exception as error:
            # Peers' images and numbers went into it: none of them may end the flight.
            _log.exception("a map cannot be encoded")
            return NoMap(f"encoding it failed: {type(error).__name__}")
        self.handing.ahead = ahead
        try:
            offer = MapOffer.of(BlobKind.MAP, ahead.data)
            ready = await self._prepared(replace(offer, update=ahead.update))
        finally:
            self.handing.ahead = None
        if isinstance(ready, NoMap):
            return ready
        if self._maps.is_in_use(instead_of):
            self._branches.given_by(self._group.own_id)
            await self._install(ready)
        return None

    async def go_back_to(self, data: bytes) -> str:
        """Fly on a map that was saved; return why it cannot be used, or nothing.

        Not on one of another world than ours, which poses that are under way are in.
        """
        try:
            offer = MapOffer.of(BlobKind.MAP, data)
        except WireError as error:
            return str(error)
        current = self._maps.current
        if current is not None and current.revision == offer.revision:
            return ""
        ready = await self._prepared(offer)
        if isinstance(ready, NoMap):
            return ready.reason
        current = self._maps.current
        new = ready.index.landmark_map
        if current is not None and way_into(current, new, offer.revision) is not None:
            return "it is of another world than the map in use"
        self._branches.given_by(self._group.own_id)
        await self._install(ready)
        return ""

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
            holders = group.holders(offer.revision)
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
        if not group.may_lead(peer):
            return "map of a coordinator that was away"
        if self._maps.has_left(offer.revision) and not self.handing.has_been_behind(
            self._delivery_wait_s
        ):
            return "map that was left"
        return None

    def _reject(self, peer: int, offer: MapOffer, kind: str, detail: str = "") -> None:
        """Count a map that is not taken; when it comes again it is looked at again."""
        self._refuse(peer, kind, detail)
        again_at_s = asyncio.get_running_loop().time() + _LOOK_AGAIN_S
        self._transfers.forget(peer, offer.kind, offer.blob, again_at_s)

    async def _prepared(self, offer: MapOffer) -> ReadyMap | NoMap:
        """Make a map ready for use, beside the event loop; or say why it cannot be used."""
        try:
            is_update = offer.kind == BlobKind.MAP_UPDATE
            missing = images_missing_in(offer.blob) if is_update else frozenset[bytes]()
            held = {name: image for name, image in self._passed.held.items() if name in missing}
            return await self._work.ready(offer, self._maps.current, held)
        except (WireError, ValueError) as error:
            return NoMap(str(error))
        except Exception as error:
            # Peers' images and numbers went in: none of them may end the flight.
            _log.exception("a map cannot be used")
            return NoMap(f"using it failed: {type(error).__name__}")

    async def _install(self, ready: ReadyMap) -> None:
        stored = self._maps.replace(
            ready.data, ready.index, ready.update, ready.templates, ready.part_of
        )
        n_keyframes = len(ready.index.landmark_map.keyframes)
        n_bytes = len(ready.data)
        self._log.map(stored.revision, stored.parent, stored.n_landmarks, n_bytes, n_keyframes)
        self._log.event("map", f"{stored.n_landmarks} landmarks in {n_keyframes} keyframes")
        _log.info("map %s: %d landmarks", stored.revision.hex(), stored.n_landmarks)
        self._tell_state()
        loop = asyncio.get_running_loop()
        loop.call_later(_STAYS_S, self._want_more_of, stored.revision)
        await loop.run_in_executor(self._disk, self._maps.keep, stored)
        await self._work.keep_only(stored)
        await loop.run_in_executor(self._disk, give_back_freed)

    def _want_more_of(self, revision: bytes) -> None:
        current = self._maps.current
        if current is None or current.revision != revision:
            return
        if self._group.wanting_update:
            # It is about to be replaced, and the next one wants the processor now.
            asyncio.get_running_loop().call_later(_STAYS_S, self._want_more_of, revision)
            return
        self._maps.want_more()

    async def _index_more(self) -> None:
        """Index the map in use by the other detectors when that is asked for, once each.

        It takes as long as the map itself, and most revisions are never asked about.
        """
        while True:
            await self._maps.more_wanted()
            if self._falls_back:
                await self._index_current()

    async def _index_current(self) -> None:
        stored = self._maps.current
        if stored is not None and not self._maps.is_improved:
            self._maps.improve(stored, await self._work.more_indexed(stored))

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
