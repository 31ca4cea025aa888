"""The group as one drone knows it: who is in it, and what is heard of them goes through here.

The leader is named by the configuration (the lowest member id unless it says otherwise): its
body at the first map is the world's origin. Who coordinates is in ``leadership``, who is there
in ``membership``, who has which map and wants it updated in ``map_votes``, which teams there
are in ``teams``.
"""

from __future__ import annotations

from dataclasses import dataclass

from vcl_companion.errors import ConfigError
from vcl_companion.swarm.leadership import Leadership
from vcl_companion.swarm.map_votes import MapVotes
from vcl_companion.swarm.membership import Membership
from vcl_companion.swarm.overlap import OverlapGraph, OverlapOptions, OwnSignature
from vcl_companion.swarm.pace import stretch_of
from vcl_companion.swarm.swarm_options import SwarmOptions
from vcl_companion.swarm.teams import Meetings, Parting, Roster, team_with_a_map
from vcl_companion.wire.messages import MapState

__all__ = ["Group", "GroupEvent", "PeerJoined", "PeerLost", "SwarmOptions"]


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

    Attributes:
        own_id: this drone.
        members: all there may be, ascending, this drone among them.
        leader: of all.
        measured: members with a known distance, ascending.
        leadership: who coordinates, and under which epoch.
        maps: who has which map, and wants it updated.
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
        self._known = Membership(self.members, own_id, options.heartbeat_timeout_s)
        self._presence = self._known.presence
        self.leadership = Leadership(self._known, self.leader, options.leader_wait_s)
        self.maps = MapVotes(self._known, self.leadership)
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
        return self._known.alive

    @property
    def trusted(self) -> tuple[int, ...]:
        """Members alive that are believed, this drone among them, ascending."""
        return self._known.trusted

    @property
    def is_complete(self) -> bool:
        """Whether every member is there."""
        return self.alive == self.members

    @property
    def coordinator(self) -> int:
        """The member of our team that builds and hands out maps; see ``leadership``."""
        return self.leadership.coordinator

    @property
    def is_coordinator(self) -> bool:
        """Whether that is this drone."""
        return self.leadership.is_ours

    @property
    def stretch(self) -> float:
        """How many times as rarely as in a small swarm this drone sees to what is not news.

        To show itself (``pace``), and to look through all the others; 1 for who coordinates, or
        did until now and may be waited for as that yet, and while those who have just come may
        not have heard everybody.
        """
        return 1.0 if self.is_coordinator else self._presence.stretch

    @property
    def team(self) -> int:
        """The team that this drone flies with."""
        return self._known.team

    @property
    def teammates(self) -> tuple[int, ...]:
        """Members alive that fly with our team, this drone among them, ascending."""
        return self._known.teammates

    @property
    def trusted_teammates(self) -> tuple[int, ...]:
        """Those of them that are believed."""
        return self._known.trusted_teammates

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
        return self._known.team_of(member)

    def state_of(self, member: int) -> MapState | None:
        """Return what a member last said of its map; None if nothing, or it is lost."""
        return self._known.state_of(member)

    def is_silent(self, member: int) -> bool:
        """Whether a member may be lost, which is known later: nobody else waits for its word."""
        return self._presence.is_silent(member)

    def is_senior(self, team: int) -> bool:
        """Whether another team goes before ours, whose map is merged into that one's then."""
        return self._roster().is_senior(team, self.team)

    def is_apart(self, member: int) -> bool:
        """Whether a member flies on a map of its own that is about to be merged into ours."""
        return self._known.is_apart(member)

    def distrust(self, peers: frozenset[int]) -> None:
        """Note who is not believed from now on; all others are."""
        self._known.distrust(peers)
        self.leadership.take_term()

    def leave_apart(self, peers: frozenset[int]) -> None:
        """Note who flies on a map of its own that is about to be merged into ours.

        Until then ours goes on without them: they neither vote for what it is to become, nor
        give frames to it, nor are waited for to have it.
        """
        self._known.leave_apart(peers)

    def join(self, team: int) -> None:
        """Fly with a team from now on: its map has been taken."""
        if team != self.team:
            self._known.go_to(team)
            self.leadership.take_term()

    def heartbeat(self, peer: int, now_s: float) -> list[GroupEvent]:
        """Note that a peer is heard; who is no member is ignored."""
        if not self._known.hear(peer, now_s):
            return []
        self.leadership.note_came(peer, now_s)
        self.leadership.take_term()
        return [PeerJoined(peer)]

    def map_state(self, peer: int, state: MapState, now_s: float) -> list[GroupEvent]:
        """Note which map a peer flies on, which is a sign of life too."""
        events = self.heartbeat(peer, now_s)
        if not self._presence.is_heard(peer):
            return events
        has_moved = self._known.believes(peer) and self._takes_us_along(peer, state)
        before = self._known.note(peer, state)
        self.leadership.hear(peer, state, before, now_s)
        if self._known.believes(peer):
            self._graph.note(peer, state.signature, now_s)
        if has_moved:
            self._known.go_to(state.team)
        if (state.team, state.epoch) != (before.team, before.epoch):
            self.leadership.take_term()
        return events

    def set_own_state(self, state: MapState) -> None:
        """Note which map this drone flies on; its team and epoch are known here."""
        self._known.note(self.own_id, state)

    def note_signature(self, signature: bytes, now_s: float) -> None:
        """Take the signature of a frame of our own (``vision/signature.py``)."""
        self._presence.note_time(now_s)
        self._signature.note(signature)
        self._graph.note(self.own_id, signature, now_s)

    def signature_to_tell(self, now_s: float) -> bytes:
        """Return what the next state is to tell: the newest signature, once, and not too often."""
        return self._signature.to_tell(now_s)

    def poll(self, now_s: float) -> list[GroupEvent]:
        """Return who is lost by now, and forget what it had: it may come back without it.

        What team we fly with, and who leads it, is seen to as well.
        """
        lost = self._presence.take_lost(now_s, knows_lead=self.leadership.is_told)
        for peer in lost:
            self._known.forget(peer)
            self.leadership.note_lost(peer, now_s)
            self._graph.forget(peer)
        self._graph.poll(now_s)
        roster = self._roster()
        self._known.go_to(self._team_by(roster))
        self._meetings.poll(roster, now_s)
        self.leadership.take_term()
        self._presence.note_lead(self.coordinator, now_s)
        return [PeerLost(peer) for peer in sorted(lost)]

    def next_poll_s(self) -> float | None:
        """Return when somebody is lost if nothing is heard until then; None for nobody."""
        return self._presence.next_lost_s(knows_lead=self.leadership.is_told)

    def _takes_us_along(self, peer: int, state: MapState) -> bool:
        """Whether our coordinator, by what it says now, has gone to a team senior to ours.

        One without a map was restarted, and has not gone anywhere.
        """
        if state.team == self.team or self.team_of(peer) != self.team or not state.revision:
            return False
        return self.leadership.may_lead(peer) and self.is_senior(state.team)

    def _team_by(self, roster: Roster) -> int:
        """Return the team that this drone is to fly with by now."""
        if self.own_id in roster.world_of:
            return self._parting.team(roster, self._presence.now_s)
        return team_with_a_map(roster) if self._presence.has_listened else self.team

    def _roster(self) -> Roster:
        believed = {m for m in self.alive if self._known.believes(m) or m == self.leader}
        mapped = {m: s for m in believed if (s := self.state_of(m)) and s.revision}
        coordinator = self.coordinator
        return Roster(
            self.own_id,
            self.leader,
            {m: self.team_of(m) for m in believed},
            {m: state.world for m, state in mapped.items()},
            {m for m, state in mapped.items() if state.localized and not state.wants_update},
            coordinator if coordinator in believed else None,
        )
