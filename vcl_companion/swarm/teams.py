"""Which team this drone flies with: how teams part, and who moves to which (issue: split, rejoin).

A team is the members that fly on one line of maps under one coordinator; all begin in team 0.
Who sees the same place is told by the overlap graph. A drone whose part of it has been
without its coordinator for long, and badly served by the map that this one makes, leaves with
its part: the lowest of these names the new team by its own id, and founds it; the others follow
when they see that it has. So do those whose maps are of one world, and their coordinator's of
another. A drone alone stays.
A team comes back as a whole, when its coordinator has got a map of the other team.

Nothing here is decided by a vote. Each drone looks at what all tell, and whoever has heard the
same decides the same; who has not is told so by the next state, a second later.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from vcl_companion.swarm.overlap import OverlapGraph


@dataclass(frozen=True)
class Roster:
    """Who is there, as one drone sees it.

    Attributes:
        own_id: this drone.
        leader: of all.
        team_of: the team of everybody who is there and believed, this drone and the leader.
        world_of: the world that the map of each of those is in, who has a map.
        served: those who find their way by their map and do not want it updated.
        coordinator: of our team; None while it is not there.
    """

    own_id: int
    leader: int
    team_of: Mapping[int, int]
    world_of: Mapping[int, bytes]
    served: Collection[int]
    coordinator: int | None

    @property
    def own_team(self) -> int:
        """The team of this drone."""
        return self.team_of[self.own_id]

    @property
    def other_teams(self) -> tuple[int, ...]:
        """The teams that there are but ours, ascending."""
        return tuple(sorted(set(self.team_of.values()) - {self.own_team}))

    def is_senior(self, team: int, to: int) -> bool:
        """Whether a team goes before another: it has the leader, or else the lower name."""
        leaders = self.team_of.get(self.leader)
        return (team != leaders, team) < (to != leaders, to)


def team_with_a_map(roster: Roster) -> int:
    """Return the team that a drone without a map belongs to: whose map it can get.

    That of the leader; without a map there, its own; without one there either, the lowest.
    With no map anywhere it stays.
    """
    own = roster.own_team
    mapped = {roster.team_of[member] for member in roster.world_of}
    for team in (roster.team_of.get(roster.leader), own, *sorted(mapped)):
        if team is not None and team in mapped:
            return team
    return own


class Parting:
    """Watches whether our part of the swarm has come off its coordinator.

    Args:
        graph: who sees the same place.
        split_after_s: a part leaves after so long; 0 for never.
    """

    def __init__(self, graph: OverlapGraph, split_after_s: float) -> None:
        self._graph = graph
        self._split_after_s = split_after_s
        self._apart: tuple[int, float] | None = None  # from which coordinator, since when

    def team(self, roster: Roster, now_s: float) -> int:
        """Return the team that this drone is to fly with by what its part sees; see the module."""
        own, coordinator = roster.own_id, roster.coordinator
        if not self._is_apart(roster, now_s):
            self._apart = None
            return roster.own_team
        assert coordinator is not None
        if self._apart is None or self._apart[0] != coordinator:
            self._apart = (coordinator, now_s)
        if now_s < self._apart[1] + self._split_after_s:
            return roster.own_team
        part = self._part(roster)
        leaving = [
            member
            for member in part
            if member in roster.world_of and roster.team_of[member] == roster.own_team
        ]
        founded = [
            member
            for member in part
            if roster.team_of[member] == member
            and roster.own_team != member
            and roster.world_of.get(member) == roster.world_of[own]
        ]
        if founded:
            return min(founded)
        # Where it flies in a team that has its own name already, the next one founds.
        founders = [member for member in leaving if member != roster.own_team]
        if len(leaving) > 1 and min(founders) == own:
            return own
        return roster.own_team

    def _part(self, roster: Roster) -> list[int]:
        """Return who leaves together: who sees the same place, or is of another world."""
        own, coordinator = roster.own_id, roster.coordinator
        world = roster.world_of[own]
        if coordinator is not None and roster.world_of.get(coordinator, world) != world:
            return [member for member, theirs in roster.world_of.items() if theirs == world]
        return list(self._graph.component(own, roster.team_of))

    def _is_apart(self, roster: Roster, now_s: float) -> bool:
        """Whether we see nothing of what our coordinator sees; without word of it nobody knows."""
        own, coordinator = roster.own_id, roster.coordinator
        if not self._split_after_s or coordinator in (None, own) or own not in roster.world_of:
            return False
        assert coordinator is not None
        theirs = roster.world_of.get(coordinator)
        if theirs is not None and theirs != roster.world_of[own]:
            return True
        if not all(self._graph.is_told_of(member, now_s) for member in (own, coordinator)):
            return False
        part = self._graph.component(own, roster.team_of)
        # Wide apart two see the same place without looking alike: while the map serves them
        # there is nothing that a team of their own would do better.
        n_served = sum(member in roster.served for member in part)
        return coordinator not in part and 2 * n_served <= len(part)


class Meetings:
    """Remembers since when other teams have been seeing what ours sees.

    Args:
        graph: who sees the same place.
        rejoin_after_s: sooner no meeting counts.
    """

    def __init__(self, graph: OverlapGraph, rejoin_after_s: float) -> None:
        self._graph = graph
        self._rejoin_after_s = rejoin_after_s
        self._since_s: dict[int, float] = {}

    def poll(self, roster: Roster, now_s: float) -> None:
        """Look who overlaps."""
        met = {team for team in roster.other_teams if self._overlap(roster, team)}
        self._since_s = {team: self._since_s.get(team, now_s) for team in met}

    def lasting(self, now_s: float) -> tuple[int, ...]:
        """Return the teams that ours has overlapped for long enough, ascending."""
        return tuple(
            team
            for team, since_s in sorted(self._since_s.items())
            if now_s >= since_s + self._rejoin_after_s
        )

    def _overlap(self, roster: Roster, other: int) -> bool:
        ours = [member for member, team in roster.team_of.items() if team == roster.own_team]
        theirs = [member for member, team in roster.team_of.items() if team == other]
        return self._graph.overlap(ours, theirs)
