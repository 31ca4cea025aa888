"""Maps that went apart: of parts of the swarm that were without each other for a while.

Where each part has made a map of its own, neither is made from the other. Whoever flies on
the one that does not go on hands it to who coordinates the other, and this one merges them
(``mapping.merging``); until then it does not hand out its own, for what the others have seen
would be lost with theirs. What cannot be merged stays as it is in another world; in the same
world the coordinator's goes on, as if the other had never been. So it does for who is lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.mapping.landmark_map import JoinedMap, LandmarkMap
from vcl_companion.swarm.group import Group
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.map_update import images_by_name

# A coordinator whose map we do not know is about to send it, as a rule, if it had ours before. If
# it had not, it knows nothing of what ours has in it: there is time to hear what it says next.
_SENDS_S, _SAYS_S = 5.0, 1.0
# So long after the coordinator's has become another one, ours goes on by whoever gave it to us.
# Then it is handed over as it is: who cannot reach the coordinator would keep us from it for ever.
_GOES_ON_S = 3.0
# A map that is coming in is waited for so many times longer: by a slow radio it takes a minute.
_COMING_LONGER = 4.0
_MAX_REFUSED = 64
# Revisions whose images are known by name, and drones that are away.
_MAX_KNOWN, _MAX_AWAY = 64, 64


class MapBranches:
    """What one drone has to do with maps that went apart; see the module.

    Args:
        group: who is there.
        maps: the current map.
        is_receiving: whether a map is coming in.
        wait_s: how long a coordinator waits for a map that it could merge.
    """

    def __init__(
        self, group: Group, maps: MapStore, is_receiving: Callable[[], bool], wait_s: float
    ) -> None:
        self._group = group
        self._maps = maps
        self._is_receiving = is_receiving
        self._wait_s = wait_s
        self._given_by = group.own_id
        self._refused: deque[bytes] = deque(maxlen=_MAX_REFUSED)
        self._had_ours: tuple[bytes, set[int]] = (b"", set())
        self._merged: set[int] = set()  # other teams' coordinators, whose map is in ours
        self._images: dict[bytes, frozenset[bytes]] = {}  # of revisions that peers may fly on
        self._held: dict[int, frozenset[bytes]] = {}
        self._foreign_since_s: dict[int, float] = {}

    def given_by(self, peer: int) -> None:
        """Note who has given us the map in use, ourselves perhaps."""
        self._given_by = peer

    def goes_on_by(self, peer: int, now_s: float) -> bool:
        """Whether our map is a peer's, and the coordinator's another that it is about to go into.

        What the peer had begun to make of it is taken, or its part of the swarm would fly on two.
        """
        coordinator = self._group.coordinator
        state = self._group.state_of(coordinator)
        is_foreign = state is not None and self._is_foreign(state.revision)
        since_s = self._foreign_since_s.get(coordinator, now_s)
        return self._given_by == peer and is_foreign and now_s < since_s + _GOES_ON_S

    def refused(self, revision: bytes) -> None:
        """Note a map that cannot be merged with ours."""
        self._refused.append(revision)

    def merged(self, peer: int, revision: bytes, images: frozenset[bytes], now_s: float) -> None:
        """Note that a peer's map has been merged into ours, and the names of its images.

        Who flies on what that was made of, as one does whom updates reach late, hands us nothing:
        others are waited for no longer than one takes that is about to begin.
        """
        self._merged.add(peer)
        for other, since_s in self._foreign_since_s.items():
            self._foreign_since_s[other] = min(since_s, now_s + _SENDS_S - self._wait_s)
        self._note_images(revision, images)
        self._held[peer] = images

    def held_by(self, peer: int) -> frozenset[bytes]:
        """Return the names of the images that a peer holds with its map, as far as we know.

        Those of the last of its maps that we know: of what it has made since we have none.
        """
        state = self._group.state_of(peer)
        images = None if state is None else self._images.get(state.revision)
        if images is not None:
            self._held[peer] = images
        return self._held.get(peer, frozenset())

    def note_held(self) -> None:
        """Note who flies on our map, or on one that we know: what it holds is known later on."""
        current = self._maps.current
        if current is not None and current.revision not in self._images:
            images = images_by_name(current.index.landmark_map.keyframes)
            self._note_images(current.revision, frozenset(images))
        alive = self._group.alive
        for peer in [peer for peer in self._held if peer not in alive][:-_MAX_AWAY]:
            del self._held[peer]
        for peer in alive:
            self.held_by(peer)

    def _note_images(self, revision: bytes, images: frozenset[bytes]) -> None:
        self._images[revision] = images
        while len(self._images) > _MAX_KNOWN:
            del self._images[next(iter(self._images))]

    def is_awaited(self, peer: int, now_s: float) -> bool:
        """Whether a teammate is not to be handed ours yet: it has one that we could merge."""
        state = self._group.state_of(peer)
        revision = b"" if state is None else state.revision
        if not self._is_foreign(revision):
            self._foreign_since_s.pop(peer, None)
            return False
        # Not from each of its revisions on: one that is never handed over would be waited for.
        since_s = self._foreign_since_s.setdefault(peer, now_s)
        return now_s < since_s + self._wait_s * (_COMING_LONGER if self._is_receiving() else 1.0)

    def receiver(self, now_s: float) -> int | None:
        """Return whom to hand our map so that it is merged into its own; None for nobody."""
        group, current = self._group, self._maps.current
        if current is None or current.part_of:
            return None
        if group.is_coordinator:
            seniors = [team for team in group.teams_met if group.is_senior(team)]
            return group.leadership.coordinator_of(seniors[0]) if seniors else None
        coordinator = group.coordinator
        self._note_holders(current.revision)
        state = group.state_of(coordinator)
        is_line_of_another = self._given_by != coordinator
        if state is None or not (is_line_of_another and self._is_foreign(state.revision)):
            self._foreign_since_s.pop(coordinator, None)
            return None
        since_s = self._foreign_since_s.setdefault(coordinator, now_s)
        wait_s = _SENDS_S if coordinator in self._had_ours[1] else _SAYS_S
        if now_s < since_s + wait_s or self._is_receiving():
            return None
        if self._giver_hands(state.revision):
            return None
        is_first_holder = group.maps.holders(current.revision)[:1] == (group.own_id,)
        return coordinator if is_first_holder else None

    def _giver_hands(self, revision: bytes) -> bool:
        """Whether who has given us our map has it, or what it has made of it since, to hand.

        Not one that flies on the coordinator's, of such a revision.
        """
        giver = self._given_by
        if giver == self._group.own_id or giver not in self._group.teammates:
            return False
        state = self._group.state_of(giver)
        return state is not None and state.revision not in (b"", revision)

    def _note_holders(self, revision: bytes) -> None:
        """Remember who has had our map, as long as it is in use here."""
        if self._had_ours[0] != revision:
            self._had_ours = revision, set()
        self._had_ours[1].update(self._group.maps.holders(revision))

    def joining(self) -> tuple[int, ...]:
        """Return the other teams' coordinators whose map ours has in it, to be handed ours."""
        group, current = self._group, self._maps.current
        if current is None:
            return ()
        teammates = group.teammates
        self._merged = self._merged.intersection(group.alive).difference(teammates)
        return tuple(sorted(self._merged)) if group.is_coordinator else ()

    def is_to_merge(self, peer: int, offer: MapOffer) -> bool:
        """Whether a map that is offered to us as the coordinator is to be merged into ours."""
        group, current = self._group, self._maps.current
        if current is None or current.part_of or not group.is_coordinator:
            return False
        if offer.kind == BlobKind.MAP_PART or offer.needs_parent:
            return False
        if offer.parent == current.revision:
            return False
        return self._is_foreign(offer.revision) and (
            peer in group.teammates or self._is_of_junior_team(peer)
        )

    def comes_from_senior(self, peer: int) -> bool:
        """Whether a peer coordinates a team that ours may join."""
        team = self._group.team_of(peer)
        is_other = team != self._group.team and self._group.is_senior(team)
        return is_other and self._group.leadership.coordinator_of(team) == peer

    def _is_of_junior_team(self, peer: int) -> bool:
        team = self._group.team_of(peer)
        return (
            team in self._group.teams_met
            and not self._group.is_senior(team)
            and self._group.leadership.coordinator_of(team) == peer
        )

    def _is_foreign(self, revision: bytes) -> bool:
        """Whether a revision is none of our line, nor in it, as far as known."""
        current = self._maps.current
        if not revision or current is None or revision in self._refused:
            return False
        if revision == current.revision or self._maps.has_left(revision):
            return False
        return not current.has_in_it(revision)


def way_into(current: StoredMap, new: LandmarkMap, revision: bytes) -> JoinedMap | str | None:
    """Say how a state on the map in use is carried over to another map.

    Args:
        current: the map in use.
        new: the other one.
        revision: of that.

    Returns:
        What says how; None where nothing has to be carried, both are of one world; a reason
        where there is no way.
    """
    world = current.world
    if new.world_of(revision) == world:
        return None
    reason = "it is of another world, which ours was not joined with"
    return new.joined_with(world) or reason
