"""A drone that cannot localize itself, and peers that tell it where it is, over real links."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.checks import assert_pose_close
from tests.daemon import demo
from tests.daemon.flying import STARVED, Flier, flying
from tests.daemon.swarm import INTER, Drone, Stranger, Swarm, swarm
from tests.daemon.waiting import passes, run, until
from vcl_companion.daemon.estimator import HISTORY_S
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.swarm.pose_requests import HostChoice
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.map_codec import revision_of
from vcl_companion.wire.messages import MapState
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRefused,
    PoseRequest,
    decode_pose_request,
    encode_pose_request,
)

MAP = (1, 2, 3)
SURE = np.diag([0.02] * 3 + [0.002] * 3) ** 2
# Nobody of a test waits for it in vain.
PATIENT = replace(INTER, wait_s=15.0)


@contextlib.asynccontextmanager
async def host_and_target(path: Path) -> AsyncIterator[tuple[Flier, Flier]]:
    """Drone 1 flies well; drone 2, on the same map, sees too little."""
    async with swarm(1, 2, path=path) as members:
        host = await members.start(1, MAP, inter=replace(INTER, every_n_frames=0))
        target = await members.start(2, MAP, inter=PATIENT)
        async with flying(host) as one, flying(target, STARVED) as two:
            one.give(0)
            await one.server.answered()
            await knows_of(target, 1)
            yield one, two


async def knows_of(drone: Drone, peer: int) -> None:
    """Wait until a drone has heard that a peer is localized on its map."""
    group = drone.group
    await until(
        lambda: (
            (state := group.state_of(peer)) is not None
            and state.localized
            and state.revision == drone.revision
        )
    )


def test_a_target_that_sees_too_little_gets_its_pose_through_a_host(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with host_and_target(tmp_path) as (one, two):
            two.give(0)
            await two.server.answered()
            assert two.sources() == [(0, "localized", "inter")]
            sent = await two.drone.autopilot.poses.get()
            truth = demo.world_from_body(2, 0)
            assert sent[0] == demo.shot(2, 0).at_ns // 1000
            error_m = np.linalg.norm(np.array(sent[1:4]) - truth.translation)
            assert 1e-5 < error_m < 0.3
            (line,) = two.drone.lines("estimate")
            assert (line["source"], line["host"], line["fused"]) == ("inter", 1, True)
            assert len(line["covariance"]) == 21
            sigma_m = np.sqrt(np.array(line["covariance"])[[0, 6, 11]])
            assert error_m < 4.0 * np.linalg.norm(sigma_m)
            # It flies now: the next frame is predicted from there, and confirmed.
            for flier in (one, two):
                flier.give(1)
            await two.server.answered()
            assert two.sources()[1:] == [(1, "localized", "inter")]
            assert two.bases() == [(0, "peer"), (1, "peer")]
            assert one.bases() == [(0, "patches"), (1, "patches")]
            assert two.drone.estimator.in_sight.tracked == 0
            assert one.sources() == [(0, "localized", "intra"), (1, "localized", "intra")]
            assert dict(one.drone.exchange.refused) == dict(two.drone.exchange.refused) == {}

    run(scenario())


def test_led_by_a_host_a_lost_target_places_the_frame_by_its_own_patches(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP, inter=replace(INTER, every_n_frames=0))
            target = await members.start(2, MAP, inter=PATIENT)
            async with flying(host) as one, flying(target, searching=STARVED) as two:
                one.give(0)
                await one.server.answered()
                await knows_of(target, 1)
                two.give(0)
                await two.server.answered()
                assert two.sources() == [(0, "localized", "intra")]
                assert two.bases() == [(0, "patches")]
                led, own = target.lines("estimate")
                assert (led["source"], led["fused"]) == ("inter", True)
                assert (own["source"], own["fused"]) == ("intra", True)
                truth = demo.world_from_body(2, 0).translation
                off_m = [np.linalg.norm(np.array(line["position"]) - truth) for line in (led, own)]
                assert off_m[1] < off_m[0]
                assert off_m[1] < 0.05

    run(scenario())


def test_a_localized_drone_asks_now_and_then_and_is_confirmed(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP, inter=replace(INTER, every_n_frames=0))
            target = await members.start(
                2, MAP, inter=replace(PATIENT, every_n_frames=2, least_interval_s=0.0)
            )
            async with flying(host) as one, flying(target) as two:
                one.give(0)
                await one.server.answered()
                await knows_of(target, 1)
                for k in range(4):
                    two.give(k)
                    await two.server.answered()
                assert [source for _, _, source in two.sources()] == [
                    "intra", "fused", "intra", "fused",
                ]  # fmt: skip
                # A peer's word joins what the sent pose rests on; it is not what it rests on.
                assert [by for _, by in two.bases()] == ["patches"] * 4
                hosts = [line["host"] for line in target.lines("estimate")]
                assert hosts == [None, None, 1, None, None, 1]

    run(scenario())


def test_many_frames_a_second_do_not_make_many_requests(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP, inter=replace(INTER, every_n_frames=0))
            every = replace(PATIENT, every_n_frames=1, least_interval_s=0.5)
            target = await members.start(2, MAP, inter=every)
            async with flying(host) as one, flying(target) as two:
                one.give(0)
                await one.server.answered()
                await knows_of(target, 1)
                for k in range(4):  # 0.2 s apart
                    two.give(k)
                    await two.server.answered()
                assert [source for _, _, source in two.sources()] == [
                    "fused", "intra", "intra", "fused",
                ]  # fmt: skip

    run(scenario())


async def asked_by(members: Swarm, system_id: int) -> tuple[Drone, Stranger]:
    """A drone on the map, and a peer of it that says it is localized there."""
    drone = await members.start(system_id, MAP, inter=replace(PATIENT, max_hosts=1))
    stranger = await members.stranger(1)
    await stranger.meets(system_id)
    stranger.say(MapState(drone.revision, 9, True, tracked=80), system_id)
    await knows_of(drone, 1)
    return drone, stranger


async def request_of(stranger: Stranger) -> PoseRequest:
    """Wait for the next request for a pose."""
    received = await stranger.blobs.get()
    assert received.kind == BlobKind.POSE_REQUEST
    return decode_pose_request(received.blob)


def proposal(request: PoseRequest, pose: Pose, covariance: Array = SURE) -> PoseProposal:
    return PoseProposal.of(request.frame.request_id, request.revision, pose, covariance)


def test_a_late_proposal_is_fused_at_its_own_time(tmp_path: Path) -> None:
    """The frame that it is about is three frames old; where we are now follows from it."""

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone, stranger = await asked_by(members, 2)
            async with flying(drone, STARVED) as two:
                two.give(0)
                first = await request_of(stranger)
                stranger.say(proposal(first, demo.world_from_body(2, 0)), 2)
                await two.server.answered()
                two.give(1)
                second = await request_of(stranger)
                assert second.frame.captured_at_ns == demo.shot(2, 1).at_ns
                for k in (2, 3, 4):
                    two.give(k)
                    await until(lambda k=k: len(two.sources()) == k)  # type: ignore[misc]
                # Nobody is asked about these: one request is open.
                assert two.sources()[1:] == [(k, "refused", None) for k in (2, 3, 4)]
                stranger.say(proposal(second, demo.world_from_body(2, 1)), 2)
                await two.server.answered()
                assert two.sources()[-1] == (1, "localized", "inter")
                times = [two.drone.autopilot.poses.get_nowait()[0] for _ in range(2)]
                assert times == [demo.shot(2, k).at_ns // 1000 for k in (0, 1)]
                # Frames of the past, now seen from both: speed is known, and so is the newest.
                state = drone.estimator.predicted(demo.shot(2, 4).at_ns, None)
                assert state is not None
                apart_m = state.world_from_body.translation - demo.world_from_body(2, 4).translation
                sigma_m = np.sqrt(np.diag(state.pose_covariance())[:3].sum())
                assert np.linalg.norm(apart_m) < 3.0 * sigma_m
                assert sigma_m < 3.0  # a speed of 5 m/s unknown would leave more after 0.8 s

    run(scenario())


@pytest.mark.parametrize("is_heard_of", [True, False])
def test_a_proposal_older_than_the_history_is_refused_and_the_log_says_why(
    tmp_path: Path, is_heard_of: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its frame is forgotten; and, later still, so is that it was asked for."""
    in_vain: list[int] = []
    monkeypatch.setattr(HostChoice, "unanswered", lambda _, host, *__: in_vain.append(host))

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone, stranger = await asked_by(members, 2)
            async with flying(drone, STARVED) as two:
                two.give(0)
                first = await request_of(stranger)
                stranger.say(proposal(first, demo.world_from_body(2, 0)), 2)
                await two.server.answered()
                two.give(1)
                second = await request_of(stranger)
                for k in range(2, 30, 3):  # six seconds of flight
                    two.give(k)
                    await until(lambda k=k: len(two.sources()) == 1 + (k + 1) // 3)  # type: ignore[misc]
                if not is_heard_of:
                    await passes(PATIENT.wait_s)
                    await two.server.answered()
                    await passes(HISTORY_S + 0.5)
                assert in_vain == ([] if is_heard_of else [1])
                before = drone.estimator.predicted(demo.shot(2, 29).at_ns, None)
                stranger.say(proposal(second, demo.world_from_body(2, 1)), 2)
                if is_heard_of:
                    await two.server.answered()
                    line = drone.lines("estimate")[-1]
                    assert line["captured_at_ns"] == demo.shot(2, 1).at_ns
                    assert (line["host"], line["fused"]) == (1, False)
                    assert line["reason"] == "no frame of 5.6 s ago is remembered"
                else:
                    late = "pose that comes too late to be fused"
                    await until(lambda: drone.exchange.refused.get(late) == 1)
                    assert drone.events("refused")[-1] == f"from drone 1: {late}"
                after = drone.estimator.predicted(demo.shot(2, 29).at_ns, None)
                assert before is not None
                assert after is not None
                assert_pose_close(
                    after.world_from_body, before.world_from_body, within_m=1e-9, within_rad=1e-9
                )

    run(scenario())


@pytest.mark.parametrize("answer", ["refused", "far off", "tilted", "vague"])
def test_what_cannot_be_believed_leaves_the_frame_refused(tmp_path: Path, answer: str) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone, stranger = await asked_by(members, 2)
            async with flying(drone, STARVED) as two:
                truth = demo.world_from_body(2, 0)
                two.give(0)
                stranger.say(proposal(await request_of(stranger), truth), 2)
                await two.server.answered()
                two.give(1)
                request = await request_of(stranger)
                if answer == "refused":
                    said: PoseProposal | PoseRefused = PoseRefused(
                        request.frame.request_id, "fog over there"
                    )
                elif answer == "vague":
                    said = proposal(request, truth, np.diag([1e2] * 3 + [1e-2] * 3))
                elif answer == "far off":
                    said = proposal(request, Pose(truth.rotation, truth.translation + 40.0))
                else:
                    tilted = truth.retracted(np.array([0, 0, 0, 0.3, 0, 0]))
                    said = proposal(request, tilted, SURE * 100.0)
                stranger.say(said, 2)
                await two.server.answered()
                assert [o for _, o, _ in two.sources()] == ["localized", "refused"]
                assert two.bases() == [(0, "peer"), (1, None)]  # nobody knows how fast it flies
                if answer == "vague":
                    assert drone.exchange.refused["pose vaguer than any is proposed"] == 1
                elif answer != "refused":
                    line = drone.lines("estimate")[-1]
                    assert line["fused"] is False
                    assert ("roll and pitch" if answer == "tilted" else "m from") in line["reason"]

    run(scenario())


def test_where_nobody_could_tell_nobody_is_asked_a_frame_later(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone, stranger = await asked_by(members, 2)
            async with flying(drone, STARVED) as two:
                two.give(0)
                fog = PoseRefused((await request_of(stranger)).frame.request_id, "fog over there")
                stranger.say(fog, 2)
                await two.server.answered()
                for k in (1, 2):
                    two.give(k)
                    await two.server.answered()
                assert stranger.blobs.empty()
                # 1.8 s after the last one it asks again, and where that helps, at every frame.
                for k in (9, 10):
                    two.give(k)
                    request = await request_of(stranger)
                    assert request.frame.captured_at_ns == demo.shot(2, k).at_ns
                    stranger.say(proposal(request, demo.world_from_body(2, k)), 2)
                    await two.server.answered()
                outcomes = [outcome for _, outcome, _ in two.sources()]
                assert outcomes == ["refused"] * 3 + ["localized"] * 2

    run(scenario())


def test_answers_nobody_asked_for_change_nothing(tmp_path: Path) -> None:
    """A wrong id, a wrong map, a second answer, a member that was not asked."""

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            drone, stranger = await asked_by(members, 2)
            other = await members.stranger(3)
            await other.meets(2)
            async with flying(drone, STARVED) as two:
                two.give(0)
                request = await request_of(stranger)
                good = proposal(request, demo.world_from_body(2, 0))
                wrong = Pose(good.world_from_body.rotation, np.array([50.0, 0.0, 0.0]))
                bad = proposal(request, wrong)
                stranger.say(replace(bad, request_id=request.frame.request_id ^ 1), 2)
                stranger.say(replace(bad, revision=bytes(8)), 2)
                other.say(bad, 2)
                await until(lambda: drone.exchange.refused.get("pose nobody asked for") == 3)
                stranger.say(good, 2)
                stranger.say(bad, 2)
                await two.server.answered()
                await until(lambda: drone.exchange.refused.get("pose nobody asked for") == 4)
                assert two.sources() == [(0, "localized", "inter")]
                state = drone.estimator.predicted(demo.shot(2, 0).at_ns, None)
                assert state is not None
                assert_pose_close(
                    state.world_from_body, good.world_from_body, within_m=1e-3, within_rad=1e-3
                )

    run(scenario())


def test_a_host_without_a_pose_of_that_time_or_on_another_map_says_so(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP)
            stranger = await members.stranger(2)
            await stranger.meets(1)
            frame = demo.answer(2, 0, request_id=5)
            stranger.hand(
                BlobKind.POSE_REQUEST, encode_pose_request(PoseRequest(bytes(8), frame)), 1
            )
            assert await answer_to(stranger) == PoseRefused(5, "the host flies on another map")
            request = PoseRequest(host.revision, replace(frame, request_id=6))
            stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(request), 1)
            refused = await answer_to(stranger)
            assert refused == PoseRefused(6, "the host does not know where it was then")

    run(scenario())


def test_a_host_that_has_an_update_already_answers_who_still_waits_for_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(2, (1, 2), inter=replace(INTER, every_n_frames=0))
            stranger = await members.stranger(1)
            await stranger.meets(2)
            before, update = host.revision, demo.encoded_update()
            stranger.hand(BlobKind.MAP, update, 2)
            await until(lambda: host.revision == revision_of(update))
            async with flying(host) as two:
                two.give(0)
                await two.server.answered()
                frame = demo.answer(1, 0, request_id=5)
                stranger.hand(
                    BlobKind.POSE_REQUEST, encode_pose_request(PoseRequest(before, frame)), 2
                )
                said = await answer_to(stranger)
                assert isinstance(said, PoseProposal)
                assert said.revision == before
                assert_pose_close(
                    said.world_from_body, demo.world_from_body(1, 0), within_m=0.3, within_rad=0.02
                )

    run(scenario())


async def answer_to(stranger: Stranger) -> PoseProposal | PoseRefused:
    """Wait for the next answer about a pose."""
    while True:
        message = await stranger.messages.get()
        if isinstance(message, PoseProposal | PoseRefused):
            return message


@pytest.mark.parametrize("image", [b"no image", demo.png(demo.blank(2))])
def test_hostile_requests_are_counted_or_refused_and_the_host_flies_on(
    tmp_path: Path, image: bytes
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP)
            stranger = await members.stranger(2)
            await stranger.meets(1)
            async with flying(host) as one:
                one.give(0)
                await one.server.answered()
                for blob in (b"", b"\x03\x43", b"\x03\x43" + bytes(300)):
                    stranger.hand(BlobKind.POSE_REQUEST, blob, 1)
                await until(lambda: host.exchange.refused.get("pose request", 0) >= 1)
                # Of another drone than the one that asks.
                alien = PoseRequest(host.revision, demo.answer(1, 0, request_id=7))
                broken = PoseRequest(
                    host.revision, replace(demo.answer(2, 0, request_id=8), image_bytes=image)
                )
                counted = host.exchange.refused["pose request"]
                stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(alien), 1)
                await until(lambda: host.exchange.refused["pose request"] > counted)
                stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(broken), 1)
                refused = await answer_to(stranger)
                assert isinstance(refused, PoseRefused)
                assert refused.request_id == 8
                good = PoseRequest(host.revision, demo.answer(2, 0, request_id=9))
                stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(good), 1)
                answer = await answer_to(stranger)
                assert isinstance(answer, PoseProposal)
                assert_pose_close(
                    answer.world_from_body,
                    demo.world_from_body(2, 0),
                    within_m=0.3,
                    within_rad=0.05,
                )
                assert one.sources() == [(0, "localized", "intra")]

    run(scenario())


