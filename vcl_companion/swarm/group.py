"""Who is in the group, who is alive, who coordinates, who has which map, who wants it updated.

The leader is named by the configuration (the lowest member id unless it says
otherwise): its body at the first map is the world's origin. The coordinator of a
team (``teams``) is the leader, where it flies with that, or, once the leader was
heard and then lost, the lowest member alive that is believed. A leader never
heard is waited for, but not for ever: at a start drones come up seconds apart, and
each must not begin a map of its own.

Who goes and comes back again and again does not lead at once (``comebacks``).

Whoever begins to coordinate takes an epoch (``epochs``); one who does it under an
older one, for it was away, is not followed until it has taken a newer one. That one is
older is believed of who coordinates, or of two, and never of one other alone. A drone
that was restarted waits for the time-out before it holds anybody for lost that
it has not heard itself: until then it knows neither who is there nor the epochs.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from vcl_companion.errors import ConfigError
from vcl_companion.swarm.comebacks import Comebacks, successor
from vcl_companion.swarm.epochs import FIRST, VACANT, Epochs, is_before, lower, taken_by
from vcl_companion.swarm.overlap import OverlapGraph, OverlapOptions, OwnSignature
from vcl_companion.swarm.pace import stretch_of
from vcl_companion.swarm.presence import Presence
from vcl_companion.swarm.swarm_options import SwarmOptions
from vcl_companion.swarm.teams import Meetings, Parting, Roster, team_with_a_map
from vcl_companion.wire.messages import MapState

__all__ = ["Group", "GroupEvent", "PeerJoined", "PeerLost", "SwarmOptions"]

_SAID_NOTHING = MapState(b"", 0, False)


@dataclass(frozen=True)
class PeerJoined:
    """A member is heard, for the first time or again."""

    peer: int


@dataclass(frozen=True)
class PeerLost:
    """A member has been silent for the time-out."""

    peer: int


GroupEvent = PeerJoined | PeerLost


class Group:
    """What one drone knows of its group; only what it is told and time change it.

    Who has which map, who wants another and who coordinates are questions within this drone's
    team; who is a member, alive, trusted, and whether all are there, are not.
    """

    def __init__(self, options: SwarmOptions, own_id: int) -> None:
        if options.members and own_id not in options.members:
            raise ConfigError(
                f"members: {list(options.members)} does not name this drone, system_id {own_id}"
            )
        self.own_id = own_id
        self.members = tuple(sorted(options.members)) or (own_id,)
        self.leader = options.leader or self.members[0]
        self.measured = tuple(sorted({m for a, b, _ in options.known_distances for m in (a, b)}))
        self._leader_wait_s = options.leader_wait_s
        self._presence = Presence(self.members, own_id, options.heartbeat_timeout_s)
        self._states: dict[int, MapState] = {}  # ours, and of members alive
        self._distrusted: frozenset[int] = frozenset()
        self._apart: frozenset[int] = frozenset()
        self._team = 0
        # Asked for with every message, and changed by hardly any; None: to be found anew.
        self._teammates: tuple[int, ...] | None = None
        self._epochs = Epochs(own_id)
        self._comebacks = Comebacks()
        overlaps = OverlapOptions().at_pace(stretch_of(len(self.members)))
        self._graph = OverlapGraph(self.members, overlaps)
        self._parting = Parting(self._graph, options.split_after_s)
        self._meetings = Meetings(self._graph, options.rejoin_after_s)
        self._signature = OwnSignature()

    @property
    def peers(self) -> tuple[int, ...]:
        """All members but this drone."""
        return tuple(member for member in self.members if member != self.own_id)

    @property
    def alive(self) -> tuple[int, ...]:
        """Members that are there as far as known, this drone among them, ascending."""
        return self._presence.alive

    @property
    def trusted(self) -> tuple[int, ...]:
        """Members alive that are believed, this drone among them, ascending."""
        return tuple(m for m in self.alive if m not in self._distrusted)

    def distrust(self, peers: frozenset[int]) -> None:
        """Note who is not believed from now on; all others are."""
        self._distrusted = peers - {self.own_id}
        self._take_term()

    def leave_apart(self, peers: frozenset[int]) -> None:
        """Note who flies on a map of its own that is about to be merged into ours.

        Until then ours goes on without them: they neither vote for what it is to become, nor
        give frames to it, nor are waited for to have it.
        """
        self._apart = peers - {self.own_id}

    def is_apart(self, member: int) -> bool:
        """Whether a member flies on a map of its own that is about to be merged into ours."""
        return member in self._apart

    @property
    def is_complete(self) -> bool:
        """Whether every member is there."""
        return self.alive == self.members

    @property
    def coordinator(self) -> int:
        """The member of our team that builds and hands out maps; see the module."""
        if self._awaits_leader and self.leader not in self.teammates:
            return self.leader
        return self._rightful(self._team, self.teammates) or self.own_id

    @property
    def is_coordinator(self) -> bool:
        """Whether that is this drone."""
        return self.coordinator == self.own_id

    @property
    def stretch(self) -> float:
        """How many times as rarely as in a small swarm this drone sees to what is not news.

        To show itself (``pace``), and to look through all the others; 1 for who coordinates, or
        did until now and may be waited for as that yet, and while those who have just come may
        not have heard everybody.
        """
        return 1.0 if self.is_coordinator else self._presence.stretch

    @property
    def newest_revision(self) -> bytes:
        """The coordinator's map, empty while it has none as far as known."""
        state = self._states.get(self.coordinator)
        return state.revision if state else b""

    @property
    def is_map_coming(self) -> bool:
        """Whether our team's newest revision is another than this drone flies on."""
        own = self._states.get(self.own_id)
        return self.newest_revision not in (b"", own.revision if own else b"")

    @property
    def team(self) -> int:
        """The team that this drone flies with."""
        return self._team

    @property
    def epoch(self) -> int:
        """The highest epoch known of our team, to be told."""
        return self._epochs.of(self._team)

    @property
    def own_epoch(self) -> int:
        """What this drone coordinates under; 0 where it does not, or is the leader from the start.

        Like the team, a change of it is worth telling at once.
        """
        return self.epoch if self.is_coordinator and self._epochs.is_ours(self._team) else FIRST

    @property
    def teammates(self) -> tuple[int, ...]:
        """Members alive that fly with our team, this drone among them, ascending."""
        if self._teammates is None:
            self._teammates = tuple(m for m in self.alive if self.team_of(m) == self._team)
        return self._teammates

    @property
    def trusted_teammates(self) -> tuple[int, ...]:
        """Those of them that are believed."""
        return tuple(m for m in self.teammates if m not in self._distrusted)

    @property
    def other_teams(self) -> tuple[int, ...]:
        """The teams that there are but ours, ascending."""
        return self._roster().other_teams

    @property
    def teams_met(self) -> tuple[int, ...]:
        """Other teams that have been seeing what ours sees for ``rejoin_after_s``, ascending."""
        return self._meetings.lasting(self._presence.now_s)

    def team_of(self, member: int) -> int:
        """Return the team that a member says it flies with; 0 where it has said nothing."""
        if member == self.own_id:
            return self._team
        state = self._states.get(member)
        return state.team if state else 0

    def is_senior(self, team: int) -> bool:
        """Whether another team goes before ours, whose map is merged into that one's then."""
        return self._roster().is_senior(team, self._team)

    def coordinator_of(self, team: int) -> int | None:
        """Return who coordinates a team, None where nobody of it is there and believed."""
        if team == self._team:
            return self.coordinator
        return self._rightful(team, self._members_of(team))

    def join(self, team: int) -> None:
        """Fly with a team from now on: its map has been taken."""
        if team != self._team:
            self._go_to(team)
            self._take_term()

    def is_fenced(self, peer: int) -> bool:
        """Whether a peer of our team knows only of an older epoch: its word may be outdated."""
        state = self._states.get(peer)
        return is_before(state.epoch if state else FIRST, self.epoch)

    def may_lead(self, peer: int) -> bool:
        """Whether to take maps of a peer, and do what it asks for, as our coordinator."""
        return peer == self.coordinator and not (peer != self.own_id and self.is_fenced(peer))

    def heartbeat(self, peer: int, now_s: float) -> list[GroupEvent]:
        """Note that a peer is heard; who is no member is ignored."""
        if not self._presence.hear(peer, now_s):
            return []
        self._teammates = None
        self._comebacks.came(peer, now_s)
        self._take_term()
        return [PeerJoined(peer)]

    def map_state(self, peer: int, state: MapState, now_s: float) -> list[GroupEvent]:
        """Note which map a peer flies on, which is a sign of life too."""
        events = self.heartbeat(peer, now_s)
        if not self._presence.is_heard(peer):
            return events
        before = self._states.get(peer, _SAID_NOTHING)
        has_moved = peer not in self._distrusted and self._takes_us_along(peer, state)
        self._states[peer] = state
        if state.team != before.team:
            self._teammates = None
        if _was_restarted(state, before):
            self._comebacks.restarted(peer, now_s)
        if peer not in self._distrusted:
            self._hear_epoch(peer, state)
            self._graph.note(peer, state.signature, now_s)
        if has_moved:
            self._go_to(state.team)
        if (state.team, state.epoch) != (before.team, before.epoch):
            self._take_term()
        return events

    def set_own_state(self, state: MapState) -> None:
        """Note which map this drone flies on; its team and epoch are known here."""
        self._states[self.own_id] = state

    def note_signature(self, signature: bytes, now_s: float) -> None:
        """Take the signature of a frame of our own (``vision/signature.py``)."""
        self._presence.note_time(now_s)
        self._signature.note(signature)
        self._graph.note(self.own_id, signature, now_s)

    def signature_to_tell(self, now_s: float) -> bytes:
        """Return what the next state is to tell: the newest signature, once, and not too often."""
        return self._signature.to_tell(now_s)

    def state_of(self, member: int) -> MapState | None:
        """Return what a member last said of its map; None if nothing, or it is lost."""
        return self._states.get(member)

    def contributors(self, first: Iterable[int], most: int) -> tuple[int, ...]:
        """Return teammates that are believed whose frames a map is to be made of, and this drone.

        Of many not all: a map would grow, and take bytes and time, with the swarm.

        Args:
            first: who is needed most, in this order.
            most: how many, at most.

        Returns:
            Those of them that there are, then who sees least of the map.
        """

        def seen(member: int) -> int:
            state = self._states.get(member)
            return state.tracked if state is not None else 0

        those = set(filter(self._counts, self.teammates))
        others = sorted(those, key=lambda member: (seen(member), member))
        order = dict.fromkeys((self.own_id, *first, *others))
        return tuple(m for m in order if m in those)[:most]

    def has_map(self, member: int) -> bool:
        """Whether a member has said so; one on a part of a map says that it has none."""
        state = self._states.get(member)
        return state is not None and bool(state.revision)

    def holders(self, revision: bytes) -> tuple[int, ...]:
        """Return the teammates that hold this revision."""
        return tuple(
            m for m in self.teammates if (s := self._states.get(m)) and s.revision == revision
        )

    def lacking(self) -> tuple[int, ...]:
        """Return the teammates that do not hold the newest revision; none without one.

        Of those that are trusted, not silent, and not on a map of their own (``leave_apart``).

        A member that said nothing of its map yet lacks it.
        """
        if not self.newest_revision:
            return ()
        holders = set(self.holders(self.newest_revision))
        return tuple(m for m in self.teammates if m not in holders and self._counts(m))

    @property
    def wanting_update(self) -> tuple[int, ...]:
        """Teammates whose vote is for an update of the newest revision (IV-G).

        The vote of one that still flies on another revision is about that one,
        and does not count.
        """
        if not self.newest_revision:
            return ()
        holders = self.holders(self.newest_revision)
        return tuple(m for m in holders if self._states[m].wants_update and self._counts(m))

    @property
    def majority_wants_update(self) -> bool:
        """Whether more than half of those that have a vote (``lacking``) are for an update."""
        n_wanting = len(self.wanting_update)
        return n_wanting > 0 and 2 * n_wanting > sum(map(self._counts, self.teammates))

    def _counts(self, member: int) -> bool:
        """Whether a teammate decides on our map, and makes it: believed, heard, not on its own."""
        is_with_us = member not in self._distrusted and not self.is_apart(member)
        return is_with_us and not self.is_silent(member)

    def is_silent(self, member: int) -> bool:
        """Whether a member may be lost, which is known later: nobody else waits for its word."""
        return self._presence.is_silent(member)

    def most_others_hold(self, revision: bytes) -> bool:
        """Whether most of the other teammates trusted, and at least two, hold a revision."""
        others = [m for m in self.trusted_teammates if m != self.own_id]
        n_holders = len(set(others) & set(self.holders(revision)))
        return n_holders >= 2 and 2 * n_holders > len(others)

    def poll(self, now_s: float) -> list[GroupEvent]:
        """Return who is lost by now, and forget what it had: it may come back without it.

        What team we fly with, and who leads it, is seen to as well.
        """
        lost = self._presence.take_lost(now_s, knows_lead=self._knows_lead)
        for peer in lost:
            self._states.pop(peer, None)
            self._teammates = None
            self._comebacks.lost(peer, now_s)
            self._graph.forget(peer)
        self._graph.poll(now_s)
        roster = self._roster()
        self._go_to(self._team_by(roster))
        self._meetings.poll(roster, now_s)
        self._take_term()
        self._presence.note_lead(self.coordinator, now_s)
        return [PeerLost(peer) for peer in sorted(lost)]

    def next_poll_s(self) -> float | None:
        """Return when somebody is lost if nothing is heard until then; None for nobody."""
        return self._presence.next_lost_s(knows_lead=self._knows_lead)

    @property
    def _awaits_leader(self) -> bool:
        """Whether the leader, which nobody has lost yet, may still come to our team."""
        if self._team != 0 or self._is_leader_gone:
            return False
        # That it was lost is believed of anybody: nobody that is there is kept from leading by it.
        return self._epochs.is_unheard_of(0) or not self._presence.has_listened

    @property
    def _is_leader_gone(self) -> bool:
        """Whether the leader, unless it is there, was lost or has been waited for long enough."""
        return self._presence.has_heard(self.leader) or self._presence.has_lasted(
            self._leader_wait_s
        )

    @property
    def _knows_lead(self) -> bool:
        """Whether who coordinated when that was last looked at says that it does."""
        member = self._presence.led_by
        if member == self.leader:
            return True
        state = self._states.get(member)
        return state is not None and state.team == self._team and taken_by(state.epoch) == member

    def _rightful(self, team: int, members: tuple[int, ...]) -> int | None:
        """Return who leads a team of these members, whoever else may come; None for nobody."""
        first: int | None = self.leader
        if first not in members:
            first = next((m for m in members if m not in self._distrusted), None)
        if first is None or self._is_settled(first):
            return first
        believed = [m for m in members if m not in self._distrusted]
        order = [self.leader, *believed] if self.leader in members else believed
        for member in order:
            if self._is_settled(member):
                return member
            told = {m: self._epoch_told(m, team) for m in believed if m != member}
            other = successor(told)
            if other is not None:
                return other
            if not self._comebacks.has_restarted(member):
                return member
        return first

    def _is_settled(self, member: int) -> bool:
        return self._comebacks.is_settled(member, self._presence.now_s)

    def _members_of(self, team: int) -> tuple[int, ...]:
        if team == self._team:
            return self.teammates
        return tuple(m for m in self.alive if self.team_of(m) == team)

    def _epoch_told(self, member: int, team: int) -> int:
        """Return the highest epoch of its team that a member of it says that it knows."""
        if member == self.own_id:
            return self._epochs.of(team)
        state = self._states.get(member)
        return state.epoch if state else FIRST

    def _hear_epoch(self, peer: int, state: MapState) -> None:
        """Take what a peer says of its team's epoch: whom to believe, see ``epochs``.

        Who coordinates takes a newer one for whatever anybody has heard of: to the one who has,
        it is one that was away.
        """
        epochs, team, epoch = self._epochs, state.team, state.epoch
        if not is_before(epochs.of(team), epoch):
            return
        members = self._members_of(team)
        lead = self._rightful(team, members)
        if peer == lead:
            epochs.hear(team, epoch)
            return
        taker = taken_by(epoch)
        # Who comes back too often takes epochs for a place that it is not let to.
        if taker not in (lead, self.own_id) and taker in members and not self._is_settled(taker):
            return
        epochs.rumour(team, epoch)
        for other in members:
            if other not in (peer, self.own_id) and other not in self._distrusted:
                told = self._epoch_told(other, team)
                # Of what it said before, none would be a lower one by half of all epochs.
                if is_before(epochs.of(team), told) and is_before(epochs.of(team), epoch):
                    epochs.hear(team, lower(epoch, told))
        if team == self._team and self.is_coordinator and is_before(epochs.of(team), epoch):
            epochs.take(team)

    def _go_to(self, team: int) -> None:
        if team != self._team:
            self._team, self._teammates = team, None

    def _take_term(self) -> None:
        """Take an epoch when this drone has begun to coordinate, or hears of a newer one."""
        lead = self.coordinator
        # It may be there, and fly with another team, or be passed over.
        if self._team == 0 and lead != self.leader:
            self._epochs.hear(0, VACANT)
        # It may have taken one before we held it for the one to lead.
        if lead not in self._distrusted:
            self._epochs.hear(self._team, self._epoch_told(lead, self._team))
        if lead != self.own_id or self._epochs.is_ours(self._team):
            return
        if self._team != 0 or self.epoch != FIRST:
            self._epochs.take(self._team)

    def _takes_us_along(self, peer: int, state: MapState) -> bool:
        """Whether our coordinator, by what it says now, has gone to a team senior to ours.

        One without a map was restarted, and has not gone anywhere.
        """
        if state.team == self._team or self.team_of(peer) != self._team or not state.revision:
            return False
        return self.may_lead(peer) and self.is_senior(state.team)

    def _team_by(self, roster: Roster) -> int:
        """Return the team that this drone is to fly with by now."""
        if self.own_id in roster.world_of:
            return self._parting.team(roster, self._presence.now_s)
        return team_with_a_map(roster) if self._presence.has_listened else self._team

    def _roster(self) -> Roster:
        believed = {m for m in self.alive if m not in self._distrusted or m == self.leader}
        mapped = {m: s for m in believed if (s := self._states.get(m)) and s.revision}
        coordinator = self.coordinator
        return Roster(
            self.own_id,
            self.leader,
            {m: self.team_of(m) for m in believed},
            {m: state.world for m, state in mapped.items()},
            {m for m, state in mapped.items() if state.localized and not state.wants_update},
            coordinator if coordinator in believed else None,
        )


def _was_restarted(state: MapState, before: MapState) -> bool:
    """Whether a member that says this after that has forgotten its map, or its team's epochs."""
    has_forgotten = before.epoch > VACANT and state.epoch == FIRST and before.team == state.team
    return has_forgotten or bool(before.revision and not state.revision)
