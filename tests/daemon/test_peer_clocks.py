"""The same instant on two drones' clocks: requests that take seconds get the frame they mean."""

from __future__ import annotations

import asyncio
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.flying import flying
from tests.daemon.swarm import Drone, Stranger, swarm
from tests.daemon.test_inter import MAP, answer_to
from tests.daemon.waiting import beside, passes, passes_until, run, until
from vcl_companion.cameras.source import Frame
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.frame_codec import encode_frame
from vcl_companion.wire.messages import FrameRequest, MapState
from vcl_companion.wire.pose_messages import PoseProposal, PoseRequest, encode_pose_request

SECOND = 1_000_000_000
ELSEWHEN = "frame of another instant than the one asked for"
# What the other drone's clock shows when it is 0 on ours.
APART_NS = -777 * SECOND - 123_456_789


def keep_time(drone: Drone, stranger: Stranger, seconds: float = 0.0) -> None:
    """Let time pass on both clocks."""
    drone.clock.advance_to(drone.clock.now_ns() + round(seconds * SECOND))
    stranger.clock.advance_to(drone.clock.now_ns() + APART_NS)


def now_s() -> float:
    return asyncio.get_running_loop().time()


async def related(drone: Drone) -> None:
    """Wait until a drone knows its peer's clock."""
    await passes_until(lambda: bool(drone.lines("clock")))


def seen_at(system_id: int, seconds: float) -> Frame:
    """A frame of so long after the first one."""
    first = demo.frame(system_id)
    at_ns = first.captured_at_ns + round(seconds * SECOND)
    return Frame(first.image, at_ns, round(10 * seconds), 0)


