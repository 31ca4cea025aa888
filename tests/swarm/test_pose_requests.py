"""Whom a drone asks where it is."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.pose_requests import HostChoice, InterMavOptions
from vcl_companion.wire.messages import MapState

MAP, OTHER = b"this map", b"that map"


def group_of(*hosts: int) -> Group:
    """Drone 9 among peers 1 to 5, of which some are localized on its map."""
    group = Group(SwarmOptions((1, 2, 3, 4, 5, 9)), 9)
    group.set_own_state(MapState(MAP, 100, True))
    for peer in hosts:
        group.map_state(peer, MapState(MAP, 100, True), 0.0)
    return group


def test_only_peers_that_are_localized_on_our_map_are_asked() -> None:
    group = group_of(1, 3)
    group.map_state(2, MapState(OTHER, 100, True), 0.0)
    group.map_state(4, MapState(MAP, 100, False), 0.0)
    choice = HostChoice(group)
    assert choice.choose(MAP, 5) == [1, 3]
    assert choice.choose(OTHER, 5) == [2]
    group.poll(100.0)
    assert choice.choose(MAP, 5) == []


def test_everybody_is_tried_then_the_surest_and_the_others_in_turn() -> None:
    choice = HostChoice(group_of(1, 2, 3, 4))
    assert choice.choose(MAP, 2) == [1, 2]
    choice.answered(1, 0.5, 0)
    choice.answered(2, math.inf, 0)
    assert choice.choose(MAP, 2) == [3, 4]
    choice.answered(3, 0.1, 0)
    choice.answered(4, math.inf, 0)
    assert choice.choose(MAP, 3) == [3, 1, 2]
    assert choice.choose(MAP, 3) == [3, 1, 4]  # who could not tell may be able to by now
    choice.lost(2)
    assert choice.choose(MAP, 1) == [2]  # back, and a new one


def test_only_who_was_surer_of_us_lately_may_know_better() -> None:
    choice, second = HostChoice(group_of(1, 2)), 10**9
    assert not choice.may_know_better(MAP, 0.2, 0)  # never asked
    choice.answered(1, 0.1, 0)
    choice.answered(2, math.inf, 5 * second)
    assert choice.may_know_better(MAP, 0.2, 29 * second)
    assert not choice.may_know_better(OTHER, 0.2, 29 * second)  # nobody flies on it
    assert not choice.may_know_better(MAP, 0.02, 29 * second)
    assert not choice.may_know_better(MAP, 0.2, 31 * second)
    choice.answered(2, 0.01, 36 * second)
    assert choice.may_know_better(MAP, 0.02, 37 * second)
    choice.lost(2)
    assert not choice.may_know_better(MAP, 0.02, 37 * second)


@pytest.mark.parametrize(
    "make",
    [
        lambda: InterMavOptions(every_n_frames=-1),
        lambda: InterMavOptions(least_interval_s=-0.1),
        lambda: InterMavOptions(wait_s=0.0),
        lambda: InterMavOptions(max_hosts=0),
        lambda: InterMavOptions(request_quality=101),
        lambda: InterMavOptions(weak_sigma_m=0.0),
        lambda: InterMavOptions(min_matches=3),
        lambda: InterMavOptions(tilt_sigma_deg=0.0),
    ],
)
def test_options_out_of_bounds_cannot_be_made(make: Callable[[], InterMavOptions]) -> None:
    with pytest.raises(ValueError, match=r"min_matches|must"):
        make()
