"""Maps to those who lack them: in the form that each can use, and not again too soon.

The coordinator hands its map to everybody, each new revision in the place of
the last. A coordinator without a map (it is back, or late), or with one that
the others have left (it was away), is handed that of the first holder; one whose map
went apart from ours is handed ours to merge it (``map_branches``).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace

from vcl_companion.daemon.map_branches import MapBranches
from vcl_companion.daemon.map_offer import HandOut
from vcl_companion.daemon.map_parts import TAKE_IN_S, MapParts
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.standalone_map import StandaloneMap
from vcl_companion.swarm.group import Group
from vcl_companion.swarm.transfer import BlobKind, Transfers
from vcl_companion.wire.header import MAX_BLOB_BYTES
from vcl_companion.wire.map_update import images_in_update, without_images

# A transfer that has failed begins anew after this.
_HAND_AGAIN_S = 10.0
# What was delivered in vain is not likely to be of use the next time: ever more rarely.
_HAND_AGAIN_AT_MOST_S = 120.0
# A coordinator that we see on the map before ours has made ours: it is about to follow.
_FOLLOWS_S = 5.0
FormFor = Callable[[int, HandOut, int], tuple[BlobKind, bytes] | None]
"""Says what to send a peer of a map that has been delivered to it so many times."""


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


class MapHanding:
    """Hands the map in use to peers, and knows who was handed which.

    Args:
        group: who is there.
        transfers: blobs on their way.
        maps: the current map.
        work: makes parts of it.
        passed: who was sent which image ahead.
        branches: maps that went apart.

    Attributes:
        ahead: a map of ours that is not ready yet, but goes to peers already.
    """

    def __init__(
        self,
        group: Group,
        transfers: Transfers,
        maps: MapStore,
        work: MapWork,
        passed: PassedFrames,
        branches: MapBranches,
    ) -> None:
        self._group = group
        self._transfers = transfers
        self._maps = maps
        self._passed = passed
        self._branches = branches
        self._parts = MapParts(
            maps,
            work,
            lambda peer, blob: transfers.submit(peer, BlobKind.MAP_PART, blob, self._now_s()),
            transfers.quick_bytes,
        )
        self._standalone = StandaloneMap(maps, work)
        self.ahead: HandOut | None = None
        self._handed: dict[int, _Handed] = {}
        self._update: _Update | None = None
        self._given = (0, b"", float("-inf"))  # by whom, which map, when
        self._behind_since_s: float | None = None  # the coordinator, as far as known

    async def run(self) -> None:
        """Have parts of maps, and forms of them, made until cancelled."""
        async with asyncio.TaskGroup() as made:
            made.create_task(self._parts.run())
            made.create_task(self._standalone.run())

    def was_given(self, peer: int, revision: bytes) -> None:
        """Note who has given us the map in use: it has it, though that may not have been heard."""
        self._given = peer, revision, self._now_s()
        self._branches.given_by(peer)

    def forgot(self, peer: int) -> None:
        """Note that a peer may have lost the map it was handed: it was restarted, or away."""
        last = self._handed.get(peer)
        if last is not None:
            self._handed[peer] = replace(last, n_delivered=0, again_at_s=float("-inf"))
        self._parts.forgot(peer)

    def delivered(self, peer: int, transfer_id: int, now_s: float) -> None:
        """Note that a blob has reached a peer, which may fly on it soon, or never."""
        self._parts.delivered(peer, transfer_id, now_s)
        handed = self._handed.get(peer)
        if handed is not None and handed.transfer_id == transfer_id:
            wait_s = min(TAKE_IN_S * 2.0**handed.n_delivered, _HAND_AGAIN_AT_MOST_S)
            self._handed[peer] = replace(
                handed, n_delivered=handed.n_delivered + 1, again_at_s=now_s + wait_s
            )

    def hand_out(self, now_s: float) -> None:
        """Send the map to those who lack it: as coordinator, or to a coordinator without one."""
        current, stored = self._maps.current, self.ahead
        if stored is None and current is not None:
            stored = _hand_out_of(current)
        if stored is None or (current is not None and current.part_of):
            return
        self._abandon_all_but(stored.revision)
        self._branches.note_held()
        if not self._coordinator_is_behind():
            self._behind_since_s = None
        elif self._behind_since_s is None:
            self._behind_since_s = now_s
        lacking = self._lacking(stored.revision)
        apart = {
            peer
            for peer in lacking
            if self._group.is_coordinator and self._branches.is_awaited(peer, now_s)
        }
        self._group.leave_apart(frozenset(apart))
        for peer in lacking:
            if peer in apart:
                continue
            if self._group.state_of(peer) is None:
                continue  # it is about to say what it has, perhaps a map of a world of its own
            is_on_part = self._is_on_part(peer)
            if not self._group.maps.has_map(peer) and self._parts.comes_first(
                peer, stored, is_on_part=is_on_part
            ):
                continue
            self._hand(peer, stored, now_s, self._form_for)
        merges = self._branches.receiver(now_s)
        for peer in (*self._branches.joining(), *(() if merges is None else (merges,))):
            self._hand(peer, stored, now_s, self._standalone_for)

    def _is_on_part(self, peer: int) -> bool:
        """Whether a peer without a map flies on a part of one."""
        state = self._group.state_of(peer)
        return state is not None and state.n_landmarks > 0 and not self._group.maps.has_map(peer)

    def _abandon_all_but(self, revision: bytes) -> None:
        """Stop sending maps that a newer one has replaced, to who is away at the moment as well.

        What comes through when it is back would be taken for the newest that there is.
        """
        for peer, last in list(self._handed.items()):
            if last.revision != revision:
                self._transfers.cancel(last.transfer_id)
                del self._handed[peer]

    def _hand(self, peer: int, stored: HandOut, now_s: float, form_for: FormFor) -> None:
        """Send a map to a peer, unless it is on its way or was sent in vain lately."""
        last = self._handed.get(peer)
        n_delivered = 0
        if last is not None:
            if now_s < last.again_at_s:
                return
            n_delivered = last.n_delivered
        form = form_for(peer, stored, n_delivered)
        if form is None:
            return
        kind, blob = form
        if len(blob) > MAX_BLOB_BYTES:  # longer than the whole, of nothing but new images
            kind, blob = BlobKind.MAP, stored.data
        sent_id = self._transfers.submit(peer, kind, blob, now_s)
        if last is not None and last.transfer_id != sent_id:
            self._transfers.cancel(last.transfer_id)  # the same map in another form
        self._handed[peer] = _Handed(stored.revision, sent_id, n_delivered, now_s + _HAND_AGAIN_S)

    def _form_for(
        self, peer: int, stored: HandOut, n_delivered: int
    ) -> tuple[BlobKind, bytes] | None:
        """Return what to send: without the images that a peer has, unless that was in vain.

        None while an image of the map is still on its way there, or it is still being made.
        """
        if n_delivered == 0 and not self._group.maps.has_map(peer):
            is_on_part = self._is_on_part(peer)
            rest = self._parts.rest_for(peer, stored, self._now_s(), is_on_part=is_on_part)
            if rest is None:
                return None
            if rest:
                return BlobKind.MAP_UPDATE, without_images(rest, self._passed.held_by(peer))
        state = self._group.state_of(peer)
        has_parent = state is not None and state.revision == stored.parent
        if not (stored.update and has_parent and n_delivered == 0):
            return self._standalone_for(peer, stored, n_delivered)
        if self._update is None or self._update.revision != stored.revision:
            self._update = _Update(stored.revision, images_in_update(stored.update), {})
        images, without = self._update.images, self._update.without
        if images & self._passed.on_their_way_to(peer):
            return None
        held = images & self._passed.held_by(peer)
        if held not in without:
            without[held] = without_images(stored.update, held)
        return BlobKind.MAP_UPDATE, without[held]

    def _standalone_for(
        self, peer: int, stored: HandOut, n_delivered: int
    ) -> tuple[BlobKind, bytes] | None:
        """Return what to send a peer that has none of our map's parents; None: not made yet.

        Without the images that it has with its own, unless that was in vain.
        """
        may_hold = n_delivered == 0 and self._group.maps.has_map(peer)
        held = self._branches.held_by(peer) if may_hold else frozenset[bytes]()
        standalone = self._standalone.without(stored, held)
        if standalone is None:
            return None
        return (BlobKind.MAP_UPDATE, standalone) if standalone else (BlobKind.MAP, stored.data)

    def _lacking(self, revision: bytes) -> list[int]:
        group = self._group
        if group.is_coordinator:
            there = {group.own_id, *group.maps.holders(revision)}
            return [peer for peer in group.teammates if peer not in there]
        state = group.state_of(group.coordinator)
        if self._was_given_lately(group.coordinator, revision):
            return []
        if state is None or (state.revision and not self.has_been_behind(_FOLLOWS_S)):
            return []
        is_first_holder = group.maps.holders(revision)[:1] == (group.own_id,)
        return [group.coordinator] if is_first_holder else []

    def _was_given_lately(self, peer: int, revision: bytes) -> bool:
        """Whether a peer has just handed us a map: it has it, though that has not been heard."""
        giver, given, at_s = self._given
        return (giver, given) == (peer, revision) and self._now_s() < at_s + _FOLLOWS_S

    def _coordinator_is_behind(self) -> bool:
        """Whether somebody else coordinates, and flies on a map that we have left."""
        state = self._group.state_of(self._group.coordinator)
        is_other = not self._group.is_coordinator
        return is_other and state is not None and self._maps.has_left(state.revision)

    def has_been_behind(self, for_s: float) -> bool:
        """Whether the coordinator has been on a map that we have left for so long."""
        return self._behind_since_s is not None and self._now_s() >= self._behind_since_s + for_s

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()


def _hand_out_of(stored: StoredMap) -> HandOut:
    return HandOut(stored.revision, stored.parent, stored.data, stored.update)