def test_a_peer_that_asks_all_the_time_is_answered_now_and_then(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP)
            stranger = await members.stranger(2)
            await stranger.meets(1)
            loop, answered_at_s = asyncio.get_running_loop(), []
            for request_id in range(4):
                request = PoseRequest(bytes(8), demo.answer(2, 0, request_id))
                stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(request), 1)
                assert (await answer_to(stranger)).request_id == request_id
                answered_at_s.append(loop.time())
            assert np.diff(answered_at_s).min() > 0.4  # each has its own way here and back
            assert host.exchange.refused == {}

    run(scenario())


def test_larger_images_than_cameras_here_have_are_not_looked_at(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host = await members.start(1, MAP)
            stranger = await members.stranger(2)
            await stranger.meets(1)
            usual = demo.answer(2, 0, request_id=1)
            wide = replace(usual.camera, width_px=2048, height_px=2048)
            for frame, why in (
                (replace(usual, camera=wide), "a frame of 4194304 pixels, at most 2097152"),
                (
                    replace(usual, request_id=2, image_bytes=bytes(300_000)),
                    "an image of 300000 bytes, at most 262144",
                ),
            ):
                request = PoseRequest(host.revision, frame)
                stranger.hand(BlobKind.POSE_REQUEST, encode_pose_request(request), 1)
                assert await answer_to(stranger) == PoseRefused(frame.request_id, why)

    run(scenario())
