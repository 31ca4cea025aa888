"""The group: options that cannot be right, who is alive, who coordinates, who lacks the map."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.errors import ConfigError
from vcl_companion.swarm.group import Group, PeerJoined, PeerLost, SwarmOptions
from vcl_companion.wire.messages import MapState

THREE = SwarmOptions(members=(3, 1, 2))
OLD, NEW = MapState(b"old     ", 900, True), MapState(b"new     ", 1000, True)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"members": (1, 251)}, "251 is not a system id"),
        ({"members": (0, 1)}, "0 is not a system id"),
        ({"members": (1, 2, 1)}, "twice"),
        ({"members": (1, 2), "leader": 3}, "leader: 3"),
        ({"leader": 1}, "leader: 1"),
        ({"members": (1, 2), "known_distances": ((1, 3, 2.0),)}, "3 is not one of"),
        ({"members": (1, 2), "known_distances": ((1, 1, 2.0),)}, "not between two"),
        ({"members": (1, 2), "known_distances": ((1, 2, 0.0),)}, "finite and positive"),
        ({"members": (1, 2), "known_distances": ((1, 2, float("nan")),)}, "finite and positive"),
        ({"members": (1, 2), "known_distances": ((1, 2, 2.0), (2, 1, 2.0))}, "twice"),
        ({"heartbeat_timeout_s": 0.0}, "heartbeat_timeout_s"),
    ],
)
def test_options_that_cannot_be_right_are_one_clear_line(fields: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        SwarmOptions(**fields)
    assert "\n" not in str(caught.value)


def test_a_drone_that_is_no_member_is_a_config_error() -> None:
    with pytest.raises(ConfigError, match="system_id 4"):
        Group(THREE, 4)


def test_a_drone_alone_is_its_own_complete_group() -> None:
    group = Group(SwarmOptions(), 7)
    assert (group.members, group.alive, group.coordinator) == ((7,), (7,), 7)
    assert group.is_complete
    assert group.is_coordinator
    assert group.poll(1e9) == []
    assert group.next_poll_s() is None
    group.set_own_state(NEW)
    assert group.maps.lacking() == ()


def test_of_many_members_those_that_are_needed_most_contribute() -> None:
    group = Group(SwarmOptions(tuple(range(1, 101)), known_distances=((7, 90, 2.0),)), 50)
    for member in range(1, 101):
        if member not in (50, 60):
            group.map_state(member, MapState(b"a       ", 900, True, tracked=1000 - member), 0.0)
    assert group.measured == (7, 90)
    assert group.maps.contributors((1, *group.measured), 6) == (50, 1, 7, 90, 100, 99)
    # 60 was never heard; who is named twice counts once.
    assert group.maps.contributors((60, 50, 3, 3), 3) == (50, 3, 100)
    assert len(group.maps.contributors((), 8)) == 8
    assert len(group.maps.contributors((), 1000)) == 99


def test_peers_join_once_are_lost_after_the_timeout_and_come_back() -> None:
    group = Group(THREE, 1)
    assert group.heartbeat(2, 10.0) == [PeerJoined(2)]
    assert group.heartbeat(2, 12.0) == []
    assert group.alive == (1, 2)
    assert not group.is_complete
    assert group.heartbeat(3, 13.0) == [PeerJoined(3)]
    assert group.is_complete
    assert group.next_poll_s() == 17.0
    assert group.poll(16.9) == []
    assert group.poll(17.0) == [PeerLost(2)]
    assert group.poll(17.0) == []
    assert group.heartbeat(2, 30.0) == [PeerJoined(2)]
    assert group.poll(30.0) == [PeerLost(3)]


def test_strangers_and_ourselves_are_not_peers() -> None:
    group = Group(THREE, 1)
    assert group.heartbeat(9, 0.0) == []
    assert group.map_state(9, NEW, 0.0) == []
    assert group.heartbeat(1, 0.0) == []
    assert group.alive == (1,)
    assert group.state_of(9) is None


def test_the_coordinator_is_the_leader_until_it_was_heard_and_lost() -> None:
    group = Group(THREE, 3)
    assert group.coordinator == 1  # never heard: waited for
    group.heartbeat(2, 0.0)
    group.heartbeat(1, 0.0)
    group.heartbeat(2, 4.0)
    group.poll(5.0)
    assert group.coordinator == 2
    group.poll(9.0)
    assert group.coordinator == 3
    assert group.is_coordinator
    group.heartbeat(1, 10.0)
    assert group.coordinator == 1


def test_a_leader_never_heard_is_not_waited_for_for_ever() -> None:
    group = Group(SwarmOptions((1, 2, 3), leader_wait_s=20.0), 2)
    for second in range(20):
        group.heartbeat(3, float(second))
        group.poll(float(second))
        assert group.coordinator == 1
    group.heartbeat(3, 20.0)
    group.poll(20.0)
    assert group.is_coordinator


def test_a_configured_leader_coordinates() -> None:
    group = Group(SwarmOptions(members=(1, 2, 3), leader=2), 1)
    assert (group.leader, group.coordinator) == (2, 2)


def test_who_lacks_the_newest_map() -> None:
    group = Group(THREE, 1)
    group.heartbeat(2, 0.0)
    assert group.maps.lacking() == ()  # there is none yet
    group.set_own_state(OLD)
    assert group.maps.lacking() == (2,)
    assert group.map_state(3, OLD, 0.0) == [PeerJoined(3)]
    group.map_state(2, OLD, 0.0)
    assert group.maps.lacking() == ()
    group.set_own_state(NEW)
    assert group.maps.newest_revision == NEW.revision
    assert group.maps.lacking() == (2, 3)
    group.map_state(3, NEW, 1.0)
    assert group.maps.holders(NEW.revision) == (1, 3)
    assert group.maps.lacking() == (2,)
    group.poll(5.0)  # 2 is lost
    assert group.maps.lacking() == ()
    group.map_state(3, NEW, 5.0)
    group.heartbeat(2, 6.0)  # back, perhaps restarted: what it had is not believed
    assert group.state_of(2) is None
    assert group.maps.lacking() == (2,)


def test_a_member_knows_the_newest_map_from_the_coordinator() -> None:
    group = Group(THREE, 3)
    group.set_own_state(OLD)
    assert group.maps.newest_revision == b""
    assert not group.maps.is_map_coming
    group.map_state(1, NEW, 0.0)
    assert group.maps.newest_revision == NEW.revision
    assert group.maps.lacking() == (3,)
    assert group.maps.is_map_coming


def test_who_is_not_believed_is_there_but_counts_for_nothing() -> None:
    group = Group(SwarmOptions((1, 2, 3, 4)), 1)
    wants = MapState(b"12345678", 100, True, wants_update=True)
    group.set_own_state(wants)
    for peer in (2, 3, 4):
        group.map_state(peer, wants, 0.0)
    group.distrust(frozenset({1, 4}))  # never ourselves
    assert (group.alive, group.trusted) == ((1, 2, 3, 4), (1, 2, 3))
    assert group.maps.wanting_update == (1, 2, 3)
    assert group.maps.holders(wants.revision) == (1, 2, 3, 4)
    for peer in (3, 4):
        group.map_state(peer, OLD, 1.0)
    assert group.maps.lacking() == (3,)
    group.distrust(frozenset())
    assert group.trusted == group.alive
    assert group.maps.lacking() == (3, 4)


def test_our_map_goes_on_without_those_whose_own_is_about_to_be_merged_into_it() -> None:
    group = Group(THREE, 1)
    group.set_own_state(MapState(NEW.revision, 1000, True, wants_update=True))
    for peer in (2, 3):
        group.map_state(peer, OLD, 0.0)
    assert (group.maps.lacking(), group.maps.majority_wants_update) == ((2, 3), False)
    group.leave_apart(frozenset({1, 2, 3}))  # never ourselves
    assert (group.maps.lacking(), group.maps.majority_wants_update) == ((), True)
    assert group.maps.contributors((2,), 3) == (1,)
    assert group.trusted_teammates == (1, 2, 3)
    group.leave_apart(frozenset())
    assert (group.maps.lacking(), group.maps.majority_wants_update) == ((2, 3), False)


def test_others_outvote_us_when_most_of_them_and_two_at_least_hold_a_map() -> None:
    group = Group(SwarmOptions((1, 2, 3, 4)), 1)
    group.map_state(2, NEW, 0.0)
    assert not group.maps.most_others_hold(NEW.revision)  # one word
    group.map_state(3, NEW, 0.0)
    group.map_state(4, OLD, 0.0)
    assert group.maps.most_others_hold(NEW.revision)
    group.distrust(frozenset({3}))
    assert not group.maps.most_others_hold(NEW.revision)


@given(st.lists(st.tuples(st.integers(1, 4), st.floats(0.0, 100.0)), max_size=40))
def test_whatever_is_heard_alive_is_who_was_heard_lately(heard: list[tuple[int, float]]) -> None:
    group = Group(THREE, 1)
    events = []
    now_s = 0.0
    latest: dict[int, float] = {}
    for peer, at_s in sorted(heard, key=lambda pair: pair[1]):
        now_s = at_s
        events += group.poll(now_s)
        events += group.heartbeat(peer, now_s)
        latest[peer] = now_s
    lately = {peer for peer, at_s in latest.items() if peer in (2, 3) and now_s < at_s + 5.0}
    assert set(group.alive) == lately | {1}
    for peer in (2, 3):
        kinds = [type(event) for event in events if event.peer == peer]
        expected = [PeerJoined, PeerLost] * len(kinds)
        assert kinds == expected[: len(kinds)]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["heard", "says", "joins", "waits"]),
            st.integers(1, 4),
            st.integers(0, 3),
        ),
        max_size=30,
    )
)
def test_teammates_are_who_is_alive_and_says_that_it_flies_with_our_team(
    events: list[tuple[str, int, int]],
) -> None:
    group, now_s = Group(SwarmOptions((1, 2, 3, 4)), 2), 0.0
    for what, member, team in events:
        match what:
            case "heard":
                group.heartbeat(member, now_s)
            case "says" if member != group.own_id:
                group.map_state(member, MapState(b"new     ", 900, True, team=team), now_s)
            case "joins":
                group.join(team)
            case "waits":
                now_s += team * 2.0
                group.poll(now_s)
        assert group.teammates == tuple(m for m in group.alive if group.team_of(m) == group.team)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["heard", "says", "we say", "distrusts", "apart", "waits"]),
            st.integers(1, 4),
            st.integers(0, 7),
        ),
        max_size=30,
    )
)
def test_who_was_asked_all_the_time_says_the_same_as_who_was_never_asked(
    events: list[tuple[str, int, int]],
) -> None:
    """What a group has once found out is found anew whenever it may be otherwise."""
    often, once = (Group(SwarmOptions((1, 2, 3, 4)), 2) for _ in range(2))
    now_s = 0.0
    for what, member, bits in events:
        now_s += 0.3
        if what == "waits":
            now_s += 0.7 * bits
        state = MapState(
            OLD.revision if bits & 1 else NEW.revision,
            900,
            True,
            wants_update=bool(bits & 2),
            team=bits >> 2,
            world=NEW.revision,
        )
        for group in (often, once):
            match what:
                case "heard":
                    group.heartbeat(member, now_s)
                case "says" if member != group.own_id:
                    group.map_state(member, state, now_s)
                case "we say":
                    group.set_own_state(state)
                case "distrusts":
                    group.distrust(frozenset({member}) if bits & 1 else frozenset())
                case "apart":
                    group.leave_apart(frozenset({member}) if bits & 1 else frozenset())
                case _:
                    group.poll(now_s)
        found_out(often)
    assert found_out(often) == found_out(once)
    assert once.maps.is_map_coming == (once.own_id in once.maps.lacking())


def found_out(group: Group) -> tuple[object, ...]:
    """Return what others ask a group for."""
    return (
        group.alive,
        group.teammates,
        group.other_teams,
        group.coordinator,
        group.maps.lacking(),
        group.maps.wanting_update,
        group.maps.majority_wants_update,
        group.maps.contributors((), 4),
        group.is_senior(1),
    )
