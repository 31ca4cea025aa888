"""The frames of a round: of which instant they may be, and that each counts once."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.waiting import beside, passes, run, until
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_choice import FURTHEST_BACK_NS
from vcl_companion.daemon.gathering import Gathering, Wanted
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.messages import FrameRequest

SECOND = 1_000_000_000
NOW_NS = 50 * SECOND
ELSEWHEN = "frame of another instant than the one asked for"


def answer(request_id: int, ago_s: float, *, is_placed: bool) -> FrameAnswer:
    """Drone 2's frame of so long ago."""
    where = demo.world_from_body(2, 0) if is_placed else None
    return replace(
        demo.answer(2, 0, request_id),
        captured_at_ns=NOW_NS - round(ago_s * SECOND),
        frame_age_s=ago_s,
        world_from_body=where,
    )


async def gathered(
    wanted: Wanted, answers: list[tuple[float, bool]]
) -> tuple[list[FrameAnswer], list[str | None]]:
    """Drone 1's round, in which drone 2, whose clock is known, answers so; and what is refused."""
    clock = ManualClock(NOW_NS)
    group = Group(SwarmOptions((1, 2)), 1)
    times: list[int] = []
    clocks = PeerClocks(
        group, lambda ts1, _: times.append(ts1), clock, FlightLog("", clock), lambda *_: None, 0
    )
    for _ in group.heartbeat(2, asyncio.get_running_loop().time()):
        clocks.joined(2)
    async with beside(clocks.run()):
        await until(lambda: bool(times))
    clocks.answered(2, times[0], times[0])
    asked: list[FrameRequest] = []
    gathering = Gathering(
        group, lambda request, _: asked.append(request), clock, clocks, np.random.default_rng(0)
    )
    gathering.begin()
    frames: list[FrameAnswer] = []
    refused: list[str | None] = []

    async def gather() -> None:
        frames.extend(await gathering.gather(wanted, lambda: False))

    async with asyncio.TaskGroup() as round_:
        round_.create_task(gather())
        await until(lambda: bool(asked))
        for ago_s, is_placed in answers:
            frame = answer(asked[-1].request_id, ago_s, is_placed=is_placed)
            refused.append(gathering.take(2, frame))
            await passes(0.25)
    return frames, refused


@pytest.mark.parametrize("is_update", [True, False])
def test_who_says_where_it_was_may_show_an_earlier_instant_in_an_update(is_update: bool) -> None:
    async def scenario() -> None:
        wanted = Wanted(NOW_NS, (2,), timeout_s=5.0)
        if is_update:
            wanted = replace(wanted, furthest_ns=FURTHEST_BACK_NS)
        given = [(20.0, True), (5.0, False), (5.0, True), (0.2, False)]
        frames, refused = await gathered(wanted, given[:3] if is_update else given)
        assert refused == [ELSEWHEN, ELSEWHEN, None] if is_update else [ELSEWHEN] * 3 + [None]
        assert [f.captured_at_ns for f in frames] == [NOW_NS - (5 if is_update else 0.2) * SECOND]

    run(scenario())


def test_more_frames_than_were_asked_for_are_refused_whatever_their_number() -> None:
    async def scenario() -> None:
        group, clock = Group(SwarmOptions((1, 2, 3)), 1), ManualClock(NOW_NS)
        clocks = PeerClocks(group, lambda *_: None, clock, FlightLog("", clock), lambda *_: None, 0)
        for peer in (2, 3):
            group.heartbeat(peer, asyncio.get_running_loop().time())
        asked: list[int] = []
        gathering = Gathering(
            group, lambda _, peer: asked.append(peer), clock, clocks, np.random.default_rng(0)
        )
        first = gathering.begin()
        frames: list[FrameAnswer] = []

        async def gather() -> None:
            frames.extend(await gathering.gather(Wanted(NOW_NS, (2, 3), timeout_s=2.0), bool))

        async with asyncio.TaskGroup() as round_:
            round_.create_task(gather())
            await until(lambda: sorted(asked) == [2, 3])
            said = [
                gathering.take(2, answer((first + n) % (1 << 32), 0.1 * n, is_placed=False))
                for n in range(20)
            ]
        assert said == [None] + ["frame nobody asked for"] * 19
        assert len(frames) == 1

    run(scenario())


def test_a_frame_that_answers_for_several_instants_counts_once() -> None:
    async def scenario() -> None:
        wanted = Wanted(
            NOW_NS, (2,), {2: 2}, spacing_s=1.5, timeout_s=5.0, furthest_ns=FURTHEST_BACK_NS
        )
        frames, refused = await gathered(wanted, [(3.0, True)] * 3)
        assert refused == [None] * 3
        assert [f.captured_at_ns for f in frames] == [NOW_NS - 3 * SECOND]

    run(scenario())


