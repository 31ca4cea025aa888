"""Maps between peers: taken in from those who may give one, handed to those who lack it.

The coordinator hands its map to everybody, each new revision in the place of
the last. A coordinator without a map (it is back, or late), or with one that
the others have left (it was away), is handed that of the first holder.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, replace

from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.mailbox import PeerMailbox
from vcl_companion.daemon.map_offer import HandOut, MapOffer, ReadyMap
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.peer_trust import PeerTrust
from vcl_companion.daemon.usage import give_back_freed
from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.quarantine import Evidence
from vcl_companion.swarm.transfer import BlobKind, Transfers
from vcl_companion.wire.map_update import images_in_update, images_missing_in, without_images

_log = logging.getLogger(__name__)

# A transfer that has failed begins anew after this.
_HAND_AGAIN_S = 10.0
# A peer, however busy, has taken a map in and said so after this, or refused it.
_TAKE_IN_S = 20.0
# What was delivered in vain is not likely to be of use the next time: ever more rarely.
_HAND_AGAIN_AT_MOST_S = 120.0
# A coordinator that we see on the map before ours has made ours: it is about to follow.
_FOLLOWS_S = 5.0
# A map that has stayed for so long is likely to stay: it is indexed by all detectors, before
# somebody is lost in it. In fast flight the next one comes sooner.
_STAYS_S = 3.0
# A map that was refused may come again after this: we may know better by then.
_LOOK_AGAIN_S = 5.0
# Maps remembered as such; one that is forgotten counts once more.
_N_CONTRADICTING = 64


@dataclass(frozen=True)
class _Handed:
    """A map that was handed to a peer, how often it arrived there, and when it is handed again."""

    revision: bytes
    transfer_id: int
    n_delivered: int
    again_at_s: float


@dataclass(frozen=True)
class _Update:
    """An update with all its images: whose, their names, and the forms for those who hold some."""

    revision: bytes
    images: frozenset[bytes]
    without: dict[frozenset[bytes], bytes]


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
        self._offered: PeerMailbox[MapOffer] = PeerMailbox()
        self._handed: dict[int, _Handed] = {}
        self._update: _Update | None = None
        self._ahead: HandOut | None = None  # ours is not ready yet, peers may have it
        self._given = (0, b"", float("-inf"))  # by whom, which map, when
        self._behind_since_s: float | None = None  # the coordinator, as far as known

    def offer(self, peer: int, kind: BlobKind, blob: bytes) -> None:
        """Take a peer's encoded map, whole or without its parent's images.

        It is looked at when its turn comes.
        """
        try:
            self._offered.put(peer, MapOffer.of(kind, blob))
        except WireError as error:
            self._refuse(peer, "map", str(error))

    def forgot(self, peer: int) -> None:
        """Note that a peer may have lost the map it was handed: it was restarted, or away."""
        self._handed.pop(peer, None)

    def delivered(self, peer: int, transfer_id: int, now_s: float) -> None:
        """Note that a blob has reached a peer, which may fly on it soon, or never."""
        handed = self._handed.get(peer)
        if handed is not None and handed.transfer_id == transfer_id:
            wait_s = min(_TAKE_IN_S * 2.0**handed.n_delivered, _HAND_AGAIN_AT_MOST_S)
            self._handed[peer] = replace(
                handed, n_delivered=handed.n_delivered + 1, again_at_s=now_s + wait_s
            )

    async def run(self) -> None:
        """Take in what peers offer, and index what is in use, until cancelled."""
        async with asyncio.TaskGroup() as parts:
            parts.create_task(self._take_offers())
            parts.create_task(self._index_more())

    async def _take_offers(self) -> None:
        """Look at one map after the other."""
        while True:
            peer, offer = await self._offered.take()
            current = self._maps.current
            if current is not None and current.revision == offer.revision:
                self._tell_state()  # it did not know that we have it
                continue
            why_not = self._why_not(peer, offer)
            if why_not is None:
                ready = await self._prepared(offer)
                if isinstance(ready, NoMap):
                    self._reject(peer, offer, "map", ready.reason)
                    continue
                why_not = self._why_not(peer, offer)  # again: preparing took a while
                if why_not is None and self._contradicts(peer, offer, ready):
                    self._reject(peer, offer, "map that contradicts ours", ready.contradicts)
                    continue
                if why_not is None:
                    self._given = peer, offer.revision, asyncio.get_running_loop().time()
                    await self._install(ready)
                    continue
            self._reject(peer, offer, why_not)

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
            self._ahead = await self._work.encoded(built, instead_of)
        except (WireError, ValueError) as error:
            return NoMap(str(error))
        except Exception as error:
            # Peers' images and numbers went into it: none of them may end the flight.
            _log.exception("a map cannot be encoded")
            return NoMap(f"encoding it failed: {type(error).__name__}")
        try:
            offer = MapOffer.of(BlobKind.MAP, self._ahead.data)
            ready = await self._prepared(replace(offer, update=self._ahead.update))
        finally:
            self._ahead = None
        if isinstance(ready, NoMap):
            return ready
        if self._maps.is_in_use(instead_of):
            await self._install(ready)
        return None

    def hand_out(self, now_s: float) -> None:
        """Send the map to those who lack it: as coordinator, or to a coordinator without one."""
        current = self._maps.current
        stored = self._ahead
        if stored is None and current is not None:
            stored = _hand_out_of(current)
        if stored is None:
            return
        if not self._coordinator_is_behind():
            self._behind_since_s = None
        elif self._behind_since_s is None:
            self._behind_since_s = now_s
        for peer in self._lacking(stored.revision):
            last = self._handed.get(peer)
            n_delivered = 0
            if last is not None and last.revision != stored.revision:
                self._transfers.cancel(last.transfer_id)
            elif last is not None:
                if now_s < last.again_at_s:
                    continue
                n_delivered = last.n_delivered
            form = self._form_for(peer, stored, n_delivered)
            if form is None:
                continue
            kind, blob = form
            sent_id = self._transfers.submit(peer, kind, blob, now_s)
            self._handed[peer] = _Handed(
                stored.revision, sent_id, n_delivered, now_s + _HAND_AGAIN_S
            )

    def _form_for(
        self, peer: int, stored: HandOut, n_delivered: int
    ) -> tuple[BlobKind, bytes] | None:
        """Return what to send: without the images that a peer has, unless that was in vain.

        None while an image of the map is still on its way there.
        """
        state = self._group.state_of(peer)
        has_parent = state is not None and state.revision == stored.parent
        if not (stored.update and has_parent and n_delivered == 0):
            return BlobKind.MAP, stored.data
        if self._update is None or self._update.revision != stored.revision:
            self._update = _Update(stored.revision, images_in_update(stored.update), {})
        images, without = self._update.images, self._update.without
        if images & self._passed.on_their_way_to(peer):
            return None
        held = images & self._passed.held_by(peer)
        if held not in without:
            without[held] = without_images(stored.update, held)
        return BlobKind.MAP_UPDATE, without[held]

    def _lacking(self, revision: bytes) -> list[int]:
        group = self._group
        if group.is_coordinator:
            there = {group.own_id, *group.holders(revision)}
            return [peer for peer in group.alive if peer not in there]
        state = group.state_of(group.coordinator)
        if self._was_given_lately(group.coordinator, revision):
            return []
        if state is None or (state.revision and not self._has_been_behind(_FOLLOWS_S)):
            return []
        is_first_holder = group.holders(revision)[:1] == (group.own_id,)
        return [group.coordinator] if is_first_holder else []

    def _was_given_lately(self, peer: int, revision: bytes) -> bool:
        """Whether a peer has just handed us a map: it has it, though that has not been heard."""
        giver, given, at_s = self._given
        now_s = asyncio.get_running_loop().time()
        return (giver, given) == (peer, revision) and now_s < at_s + _FOLLOWS_S

    def _coordinator_is_behind(self) -> bool:
        """Whether somebody else coordinates, and flies on a map that we have left."""
        state = self._group.state_of(self._group.coordinator)
        is_other = not self._group.is_coordinator
        return is_other and state is not None and self._maps.has_left(state.revision)

    def _has_been_behind(self, for_s: float) -> bool:
        """Whether the coordinator has been on a map that we have left for so long."""
        now_s = asyncio.get_running_loop().time()
        return self._behind_since_s is not None and now_s >= self._behind_since_s + for_s

    def _why_not(self, peer: int, offer: MapOffer) -> str | None:
        """Return why we do not fly on a peer's map, or None if we do.

        Anybody's who is believed is taken while we have none, later only the coordinator's. The
        coordinator itself takes one that goes on from its own, or that most fly on.
        """
        group, current = self._group, self._maps.current
        if self._trust.why_not(peer):
            return "map of a quarantined drone"
        if current is None:
            return None
        if group.is_coordinator:
            holders = group.holders(offer.revision)
            n_holders = sum(member in group.trusted for member in holders)
            if 2 * n_holders > len(group.trusted) or offer.parent == current.revision:
                return None
        if peer != group.coordinator:
            return "map, but not from the coordinator"
        if self._maps.has_left(offer.revision) and not self._has_been_behind(self._delivery_wait_s):
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
        stored = self._maps.replace(ready.data, ready.index, ready.update, ready.templates)
        n_keyframes = len(ready.index.landmark_map.keyframes)
        n_bytes = len(ready.data)
        self._log.map(stored.revision, stored.parent, stored.n_landmarks, n_bytes, n_keyframes)
        self._log.event("map", f"{stored.n_landmarks} landmarks in {n_keyframes} keyframes")
        _log.info("map %s: %d landmarks", stored.revision.hex(), stored.n_landmarks)
        self._tell_state()
        loop = asyncio.get_running_loop()
        loop.call_later(_STAYS_S, self._want_more_of, stored)
        await loop.run_in_executor(self._disk, self._maps.keep, stored)
        await loop.run_in_executor(self._disk, give_back_freed)

    def _want_more_of(self, stored: StoredMap) -> None:
        if not self._maps.is_in_use(stored):
            return
        if self._group.wanting_update:
            # It is about to be replaced, and the next one wants the processor now.
            asyncio.get_running_loop().call_later(_STAYS_S, self._want_more_of, stored)
            return
        self._maps.want_more()

    async def _index_more(self) -> None:
        """Index the map in use by the other detectors when that is asked for, once each.

        It takes as long as the map itself, and most revisions are never asked about.
        """
        done: StoredMap | None = None
        while True:
            stored = await self._maps.more_wanted()
            if stored is done or not self._falls_back:
                continue
            self._maps.improve(stored, await self._work.more_indexed(stored))
            if self._maps.is_in_use(stored):
                done = self._maps.current


def _hand_out_of(stored: StoredMap) -> HandOut:
    return HandOut(stored.revision, stored.parent, stored.data, stored.update)
