"""Epochs that one wrong member tells: they keep nobody from its coordinator, true ones do."""

from __future__ import annotations

import pytest

from vcl_companion.swarm.epochs import FIRST, VACANT, is_before, taken_by
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.wire.messages import MapState

FOUR = SwarmOptions((1, 2, 3, 4))
WRONG = 4
STEP_S, DELAY_S = 0.05, 0.02


def state(epoch: int = 0, team: int = 0) -> MapState:
    return MapState(b"revision", 100, True, 200, False, team, epoch, world=b"a world.")


class Air:
    """Drones 1 to 3, who tell each other their state, and what a fourth tells each of them."""

    def __init__(self) -> None:
        self.groups = {own: Group(FOUR, own) for own in (1, 2, 3)}
        self.now_s = 0.0
        self.n_fenced = 0
        self.n_told = 0
        self._told_at_s = {own: -9.0 + 0.3 * own for own in self.groups}
        self._told_lead = dict.fromkeys(self.groups, (0, 0))
        self._in_flight: list[tuple[int, int, MapState]] = []

    def say(self, sender: int, receiver: int, said: MapState) -> None:
        self._in_flight.append((sender, receiver, said))

    def step(self) -> None:
        """Let a moment pass, after which all that was said has come."""
        self.now_s += STEP_S
        came, self._in_flight = self._in_flight, []
        for sender, receiver, said in came:
            self.groups[receiver].map_state(sender, said, self.now_s)
        for own, group in self.groups.items():
            group.poll(self.now_s)
            lead = group.team, group.leadership.own_epoch
            if lead != self._told_lead[own] or self.now_s >= self._told_at_s[own] + 2.0:
                self._told_at_s[own], self._told_lead[own] = self.now_s, lead
                self.n_told += 1
                group.set_own_state(state(group.leadership.epoch))
                for other in self.groups:
                    if other != own:
                        self.say(own, other, state(group.leadership.epoch))
        self.n_fenced += not all(self.groups[own].leadership.may_lead(1) for own in (2, 3))


@pytest.mark.parametrize("every_s", [0.1, 1.0])
@pytest.mark.parametrize("is_told_to_the_leader", [False, True])
def test_epochs_that_one_member_makes_up_fence_nobody(
    every_s: float, is_told_to_the_leader: bool
) -> None:
    air = Air()
    next_s = 5.0
    while air.now_s < 40.0:
        air.step()
        if air.now_s >= next_s:
            next_s += every_s
            for own, group in air.groups.items():
                made_up = (group.leadership.epoch // 256 + 1) * 256 + WRONG
                epoch = made_up if own != 1 or is_told_to_the_leader else group.leadership.epoch
                air.say(WRONG, own, state(epoch))
    assert air.n_fenced == 0
    assert {group.coordinator for group in air.groups.values()} == {1}
    assert (air.groups[2].leadership.epoch != FIRST) == is_told_to_the_leader


def test_an_epoch_half_of_all_further_on_costs_the_leader_one_of_its_own_and_no_more() -> None:
    air = Air()
    for _ in range(100):
        air.step()
    for n in range(40):
        epoch = (air.groups[1].leadership.epoch or 0x104) + (1 << 31) - 1
        air.say(WRONG, 1, state(epoch % (1 << 32)))
        for _ in range(20):
            air.step()
        assert air.groups[1].leadership.epoch == air.groups[3].leadership.epoch, n
    assert air.n_fenced == 0
    assert air.n_told < 40 * 4  # not one at every look


def test_who_was_away_is_fenced_by_the_word_of_two() -> None:
    group = Group(FOUR, 2)  # restarted, it knows of nothing
    group.map_state(1, state(), 0.0)
    group.map_state(3, state(0x303), 0.0)
    assert group.leadership.may_lead(1)
    group.map_state(4, state(0x203), 0.1)
    assert group.leadership.epoch == 0x203  # what both know
    assert not group.leadership.may_lead(1)
    group.map_state(1, state(0x401), 0.2)
    assert group.leadership.may_lead(1)


def test_who_coordinates_is_believed_alone_and_what_it_said_before_it_was_known_to() -> None:
    group = Group(FOUR, 4)
    group.map_state(1, state(), 0.0)
    group.map_state(3, state(), 4.0)
    group.map_state(2, state(0x102), 4.9)  # it has lost the leader a little sooner
    assert group.leadership.epoch == FIRST
    group.poll(5.0)
    assert (group.coordinator, group.leadership.epoch) == (2, 0x102)
    group.map_state(1, state(), 6.0)  # back, and has heard nothing
    assert not group.leadership.may_lead(1)


def test_what_a_quarantined_leader_tells_is_not_taken() -> None:
    group = Group(FOUR, 2)
    group.distrust(frozenset({1}))
    group.map_state(1, state(0x901), 0.0)
    group.poll(0.1)
    assert (group.coordinator, group.leadership.epoch) == (1, FIRST)


def test_the_leader_takes_a_newer_one_whoever_has_heard_of_another() -> None:
    group = Group(FOUR, 1)
    group.map_state(2, state(), 0.0)
    group.map_state(3, state(0x203), 0.0)
    assert taken_by(group.leadership.epoch) == 1
    assert is_before(0x203, group.leadership.epoch)
    group.map_state(2, state(VACANT), 0.0)
    assert group.leadership.epoch == 0x301


def test_who_has_heard_a_single_member_tell_of_a_lost_leader_takes_its_place() -> None:
    group = Group(FOUR, 2)
    for second in range(6):
        group.map_state(4, state(0x504), float(second))
        group.poll(float(second))
    assert group.is_coordinator
    assert is_before(0x504, group.leadership.epoch)


def test_epochs_of_another_team_are_believed_of_its_coordinator() -> None:
    group = Group(FOUR, 1)
    group.map_state(3, state(0x103, team=3), 0.0)
    group.map_state(4, state(0x904, team=3), 0.0)
    group.join(3)
    assert group.is_coordinator  # the leader
    assert is_before(0x904, group.leadership.epoch)
    other = Group(FOUR, 2)
    other.map_state(3, state(0x103, team=3), 0.0)
    other.map_state(4, state(0x904, team=3), 0.0)
    other.map_state(1, state(0x103, team=3), 0.0)
    other.join(3)
    assert other.coordinator == 1
    assert other.leadership.may_lead(1)
