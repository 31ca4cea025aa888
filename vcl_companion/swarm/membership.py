"""Who is there, who is believed, what each says of its map, and with which team it flies."""

from __future__ import annotations

from vcl_companion.swarm.presence import Presence
from vcl_companion.wire.messages import MapState

_SAID_NOTHING = MapState(b"", 0, False)


class Membership:
    """The members of a group as one drone knows them; ``Group`` tells it what happens.

    Args:
        members: all there may be, ascending, this drone among them.
        own_id: this drone.
        timeout_s: who is silent for so long is lost, in a small swarm.
    """

    def __init__(self, members: tuple[int, ...], own_id: int, timeout_s: float) -> None:
        self.own_id = own_id
        self.presence = Presence(members, own_id, timeout_s)
        self._states: dict[int, MapState] = {}  # ours, and of members alive
        self._distrusted: frozenset[int] = frozenset()
        self._apart: frozenset[int] = frozenset()
        self._team = 0
        # Asked for with every message, and changed by hardly any; None: to be found anew.
        self._teammates: tuple[int, ...] | None = None

    @property
    def alive(self) -> tuple[int, ...]:
        """Members that are there as far as known, this drone among them, ascending."""
        return self.presence.alive

    @property
    def trusted(self) -> tuple[int, ...]:
        """Members alive that are believed, this drone among them, ascending."""
        return tuple(filter(self.believes, self.alive))

    @property
    def team(self) -> int:
        """The team that this drone flies with."""
        return self._team

    @property
    def teammates(self) -> tuple[int, ...]:
        """Members alive that fly with our team, this drone among them, ascending."""
        if self._teammates is None:
            self._teammates = tuple(m for m in self.alive if self.team_of(m) == self._team)
        return self._teammates

    @property
    def trusted_teammates(self) -> tuple[int, ...]:
        """Those of them that are believed."""
        return tuple(filter(self.believes, self.teammates))

    def of_team(self, team: int) -> tuple[int, ...]:
        """Return the members alive that fly with a team, ascending."""
        if team == self._team:
            return self.teammates
        return tuple(m for m in self.alive if self.team_of(m) == team)

    def team_of(self, member: int) -> int:
        """Return the team that a member says it flies with; 0 where it has said nothing."""
        if member == self.own_id:
            return self._team
        state = self._states.get(member)
        return state.team if state else 0

    def state_of(self, member: int) -> MapState | None:
        """Return what a member last said of its map; None if nothing, or it is lost."""
        return self._states.get(member)

    def believes(self, member: int) -> bool:
        """Whether what a member says is taken for true."""
        return member not in self._distrusted

    def counts(self, member: int) -> bool:
        """Whether a teammate decides on our map, and makes it: believed, heard, not on its own."""
        is_with_us = self.believes(member) and not self.is_apart(member)
        return is_with_us and not self.presence.is_silent(member)

    def is_apart(self, member: int) -> bool:
        """Whether a member flies on a map of its own that is about to be merged into ours."""
        return member in self._apart

    def distrust(self, peers: frozenset[int]) -> None:
        """Note who is not believed from now on; all others are."""
        self._distrusted = peers - {self.own_id}

    def leave_apart(self, peers: frozenset[int]) -> None:
        """Note who flies on a map of its own that is about to be merged into ours."""
        self._apart = peers - {self.own_id}

    def go_to(self, team: int) -> None:
        """Fly with a team from now on."""
        if team != self._team:
            self._team, self._teammates = team, None

    def hear(self, peer: int, now_s: float) -> bool:
        """Note that a peer is heard; return whether it is there since now (``Presence.hear``)."""
        is_new = self.presence.hear(peer, now_s)
        if is_new:
            self._teammates = None
        return is_new

    def note(self, member: int, state: MapState) -> MapState:
        """Note what a member, this drone or another, says; return what it said before."""
        before = self._states.get(member, _SAID_NOTHING)
        self._states[member] = state
        if state.team != before.team:
            self._teammates = None
        return before

    def forget(self, peer: int) -> None:
        """Forget what somebody said who is lost: it may come back without that."""
        self._states.pop(peer, None)
        self._teammates = None
