"""When a first map is made though somebody says that it has one."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.daemon.waiting import hurry, run, running_loop
from vcl_companion.daemon.first_map_turn import FirstMapTurn
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.wire.messages import MapState

NONE, CLAIM = MapState(b"", 0, False), MapState(b"a map   ", 100, True, 10)
WAIT_S, LOOK_S, ROUND_S = 30.0, 0.25, 2.0


class Founder:
    """Drone 1, which makes a first map in rounds that end when there is one."""

    def __init__(self, is_receiving: bool = False) -> None:
        self.group = Group(SwarmOptions((1, 2, 3, 4)), 1)
        self.turn = FirstMapTurn(self.group, MapStore(""), lambda: is_receiving, 10.0, WAIT_S)
        self._round_began_s: float | None = None

    def made_after_s(self, say: Callable[[int, float], MapState], most_s: float) -> float | None:
        """Let time pass; return when the map was made, if it was."""
        began_at_s = running_loop().time()
        while (passed_s := running_loop().time() - began_at_s) < most_s:
            for peer in (2, 3, 4):
                self.group.map_state(peer, say(peer, passed_s), running_loop().time())
            self.group.poll(running_loop().time())
            is_due = not self.turn.has_map() and self.turn.is_due(began_at_s)
            if not is_due:
                self._round_began_s = None
            elif self._round_began_s is None:
                self._round_began_s = passed_s
            elif passed_s >= self._round_began_s + ROUND_S:
                return passed_s
            hurry(LOOK_S)
        return None


@pytest.mark.parametrize("says_for_s", [29.0, 10.0, 2.0, 0.5])
@pytest.mark.parametrize("says_not_for_s", [0.5, 1.0])
def test_who_says_now_and_then_that_it_has_a_map_does_not_keep_all_from_the_first_one(
    says_for_s: float, says_not_for_s: float
) -> None:
    def say(peer: int, passed_s: float) -> MapState:
        is_claimed = passed_s % (says_for_s + says_not_for_s) < says_for_s
        return CLAIM if peer == 4 and is_claimed else NONE

    async def scenario() -> None:
        made_s = Founder().made_after_s(say, 300.0)
        assert made_s is not None
        assert made_s < 2.0 * WAIT_S

    run(scenario())


@pytest.mark.parametrize(("is_receiving", "waits"), [(False, 1.0), (True, 10.0)])
def test_who_has_a_map_is_waited_for_whatever_another_has_said(
    is_receiving: bool, waits: float
) -> None:
    wait_s = waits * WAIT_S

    def say(peer: int, passed_s: float) -> MapState:
        comes_s = wait_s - 5.0  # when the one that has none is found out
        return CLAIM if peer == 4 or (peer == 2 and passed_s > comes_s) else NONE

    async def scenario() -> None:
        made_s = Founder(is_receiving).made_after_s(say, 3.0 * wait_s)
        assert made_s is not None
        assert 0.0 <= made_s - (2.0 * wait_s - 5.0 + ROUND_S) < 2.0

    run(scenario())


def test_a_quarantined_drones_map_is_not_waited_for() -> None:
    async def scenario() -> None:
        founder = Founder()
        founder.group.distrust(frozenset({4}))
        made_s = founder.made_after_s(lambda peer, _: CLAIM if peer == 4 else NONE, 60.0)
        assert made_s is not None
        assert made_s < 5.0

    run(scenario())
