"""Teams: who leads under which epoch, whatever is lost, and who flies with whom, as they see it."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.swarm.sky import Sky
from vcl_companion.errors import ConfigError
from vcl_companion.swarm.epochs import FIRST, VACANT, Epochs, is_before, taken_by
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.wire.messages import MAX_EPOCH, MapState

FIVE = SwarmOptions((1, 2, 3, 4, 5))
QUIET_S = 40.0


def state(team: int = 0, epoch: int = 0, revision: bytes = b"revision") -> MapState:
    return MapState(revision, 1, True, 1, False, team, epoch)


@pytest.mark.parametrize("name", ["split_after_s", "rejoin_after_s"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_times_that_cannot_be_are_one_clear_line(name: str, value: float) -> None:
    options: dict[str, Any] = {name: value}
    with pytest.raises(ConfigError, match=name):
        SwarmOptions((1, 2), **options)


def test_of_two_drones_none_takes_an_epoch_of_the_other() -> None:
    a, b = Epochs(3), Epochs(4)
    assert a.take(0) != b.take(0)
    assert (taken_by(a.of(0)), taken_by(b.of(0))) == (3, 4)
    assert (taken_by(FIRST), taken_by(VACANT)) == (0, 0)
    assert a.is_ours(0)
    a.hear(0, b.of(0))
    assert not a.is_ours(0)
    assert a.take(0) > b.of(0)
    a.hear(0, FIRST)
    assert a.is_ours(0)
    # A team named again goes on above all that was ever heard.
    assert a.take(7) > a.of(0)


def test_at_the_end_of_all_epochs_nobody_is_fenced_for_ever() -> None:
    group = Group(FIVE, 2)
    group.map_state(1, state(), 0.0)
    group.map_state(3, state(epoch=MAX_EPOCH), 4.0)
    group.poll(5.0)
    # The first one comes again, and is above the last.
    assert (group.coordinator, group.leadership.epoch) == (2, 0x102)
    assert group.leadership.may_lead(2)
    group.map_state(1, state(), 6.0)
    assert group.coordinator == 1
    assert group.leadership.is_fenced(1)
    assert not group.leadership.may_lead(1)


@given(known=st.integers(0, MAX_EPOCH), told=st.integers(0, MAX_EPOCH), own=st.integers(1, 250))
@example(known=0x105, told=MAX_EPOCH, own=2)
@example(known=0x105, told=0x105 + (1 << 31) - 1, own=2)
def test_whatever_a_wrong_peer_tells_there_is_a_next_epoch(known: int, told: int, own: int) -> None:
    epochs, other = Epochs(own), Epochs(251 - own)
    for team, epoch in ((0, known), (7, told), (0, told)):
        epochs.hear(team, epoch)
    before = epochs.of(0)
    taken = epochs.take(0)
    assert is_before(before, taken)
    assert not is_before(taken, before)
    assert taken_by(taken) == own
    other.hear(0, before)
    other.hear(0, taken)
    assert other.of(0) == taken


def test_while_nobody_was_lost_there_is_one_team_under_the_first_epoch() -> None:
    sky = Sky(FIVE)
    sky.run(60.0)
    assert set(sky.leads().values()) == {(0, 1)}
    assert {group.leadership.epoch for group in sky.up.values()} == {FIRST}
    assert all(group.leadership.may_lead(1) for group in sky.up.values())


def test_who_takes_a_lost_leaders_place_does_so_under_a_newer_epoch() -> None:
    sky = Sky(FIVE)
    sky.run(5.0)
    sky.stop(1)
    sky.run(10.0)
    assert set(sky.leads().values()) == {(0, 2)}
    taken = sky.up[2].leadership.own_epoch
    assert taken > VACANT
    assert {group.leadership.epoch for group in sky.up.values()} == {taken}
    sky.start(1)
    sky.run(10.0)
    assert set(sky.leads().values()) == {(0, 1)}
    assert sky.up[1].leadership.own_epoch > taken
    assert sky.up[2].leadership.own_epoch == 0
    assert all(group.leadership.may_lead(1) for group in sky.up.values())


def test_a_coordinator_that_was_away_is_fenced_until_it_has_heard_of_it() -> None:
    group = Group(FIVE, 3)
    for peer in (1, 2):
        group.map_state(peer, state(), 0.0)
    group.map_state(2, state(epoch=0x102), 6.0)
    group.poll(6.0)
    assert group.coordinator == 2
    assert group.leadership.may_lead(2)
    assert not group.leadership.may_lead(1)
    group.map_state(1, state(), 7.0)  # it is back, and has not heard yet
    assert group.coordinator == 1
    assert group.leadership.is_fenced(1)
    assert not group.leadership.may_lead(1)
    group.map_state(1, state(epoch=0x201), 8.0)
    assert group.leadership.may_lead(1)


def test_a_restarted_drone_waits_before_it_holds_the_leader_for_lost() -> None:
    group = Group(FIVE, 2)
    group.map_state(4, state(epoch=0x104), 0.0)
    assert group.coordinator == 1
    group.poll(4.9)
    assert not group.is_coordinator
    group.map_state(4, state(epoch=0x104), 4.9)
    group.poll(5.0)
    assert group.is_coordinator
    assert group.leadership.own_epoch > 0x104


def test_one_who_never_heard_the_leader_learns_that_it_was_lost() -> None:
    sky = Sky(FIVE)
    sky.stop(2)
    sky.run(5.0)
    sky.stop(1)
    sky.start(2)
    sky.run(20.0)
    assert set(sky.leads().values()) == {(0, 2)}


def test_who_sees_nothing_of_the_coordinators_place_leaves_together_and_comes_back() -> None:
    sky = Sky(FIVE, place={1: 0, 2: 0, 3: 8, 4: 8, 5: 8})
    sky.run(25.0)
    assert sky.teams() == {frozenset((1, 2, 3, 4, 5))}
    sky.run(30.0)
    assert sky.teams() == {frozenset((1, 2)), frozenset((3, 4, 5))}
    assert sky.leads()[4] == sky.leads()[5] == (3, 3)
    assert sky.up[3].leadership.own_epoch == sky.up[5].leadership.epoch > FIRST
    assert sky.up[1].other_teams == (3,)
    assert sky.up[4].leadership.coordinator_of(0) == 1
    assert sky.up[4].is_senior(0)
    assert not sky.up[1].is_senior(3)
    sky.place |= {2: 8, 1: 0}  # one of ours sees what they see
    sky.run(30.0)
    assert sky.teams() == {frozenset((1, 2, 3, 4, 5))}
    assert set(sky.leads().values()) == {(0, 1)}


@pytest.mark.parametrize(
    ("options", "place"),
    [
        (SwarmOptions(FIVE.members, split_after_s=0.0), {1: 0, 2: 0, 3: 8, 4: 8, 5: 8}),
        (FIVE, {1: 0, 2: 0, 3: 0, 4: 0, 5: 8}),  # alone
        (FIVE, {2: 0, 3: 8, 4: 8, 5: 8}),  # what the coordinator sees is not known
        (FIVE, {1: 0, 2: 0}),  # nor what the others do
    ],
)
def test_no_team_parts_without_reason(options: SwarmOptions, place: dict[int, int]) -> None:
    sky = Sky(options, place=place)
    sky.run(120.0)
    assert sky.teams() == {frozenset(FIVE.members)}


def test_a_leader_elsewhere_makes_its_team_the_senior() -> None:
    sky = Sky(SwarmOptions(FIVE.members, leader=5), place={1: 0, 2: 0, 3: 8, 4: 8, 5: 8})
    sky.run(60.0)
    assert set(sky.leads().values()) == {(0, 5), (1, 1)}
    sky.place = dict.fromkeys(FIVE.members, 8)
    sky.run(30.0)
    assert set(sky.leads().values()) == {(0, 5)}


def test_a_restarted_drone_goes_to_the_team_that_has_a_map() -> None:
    sky = Sky(FIVE, place={1: 0, 2: 0, 3: 8, 4: 8, 5: 8})
    sky.run(60.0)
    sky.stop(2)
    sky.start(1)  # nobody has the first team's map any more
    sky.run(20.0)
    assert sky.teams() == {frozenset((1, 3, 4, 5))}
    assert set(sky.leads().values()) == {(3, 1)}


def test_questions_are_about_our_own_team() -> None:
    group = Group(FIVE, 1)
    group.set_own_state(state())
    wants = MapState(b"revision", 1, True, 1, True)
    group.map_state(2, wants, 0.0)
    group.map_state(3, MapState(b"revision", 1, True, 1, True, 3, 0x103), 0.0)
    group.map_state(4, MapState(b"other   ", 1, True, 1, True, 3, 0x103), 0.0)
    group.heartbeat(5, 0.0)
    assert group.teammates == (1, 2, 5)
    assert group.alive == FIVE.members
    assert group.maps.holders(b"revision") == (1, 2)
    assert group.maps.wanting_update == (2,)
    assert not group.maps.majority_wants_update
    assert group.maps.lacking() == (5,)
    assert set(group.maps.contributors((3, 4), 9)) == {1, 2, 5}
    assert not group.maps.most_others_hold(b"revision")


def test_who_is_not_believed_moves_nobody() -> None:
    group = Group(FIVE, 3)
    group.set_own_state(state())
    group.distrust(frozenset({1, 2}))
    group.map_state(1, state(), 0.0)
    group.map_state(2, state(epoch=0x702), 0.0)
    assert group.leadership.epoch == FIRST
    group.map_state(1, state(team=7, epoch=0x901), 1.0)
    assert group.team == 0


def settled(sky: Sky) -> dict[int, tuple[int, int]]:
    """Return who leads whom when that has stayed; signatures that are alike by chance delay it."""
    for _ in range(6):
        before = sky.leads()
        sky.run(QUIET_S)
        if sky.leads() == before:
            return before
    pytest.fail(f"teams go on changing: {before}, {sky.leads()}")


_CHANGES = st.one_of(
    st.tuples(st.sampled_from(["stop", "start"]), st.integers(1, 5), st.just(0)),
    st.tuples(st.just("side"), st.integers(1, 5), st.integers(0, 2)),
    st.tuples(st.just("place"), st.integers(1, 5), st.integers(0, 2)),
    st.tuples(st.just("run"), st.just(0), st.integers(1, 45)),
)


@given(
    st.lists(_CHANGES, max_size=25),
    st.integers(0, 1000),
    st.sampled_from([0.0, 0.3, 0.6]),
    st.sampled_from([0.0, 1.5]),
    st.sampled_from([0, 1, 4]),
)
@example([("stop", 1, 0), ("run", 0, 9), ("start", 1, 0)], 0, 0.0, 0.0, 0)
@example(
    [("place", 1, 1), ("run", 0, 16), ("run", 0, 17), ("start", 1, 0), ("start", 3, 0)],
    0,
    0.0,
    0.0,
    0,
)
@settings(max_examples=150, deadline=None)
def test_whatever_happens_teams_agree_in_the_end(
    changes: list[tuple[str, int, int]], seed: int, loss: float, late_s: float, leader: int
) -> None:
    sky = Sky(SwarmOptions(FIVE.members, leader), seed, loss, late_s)
    sky.place = dict.fromkeys(FIVE.members, 0)
    for what, member, number in changes:
        match what:
            case "stop":
                sky.stop(member)
            case "start":
                sky.start(member)
            case "side":
                sky.side[member] = number
            case "place":
                sky.place[member] = number
            case "run":
                sky.run(float(number))
    sky.loss, sky.side = 0.0, {}
    sky.run(3 * QUIET_S)  # parts come off in that time, and come back
    before = settled(sky)
    for member, (team, coordinator) in before.items():
        others = {before[other][1] for other in before if before[other][0] == team}
        assert others == {coordinator}, f"{member} of {before}"
    epochs = {
        team: {g.leadership.epoch for g in sky.up.values() if g.team == team}
        for team, _ in before.values()
    }
    assert all(len(known) == 1 for known in epochs.values())
    for group in sky.up.values():
        if group.coordinator in sky.up:
            assert group.leadership.may_lead(group.coordinator)
    sky.place = dict.fromkeys(FIVE.members, 1)
    sky.run(3 * QUIET_S)
    assert len(sky.teams()) <= 1


def test_members_follow_their_coordinator_to_a_senior_team_at_once() -> None:
    group = Group(FIVE, 5)
    group.set_own_state(state())
    group.join(3)
    group.map_state(3, state(team=3, epoch=0x103), 0.0)
    group.map_state(4, state(team=3, epoch=0x103), 0.0)
    group.map_state(4, state(team=0), 1.0)  # not the coordinator
    assert group.team == 3
    group.map_state(3, state(team=0, revision=b""), 1.0)  # restarted, it went nowhere
    assert group.team == 3
    group.map_state(3, state(team=3, epoch=group.leadership.epoch), 2.0)
    group.map_state(3, state(team=4, epoch=0x904), 3.0)  # not a senior one
    assert group.team == 3
    group.map_state(3, state(team=3, epoch=group.leadership.epoch), 4.0)
    group.map_state(3, state(team=0), 5.0)
    assert group.team == 0


def test_whom_the_map_serves_does_not_leave_it_though_nobody_looks_like_the_coordinator() -> None:
    sky = Sky(FIVE, place={1: 0, 2: 0, 3: 8, 4: 8, 5: 8}, served={3, 4})
    sky.run(90.0)
    assert sky.teams() == {frozenset((1, 2, 3, 4, 5))}
    sky.served.clear()
    sky.run(60.0)
    assert sky.teams() == {frozenset((1, 2)), frozenset((3, 4, 5))}


def test_whose_maps_are_of_another_world_than_the_coordinators_go_on_without_it() -> None:
    elsewhere = {4: b"another.", 5: b"another."}
    sky = Sky(FIVE, place={4: 8, 5: 9}, world=elsewhere, served={1, 2, 3, 4, 5})
    sky.run(25.0)
    assert sky.teams() == {frozenset((1, 2, 3, 4, 5))}
    sky.run(30.0)
    assert sky.teams() == {frozenset((1, 2, 3)), frozenset((4, 5))}
    assert sky.leads()[5] == (4, 4)
