"""Groups of drones in one process, and the air between them: what they say is lost and late.

The states go through the real wire format; time is counted, not waited for. What a daemon
does with maps is done at once: the coordinator of a team that has met a senior one moves there.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field

import numpy as np

from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.vision.signature import SIGNATURE_BYTES
from vcl_companion.wire.messages import MapState
from vcl_companion.wire.tunnel import decode_payload, encode_payload

STEP_S = 0.5
_BEAT_S = 1.0
_WORLD = b"a world."


@dataclass
class Sky:
    """See the module.

    Attributes:
        options: of all drones.
        loss: share of what is said that a drone does not hear.
        late_s: what is heard comes so late at most, in any order, some of it twice.
        place: what each drone sees: a number, the same for who sees the same.
        side: the part of the air that each drone is in; who is in another is not heard.
        up: the drones that there are.
        world: what the map of each is in, if not in that of most.
        served: those whom the map that they have is good enough for.
        led: who coordinated each team under each epoch.
    """

    options: SwarmOptions
    seed: int = 0
    loss: float = 0.0
    late_s: float = 0.0
    now_s: float = 100.0
    place: dict[int, int] = field(default_factory=dict)
    side: dict[int, int] = field(default_factory=dict)
    up: dict[int, Group] = field(default_factory=dict)
    world: dict[int, bytes] = field(default_factory=dict)
    served: set[int] = field(default_factory=set)
    led: dict[tuple[int, int], int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._order = itertools.count()
        self._in_flight: list[tuple[float, int, int, int, bytes | None]] = []
        self._mapped: set[int] = set()
        self._known: dict[int, dict[int, int]] = {}
        self._signed_at_s: dict[int, float] = {}
        for member in self.options.members:
            self.start(member)
            self._mapped.add(member)

    def start(self, member: int) -> None:
        """Start a drone, or start it again with nothing remembered: no map, no epochs."""
        self.up[member] = Group(self.options, member)
        self._mapped.discard(member)
        self._known[member] = {}

    def stop(self, member: int) -> None:
        """End a drone."""
        self.up.pop(member, None)

    def run(self, for_s: float) -> None:
        """Let time pass, and check at every step what must hold whatever happens."""
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            self.now_s += STEP_S
            self._deliver()
            for member, group in sorted(self.up.items()):
                group.poll(self.now_s)
                self._move(group)
                self._get_map(group)
                self._speak(member, group)
            self._check()

    def leads(self) -> dict[int, tuple[int, int]]:
        """Return the team of each drone and who, it believes, coordinates it."""
        return {member: (group.team, group.coordinator) for member, group in self.up.items()}

    def teams(self) -> set[frozenset[int]]:
        """Return who flies with whom."""
        by_team: dict[int, set[int]] = {}
        for member, group in self.up.items():
            by_team.setdefault(group.team, set()).add(member)
        return {frozenset(members) for members in by_team.values()}

    def _speak(self, member: int, group: Group) -> None:
        place = self.place.get(member)
        if place is not None and self.now_s >= self._signed_at_s.get(member, 0.0) + 2.0:
            self._signed_at_s[member] = self.now_s
            seen = np.random.default_rng(place).bytes(SIGNATURE_BYTES)
            group.note_signature(seen, self.now_s)
        if (self.now_s + member * STEP_S) % _BEAT_S:
            self._send(member, None)
            return
        revision = b"revision" if member in self._mapped else b""
        world = self.world.get(member, _WORLD) if revision else b""
        state = MapState(
            revision, 1, bool(revision), 1, member not in self.served, group.team,
            group.leadership.epoch, world, group.signature_to_tell(self.now_s),
        )  # fmt: skip
        group.set_own_state(state)
        self._send(member, encode_payload(state)[1])

    def _send(self, sender: int, payload: bytes | None) -> None:
        for receiver in self.up:
            if receiver == sender or self.side.get(sender) != self.side.get(receiver):
                continue
            for _ in range(1 + (self._rng.uniform() < 0.2 and self.late_s > 0)):
                if self._rng.uniform() >= self.loss:
                    at_s = self.now_s + self.late_s * float(self._rng.uniform())
                    entry = (at_s, next(self._order), sender, receiver, payload)
                    heapq.heappush(self._in_flight, entry)

    def _deliver(self) -> None:
        while self._in_flight and self._in_flight[0][0] <= self.now_s:
            _, _, sender, receiver, payload = heapq.heappop(self._in_flight)
            group = self.up.get(receiver)
            if group is None:
                continue
            if payload is None:
                group.heartbeat(sender, self.now_s)
                continue
            state = decode_payload(33101, payload)
            assert isinstance(state, MapState)
            group.map_state(sender, state, self.now_s)

    def _move(self, group: Group) -> None:
        """Have maps merged: the junior's coordinator goes where its map has gone."""
        if group.own_id not in self._mapped or not group.is_coordinator:
            return
        for team in group.teams_met:
            host = group.leadership.coordinator_of(team)
            if group.is_senior(team) and host in self.up and host in self._mapped:
                group.join(team)
                return

    def _get_map(self, group: Group) -> None:
        if group.own_id in self._mapped:
            return
        holders = group.maps.holders(b"revision")
        if any(self.up.get(h) is not None and h in self._mapped for h in holders):
            self._mapped.add(group.own_id)

    def _check(self) -> None:
        for member, group in self.up.items():
            assert group.coordinator in group.members
            known = self._known[member]
            assert group.leadership.epoch >= known.get(group.team, 0), "an epoch went back"
            known[group.team] = group.leadership.epoch
            if group.is_coordinator:
                leads = self.led.setdefault((group.team, group.leadership.epoch), member)
                assert leads == member, "two have led under one epoch"
