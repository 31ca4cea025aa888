"""Who is handed whose map when the parts of a swarm hear each other again, and how soon."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.swarm import FAST, INTER
from tests.daemon.waiting import run
from vcl_companion.daemon.map_branches import MapBranches
from vcl_companion.daemon.map_handing import MapHanding
from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.transfer import (
    BlobDelivered,
    BlobKind,
    BlobReceived,
    Event,
    Transfers,
)
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.map_codec import revision_of
from vcl_companion.wire.messages import MapState
from vcl_companion.wire.tunnel import decode_payload

OURS = revision_of(demo.encoded_map(1, 2))
THEIRS = MapState(b"another!", 900, True)


def handing(group: Group, maps: MapStore, transfers: Transfers) -> MapHanding:
    """What hands our map to whom, with all that it asks."""
    work = MapWork(demo.workshop(SwarmOptions((1, 2, 3)), demo.sensor(1), INTER), forks=False)
    passed = PassedFrames(
        group,
        lambda peer, blob: transfers.submit(peer, BlobKind.PASSED_FRAME, blob, 0.0),
        transfers.cancel,
        work,
        lambda: False,
    )
    return MapHanding(
        group, transfers, maps, work, passed, MapBranches(group, maps, lambda: False, 20.0)
    )


def tags(transfers: Transfers, now_s: float) -> set[int]:
    """Of what is sent now."""
    payloads = transfers.poll(now_s)[0]
    messages = [decode_payload(one.payload_type, one.payload) for one in payloads]
    return {message.tag for message in messages if isinstance(message, Chunk)}


def across(
    here: Transfers, there: Transfers, now_s: float
) -> tuple[list[BlobReceived], list[BlobDelivered]]:
    """Carry what drone 1 sends to drone 2, and its answers, over a link that loses nothing."""
    events: list[Event] = []
    for _ in range(50):
        for sender, receiver, by in ((here, there, 1), (there, here, 2)):
            for one in sender.poll(now_s)[0]:
                message = decode_payload(one.payload_type, one.payload)
                assert isinstance(message, (Chunk, TransferStatus))
                events += receiver.receive(by, message, now_s)
        now_s += 0.01
    return (
        [event for event in events if isinstance(event, BlobReceived)],
        [event for event in events if isinstance(event, BlobDelivered)],
    )


class Member:
    """Drone 2 of three, which has made a map while the leader, drone 1, was away."""

    def __init__(self) -> None:
        self.group = Group(SwarmOptions((1, 2, 3)), 2)
        self.maps = MapStore("")
        self.maps.replace(demo.encoded_map(1, 2), demo.map_index(1, 2))
        self.is_receiving = False
        self.branches = MapBranches(self.group, self.maps, lambda: self.is_receiving, 20.0)
        self.group.set_own_state(MapState(OURS, 900, True))
        self.group.map_state(3, MapState(OURS, 900, True), 0.0)

    def handed_at_s(self, until_s: float = 9.0) -> float | None:
        """When the coordinator is handed our map; None: not by then."""
        times = (n / 10 for n in range(round(10 * until_s)))
        return next((t for t in times if self.branches.receiver(t) is not None), None)


def test_a_coordinator_that_never_had_our_map_gets_it_within_a_second() -> None:
    member = Member()
    member.group.map_state(1, THEIRS, 0.0)
    assert member.handed_at_s() == pytest.approx(1.0)


def test_one_that_had_it_is_about_to_send_what_it_has_made_of_it() -> None:
    member = Member()
    member.group.map_state(1, MapState(OURS, 900, True), 0.0)
    assert member.handed_at_s(0.5) is None
    member.group.map_state(1, THEIRS, 0.6)
    assert member.handed_at_s() == pytest.approx(5.0)


def test_while_a_map_comes_in_none_is_handed() -> None:
    member = Member()
    member.group.map_state(1, THEIRS, 0.0)
    member.is_receiving = True
    assert member.handed_at_s() is None


def test_the_first_of_those_who_have_it_hands_it() -> None:
    third = Member()
    third.group = Group(SwarmOptions((1, 2, 3)), 3)
    third.branches = MapBranches(third.group, third.maps, lambda: False, 20.0)
    third.group.set_own_state(MapState(OURS, 900, True))
    third.group.map_state(2, MapState(OURS, 900, True), 0.0)
    third.group.map_state(1, THEIRS, 0.0)
    assert third.handed_at_s() is None


def test_who_has_given_us_our_map_hands_what_it_has_made_of_it() -> None:
    """Both would be sent, each half as fast."""
    member = Member()
    member.branches.given_by(3)
    member.group.map_state(1, THEIRS, 0.0)
    member.group.map_state(3, MapState(b"made of.", 950, True), 0.0)
    assert member.handed_at_s() is None
    # Unless it has left ours, or is not there any more.
    member.group.map_state(3, THEIRS, 0.0)
    assert member.handed_at_s() is not None
    member.group.map_state(3, MapState(b"", 0, False), 0.0)
    assert member.handed_at_s() is not None
    member.group.map_state(3, MapState(b"made of.", 950, True), 0.0)
    member.group.heartbeat(1, 60.0)
    member.group.poll(60.0)
    assert member.group.teammates == (1, 2)
    assert member.handed_at_s() is not None


def test_what_peers_hold_is_known_of_the_last_of_their_maps_that_is() -> None:
    member, names = Member(), MapOffer.of(BlobKind.MAP, demo.encoded_map(1, 2)).images()
    branches, group = member.branches, member.group
    assert branches.held_by(3) == branches.held_by(1) == frozenset()
    branches.note_held()
    assert branches.held_by(3) == names
    assert branches.held_by(1) == frozenset()
    group.map_state(3, MapState(b"made of.", 950, True), 0.0)
    branches.note_held()
    assert branches.held_by(3) == names
    branches.merged(1, THEIRS.revision, frozenset({b"an image"}), 0.0)
    assert branches.held_by(1) == {b"an image"}
    group.map_state(3, THEIRS, 0.0)
    assert branches.held_by(3) == {b"an image"}


@pytest.mark.parametrize("comes", ["known", "unknown", "in vain", "without a map"])
def test_who_flew_apart_is_sent_no_images_that_it_has(comes: str) -> None:
    async def scenario() -> None:
        group, maps = Group(SwarmOptions((1, 2)), 1), MapStore("")
        transfers = Transfers(FAST, np.random.default_rng(0))
        hands = handing(group, maps, transfers)
        making = asyncio.create_task(hands.run())
        stored = maps.replace(demo.encoded_map(1, 2), demo.map_index(1, 2))
        group.set_own_state(MapState(OURS, 900, True))
        group.map_state(2, THEIRS if comes == "unknown" else MapState(OURS, 900, True), 0.0)
        hands.hand_out(0.0)
        # Since then it has made another one of it, or lost it; ours has a third view.
        whole = demo.encoded_map(1, 2, 3)
        maps.replace(whole, demo.map_index(1, 2, 3))
        group.set_own_state(MapState(revision_of(whole), 950, True))
        there, came = Transfers(FAST, np.random.default_rng(1)), list[BlobReceived]()
        state = MapState(b"", 0, False) if comes == "without a map" else THEIRS
        for n in range(100):
            now_s = 0.5 * n
            group.map_state(2, state, now_s)
            hands.hand_out(now_s)
            await asyncio.sleep(0.02)
            received, delivered = across(transfers, there, now_s)
            came += received
            for one in delivered if comes == "in vain" else ():
                hands.delivered(2, one.transfer_id, now_s)
            if len(came) == (2 if comes == "in vain" else 1):
                break
        kinds, n_bytes = [one.kind for one in came], [len(one.blob) for one in came]
        if comes in ("known", "in vain"):
            shorter = MapOffer.of(came[0].kind, came[0].blob)
            here = shorter.images_here({}, stored)
            assert shorter.whole(None, here) == whole
            assert n_bytes[0] < 0.5 * len(whole)
        if comes == "known":
            assert kinds == [BlobKind.MAP_UPDATE]
        else:
            assert kinds[-1] == BlobKind.MAP
            assert came[-1].blob == whole
        making.cancel()
        with suppress(asyncio.CancelledError):
            await making

    run(scenario())


def test_until_a_part_has_said_what_it_has_or_long_enough_ours_goes_on_without_it() -> None:
    async def scenario() -> None:
        group, maps = Group(SwarmOptions((1, 2, 3)), 1), MapStore("")
        hands = handing(group, maps, Transfers(FAST, np.random.default_rng(0)))
        maps.replace(demo.encoded_map(1, 2), demo.map_index(1, 2))
        group.set_own_state(MapState(OURS, 900, True, wants_update=True))
        lacking = []
        for n in range(25):
            for peer in (2, 3):
                group.map_state(peer, THEIRS, float(n))
            hands.hand_out(float(n))
            lacking.append(group.maps.lacking())
            assert group.maps.majority_wants_update == (not lacking[-1])
        assert lacking == [()] * 20 + [(2, 3)] * 5
        group.map_state(3, MapState(OURS, 900, True), 25.0)
        hands.hand_out(25.0)
        assert group.maps.lacking() == (2,)

    run(scenario())


def test_a_map_that_was_replaced_does_not_reach_who_was_away_when_it_is_back() -> None:
    async def scenario() -> None:
        group, maps = Group(SwarmOptions((1, 2, 3)), 1), MapStore("")
        transfers = Transfers(FAST, np.random.default_rng(0))
        hands = handing(group, maps, transfers)
        maps.replace(demo.encoded_map(1, 2), demo.map_index(1, 2))
        group.set_own_state(MapState(OURS, 900, True))
        for peer in (2, 3):
            group.map_state(peer, MapState(b"", 0, False), 0.0)
        hands.hand_out(0.0)
        begun, _ = transfers.poll(0.0)
        assert {payload.peer for payload in begun} <= {0, 2, 3}
        assert begun
        group.poll(20.0)  # both are lost
        assert group.alive == (1,)
        maps.replace(demo.encoded_map(1, 2, 3), demo.map_index(1, 2, 3))
        hands.hand_out(20.0)
        assert transfers.poll(60.0) == ([], [])

    run(scenario())


def test_a_map_on_its_way_before_a_gap_is_not_sent_on_beside_its_successor() -> None:
    async def scenario() -> None:
        group, maps = Group(SwarmOptions((1, 2)), 1), MapStore("")
        transfers = Transfers(FAST, np.random.default_rng(0))
        hands = handing(group, maps, transfers)
        maps.replace(demo.encoded_map(1, 2), demo.map_index(1, 2))
        group.set_own_state(MapState(OURS, 900, True))
        group.map_state(2, MapState(b"", 0, False), 0.0)
        hands.hand_out(0.0)
        before = tags(transfers, 0.0)
        assert before
        group.poll(20.0)
        group.map_state(2, MapState(b"", 0, False), 21.0)
        hands.forgot(2)  # it is back
        maps.replace(demo.encoded_map(1, 2, 3), demo.map_index(1, 2, 3))
        hands.hand_out(21.0)
        after = tags(transfers, 21.0) | tags(transfers, 21.5)
        assert after
        assert not before & after

    run(scenario())


def test_what_the_drone_that_gave_us_our_map_makes_of_it_is_taken_for_a_moment() -> None:
    member = Member()
    member.branches.given_by(3)
    member.group.map_state(1, THEIRS, 0.0)
    member.branches.receiver(0.0)
    assert member.branches.goes_on_by(3, 2.0)
    assert not member.branches.goes_on_by(1, 2.0)
    assert not member.branches.goes_on_by(3, 4.0)  # who hears no coordinator goes on for ever
    member.group.map_state(1, MapState(OURS, 900, True), 4.0)
    assert not member.branches.goes_on_by(3, 4.0)


def test_once_a_map_is_merged_others_are_waited_for_no_longer_than_one_takes_to_begin() -> None:
    """They may fly on what it was made of, and hand nothing."""
    member = Member()
    member.group.map_state(3, THEIRS, 0.0)
    assert member.branches.is_awaited(3, 0.0)
    member.branches.merged(1, b"a third.", frozenset(), 2.0)
    assert [member.branches.is_awaited(3, at_s) for at_s in (6.9, 7.1)] == [True, False]
    member.is_receiving = True
    assert member.branches.is_awaited(3, 7.1)


def test_a_map_that_is_coming_in_is_waited_for_longer_but_not_for_ever() -> None:
    member = Member()
    member.is_receiving = True
    awaited = []
    for n in range(100):
        member.group.map_state(3, THEIRS, float(n))
        awaited.append(member.branches.is_awaited(3, float(n)))
    assert awaited == [True] * 80 + [False] * 20
    member.is_receiving = False
    assert not member.branches.is_awaited(3, 30.0)


def test_who_makes_one_map_after_the_other_is_not_waited_for_any_longer() -> None:
    member = Member()
    awaited = []
    for n in range(40):
        member.group.map_state(3, MapState(b"map %4d" % n, 900, True), float(n))
        awaited.append(member.branches.is_awaited(3, float(n)))
    assert awaited == [True] * 20 + [False] * 20
    member.group.map_state(3, MapState(OURS, 900, True), 40.0)
    assert not member.branches.is_awaited(3, 40.0)
    member.group.map_state(3, THEIRS, 41.0)  # it went apart once more
    assert member.branches.is_awaited(3, 41.0)
