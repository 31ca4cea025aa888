"""Who is in the group, who is alive, who coordinates, who has which map, who wants it updated.

The leader is named by the configuration (the lowest member id unless it says
otherwise): its body at the first map is the world's origin. The coordinator is
the leader, or, once the leader was heard and then lost, the lowest member
alive. A leader never heard is waited for: at a start drones come up seconds
apart, and each must not begin a map of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from vcl_companion.errors import ConfigError
from vcl_companion.wire.messages import MapState

_MAX_MEMBER_ID = 250


@dataclass(frozen=True)
class SwarmOptions:
    """The group as it is configured, the same on every drone.

    Attributes:
        members: system ids of all drones; empty for a drone alone.
        leader: one of them; 0 for the lowest.
        known_distances: (a, b, m): distance between two drones at the start, m.
        heartbeat_timeout_s: silent for this long is lost.
    """

    members: tuple[int, ...] = ()
    leader: int = 0
    known_distances: tuple[tuple[int, int, float], ...] = ()
    heartbeat_timeout_s: float = 5.0

    def __post_init__(self) -> None:
        for member in self.members:
            if not 1 <= member <= _MAX_MEMBER_ID:
                raise ConfigError(f"members: {member} is not a system id of 1 to {_MAX_MEMBER_ID}")
        if len(set(self.members)) != len(self.members):
            raise ConfigError(f"members: {list(self.members)} names a drone twice")
        if self.leader and self.leader not in self.members:
            raise ConfigError(f"leader: {self.leader} is not one of members {list(self.members)}")
        if not (math.isfinite(self.heartbeat_timeout_s) and self.heartbeat_timeout_s > 0):
            raise ConfigError(f"heartbeat_timeout_s: {self.heartbeat_timeout_s} is not positive")
        pairs: set[frozenset[int]] = set()
        for a, b, distance_m in self.known_distances:
            row = f"known_distances: [{a}, {b}, {distance_m}]"
            for member in (a, b):
                if member not in self.members:
                    raise ConfigError(f"{row}: {member} is not one of {list(self.members)}")
            if a == b:
                raise ConfigError(f"{row} is not between two drones")
            if not (math.isfinite(distance_m) and distance_m > 0):
                raise ConfigError(f"{row}: a distance must be finite and positive, in metres")
            if frozenset((a, b)) in pairs:
                raise ConfigError(f"{row} gives a distance twice")
            pairs.add(frozenset((a, b)))


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
    """What one drone knows of its group; only heartbeats, map states and time change it."""

    def __init__(self, options: SwarmOptions, own_id: int) -> None:
        if options.members and own_id not in options.members:
            raise ConfigError(
                f"members: {list(options.members)} does not name this drone, system_id {own_id}"
            )
        self.own_id = own_id
        self.members = tuple(sorted(options.members)) or (own_id,)
        self.leader = options.leader or self.members[0]
        self.measured = tuple(sorted({m for a, b, _ in options.known_distances for m in (a, b)}))
        self._timeout_s = options.heartbeat_timeout_s
        self._heard_at_s: dict[int, float] = {}  # members alive
        self._ever_heard: set[int] = set()
        self._states: dict[int, MapState] = {}  # ours, and of members alive
        self._distrusted: frozenset[int] = frozenset()

    @property
    def peers(self) -> tuple[int, ...]:
        """All members but this drone."""
        return tuple(member for member in self.members if member != self.own_id)

    @property
    def alive(self) -> tuple[int, ...]:
        """Members that are there as far as known, this drone among them, ascending."""
        return tuple(m for m in self.members if m == self.own_id or m in self._heard_at_s)

    @property
    def trusted(self) -> tuple[int, ...]:
        """Members alive that are believed, this drone among them, ascending."""
        return tuple(m for m in self.alive if m not in self._distrusted)

    def distrust(self, peers: frozenset[int]) -> None:
        """Note who is not believed from now on; all others are."""
        self._distrusted = peers - {self.own_id}

    @property
    def is_complete(self) -> bool:
        """Whether every member is there."""
        return self.alive == self.members

    @property
    def coordinator(self) -> int:
        """The member that builds and hands out maps; see the module."""
        lost = self.leader in self._ever_heard and self.leader not in self._heard_at_s
        return self.alive[0] if lost else self.leader

    @property
    def is_coordinator(self) -> bool:
        """Whether that is this drone."""
        return self.coordinator == self.own_id

    @property
    def newest_revision(self) -> bytes:
        """The coordinator's map, empty while it has none as far as known."""
        state = self._states.get(self.coordinator)
        return state.revision if state else b""

    def heartbeat(self, peer: int, now_s: float) -> list[GroupEvent]:
        """Note that a peer is heard; who is no member is ignored."""
        if peer == self.own_id or peer not in self.members:
            return []
        is_new = peer not in self._heard_at_s
        self._heard_at_s[peer] = max(now_s, self._heard_at_s.get(peer, now_s))
        self._ever_heard.add(peer)
        return [PeerJoined(peer)] if is_new else []

    def map_state(self, peer: int, state: MapState, now_s: float) -> list[GroupEvent]:
        """Note which map a peer flies on, which is a sign of life too."""
        events = self.heartbeat(peer, now_s)
        if peer in self._heard_at_s:
            self._states[peer] = state
        return events

    def set_own_state(self, state: MapState) -> None:
        """Note which map this drone flies on."""
        self._states[self.own_id] = state

    def state_of(self, member: int) -> MapState | None:
        """Return what a member last said of its map; None if nothing, or it is lost."""
        return self._states.get(member)

    def contributors(self, first: Iterable[int], most: int) -> tuple[int, ...]:
        """Return members alive and believed whose frames a map is to be made of, and this drone.

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

        others = sorted(self.trusted, key=lambda member: (seen(member), member))
        order = dict.fromkeys((self.own_id, *first, *others))
        return tuple(m for m in order if m in self.trusted)[:most]

    def holders(self, revision: bytes) -> tuple[int, ...]:
        """Return the members alive that hold this revision."""
        return tuple(m for m in self.alive if (s := self._states.get(m)) and s.revision == revision)

    def lacking(self) -> tuple[int, ...]:
        """Return the members trusted that do not hold the newest revision; none without one.

        A member that said nothing of its map yet lacks it.
        """
        if not self.newest_revision:
            return ()
        holders = self.holders(self.newest_revision)
        return tuple(member for member in self.trusted if member not in holders)

    @property
    def wanting_update(self) -> tuple[int, ...]:
        """Members trusted whose vote is for an update of the newest revision (IV-G).

        The vote of one that still flies on another revision is about that one,
        and does not count.
        """
        if not self.newest_revision:
            return ()
        holders = self.holders(self.newest_revision)
        return tuple(m for m in self.trusted if m in holders and self._states[m].wants_update)

    @property
    def majority_wants_update(self) -> bool:
        """Whether more than half of the members trusted vote for an update."""
        return 2 * len(self.wanting_update) > len(self.trusted)

    def most_others_hold(self, revision: bytes) -> bool:
        """Whether most of the other members trusted, and at least two, hold a revision."""
        others = [m for m in self.trusted if m != self.own_id]
        n_holders = len(set(others) & set(self.holders(revision)))
        return n_holders >= 2 and 2 * n_holders > len(others)

    def poll(self, now_s: float) -> list[GroupEvent]:
        """Return who is lost by now, and forget what it had: it may come back without it."""
        late = [p for p, at_s in self._heard_at_s.items() if now_s >= at_s + self._timeout_s]
        for peer in late:
            del self._heard_at_s[peer]
            self._states.pop(peer, None)
        return [PeerLost(peer) for peer in sorted(late)]

    def next_poll_s(self) -> float | None:
        """Return when somebody is lost if nothing is heard until then; None for nobody."""
        if not self._heard_at_s:
            return None
        return min(self._heard_at_s.values()) + self._timeout_s
