"""Groups whose members show themselves rarely (``pace``): who is lost, leads, and is waited for."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

import pytest

from vcl_companion.swarm.group import Group, PeerJoined, PeerLost, SwarmOptions
from vcl_companion.swarm.pose_requests import HostChoice
from vcl_companion.wire.messages import MapState

MAP = MapState(b"revision", 900, True, tracked=80, world=b"world   ")
STEP_S, LOSS = 0.1, 0.1


class Air:
    """Some drones of a group of many that all hear each other, but for what a test says.

    They show themselves as ``PeerLink`` and ``OwnState`` do, at the pace of their groups.
    """

    def __init__(self, n_members: int, alive: range, seed: int) -> None:
        self._rng = random.Random(seed)
        members = SwarmOptions(tuple(range(1, n_members + 1)))
        self.groups = {own: Group(members, own) for own in alive}
        self.dead: set[int] = set()
        self.hears: Callable[[int, int], bool] = lambda sender, receiver: True
        self.now_s = 0.0
        self.lost: Counter[tuple[int, int]] = Counter()
        self._beat_at_s = {own: self._rng.uniform(-1.0, 0.0) for own in alive}
        self._told_at_s = dict(self._beat_at_s)
        self._lead = dict.fromkeys(alive, (0, 0))

    def tell(self, own: int) -> None:
        """Have a drone tell its state now."""
        group = self.groups[own]
        state = MapState(
            MAP.revision,
            900,
            True,
            100,
            team=group.team,
            epoch=group.leadership.epoch,
            world=MAP.world,
        )
        group.set_own_state(state)
        self._told_at_s[own] = self.now_s
        self._lead[own] = group.team, group.leadership.own_epoch
        for receiver in self._receivers(own):
            receiver.map_state(own, state, self.now_s)

    def fly(self, seconds: float) -> None:
        """Let time pass."""
        until_s = self.now_s + seconds
        while self.now_s < until_s:
            for own, group in self.groups.items():
                if own not in self.dead:
                    self._step(own, group)
            self.now_s += STEP_S

    def _step(self, own: int, group: Group) -> None:
        for event in group.poll(self.now_s):
            if isinstance(event, PeerLost):
                self.lost[own, event.peer] += 1
        if self.now_s >= self._beat_at_s[own] + group.stretch - 0.5:
            self._beat_at_s[own] = self.now_s
            for receiver in self._receivers(own):
                receiver.heartbeat(own, self.now_s)
        has_led = (group.team, group.leadership.own_epoch) != self._lead[own]
        if has_led or self.now_s >= self._told_at_s[own] + max(2.0, group.stretch):
            self.tell(own)

    def _receivers(self, sender: int) -> list[Group]:
        return [
            group
            for own, group in self.groups.items()
            if own not in {sender, *self.dead}
            and self.hears(sender, own)
            and self._rng.random() >= LOSS
        ]


@pytest.mark.parametrize(("n_members", "stretch"), [(3, 1.0), (16, 1.0), (40, 2.5), (100, 6.25)])
def test_members_are_given_time_but_for_who_coordinates(n_members: int, stretch: float) -> None:
    group = Group(SwarmOptions(tuple(range(1, n_members + 1))), 2)
    assert group.stretch == stretch
    group.heartbeat(1, 0.0)
    group.heartbeat(3, 0.0)
    assert group.stretch == 1.0  # they are to hear of us soon
    group.poll(0.0)
    assert group.next_poll_s() == 5.0
    assert group.poll(4.9) == []
    assert group.poll(5.0) == ([PeerLost(1), PeerLost(3)] if stretch == 1.0 else [PeerLost(1)])
    assert group.is_coordinator
    assert group.stretch == 1.0
    if stretch > 1.0:
        assert group.next_poll_s() == 5.0 * stretch
        assert group.poll(5.0 * stretch - 0.1) == []
        assert group.poll(5.0 * stretch) == [PeerLost(3)]


def test_a_successor_has_its_time_to_show_itself_and_is_replaced_soon_when_it_does_not() -> None:
    group = Group(SwarmOptions(tuple(range(1, 101))), 4)
    for peer in (1, 2, 3):
        group.heartbeat(peer, 0.0)
    group.poll(0.0)
    group.heartbeat(3, 10.0)
    group.heartbeat(1, 20.0)
    assert group.stretch == 6.25
    assert group.poll(25.0) == [PeerLost(1)]
    # 2 was last heard 25 s ago, as others are; now a pace and a time-out.
    assert group.coordinator == 2
    assert group.poll(31.2) == []
    assert group.poll(31.3) == [PeerLost(2)]
    assert group.coordinator == 3
    group.map_state(3, MapState(b"", 0, False, epoch=3 << 8 | 3), 31.4)
    assert group.poll(36.3) == []
    assert group.poll(36.4) == [PeerLost(3)]
    assert group.is_coordinator
    group.heartbeat(3, 37.0)
    assert group.coordinator == 3


@pytest.mark.parametrize("n_members", [40, 100, 250])
def test_who_hears_all_but_the_leader_takes_nobody_for_lost_over_and_over(n_members: int) -> None:
    """Whom it takes for the coordinator follows the leader, and shows itself as others do."""
    air = Air(n_members, range(1, 8), seed=n_members)
    air.fly(20.0)
    air.hears = lambda sender, receiver: (sender, receiver) != (1, 3)
    air.fly(150.0)
    assert air.lost == {(3, 1): 1}
    assert air.groups[3].coordinator == 2
    assert all(group.coordinator == 1 for own, group in air.groups.items() if own != 3)


@pytest.mark.parametrize("own", [4, 6])
def test_who_distrusts_the_coordinator_takes_nobody_for_lost_over_and_over(own: int) -> None:
    air = Air(100, range(1, 8), seed=own)
    air.fly(20.0)
    air.dead.add(1)
    air.fly(20.0)
    assert {group.coordinator for number, group in air.groups.items() if number != 1} == {2}
    air.groups[own].distrust(frozenset({2}))
    air.lost.clear()
    air.fly(150.0)
    assert air.lost == {}
    assert air.groups[own].coordinator == 3


@pytest.mark.parametrize("seed", range(6))
def test_who_leaves_a_team_that_it_led_takes_those_along_who_have_not_heard_of_it(
    seed: int,
) -> None:
    """Nobody takes it for lost before its next word, though it does not lead any more."""
    air = Air(100, range(1, 9), seed)
    for own in range(5, 9):
        air.groups[own].join(5)
    air.fly(30.0)
    assert air.groups[8].coordinator == 5
    air.hears = lambda sender, receiver: (sender, receiver) != (5, 8)
    air.groups[5].join(0)
    air.tell(5)
    air.fly(0.5)
    air.hears = lambda sender, receiver: True
    air.fly(30.0)
    assert [group.team for group in air.groups.values()] == [0] * 8
    assert air.lost == {}


def test_who_may_be_lost_is_waited_for_by_nobody_and_asked_last() -> None:
    """Sooner than it is lost: after a pace, and what members of a small swarm are given."""
    group = Group(SwarmOptions(tuple(range(1, 101))), 1)
    group.set_own_state(MAP)
    hosts = HostChoice(group)
    assert group.map_state(2, MapState(b"other   ", 900, True), 0.0) == [PeerJoined(2)]
    group.map_state(3, MAP, 0.0)
    group.map_state(4, MAP, 2.0)
    hosts.answered(3, 0.001, 1.0, 0)
    hosts.answered(4, 0.1, 1.0, 0)
    group.poll(7.7)
    assert group.maps.lacking() == (2,)
    assert hosts.choose(MAP.revision, 1) == [3]
    group.poll(7.8)
    assert group.maps.lacking() == ()
    assert group.alive == (1, 2, 3, 4)
    assert hosts.choose(MAP.revision, 1) == [4]
    assert hosts.choose(MAP.revision, 2) == [4, 3]
