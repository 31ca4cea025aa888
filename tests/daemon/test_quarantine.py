"""A member with a right key that is wrong: nobody is dragged, and everybody is told who it was."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.bent import bent
from tests.daemon.flying import flying
from tests.daemon.swarm import INTER, Drone, Stranger, swarm
from tests.daemon.waiting import hurry, passes, passes_until, run, until
from vcl_companion.geometry.pose import Pose
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.frame_codec import encode_frame
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of
from vcl_companion.wire.map_update import encode_map_update
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRefused,
    PoseRequest,
    decode_pose_request,
    encode_pose_request,
)

MAP = (1, 2, 3)
PAIR, NEXT = demo.encoded_map(1, 2), demo.encoded_update()
OVERSURE = np.diag([0.01] * 3 + [0.001] * 3) ** 2
EVERY = replace(INTER, wait_s=15.0, every_n_frames=1, least_interval_s=0.0, max_hosts=1)
CONTRADICTS = "map that contradicts ours"


def texts(drone: Drone) -> list[str]:
    """What its autopilot has been told since it was last asked."""
    return [drone.autopilot.texts.get_nowait() for _ in range(drone.autopilot.texts.qsize())]


async def refused_as(drone: Drone, kind: str, times: int = 1) -> None:
    await until(lambda: drone.exchange.refused.get(kind, 0) >= times)


def test_a_peer_that_puts_us_elsewhere_does_not_move_us_and_is_quarantined(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, MAP, inter=EVERY)
            stranger = await members.stranger(1)
            await stranger.meets(2)
            async with flying(drone) as two:
                for k in range(6):
                    stranger.say(MapState(drone.revision, 9, True, tracked=80), 2)
                    await until(lambda: bool(drone.group.state_of(1)))
                    two.give(k)
                    await answered_5_m_off(stranger, k)
                    await two.server.answered()
                    assert_it_knows_where_it_is(drone, k)
                    hurry(1.1)
                assert 1 not in drone.group.trusted
                two.give(6)  # nobody is asked any more
                await two.server.answered()
                assert_it_knows_where_it_is(drone, 6)
            assert stranger.blobs.empty()
            assert {source for _, _, source in two.sources()} == {"intra"}
            assert drone.events("jump") == []
            (event,) = drone.events("quarantine")
            assert event.startswith("drone 1 for 60 s: pose 5.0 m from where we are, more than")
            await until(lambda: not drone.autopilot.texts.empty())
            said = [text for text in texts(drone) if "quarantined" in text]
            assert said == ["VCL: drone 1 quarantined: pose 5.0 m from where we"]
            assert dict(drone.exchange.trust.n_terms) == {1: 1}
            await it_counts_for_nothing_but_is_told(drone, stranger)
            await passes_until(lambda: drone.events("released") == ["drone 1"], at_most_s=62.0)
            assert 1 in drone.group.trusted
            await until(lambda: "VCL: drone 1 believed again" in texts(drone))

    run(scenario())


async def answered_5_m_off(stranger: Stranger, k: int) -> None:
    """Answer the next request with a pose 5 m beside, and be very sure of it."""
    received = await stranger.blobs.get()
    request = decode_pose_request(received.blob)
    truth = demo.world_from_body(2, k)
    off = Pose(truth.rotation, truth.translation + np.array([0.0, 5.0, 0.0]))
    said = PoseProposal.of(request.frame.request_id, request.revision, off, OVERSURE)
    stranger.say(said, 2)


def assert_it_knows_where_it_is(drone: Drone, k: int) -> None:
    state = drone.estimator.predicted(demo.shot(2, k).at_ns, None)
    assert state is not None
    off = state.world_from_body.translation - demo.world_from_body(2, k).translation
    assert np.linalg.norm(off) < 4.0 * drone.estimator.sigma_m
    assert drone.estimator.sigma_m < 0.3


async def it_counts_for_nothing_but_is_told(drone: Drone, stranger: Stranger) -> None:
    """Its map, its requests and its vote; who coordinates has no say about maps either."""
    before = drone.revision
    stranger.hand(BlobKind.MAP, PAIR, 2)
    await refused_as(drone, "map of a quarantined drone")
    stranger.say(FrameRequest(7, 0, 0.0), 2)
    stranger.say(MapRefused(7, "because I say so"), 2)
    await refused_as(drone, "message of a quarantined drone", 2)
    stranger.say(MapState(drone.revision, 9, True, tracked=80, wants_update=True), 2)
    request = PoseRequest(drone.revision, demo.answer(1, 0, request_id=8))
    stranger.heard()
    stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(request), 2)
    while not isinstance(refused := await stranger.messages.get(), PoseRefused):
        pass
    assert refused.request_id == 8
    assert refused.reason.startswith("quarantined: pose 5.0 m from where we are")
    state = drone.group.state_of(1)  # it is heard
    assert state is not None
    assert state.wants_update
    assert drone.group.maps.wanting_update == ()
    assert drone.revision == before


@pytest.mark.parametrize(("scale", "shift_m"), [(1.2, 0.0), (1.0, 3.0)])
def test_a_coordinators_bent_update_is_refused_and_an_honest_one_taken(
    tmp_path: Path, scale: float, shift_m: float
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            wrong = bent(decode_map(NEXT), scale, (shift_m, 0.0, 0.0))
            stranger.hand(BlobKind.MAP, encode_map(wrong), 2)
            await refused_as(drone, CONTRADICTS)
            assert drone.revision == revision_of(PAIR)
            (reason,) = drone.events("refused")
            assert reason.startswith(f"from drone 1: {CONTRADICTS}: ")
            assert "known keyframes moved by" in reason
            stranger.hand(BlobKind.MAP, NEXT, 2)
            await until(lambda: drone.revision == revision_of(NEXT))
            assert drone.events("quarantine") == []
            assert dict(drone.exchange.refused) == {CONTRADICTS: 1}

    run(scenario())


def test_a_coordinator_of_two_bent_maps_is_quarantined_and_may_come_back(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            for n, shift_m in enumerate((3.0, -3.0), start=1):
                map_ = bent(decode_map(NEXT), shift_m=(shift_m, 0.0, 0.0))
                stranger.hand(BlobKind.MAP, encode_map(map_), 2)
                await refused_as(drone, CONTRADICTS, n)
                hurry(1.1)
            (event,) = drone.events("quarantine")
            assert event == "drone 1 for 60 s: map: 2 of 2 known keyframes moved by 3.00 m"
            stranger.hand(BlobKind.MAP, NEXT, 2)
            await refused_as(drone, "map of a quarantined drone")
            assert drone.revision == revision_of(PAIR)
            await passes(61.0)
            assert drone.events("released") == ["drone 1"]
            stranger.forget()
            stranger.hand(BlobKind.MAP, NEXT, 2)
            await until(lambda: drone.revision == revision_of(NEXT))

    run(scenario())


def test_a_revision_of_ours_that_shows_nothing_of_ours_is_refused(tmp_path: Path) -> None:
    """Other instants would keep its keyframes from being compared."""

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            disguised = bent(decode_map(NEXT), scale=1.2)
            keyframes = tuple(
                replace(k, captured_at_ns=k.captured_at_ns + 1) for k in disguised.keyframes
            )
            stranger.hand(BlobKind.MAP, encode_map(replace(disguised, keyframes=keyframes)), 2)
            await refused_as(drone, CONTRADICTS)
            assert drone.revision == revision_of(PAIR)
            assert "it has 0 of its 2 keyframes" in drone.events("refused")[0]

    run(scenario())


@pytest.mark.parametrize("shift_m", [0.0, 3.0])
def test_a_map_that_names_nothing_of_ours_is_held_against_our_frames(
    tmp_path: Path, shift_m: float
) -> None:
    """As one of some revisions later may: an honest one is taken, for all that is new in it."""

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            async with flying(drone) as two:
                for k in range(4):
                    two.give(k)
                    await two.server.answered()
                later = bent(decode_map(NEXT), shift_m=(shift_m, 0.0, 0.0))
                keyframes = tuple(
                    replace(k, captured_at_ns=k.captured_at_ns + 1) for k in later.keyframes
                )
                world = revision_of(PAIR)
                map_ = encode_map(
                    replace(later, keyframes=keyframes, parent=b"unknown ", world=world)
                )
                stranger.hand(BlobKind.MAP, map_, 2)
                if shift_m:
                    await refused_as(drone, CONTRADICTS)
                    (reason,) = drone.events("refused")
                    assert re.search("a frame of ours was taken (2.9|3.0). m off by it$", reason)
                    assert drone.revision == revision_of(PAIR)
                else:
                    await until(lambda: drone.revision == revision_of(map_))

    run(scenario())


def test_a_newcomer_that_took_a_bent_map_follows_the_others(tmp_path: Path) -> None:
    """What most of the others fly on is not held against the one who hands it."""

    async def scenario() -> None:
        async with swarm(1, 2, 3, 4, path=tmp_path) as members:
            drone = await members.start(2)
            one, three, four = [await members.stranger(m) for m in (1, 3, 4)]
            for stranger in (one, three, four):
                await stranger.meets(2)
            four.hand(BlobKind.MAP, encode_map(bent(decode_map(PAIR), scale=1.2)), 2)
            await drone.maps.decided()
            one.hand(BlobKind.MAP, NEXT, 2)
            await refused_as(drone, CONTRADICTS)
            await passes(6.0)  # it is looked at again
            for stranger in (one, three):
                stranger.say(MapState(revision_of(NEXT), 9, True, tracked=80), 2)
            await until(lambda: len(drone.group.maps.holders(revision_of(NEXT))) == 2)
            one.forget()
            one.hand(BlobKind.MAP, NEXT, 2)
            await until(lambda: drone.revision == revision_of(NEXT))
            assert drone.events("quarantine") == []

    run(scenario())


def no_map(n: int) -> bytes:
    """Another one each time: a blob that came already is not taken again."""
    return NEXT[: -1 - n]


BAD_BYTES = (
    (BlobKind.MAP, "map", lambda n: bytes([3, 0x42, n])),
    (BlobKind.MAP, "map", no_map),
    (BlobKind.POSE_REQUEST, "pose request", lambda n: bytes([3, 0x43, n])),
    (BlobKind.PASSED_FRAME, "passed frame", lambda n: bytes([3, 0x45, n])),
)


@pytest.mark.parametrize(("kind", "name", "blob"), BAD_BYTES)
def test_whoever_sends_what_no_drone_sends_is_quarantined(
    tmp_path: Path, kind: BlobKind, name: str, blob: Callable[[int], bytes]
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            for n in range(12):
                assert drone.events("quarantine") == []
                stranger.hand(kind, blob(n), 2)
                await refused_as(drone, name, n + 1)
                await passes(1.25)
            (event,) = drone.events("quarantine")
            assert event.startswith(f"drone 1 for 60 s: {name}: ")

    run(scenario())


def test_what_is_lacking_for_an_update_is_no_such_evidence(tmp_path: Path) -> None:
    """Its parent or an image is not here, or who passes frames on does not lead any more."""
    whole = decode_map(NEXT)
    update = encode_map_update(NEXT, decode_map(PAIR), whole)
    frame = encode_frame(demo.answer(1), BlobKind.PASSED_FRAME)

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            one, three = await members.stranger(1), await members.stranger(3)
            for stranger in (one, three):
                await stranger.meets(2)
            three.hand(BlobKind.PASSED_FRAME, frame, 2)
            await refused_as(drone, "passed frame")
            for n in range(14):
                one.hand(BlobKind.MAP_UPDATE, update[: -1 - n], 2)
                await refused_as(drone, "map", n + 1)
                await passes(1.25)
            assert drone.events("quarantine") == []

    run(scenario())


def test_a_map_that_cannot_be_taken_for_an_unforeseen_reason_ends_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2, (1, 2))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            carry, drone.group.leadership.may_lead = drone.group.leadership.may_lead, None  # type: ignore[assignment]
            stranger.hand(BlobKind.MAP, NEXT, 2)
            await until(lambda: "taking a map failed, and goes on" in caplog.messages)
            drone.group.leadership.may_lead = carry  # type: ignore[method-assign]
            stranger.forget()
            drone.exchange._sharing.offer(1, BlobKind.MAP, NEXT)
            await until(lambda: drone.revision == revision_of(NEXT))

    with caplog.at_level(logging.ERROR):
        run(scenario())
