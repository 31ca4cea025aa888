"""Frames sent ahead of the map that they go into: to whom, how often, and what is held of them."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.swarm import INTER, swarm
from tests.daemon.waiting import computed, hurry, passes_until, run
from tests.wire.samples import small_frame
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.errors import WireError
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.seen_landmarks import SeenLandmarks
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.wire.frame_codec import FrameAnswer, decode_frame, encode_frame
from vcl_companion.wire.map_codec import decode_map, revision_of
from vcl_companion.wire.map_update import decode_map_update, images_in_update, name_of_image
from vcl_companion.wire.messages import MapState

PAIR = demo.encoded_map(1, 2)


class Member:
    """The frames that one drone of three passes on and holds, and what it handed to whom."""

    def __init__(self, own_id: int, *, all_hear: bool = False) -> None:
        self.group = group = Group(SwarmOptions((1, 2, 3)), own_id)
        for peer in {1, 2, 3} - {own_id}:
            group.heartbeat(peer, 0.0)
        self.handed: list[tuple[int, bytes]] = []
        self.cancelled: list[int] = []
        self.work = MapWork(
            demo.workshop(SwarmOptions((1, 2, 3)), demo.sensor(own_id), INTER), forks=False
        )
        self.frames = PassedFrames(
            group, self._hand, self.cancelled.append, self.work, lambda: all_hear
        )

    def _hand(self, peer: int, blob: bytes) -> int:
        self.handed.append((peer, blob))
        return len(self.handed)


def frame_of(drone_id: int, image: bytes) -> FrameAnswer:
    return replace(small_frame(), drone_id=drone_id, image_bytes=image)


def test_a_frame_from_beyond_what_can_be_told_is_not_passed_on() -> None:
    one = Member(1)
    beyond = Pose(np.eye(3), np.array([32_001.0, 0.0, 0.0]))
    one.frames.pass_on(replace(frame_of(1, b"of one"), world_from_body=beyond))
    assert one.handed == []
    one.frames.pass_on(frame_of(1, b"of one"))
    assert [peer for peer, _ in one.handed] == [2, 3]


def test_a_frame_goes_to_everybody_who_did_not_take_it_and_once() -> None:
    one = Member(1)
    own, two_s = frame_of(1, b"of one"), frame_of(2, b"of two")
    for frame in (own, two_s, own, two_s):
        one.frames.pass_on(frame)
    assert [peer for peer, _ in one.handed] == [2, 3, 3]
    assert [decode_frame(blob, BlobKind.PASSED_FRAME).image_bytes for _, blob in one.handed] == [
        b"of one", b"of one", b"of two",
    ]  # fmt: skip
    name, of_two = name_of_image(b"of one"), name_of_image(b"of two")
    assert one.frames.held_by(2) == {of_two}
    assert one.frames.on_their_way_to(3) == {name, of_two}
    one.frames.ended(2, 1, delivered=True)
    one.frames.ended(3, 2, delivered=False)
    one.frames.ended(3, 77, delivered=True)  # any other transfer
    assert one.frames.held_by(2) == {name, of_two}
    assert one.frames.held_by(3) == frozenset()
    assert one.frames.on_their_way_to(3) == {of_two}
    one.frames.pass_on(own)  # what failed is tried again
    assert [peer for peer, _ in one.handed] == [2, 3, 3, 3]


def test_who_flies_on_a_map_of_its_own_is_passed_nothing_until_that_is_in_ours() -> None:
    one = Member(1)
    one.group.leave_apart(frozenset({3}))
    one.frames.pass_on(frame_of(1, b"of one"))
    assert [peer for peer, _ in one.handed] == [2]
    one.group.leave_apart(frozenset())
    one.frames.pass_on(frame_of(1, b"of one, later"))
    assert [peer for peer, _ in one.handed] == [2, 2, 3]


def test_what_an_image_shows_of_the_map_is_for_the_coordinator_alone() -> None:
    one = Member(1)
    seen = SeenLandmarks(b"revision", np.array([3, 7]), np.zeros((2, 2)))
    here = replace(frame_of(2, b"of two"), world_from_body=Pose.identity(), seen=seen)
    one.frames.pass_on(here)
    ((peer, blob),) = one.handed
    assert (peer, decode_frame(blob, BlobKind.PASSED_FRAME).seen) == (3, None)


def test_what_all_have_heard_is_not_passed_on_and_held_by_who_says_so() -> None:
    one = Member(1, all_hear=True)
    two_s, three_s = frame_of(2, b"of two"), frame_of(3, b"of three")
    of_two, of_three = name_of_image(b"of two"), name_of_image(b"of three")
    one.frames.is_held(3, b"digest 2")  # before we have it ourselves
    for frame, digest in ((two_s, b"digest 2"), (three_s, b"digest 3")):
        one.frames.answered(frame, digest)
        one.frames.pass_on_answer(frame)
    assert not one.handed
    assert one.frames.held_by(3) == {of_two, of_three}
    assert one.frames.held_by(2) == {of_two}  # it has not said so yet
    one.frames.is_held(2, b"digest 3")
    assert one.frames.held_by(2) == {of_two, of_three}
    one.frames.is_held(2, b"digest of something else")
    one.frames.forgot(2)
    assert one.frames.held_by(2) == frozenset()


def test_what_a_member_gives_to_the_coordinator_is_held_where_it_is_heard() -> None:
    three = Member(3)
    three.frames.hold(frame_of(2, b"of two"))
    assert three.frames.held[name_of_image(b"of two")] == b"of two"


def test_what_nobody_needs_any_more_is_stopped() -> None:
    one = Member(1)
    one.frames.pass_on(frame_of(1, b"of one"))
    one.frames.forgot(2)
    assert one.cancelled == [1]
    one.frames.over()
    assert one.cancelled == [1, 2]
    assert one.frames.on_their_way_to(3) == frozenset()


def test_what_one_drone_gives_pushes_out_no_more_than_its_own() -> None:
    three = Member(3)
    for n in range(12):
        three.frames.hold(frame_of(1, b"honest %d" % n))
    for n in range(100):
        three.frames.hold(frame_of(2, b"%d" % n))
        three.frames.hold(frame_of(2, b"honest 3"))  # not its own: it says it again
    held = three.frames.held
    assert [b"honest %d" % n in held.values() for n in range(12)] == [True] * 12
    assert sum(not image.startswith(b"honest") for image in held.values()) == 24
    assert held[name_of_image(b"99")] == b"99"


def test_what_one_drone_gives_is_not_looked_at_for_longer_than_a_map_can_wait() -> None:
    """Frames of 640 x 480, and larger ones: what counts is what they take."""
    looked_at: list[tuple[int, int]] = []

    async def scenario() -> None:
        three = Member(3)

        async def look_at(frame: FrameAnswer) -> None:
            looked_at.append((frame.drone_id, frame.camera.width_px))

        three.work.look_at = look_at  # type: ignore[method-assign]
        looking = asyncio.create_task(three.frames.run())
        usual, large = (replace(small_frame().camera, width_px=w, height_px=h) for w, h in SIZES)
        for n in range(10):
            for drone_id, camera in ((1, usual), (2, large)):
                three.frames.hold(replace(frame_of(drone_id, b"%d" % n), camera=camera))
            await asyncio.sleep(0.0)
        assert looked_at.count((1, 640)) == 10
        assert looked_at.count((2, 2048)) == 2
        hurry(8.1)
        three.frames.hold(replace(frame_of(2, b"next"), camera=large))
        await asyncio.sleep(0.01)
        assert looked_at.count((2, 2048)) == 3
        looking.cancel()

    run(scenario())


SIZES = ((640, 480), (2048, 2048))


def test_only_so_many_are_held() -> None:
    three = Member(3)
    with pytest.raises(WireError, match="not a passed frame"):
        three.frames.take(encode_frame(frame_of(2, b"of two")))
    three.frames.take(encode_frame(frame_of(2, b"of two"), BlobKind.PASSED_FRAME))
    assert three.frames.held[name_of_image(b"of two")] == b"of two"
    three.frames.hold(frame_of(3, b"my own"))
    for n in range(100):
        frame = frame_of(1 + n % 3, b"%d" % n)  # rounds of three
        three.frames.take(encode_frame(frame, BlobKind.PASSED_FRAME))
    assert len(three.frames.held) == 48
    assert name_of_image(b"my own") not in three.frames.held
    assert three.frames.held[name_of_image(b"99")] == b"99"


def test_an_image_that_is_none_ends_nothing() -> None:
    async def scenario() -> None:
        three = Member(3)
        looking = asyncio.create_task(three.frames.run())
        three.frames.take(encode_frame(frame_of(2, b"no image"), BlobKind.PASSED_FRAME))
        await asyncio.sleep(0.2)
        assert not looking.done()
        looking.cancel()

    run(scenario())


def test_an_update_comes_without_the_images_that_were_sent_ahead(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, two = [
                await members.start(s, flies_on=(1, 2), update=UpdateOptions()) for s in (1, 2)
            ]
            three = await members.stranger(3)
            await three.meets(1, 2)
            old = revision_of(PAIR)
            for to in (1, 2):
                three.say(MapState(old, 1, True, 10, True), to)
            await one.see(demo.frame(1, 12))
            await two.see(demo.frame(2, 12))
            for drone in (one, two):
                drone.track(10)
            asked = asyncio.create_task(three.asked())
            await passes_until(asked.done)
            answer = demo.answer(3, 12, asked.result().request_id)
            three.hand(BlobKind.FRAME_ANSWER, encode_frame(answer), 1)
            await computed(lambda: one.revision != old)
            update, held = await three.update_and_held(answer.image_bytes)
            assert len(held) == 3
            assert images_in_update(update) == frozenset()
            data = decode_map_update(update, decode_map(PAIR), held)
            assert revision_of(data) == one.revision
            assert len(data) - len(update) > 20_000
            await computed(lambda: two.revision == one.revision)
            # Clocks that the test moves one after the other do not fit each other for a moment.
            assert set(two.exchange.refused) <= {"time"}

    run(scenario())
