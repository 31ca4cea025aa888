"""When votes for a new map lead to a round: majority, loss, death, late joiners."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vcl_companion.swarm.awaited import Awaited
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.own_vote import OwnVote, Sight
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.swarm.update_trigger import UpdateTrigger
from vcl_companion.wire.messages import MapState
from vcl_companion.wire.tunnel import decode_payload, encode_payload

# Long against a step of these tests.
OPTIONS = UpdateOptions(hold_s=0.5, interval_s=1.0)
STEP_S = 0.1
FIRST, SECOND = b"revision", b"the next"
PLENTY, FEW = 400, 20


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("tracked", -1),
        ("enough", 0),
        ("share", 1.0),
        ("share", -0.1),
        ("hold_s", 0.0),
        ("interval_s", float("nan")),
        ("gather_timeout_s", -1.0),
        ("delivery_wait_s", float("inf")),
        ("lost_s", 0.0),
        ("contributors", 1),
        ("joiner_frames", 0),
        ("joiner_frames", 9),
        ("joiner_spacing_s", 0.0),
    ],
)
def test_settings_that_cannot_be_are_named(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        UpdateOptions(**{name: value})  # type: ignore[arg-type]


@dataclass
class Member:
    """What one drone knows and sees; ``revision`` empty without a map."""

    group: Group
    vote: OwnVote
    trigger: UpdateTrigger
    revision: bytes = FIRST
    tracked: int = PLENTY
    round_ends_at_s: float | None = None
    told_at_s: float = -1.0


@dataclass
class Sky:
    """Some members that tell each other their state, once a second, over a lossy air."""

    ids: tuple[int, ...]
    loss: float = 0.0
    seed: int = 0
    options: UpdateOptions = OPTIONS
    round_s: float = 2.0
    helps: bool = True
    delivers: bool = True
    moves: bool = False
    now_s: float = 0.0
    members: dict[int, Member] = field(default_factory=dict)
    begun: list[tuple[float, int]] = field(default_factory=list)
    begun_alone: list[bool] = field(default_factory=list)
    n_made: int = 0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        for own_id in self.ids:
            self.start(own_id)

    def start(self, own_id: int, revision: bytes = FIRST) -> Member:
        group = Group(SwarmOptions(members=self.ids), own_id)
        trigger = UpdateTrigger(self.options, group, Awaited(group, self.options.delivery_wait_s))
        self.members[own_id] = Member(group, OwnVote(self.options), trigger, revision)
        return self.members[own_id]

    def die(self, own_id: int) -> None:
        del self.members[own_id]

    def see(self, tracked: int, *ids: int) -> None:
        for own_id in ids:
            self.members[own_id].tracked = tracked

    def run(self, seconds: float, stop: Callable[[], bool] = lambda: False) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            for own_id in list(self.members):
                self._step(own_id, self.members[own_id])
            if stop():
                return

    def _step(self, own_id: int, member: Member) -> None:
        member.group.poll(self.now_s)
        group = member.group
        is_coming = own_id in group.maps.lacking()
        member.vote.follow(member.revision, group.maps.majority_wants_update, is_coming, self.now_s)
        wants = member.vote.look(member.revision, Sight(member.tracked), self.now_s)
        before = member.group.state_of(own_id)
        state = MapState(member.revision, 0, member.tracked > 0, member.tracked, wants)
        member.group.set_own_state(state)
        news = before is None or before.wants_update != wants
        if news or self.now_s - member.told_at_s > 1.0 - STEP_S / 2:
            member.told_at_s = self.now_s
            self._tell(own_id, state)
        member.trigger.poll(self.now_s)
        if member.round_ends_at_s is not None:
            if self.now_s >= member.round_ends_at_s:
                self._finish(member)
        elif member.trigger.is_due(self.now_s):
            self.begun.append((self.now_s, own_id))
            self.begun_alone.append(member.group.alive == (own_id,))
            member.round_ends_at_s = self.now_s + self.round_s

    def _finish(self, member: Member) -> None:
        member.round_ends_at_s = None
        member.trigger.ended(self.now_s, from_new_places=self.moves)
        self.n_made += 1
        member.revision = b"rev %4d" % self.n_made
        for other in self.members.values():
            if self.delivers:
                other.revision = member.revision
            if self.helps:
                other.tracked = PLENTY

    def _tell(self, own_id: int, state: MapState) -> None:
        payload_type, payload = encode_payload(state)
        for peer, other in self.members.items():
            if peer != own_id and self._rng.uniform() >= self.loss:
                heard = decode_payload(payload_type, payload)
                assert isinstance(heard, MapState)
                other.group.map_state(own_id, heard, self.now_s)


def test_nothing_is_updated_that_is_seen_well() -> None:
    sky = Sky((1, 2, 3))
    sky.run(60.0)
    assert sky.begun == []


@pytest.mark.parametrize(
    ("n_members", "n_blind", "begins"),
    [(1, 1, True), (2, 1, False), (2, 2, True), (3, 1, False), (3, 2, True), (4, 2, False),
     (4, 3, True), (5, 2, False), (5, 3, True)],
)  # fmt: skip
def test_more_than_half_decide(n_members: int, n_blind: int, begins: bool) -> None:
    sky = Sky(tuple(range(1, n_members + 1)))
    sky.run(10.0)
    sky.see(FEW, *range(n_members, n_members - n_blind, -1))
    sky.run(30.0)
    assert bool(sky.begun) == begins
    assert len(sky.begun) <= 1  # it has helped
    if begins:
        (at_s, by) = sky.begun[0]
        assert by == 1
        assert 10.0 + OPTIONS.hold_s < at_s < 13.0


def test_a_majority_for_a_moment_is_none() -> None:
    sky = Sky((1, 2, 3), options=replace(OPTIONS, hold_s=1.5))
    sky.run(10.0)
    for _ in range(20):
        sky.see(FEW, 2, 3)
        sky.run(0.6)
        sky.see(PLENTY, 2, 3)
        sky.run(1.2)
    assert sky.begun == []


@given(st.floats(0.0, 0.5), st.integers(0, 2**32 - 1))
def test_lost_messages_delay_a_round_and_make_none(loss: float, seed: int) -> None:
    sky = Sky((1, 2, 3), loss, seed)
    sky.run(10.0)
    sky.see(FEW, 3)
    sky.run(20.0)
    # A member that is not heard of for the time-out counts for dead, and one of two is no
    # majority; only who hears nobody at all decides alone.
    assert all(sky.begun_alone)
    assume(not sky.begun)
    sky.see(FEW, 2)
    sky.run(40.0, lambda: bool(sky.begun))
    assert sky.begun


def test_the_dead_do_not_vote_and_are_not_counted() -> None:
    sky = Sky((1, 2, 3, 4))
    sky.run(5.0)
    sky.see(FEW, 1, 2)
    sky.run(10.0)
    assert sky.begun == []
    sky.die(4)
    sky.run(10.0)
    assert [by for _, by in sky.begun] == [1]
    sky = Sky((1, 2, 3, 4))
    sky.see(FEW, 3, 4)
    sky.run(10.0)
    sky.die(4)
    sky.die(3)
    sky.run(20.0)
    assert sky.begun == []


def test_when_the_coordinator_dies_in_a_round_the_next_one_makes_it() -> None:
    sky = Sky((1, 2, 3))
    sky.run(10.0)
    sky.see(FEW, 1, 2, 3)
    sky.run(10.0, lambda: bool(sky.begun))
    died_at_s = sky.now_s
    sky.die(1)
    sky.run(20.0)
    assert [by for _, by in sky.begun] == [1, 2]
    assert sky.begun[1][0] - died_at_s < 5.0 + OPTIONS.hold_s + 1.5  # silence, then a majority
    assert {member.revision for member in sky.members.values()} == {b"rev    1"}


def test_a_late_joiner_counts_and_is_lost_until_it_localizes() -> None:
    sky = Sky((1, 2, 3))
    sky.die(3)
    sky.run(10.0)
    three = sky.start(3, b"")
    sky.see(0, 3)
    sky.run(3.0)
    coordinator = sky.members[1].trigger
    assert coordinator.lost(sky.now_s) == ()  # it has no map: it is no wonder
    three.revision = FIRST
    sky.run(OPTIONS.lost_s - 0.5)
    assert coordinator.lost(sky.now_s) == ()
    sky.run(2.0)
    assert coordinator.lost(sky.now_s) == (3,)
    assert sky.begun == []  # one of three
    sky.see(FEW, 2)
    sky.run(5.0, lambda: bool(sky.begun))
    assert sky.begun
    sky.see(PLENTY, 3)
    sky.run(1.5)
    assert coordinator.lost(sky.now_s) == ()


def test_a_vote_about_another_revision_does_not_count() -> None:
    sky = Sky((1, 2, 3))
    sky.members[2].revision = sky.members[3].revision = SECOND
    sky.see(FEW, 2, 3)
    sky.run(60.0)
    assert sky.members[1].group.maps.wanting_update == ()
    assert sky.begun == []


def test_the_last_revision_is_let_arrive_before_the_next_but_not_for_ever() -> None:
    sky = Sky((1, 2, 3, 4), helps=False)
    sky.run(10.0)
    sky.see(FEW, 1, 2, 3)
    sky.run(5.0, lambda: bool(sky.begun))
    sky.run(sky.round_s + 0.2)
    assert sky.n_made == 1
    sky.members[4].revision = FIRST  # it does not come through to the fourth
    installed_at_s = sky.now_s
    sky.run(60.0, lambda: len(sky.begun) > 1)
    waited_s = sky.begun[1][0] - installed_at_s
    assert abs(waited_s - OPTIONS.delivery_wait_s) < 1.0


def test_rounds_that_do_not_help_become_rare_until_one_helps() -> None:
    sky = Sky((1, 2, 3), helps=False)
    sky.see(FEW, 1, 2, 3)
    sky.run(120.0)
    times = np.array([at_s for at_s, _ in sky.begun])
    pauses = np.diff(times) - sky.round_s
    interval_s = OPTIONS.interval_s
    expected = [2**k * interval_s for k in range(3)] + [8 * interval_s] * 10
    assert len(pauses) >= 4
    assert pauses == pytest.approx(expected[: len(pauses)], abs=4 * STEP_S)
    sky.helps = True
    sky.run(30.0, lambda: sky.n_made == len(sky.begun) and sky.members[2].tracked == PLENTY)
    sky.run(3.0)
    n_before = len(sky.begun)
    sky.helps = False
    sky.see(FEW, 1, 2, 3)
    sky.run(16.0)
    pauses = np.diff([at_s for at_s, _ in sky.begun[n_before:]]) - sky.round_s
    assert pauses[0] == pytest.approx(interval_s, abs=4 * STEP_S)


def test_a_round_is_coming_from_the_majoritys_wish_on_but_for_those_that_do_not_help() -> None:
    sky = Sky((1, 2, 3), helps=False)
    sky.run(5.0)
    assert not any(member.trigger.is_coming for member in sky.members.values())
    sky.see(FEW, 1, 2, 3)
    sky.run(5.0, lambda: sky.members[1].trigger.is_coming)
    assert not sky.begun
    assert [sky.members[n].trigger.is_coming for n in (1, 2, 3)] == [True, False, False]
    sky.run(60.0)
    assert len(sky.begun) >= 4
    assert not sky.members[1].trigger.is_coming


def test_who_is_on_the_move_goes_on_however_little_each_round_brings() -> None:
    sky = Sky((1, 2, 3), helps=False, moves=True)
    sky.see(FEW, 1, 2, 3)
    sky.run(60.0)
    pauses = np.diff([at_s for at_s, _ in sky.begun]) - sky.round_s
    assert len(pauses) >= 10
    assert (pauses < 2.0 * OPTIONS.interval_s).all()


def test_who_falls_silent_is_not_waited_for_until_it_is_lost() -> None:
    sky = Sky((1, 2, 3))
    sky.run(10.0)
    sky.die(2)
    sky.die(3)
    sky.see(FEW, 1)
    sky.run(4.0, lambda: bool(sky.begun))
    assert sky.begun
    assert sky.members[1].group.alive == (1, 2, 3)


def test_rounds_that_show_more_for_a_moment_only_stay_frequent() -> None:
    sky = Sky((1, 2, 3))
    for n_made in range(1, 6):
        sky.see(FEW, 1, 2, 3)
        sky.run(30.0, lambda n_made=n_made: sky.n_made == n_made)  # type: ignore[misc]
        sky.run(1.4)  # in fast flight what was gained is soon out of sight
    pauses = np.diff([at_s for at_s, _ in sky.begun]) - sky.round_s
    assert len(pauses) == 4
    assert (pauses < 3.0).all()  # up to eight intervals where nothing helps
