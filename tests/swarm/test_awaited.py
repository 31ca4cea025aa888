"""Members that do not take the newest map: waited for once, then not until they have one."""

from __future__ import annotations

import itertools

import pytest

from vcl_companion.swarm.awaited import Awaited
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.swarm.update_trigger import UpdateTrigger
from vcl_companion.wire.messages import MapState

WAIT_S = 30.0


def revision(n: int) -> bytes:
    return b"map %4d" % n


class Watch:
    """The coordinator, drone 1, and what the others have said that they fly on."""

    def __init__(self, n_members: int) -> None:
        self.group = Group(SwarmOptions(tuple(range(1, n_members + 1))), 1)
        self.awaited = Awaited(self.group, WAIT_S)
        self.now_s = 0.0

    def look(self, newest: int, **holds: int) -> tuple[int, ...]:
        """Tell what all fly on, and look; who is not named has the newest."""
        self.tell(newest, **holds)
        return self.awaited.look(self.now_s)

    def tell(self, newest: int, **holds: int) -> None:
        """Tell what all fly on."""
        for peer in self.group.peers:
            self._say(peer, holds.get(f"drone_{peer}", newest))
        self.group.set_own_state(MapState(revision(newest), 100, True, 50, True))
        self.group.poll(self.now_s)

    def _say(self, peer: int, n: int) -> None:
        if n >= 0:  # else it is silent
            self.group.map_state(peer, MapState(revision(n), 100, True, 50, True), self.now_s)


def test_who_never_takes_a_map_is_waited_for_once_in_a_while() -> None:
    watch, waited_s, n = Watch(4), [], 0
    for _ in range(6000):
        watch.now_s += 0.1
        is_waited_for = 4 in watch.look(n, drone_4=0)
        if n and is_waited_for:
            waited_s.append(watch.now_s)
        elif watch.now_s > n:
            n += 1  # the next one, a second later
    assert 0.9 * WAIT_S < len([t for t in waited_s if t < 1.0 + WAIT_S + 1.0]) * 0.1 < WAIT_S + 1.0
    assert len(waited_s) * 0.1 < 0.25 * 600.0


def test_who_has_come_to_a_newest_one_is_waited_for_again() -> None:
    watch = Watch(3)
    assert watch.look(1, drone_3=0) == (3,)
    watch.now_s = WAIT_S
    assert watch.look(1, drone_3=0) == ()
    assert watch.look(2, drone_3=0) == ()
    assert watch.look(2, drone_2=1, drone_3=0) == (2,)
    assert watch.look(2) == ()
    assert watch.look(3, drone_3=2) == (3,)


def test_who_gets_each_one_late_but_within_the_time_is_always_waited_for() -> None:
    watch = Watch(3)
    for n in range(1, 20):
        for _ in range(28):
            watch.now_s += 1.0
            assert watch.look(n, drone_3=n - 1) == (3,)


def test_who_went_away_begins_anew() -> None:
    watch = Watch(3)
    watch.look(1, drone_3=0)
    for _ in range(20):
        watch.now_s += 1.0
        watch.look(1, drone_3=-1)
    assert watch.group.alive == (1, 2)
    watch.now_s += WAIT_S
    assert watch.look(1, drone_3=0) == (3,)


@pytest.mark.parametrize("n_members", [4, 8])
def test_one_member_that_takes_no_map_does_not_make_updates_rare(n_members: int) -> None:
    options = UpdateOptions()
    watch = Watch(n_members)
    trigger = UpdateTrigger(options, watch.group, watch.awaited)
    n, rounds_s = 0, []
    while watch.now_s < 300.0:
        watch.now_s += 0.1
        watch.tell(n, **{f"drone_{n_members}": 0})
        trigger.poll(watch.now_s)
        if trigger.is_due(watch.now_s):
            rounds_s.append(watch.now_s)
            n += 1
            trigger.ended(watch.now_s, from_new_places=True)
    assert len(rounds_s) > 100
    assert max(b - a for a, b in itertools.pairwise(rounds_s)) < WAIT_S + 1.0
