"""Whom a drone asks where it is."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.pose_requests import HostChoice, InterMavOptions
from vcl_companion.wire.messages import MapState

MAP, OTHER = b"this map", b"that map"
SECOND = 10**9


def group_of(*hosts: int) -> Group:
    """Drone 9 among peers 1 to 5, of which some are localized on its map."""
    group = Group(SwarmOptions((1, 2, 3, 4, 5, 9)), 9)
    group.set_own_state(MapState(MAP, 100, True, tracked=80))
    for peer in hosts:
        group.map_state(peer, MapState(MAP, 100, True, tracked=80), 0.0)
    return group


def test_only_peers_that_see_our_map_are_asked() -> None:
    group = group_of(1, 3)
    group.map_state(2, MapState(OTHER, 100, True, tracked=80), 0.0)
    group.map_state(4, MapState(MAP, 100, False), 0.0)
    # Localized, by its own last frames.
    group.map_state(5, MapState(MAP, 100, True, tracked=0), 0.0)
    choice = HostChoice(group)
    assert choice.choose(MAP, 5) == [1, 3]
    assert choice.choose(OTHER, 5) == [2]
    group.poll(100.0)
    assert choice.choose(MAP, 5) == []


def test_everybody_is_tried_then_the_surest_and_the_others_in_turn() -> None:
    choice = HostChoice(group_of(1, 2, 3, 4))
    assert choice.choose(MAP, 2) == [1, 2]
    choice.answered(1, 0.5, 1.0, 0)
    choice.answered(2, math.inf, 1.0, 0)
    assert choice.choose(MAP, 2) == [3, 4]
    choice.answered(3, 0.1, 1.0, 0)
    choice.answered(4, math.inf, 1.0, 0)
    assert choice.choose(MAP, 3) == [3, 1, 2]
    assert choice.choose(MAP, 3) == [3, 1, 4]  # who could not tell may be able to by now
    choice.lost(2)
    assert choice.choose(MAP, 1) == [2]  # back, and a new one


@pytest.mark.parametrize("at_once", [1, 2])
def test_who_never_answers_is_asked_in_turn_with_those_who_cannot_tell(at_once: int) -> None:
    """Asked when there was no other one, it would be the first for ever."""
    choice = HostChoice(group_of(1, 2, 3))
    asked = []
    for n in range(60):
        hosts = choice.choose(MAP, at_once)
        asked += hosts
        for host in hosts:
            if host == 1:
                choice.unanswered(host, math.inf, n * SECOND)
            else:
                choice.answered(host, 0.05, math.inf, n * SECOND)
    assert asked.count(1) == 1
    assert asked[at_once * 10 :].count(2) > 0
    choice = HostChoice(group_of(1, 2))
    assert [choice.choose(MAP, 1) for _ in range(4)] == [[1], [2], [1], [2]]  # none yet


def test_who_was_sure_and_answers_no_more_is_not_the_first_any_more() -> None:
    choice = HostChoice(group_of(1, 2))
    choice.choose(MAP, 2)
    choice.answered(1, 0.01, math.inf, 0)
    choice.answered(2, 0.1, math.inf, 0)
    assert choice.choose(MAP, 1) == [1]
    choice.unanswered(1, math.inf, 2 * SECOND)
    assert choice.choose(MAP, 1) == [2]
    choice.answered(1, 0.01, math.inf, 9 * SECOND)
    choice.unanswered(1, math.inf, 4 * SECOND)  # of a request before
    assert choice.choose(MAP, 1) == [1]


def test_only_who_was_surer_of_us_lately_may_know_better() -> None:
    choice = HostChoice(group_of(1, 2))

    def may(revision: bytes, at_s: int) -> bool:
        return choice.may_know_better(revision, at_s * SECOND, is_weak=False)

    assert not may(MAP, 0)  # never asked
    choice.answered(1, 0.1, 0.2, 0)
    choice.answered(2, math.inf, 0.2, 5 * SECOND)
    assert may(MAP, 29)
    assert not may(OTHER, 29)  # nobody flies on it
    assert not may(MAP, 31)
    choice.answered(2, 0.19, 0.2, 35 * SECOND)  # as sure as we are: it flies on the same map
    assert not may(MAP, 36)
    choice.answered(2, 0.1, 0.2, 36 * SECOND)
    assert may(MAP, 37)
    choice.answered(2, 0.1, math.inf, 60 * SECOND)  # when we knew nothing: what was stands
    assert may(MAP, 65)
    assert not may(MAP, 67)
    choice.answered(2, 0.1, 0.2, 68 * SECOND)
    assert may(MAP, 69)
    choice.lost(2)
    assert not may(MAP, 69)


def test_who_told_us_when_we_knew_nothing_is_not_asked_for_it_when_we_do() -> None:
    choice = HostChoice(group_of(1))
    choice.answered(1, 0.1, math.inf, 0)
    assert not choice.may_know_better(MAP, SECOND, is_weak=False)
    assert choice.may_know_better(MAP, SECOND, is_weak=True)
    choice.answered(1, math.inf, 0.2, 2 * SECOND)
    choice.answered(1, 0.1, math.inf, 3 * SECOND)  # it could not tell then; now it could
    assert choice.may_know_better(MAP, 4 * SECOND, is_weak=True)


def test_who_knows_little_asks_those_who_have_not_shown_lately_that_they_know_no_better() -> None:
    choice = HostChoice(group_of(1, 2))

    def may(at_s: int) -> bool:
        return choice.may_know_better(MAP, at_s * SECOND, is_weak=True)

    assert may(0)  # never asked
    choice.answered(1, 0.5, 0.5, 0)
    assert may(1)  # the other one
    choice.answered(2, math.inf, 0.5, SECOND)
    assert not may(2)
    assert not may(10)
    assert may(11)  # by now the first may
    choice.answered(1, math.inf, math.inf, 11 * SECOND)  # it could not tell, nor could we
    choice.answered(2, 0.3, 0.5, 11 * SECOND)
    assert may(12)
    assert may(41)


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
