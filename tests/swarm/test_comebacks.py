"""Leaders that go and come back again and again: the others make maps meanwhile."""

from __future__ import annotations

import pytest

from tests.swarm.sky import STEP_S, Sky
from vcl_companion.swarm.comebacks import Comebacks, successor
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.wire.messages import MapState

FIVE = SwarmOptions((1, 2, 3, 4, 5))


def state(epoch: int = 0, revision: bytes = b"revision") -> MapState:
    return MapState(revision, 100, True, 200, False, 0, epoch)


def restart(sky: Sky, member: int, up_s: float, down_s: float) -> list[set[int]]:
    """Restart a drone once; return who led by what the others believed, at each moment."""
    led = []
    for for_s in (down_s, up_s):
        until_s = sky.now_s + for_s
        while sky.now_s < until_s:
            sky.run(STEP_S)
            led.append({sky.up[m].coordinator for m in sky.up if m != member})
        if for_s == down_s:
            sky.start(member)
    sky.stop(member)
    return led


@pytest.mark.parametrize(("up_s", "down_s"), [(2.0, 6.0), (4.0, 10.0), (10.0, 7.0), (20.0, 8.0)])
def test_a_leader_that_restarts_again_and_again_leaves_the_lead_to_the_next(
    up_s: float, down_s: float
) -> None:
    sky = Sky(FIVE)
    sky.run(10.0)
    sky.stop(1)
    before = [restart(sky, 1, up_s, down_s) for _ in range(5)]
    assert {1} in before[0]  # once it leads at once
    for _ in range(5):
        assert {frozenset(led) for led in restart(sky, 1, up_s, down_s)} == {frozenset({2})}
        assert all(sky.up[m].leadership.may_lead(2) for m in (3, 4, 5))
    sky.start(1)
    sky.run(45.0)
    assert set(sky.leads().values()) == {(0, 1)}
    assert all(group.leadership.may_lead(1) for group in sky.up.values())


def test_who_takes_its_place_is_judged_alike() -> None:
    sky = Sky(FIVE)
    sky.run(10.0)
    sky.stop(1)
    sky.run(10.0)
    sky.stop(2)
    for _ in range(4):
        restart(sky, 2, 5.0, 8.0)
    assert {frozenset(led) for led in restart(sky, 2, 5.0, 8.0)} == {frozenset({3})}


def test_where_nobody_else_leads_it_does_at_once() -> None:
    """Drones 2 and 5 hear the leader badly; what they took, nobody else has heard of."""
    group = Group(FIVE, 5)
    now_s = 0.0
    for _ in range(5):
        group.map_state(1, state(), now_s)
        now_s += 6.0
        for other in (2, 3, 4):
            group.map_state(other, state(), now_s - 0.1)
        group.poll(now_s)
        assert group.coordinator == 2  # as far as it knows
    group.map_state(1, state(), now_s)
    assert group.coordinator == 1
    for other in (2, 3):
        group.map_state(other, state(0x102), now_s)
    assert group.coordinator == 2
    for other in (3, 4):
        group.map_state(other, state(0x201), now_s)  # the leader's own
    assert group.coordinator == 1


def test_a_leader_that_restarts_too_fast_to_be_lost_leaves_the_lead_too() -> None:
    group = Group(FIVE, 2)
    led = []
    for second in range(60):
        now_s = float(second)
        for other in (3, 4, 5):
            group.map_state(other, state(group.leadership.epoch), now_s)
        # It has been handed the map after six seconds, and falls over it.
        has_map = second < 20 or second % 10 > 5
        group.map_state(1, state(revision=b"revision" if has_map else b""), now_s)
        group.set_own_state(state(group.leadership.epoch))
        group.poll(now_s)
        led.append(group.coordinator)
    assert led[:29] == [1] * 29
    assert set(led[30:35]) == {2}
    assert set(led[40:]) == {2}
    assert group.leadership.own_epoch > 1


def test_the_lead_waits_longer_each_time_and_not_for_ever() -> None:
    comebacks, waits = Comebacks(), []
    comebacks.came(1, 0.0)
    assert comebacks.is_settled(1, 0.0)
    now_s = 10.0
    for _ in range(12):
        comebacks.lost(1, now_s)
        comebacks.came(1, now_s)
        waits.append(next(s for s in range(40) if comebacks.is_settled(1, now_s + s)))
        now_s += 35.0
    assert waits == [0, 5, 10, 20] + [30] * 8
    comebacks.lost(1, now_s + 300.0)
    comebacks.came(1, now_s + 300.0)
    assert comebacks.is_settled(1, now_s + 300.0)  # that was long ago


def test_a_successor_has_most_of_those_behind_it_who_know_of_any() -> None:
    assert successor({}) is None
    assert successor({2: 0, 3: 1}) is None
    assert successor({2: 0x102, 3: 0, 4: 1}) == 2
    assert successor({2: 0x102, 3: 0x203}) is None
    assert successor({2: 0x102, 3: 0x203, 4: 0x102}) == 2
    assert successor({2: 0, 3: 0x102, 4: 0x102}) is None  # it says otherwise itself
    assert successor({3: 0x101, 4: 0x101}) is None  # that is the one who came back
