"""Drones that make and share a first map over real links, and peers that misbehave."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.daemon import demo
from tests.daemon.swarm import DATA, MESSAGE, Drone, said, swarm, tunnel
from tests.daemon.waiting import hurry, passes, run, until
from tests.wire.samples import small_map
from vcl_companion.cameras.source import Frame
from vcl_companion.swarm.transfer import BlobKind, TransferOptions
from vcl_companion.wire.frame_codec import encode_frame
from vcl_companion.wire.header import PROTOCOL_VERSION
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.tunnel import encode_payload

PAIR, TRIO = demo.encoded_map(1, 2), demo.encoded_map(1, 2, 3)
NO_MAP = MapState(b"", 0, False)


def counted(drone: Drone, kind: str, times: int) -> Callable[[], bool]:
    """Whether a drone has refused so much of a kind."""
    return lambda: drone.exchange.refused.get(kind, 0) >= times


def asked_more(drone: Drone) -> Callable[[], bool]:
    """Whether a drone has been asked for one more frame than by now."""
    n_before = len(drone.requests)
    return lambda: len(drone.requests) > n_before


async def one_thing_later(drone: Drone) -> None:
    """Wait until a drone has done what was said to it, and one thing beside its event loop."""
    await asyncio.sleep(0.05)
    await drone.work.encode(demo.shot(drone.system_id).image, 40, 1 << 20)


def later(system_id: int, frame: Frame, by_s: float = 0.1) -> Frame:
    """The same picture a moment later."""
    return Frame(frame.image, frame.captured_at_ns + int(by_s * 1e9), frame.sequence + 1, 0)


def test_three_drones_make_one_map_and_all_fly_on_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            drones = [await members.start(system_id) for system_id in (3, 1, 2)]
            for drone in drones:
                await drone.see(demo.frame(drone.system_id))
            for drone in drones:
                await drone.maps.decided()
            assert len({drone.revision for drone in drones}) == 1
            stored = drones[0].maps.current
            assert stored is not None
            keyframes = decode_map(stored.data).keyframes
            assert [keyframe.drone_id for keyframe in keyframes] == [1, 2, 3]
            assert stored.n_landmarks > 200
            for drone in drones:
                (line,) = drone.lines("map")
                assert line["revision"] == drone.revision.hex()
                assert line["landmarks"] == stored.n_landmarks
                assert dict(drone.exchange.refused) == {}
            assert len({request.request_id for drone in drones for request in drone.requests}) == 1

    run(scenario())


def test_a_refusal_reaches_everybody_and_a_newer_frame_is_tried(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await members.start(1), await members.start(2)
            told = asyncio.create_task(two.maps.decided())
            first = demo.frame(2, image=demo.blank(2))
            await one.see(demo.frame(1))
            await two.see(first)
            assert await told is None
            assert "drones 1 and 2 see too little in common" in one.maps.refusal
            assert one.maps.refusal.startswith(two.maps.refusal)
            assert one.events("no map") == [one.maps.refusal]
            await two.see(later(2, demo.frame(2)))
            await one.see(later(1, demo.frame(1)))
            await two.maps.decided()
            assert one.revision == two.revision != b""

    run(scenario())


@pytest.mark.parametrize(("by_s", "warned"), [(0.1, 0), (9.0, 0), (42.0, 1)])
def test_a_first_map_long_after_its_first_try_warns_of_its_scale(
    tmp_path: Path, by_s: float, warned: int
) -> None:
    """Known distances are of when it was tried first: the drones may have flown off since."""

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await members.start(1), await members.start(2)
            told = asyncio.create_task(two.maps.decided())
            await one.see(demo.frame(1))
            await two.see(demo.frame(2, image=demo.blank(2)))
            assert await told is None
            await two.see(later(2, demo.frame(2), by_s))
            await one.see(later(1, demo.frame(1), by_s))
            await two.maps.decided()  # handed out, after which it is not long until it is noted
            assert one.revision == two.revision != b""
            await until(lambda: len(one.events("late first map")) >= warned)
            late = one.events("late first map")
            assert len(late) == warned
            assert all("tried for 42 s" in reason for reason in late)
            said = [await one.autopilot.texts.get() for _ in range(warned)]
            assert all(text == "VCL scale unsure: first map tried for 42 s" for text in said)

    run(scenario())


def test_only_the_coordinator_can_refuse(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two = await members.start(2, runs=False)
            two.exchange.on_tunnel(said(3, MapRefused(1, "because I say so")))
            assert two.maps.refusal == ""
            two.exchange.on_tunnel(said(1, MapRefused(1, "fog")))
            assert two.maps.refusal == "fog"

    run(scenario())


def test_a_late_joiner_is_handed_the_map(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2))
            for system_id in (2, 3):
                late = await members.start(system_id)
                await late.see(demo.frame(system_id))
                await late.maps.decided()
                assert late.revision == one.revision == revision_of(PAIR)
            await members.stop(late)
            began_s = asyncio.get_running_loop().time()
            again = await members.start(3)  # it was away for a moment, and has lost everything
            await again.maps.decided()
            assert asyncio.get_running_loop().time() - began_s < 5.0
            assert again.revision == one.revision

    run(scenario())


def test_a_coordinator_that_is_back_is_handed_the_map_and_makes_none(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            holders = [await members.start(system_id, flies_on=(1, 2)) for system_id in (2, 3)]
            for _ in range(2):
                one = await members.start(1)
                await one.see(demo.frame(1))
                await one.maps.decided()
                assert one.revision == revision_of(PAIR)
                assert len(one.lines("map")) == 1
                assert one.events("no map") == []
                await members.stop(one)
            for holder in holders:
                assert holder.requests == []
                assert holder.revision == revision_of(PAIR)

    run(scenario())


def test_who_has_not_said_yet_what_it_flies_on_is_waited_for(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await members.start(1), await members.stranger(2)
            await two.meets(1)
            await one.see(demo.frame(1))
            for _ in range(3):  # seconds in which it could begin a round
                hurry(1.0)
                await one_thing_later(one)
            assert not any(isinstance(message, FrameRequest) for message in two.heard())
            two.say(NO_MAP, 1)
            assert (await two.asked()).frame_age_s == 0.0

    run(scenario())


def test_a_map_that_turns_up_during_a_round_ends_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await members.start(1), await members.stranger(2)
            await two.meets(1)
            two.say(NO_MAP, 1)
            await one.see(demo.frame(1))
            asked = await two.asked()
            two.say(MapState(revision_of(TRIO), 9, True), 1)
            two.hand(BlobKind.FRAME_ANSWER, encode_frame(demo.answer(2, 0, asked.request_id)), 1)
            for _ in range(5):  # the round has all it wants, and ends
                await one_thing_later(one)
            assert (one.revision, one.maps.refusal) == (b"", "")
            two.hand(BlobKind.MAP, TRIO, 1)
            await one.maps.decided()
            assert one.revision == revision_of(TRIO)
            state = await two.messages.get()
            while not (isinstance(state, MapState) and state.revision):
                state = await two.messages.get()
            assert len(one.lines("map")) == 1
            assert one.events("no map") == []

    run(scenario())


def test_requests_of_two_lives_are_not_mistaken_for_each_other(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            two = await members.stranger(2)
            numbers = []
            for _ in range(3):
                one = await members.start(1)
                two.say(NO_MAP, 1)
                await one.see(demo.frame(1))
                numbers.append((await two.asked()).request_id)
                await members.stop(one)
            assert len(set(numbers)) == 3

    run(scenario())


def test_a_request_repeated_gets_the_very_same_bytes(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            two, one = await members.start(2), await members.stranger(1)
            await one.meets(2)
            one.say(FrameRequest(5, 0, 0.0), 2)  # it has no frame yet: silence
            await two.see(demo.frame(2))
            one.say(FrameRequest(6, 0, 0.0), 2)
            blob, answer = await one.answer()
            assert (answer.drone_id, answer.request_id) == (2, 6)
            assert answer.captured_at_ns == demo.shot(2).at_ns
            assert answer.ned_from_body is not None
            await two.see(later(2, demo.frame(2)))
            one.forget()
            await passes(10.5)  # it has heard that the frame has arrived
            one.say(FrameRequest(6, 0, 0.0), 2)
            assert (await one.answer())[0] == blob
            one.say(FrameRequest(7, 0, 0.0), 2)
            newer_blob, newer = await one.answer()
            assert newer_blob != blob
            assert newer.request_id == 7
            assert newer.captured_at_ns == demo.shot(2).at_ns + 100_000_000
            one.say(FrameRequest(8, 0, 0.1), 2)
            assert (await one.answer())[1].captured_at_ns == demo.shot(2).at_ns
            assert one.blobs.empty()

    run(scenario())


def test_a_frame_that_is_no_more_wanted_is_not_sent_to_its_end(tmp_path: Path) -> None:
    async def scenario() -> None:
        slow = TransferOptions(rate_bytes_per_s=40_000, burst_bytes=1024, status_interval_s=0.05)
        async with swarm(1, 2, path=tmp_path) as members:
            two, one = await members.start(2, transfer=slow), await members.stranger(1)
            await one.meets(2)
            await two.see(demo.frame(2))
            for request_id in range(20, 24):
                arrived = asked_more(two)
                one.say(FrameRequest(request_id, 0, 0.0), 2)
                await until(arrived)
            assert (await one.answer())[1].request_id == 23
            assert one.blobs.empty()

    run(scenario())


def test_a_flood_of_requests_piles_nothing_up(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two, one = await members.start(2), await members.stranger(1)
            await one.meets(2)
            await two.see(demo.frame(2))
            n_tasks = len(asyncio.all_tasks())
            for request_id in range(5000):
                two.exchange.on_tunnel(
                    said(1 + 2 * (request_id % 2), FrameRequest(request_id, 0, 0.0))
                )
            await asyncio.sleep(0)
            assert len(asyncio.all_tasks()) <= n_tasks + 2
            # Each peer's last one is answered.
            assert (await one.answer())[1].request_id == 4998
            one.say(FrameRequest(6000, 0, 0.0), 2)
            assert (await one.answer())[1].request_id == 6000
            assert one.blobs.empty()

    run(scenario())


def test_who_does_not_coordinate_is_given_a_frame_now_and_then(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two = await members.start(2)
            one, three = await members.stranger(1), await members.stranger(3)
            await one.meets(2)
            await three.meets(2)
            await two.see(demo.frame(2))
            three.say(FrameRequest(7, 0, 0.0), 2)
            assert (await three.answer())[1].request_id == 7
            three.say(FrameRequest(8, 0, 0.0), 2)
            kind = "frames asked for too often for no coordinator"
            await until(counted(two, kind, 1))
            for number in (5, 6):
                one.say(FrameRequest(number, 0, 0.0), 2)
                assert (await one.answer())[1].request_id == number
            hurry(11.0)
            three.forget()
            three.say(FrameRequest(9, 0, 0.0), 2)
            assert (await three.answer())[1].request_id == 9

    run(scenario())


def test_a_frame_that_was_delivered_is_given_again_no_sooner_than_another(tmp_path: Path) -> None:
    """Who says to have been restarted, or that it came damaged, keeps no map waiting by it."""

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two = await members.start(2)
            one, three = await members.stranger(1), await members.stranger(3)
            await one.meets(2)
            await three.meets(2)
            await two.see(demo.frame(2))
            for n, stranger in enumerate((one, three)):  # who coordinates, and who does not
                asks = encode_payload(FrameRequest(7, 0, 0.0))
                stranger.say_bytes(*asks, 2)
                await stranger.answer()
                await passes(0.5)
                for _ in range(3):
                    stranger.forget()
                    stranger.say_bytes(*asks, 2)
                    await passes(0.5)
                assert stranger.blobs.empty()
                kind = "frames asked for too often for no coordinator"
                assert two.exchange.refused.get(kind, 0) == 3 * n
                await passes(10.0)
                stranger.say_bytes(*asks, 2)
                assert (await stranger.answer())[1].request_id == 7

    run(scenario())


def test_frames_that_nobody_asked_for_are_refused(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            kind = "frame nobody asked for"
            one = await members.start(1)
            two, three = await members.stranger(2), await members.stranger(3)
            await two.meets(1)
            await three.meets(1)
            two.hand(BlobKind.FRAME_ANSWER, encode_frame(demo.answer(2)), 1)
            await until(counted(one, kind, 1))
            for peer in (two, three):
                peer.say(NO_MAP, 1)
            await one.see(demo.frame(1))
            number = (await two.asked()).request_id
            wrong = (
                encode_frame(demo.answer(2, 0, number + 1)),
                encode_frame(demo.answer(3, 0, number)),  # in another's name
            )
            for blob in wrong:
                two.hand(BlobKind.FRAME_ANSWER, blob, 1)
            await until(counted(one, kind, 3))
            for peer, system_id in ((two, 2), (three, 3)):
                peer.hand(BlobKind.FRAME_ANSWER, encode_frame(demo.answer(system_id, 0, number)), 1)
            stored = await one.maps.decided()
            assert stored is not None
            keyframes = decode_map(stored.data).keyframes
            assert [keyframe.drone_id for keyframe in keyframes] == [1, 2, 3]
            assert dict(one.exchange.refused) == {kind: 3}
            assert one.events("refused") == [f"from drone 2: {kind}"]

    run(scenario())


def test_a_map_is_taken_from_the_coordinator_or_from_anybody_if_there_is_none(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        kind = "map, but not from the coordinator"
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two = await members.start(2)
            one, three = await members.stranger(1), await members.stranger(3)
            await one.meets(2)
            await three.meets(2)
            three.hand(BlobKind.MAP, TRIO, 2)
            await two.maps.decided()
            assert two.revision == revision_of(TRIO)
            three.hand(BlobKind.MAP, PAIR, 2)
            await until(counted(two, kind, 1))
            assert two.revision == revision_of(TRIO)
            one.hand(BlobKind.MAP, PAIR, 2)
            await until(lambda: two.revision == revision_of(PAIR))
            assert dict(two.exchange.refused) == {kind: 1}
            assert [line["revision"] for line in two.lines("map")] == [
                revision_of(TRIO).hex(), revision_of(PAIR).hex(),
            ]  # fmt: skip

    run(scenario())


def test_maps_and_frames_that_are_none_are_counted_and_harm_nothing(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two, one = await members.start(2), await members.stranger(1)
            await one.meets(2)
            bad_maps = (
                b"\x03\x42 no map",
                PAIR[:-1],
                encode_map(small_map()),  # well formed, but its images are none
                encode_frame(demo.answer(1)),
            )
            for n, blob in enumerate(bad_maps, start=1):
                one.hand(BlobKind.MAP, blob, 2)
                await until(counted(two, "map", n))
            for n, blob in enumerate((b"", b"\x03\x41", PAIR), start=1):
                one.hand(BlobKind.FRAME_ANSWER, blob, 2)
                await until(counted(two, "frame", n))
            assert two.revision == b""
            one.hand(BlobKind.MAP, PAIR, 2)
            await two.maps.decided()
            assert two.revision == revision_of(PAIR)
            assert len(two.events("refused")) == 2

    run(scenario())


def test_garbage_is_counted_by_kind_and_logged_once(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            two, one = await members.start(2), await members.stranger(1)
            await one.meets(2)
            head, body = encode_payload(FrameRequest(0, 0, 0.0))[1][:2], bytes(12)
            for k in range(1, 51):  # ages of no frame, each another message
                one.say_bytes(MESSAGE, head + body + k.to_bytes(7, "little") + b"\xff", 2)
            one.say_bytes(40_000, b"not for us at all", 2)
            await until(counted(two, "payload", 50))
            one.hand(BlobKind.MAP, PAIR, 2)
            await two.maps.decided()
            assert dict(two.exchange.refused) == {"payload": 50}
            (reason,) = two.events("refused")
            assert reason.startswith("from drone 1: payload: frame request: an age")

    run(scenario())


payloads = st.one_of(
    st.binary(max_size=128),
    st.builds(
        lambda kind, body: bytes([PROTOCOL_VERSION, kind]) + body,
        st.integers(0, 8),
        st.binary(max_size=126),
    ),
)


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.integers(1, 3), st.sampled_from([MESSAGE, DATA, DATA + 7]), payloads),
        max_size=30,
    )
)
def test_no_payload_whatever_raises(told: list[tuple[int, int, bytes]]) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=Path(directory)) as members:
            two = await members.start(2, runs=False)
            for sender, payload_type, payload in told:
                two.exchange.on_tunnel(tunnel(sender, payload_type, payload))
            assert set(two.exchange.refused) <= {
                "payload",
                "frame",
                "frame nobody asked for",
                "pose nobody asked for",
            }
            assert sum(two.exchange.refused.values()) <= len(told)

    with tempfile.TemporaryDirectory() as directory:
        run(scenario())