@pytest.mark.parametrize("knows_the_clock", [True, False])
def test_a_request_that_took_two_seconds_gets_the_frame_it_means(
    tmp_path: Path, knows_the_clock: bool
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            two, one = await members.start(2), await members.stranger(1)
            await one.meets(2)
            if knows_the_clock:
                keep_time(two, one)
                await related(two)
            await two.see(demo.frame(2))
            wanted_ns = demo.shot(2).at_ns
            await two.see(seen_at(2, 2.0))
            # Sent at that very instant: its age was 0.
            one.say(FrameRequest(6, wanted_ns + APART_NS, 0.0), 2)
            late_s = ((await one.answer())[1].captured_at_ns - wanted_ns) / SECOND
            assert late_s == (0.0 if knows_the_clock else 2.0)

    run(scenario())


def test_a_frame_sent_by_its_age_is_looked_for_again_when_the_clock_is_known(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            two, one = await members.start(2), await members.stranger(1)
            await one.meets(2)
            for seconds in (0.0, 1.0, 2.0):
                await two.see(seen_at(2, seconds))
            asked = FrameRequest(6, demo.shot(2).at_ns + SECOND + APART_NS, 0.0)
            one.say(asked, 2)
            assert (await one.answer())[1].captured_at_ns == demo.shot(2).at_ns + 2 * SECOND
            keep_time(two, one)
            await related(two)
            one.say(asked, 2)
            blob, again = await one.answer()
            assert again.captured_at_ns == demo.shot(2).at_ns + SECOND
            one.forget()
            await passes(10.5)  # it has heard that the frame has arrived
            one.say(asked, 2)
            assert (await one.answer())[0] == blob

    run(scenario())


def test_an_answer_that_shows_another_instant_is_refused_and_asked_for_again(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await members.start(1), await members.stranger(2)
            await two.meets(1)
            keep_time(one, two)
            await related(one)
            two.say(MapState(b"", 0, False), 1)
            await one.see(demo.frame(1))
            asked = await two.asked()
            assert asked.at_ns == demo.shot(1).at_ns
            frame = demo.answer(2, 0, asked.request_id)
            at_ns = asked.at_ns + APART_NS
            keep_time(one, two, 3.0)
            for late_s, age_s in ((1.5, 1.5), (0.5, 2.5)):
                late = replace(
                    frame, captured_at_ns=at_ns + round(late_s * SECOND), frame_age_s=age_s
                )
                two.hand(BlobKind.FRAME_ANSWER, encode_frame(late), 1)
                if late_s > 1.0:
                    await until(lambda: one.exchange.refused.get(ELSEWHEN) == 1)
                    await passes(1.0)
                    again = await two.asked()
                    assert (again.request_id, again.at_ns) == (asked.request_id, asked.at_ns)
            await one.maps.decided()
            assert one.revision
            assert dict(one.exchange.refused) == {ELSEWHEN: 1}

    run(scenario())


@pytest.mark.parametrize("knows_the_clock", [True, False])
def test_a_pose_request_that_took_two_seconds_is_held_against_the_frame_of_its_time(
    tmp_path: Path, knows_the_clock: bool
) -> None:
    """Of its own frames the host has one with a fix from then, and none since."""

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            host, target = await members.start(1, MAP), await members.stranger(2)
            await target.meets(1)
            if knows_the_clock:
                keep_time(host, target)
                await related(host)
            async with flying(host) as one:
                one.give(0)
                await one.server.answered()
                await until(lambda: host.estimator.is_localized(host.clock.now_ns()))
                keep_time(host, target, 2.0)
                frame = replace(
                    demo.answer(2, 0, request_id=9),
                    captured_at_ns=demo.shot(2).at_ns + APART_NS,
                    frame_age_s=0.0,
                )
                request = PoseRequest(host.revision, frame)
                target.hand(BlobKind.POSE_REQUEST, encode_pose_request(request), 1)
                answer = await answer_to(target)
                assert isinstance(answer, PoseProposal) == knows_the_clock

    run(scenario())


def test_two_daemons_know_each_others_clocks_and_write_down_how_well(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await members.start(1), await members.start(2)
            await knows_of_time(one, two)
            for drone, peer in ((one, two), (two, one)):
                (line,) = drone.lines("clock")
                assert line["peer"] == peer.system_id
                assert abs(line["offset_ns"]) <= line["bound_ns"]
                assert line["at_ns"] == drone.clock.now_ns()
                assert abs(line["drift_ppm"]) <= line["drift_bound_ppm"] <= 200.0
            await passes(30.0)
            assert 4 <= len(one.lines("clock")) <= 6
            # Its host is started anew, and back before anybody has missed it.
            await members.stop(two)
            again = await members.start(2)
            again.clock.advance_to(again.clock.now_ns() + 50 * SECOND)
            await passes_until(lambda: bool(one.events("clock")))
            assert one.events("clock") == ["drone 2 has another clock than before"]
            assert one.lines("clock")[-1]["offset_ns"] == pytest.approx(-50 * SECOND, abs=10)

    run(scenario())


async def knows_of_time(*drones: Drone) -> None:
    await passes_until(lambda: all(drone.lines("clock") for drone in drones))


@pytest.mark.parametrize(("n_members", "every_s"), [(2, 8.0), (9, 8.0)])
def test_who_is_alive_is_asked_quickly_at_first_and_then_rarely(
    n_members: int, every_s: float
) -> None:
    """The bytes of a question and its answer, signed, stay below 90 a second and drone.

    However many join at one time, two or three are asked at once.
    """

    async def scenario() -> None:
        clock = ManualClock(50 * SECOND)
        group = Group(SwarmOptions(tuple(range(1, n_members + 1))), 1)
        asked: list[tuple[int, int]] = []
        asked_at_s: list[float] = []
        clocks = PeerClocks(
            group, lambda ts1, peer: asked.append((ts1, peer)), clock, FlightLog("", clock),
            lambda *_: None, 0,
        )  # fmt: skip
        n_peers = n_members - 1
        quick_s = 10.0 + n_peers
        async with beside(clocks.run()):
            await passes(2.0)
            assert asked == []  # nobody is there
            began_s = now_s()
            while now_s() < began_s + quick_s + 4 * every_s:
                for peer in group.peers:
                    for _ in group.heartbeat(peer, now_s()):
                        clocks.joined(peer)
                await passes(0.5)
                clock.advance_to(clock.now_ns() + SECOND // 2)
                assert len(asked) - len(asked_at_s) <= 3
                for ts1_ns, peer in asked[len(asked_at_s) :]:
                    asked_at_s.append(now_s() - began_s)
                    clocks.answered(peer, ts1_ns, ts1_ns + APART_NS + 1000 * SECOND)
        n_steady = sum(at_s > quick_s for at_s in asked_at_s)
        assert 4 * n_peers <= len(asked) - n_steady <= 5 * n_peers
        assert 3 * n_peers <= n_steady <= 4 * n_peers
        assert 2 * 43 * n_steady / (4 * every_s) < 90.0

    run(scenario())


def test_in_a_large_group_those_are_asked_that_a_drone_deals_with() -> None:
    async def scenario() -> None:
        clock = ManualClock(50 * SECOND)
        group = Group(SwarmOptions(tuple(range(1, 31))), 7)
        asked: Counter[int] = Counter()
        clocks = PeerClocks(
            group, lambda _, peer: asked.update([peer]), clock, FlightLog("", clock),
            lambda *_: None, 0,
        )  # fmt: skip

        async def lets_pass(seconds: float) -> None:
            end_s = now_s() + seconds
            while now_s() < end_s:
                for peer in group.peers:
                    for _ in group.heartbeat(peer, now_s()):
                        clocks.joined(peer)
                await passes(0.5)

        async with beside(clocks.run()):
            await lets_pass(60.0)
            assert set(asked) == {1}  # who coordinates
            clocks.instant(12, 5, 0.0, 9)
            await lets_pass(20.0)
            assert set(asked) == {1, 12}
            asked.clear()
            await lets_pass(300.0)  # nothing was heard of it for so long
            before = asked[12]
            await lets_pass(60.0)
            assert asked[12] == before > 0
            assert 360 / 29 - 2 <= asked[1] <= 360 / 29 + 2

    run(scenario())


def test_who_answers_ever_another_time_is_asked_rarely_too() -> None:
    async def scenario() -> None:
        clock = ManualClock(50 * SECOND)
        group = Group(SwarmOptions((1, 2)), 1)
        asked: list[int] = []
        refused: list[str] = []
        clocks = PeerClocks(
            group, lambda ts1, _: asked.append(ts1), clock, FlightLog("", clock),
            lambda _peer, _kind, why: refused.append(why), 0,
        )  # fmt: skip
        async with beside(clocks.run()):
            n_answered = 0
            for _ in range(80):
                for _ in group.heartbeat(2, now_s()):
                    clocks.joined(2)
                await passes(0.5)
                for ts1_ns in asked[n_answered:]:
                    n_answered += 1
                    clocks.answered(2, ts1_ns, n_answered**2 * 1000 * SECOND)
        assert len(refused) > 5
        assert len(asked) <= 9 + 40 / 8
        assert clocks.instant(2, 5, 0.0, 9).bound_ns is None

    run(scenario())


def test_a_group_at_rest_says_little(tmp_path: Path) -> None:
    """Signs of life, states and time, to two peers each and signed, below 200 B/s a drone."""

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            drones = [await members.start(k, flies_on=MAP) for k in (1, 2, 3)]
            await knows_of_time(*drones)
            await passes(12.0)
            before = [drone.link_counters.bytes_out for drone in drones]
            await passes(40.0)
            for drone, then in zip(drones, before, strict=True):
                assert 60.0 < (drone.link_counters.bytes_out - then) / 40.0 < 200.0

    run(scenario())


def test_who_never_answers_is_asked_rarely() -> None:
    async def scenario() -> None:
        clock = ManualClock(50 * SECOND)
        group = Group(SwarmOptions((1, 2)), 1)
        asked: list[int] = []
        clocks = PeerClocks(
            group, lambda ts1, _: asked.append(ts1), clock, FlightLog("", clock),
            lambda *_: None, 0,
        )  # fmt: skip
        async with beside(clocks.run()):
            group.heartbeat(2, now_s())
            clocks.joined(2)
            await passes(8.0)
            n_quick = len(asked)
            await passes(40.0)
        assert 8 <= n_quick <= 9
        assert 4 <= len(asked) - n_quick <= 5

    run(scenario())