class Rounds:
    """Drone 1's rounds, in which drones 2 and 3 answer after so long, or never (None)."""

    def __init__(self, **answers_after_s: float | None) -> None:
        self.answers_after_s = answers_after_s
        self.now_s = asyncio.get_running_loop().time
        self.group, clock = Group(SwarmOptions((1, 2, 3)), 1), ManualClock(NOW_NS)
        self.hear()
        clocks = PeerClocks(
            self.group, lambda *_: None, clock, FlightLog("", clock), lambda *_: None, 0
        )
        self.gathering = Gathering(self.group, self._asked, clock, clocks, np.random.default_rng(0))
        self.refused: list[str | None] = []

    def hear(self, *peers: int) -> None:
        for peer in peers or (2, 3):
            self.group.heartbeat(peer, self.now_s())

    def _asked(self, request: FrameRequest, peer: int) -> None:
        after_s = self.answers_after_s[f"drone_{peer}"]
        if after_s is not None:
            frame = replace(answer(request.request_id, 0.1, is_placed=False), drone_id=peer)
            asyncio.get_running_loop().call_later(after_s, self._answer, peer, frame)

    def _answer(self, peer: int, frame: FrameAnswer) -> None:
        self.refused.append(self.gathering.take(peer, frame))

    async def round_s(self, *, needs_others: bool = False) -> tuple[float, list[int]]:
        """Make one; return how long it took, and whose frames came."""
        self.gathering.begin()
        began_at_s, frames = self.now_s(), list[FrameAnswer]()
        wanted = Wanted(NOW_NS, (1, 2, 3), timeout_s=5.0, needs_others=needs_others)

        async def gather() -> None:
            frames.extend(await self.gathering.gather(wanted, lambda: False))

        gathering = asyncio.create_task(gather())
        while not gathering.done():
            await passes(0.25)
        return self.now_s() - began_at_s, sorted(frame.drone_id for frame in frames)


def test_who_never_answers_makes_one_round_long_and_not_each() -> None:
    async def scenario() -> None:
        rounds = Rounds(drone_2=0.1, drone_3=None)
        assert (await rounds.round_s())[0] >= 5.0
        for _ in range(3):
            took_s, drones = await rounds.round_s()
            assert took_s < 2.0
            assert drones == [2]
        rounds.answers_after_s["drone_3"] = 0.3  # it is still asked, and has a moment
        took_s, drones = await rounds.round_s()
        assert took_s < 2.0
        assert drones == [2, 3]
        rounds.answers_after_s["drone_3"] = 3.0  # and has all the time from then on
        assert (await rounds.round_s())[1] == [2, 3]

    run(scenario())


def test_who_answers_too_late_is_waited_for_again() -> None:
    async def scenario() -> None:
        rounds = Rounds(drone_2=0.1, drone_3=5.5)
        assert (await rounds.round_s())[1] == [2]
        await passes(1.0)
        assert rounds.refused.count("frame nobody asked for") >= 1
        rounds.answers_after_s["drone_3"] = 4.0
        assert (await rounds.round_s())[1] == [2, 3]

    run(scenario())


def test_where_nobody_has_answered_all_are_waited_for_if_one_frame_is_none() -> None:
    async def scenario() -> None:
        rounds = Rounds(drone_2=None, drone_3=None)
        assert (await rounds.round_s(needs_others=True))[0] >= 5.0
        assert (await rounds.round_s(needs_others=True))[0] >= 5.0
        assert (await rounds.round_s())[0] < 2.0

    run(scenario())


def test_who_was_away_is_waited_for_again() -> None:
    async def scenario() -> None:
        rounds = Rounds(drone_2=0.1, drone_3=None)
        await rounds.round_s()
        rounds.group.poll(rounds.now_s())  # both are lost
        rounds.hear(2)
        assert (await rounds.round_s())[0] < 2.0
        rounds.hear(3)
        assert (await rounds.round_s())[0] >= 5.0

    run(scenario())


@pytest.mark.parametrize("is_update", [True, False])
def test_who_has_gone_silent_holds_no_update_up(is_update: bool) -> None:
    async def scenario() -> None:
        rounds = Rounds(drone_2=0.1, drone_3=None)

        async def two_is_heard() -> None:
            while True:
                await asyncio.sleep(0.25)
                rounds.hear(2)

        async with beside(two_is_heard()):
            took_s, drones = await rounds.round_s(needs_others=not is_update)
        assert drones == [2]
        assert 2.5 <= took_s < 3.5 if is_update else took_s >= 5.0

    run(scenario())
