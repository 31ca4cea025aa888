"""What a ground station may ask, over the autopilot's link of a drone in a real swarm."""

import asyncio
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import computed, passes, passes_until, run, until
from vcl_companion.swarm.update_options import UpdateOptions

UPDATE_MAP, SAVE, RELOAD, RELOCALIZE, PAUSE = range(31010, 31015)
ACCEPTED, BUSY, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS, CANCELLED = range(7)
QUIET = UpdateOptions(tracked=0, share=0.0)


async def last_answer(drone: Drone) -> tuple[int, int, int]:
    """Wait for the answer that ends a command."""
    while True:
        answer = await drone.autopilot.answers.get()
        if answer[1] != IN_PROGRESS:
            return answer


def test_the_ground_has_the_map_updated_though_nobody_votes_for_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drones = [
                await members.start(system_id, flies_on=(1, 2), update=QUIET)
                for system_id in (1, 2)
            ]
            one, two = drones
            old = one.revision
            for drone in drones:
                await drone.see(demo.frame(drone.system_id, 12))
                drone.track(500)
            await passes(8.0)
            assert one.events("update") == []
            one.autopilot.forward(UPDATE_MAP)
            ended = asyncio.create_task(last_answer(one))
            await computed(lambda: one.revision != old)
            assert await ended == (UPDATE_MAP, ACCEPTED, 100)
            assert "and the ground" in one.events("update")[0]
            assert one.events("command") == ["update the map, by system 255"]
            await passes_until(lambda: two.revision == one.revision)
            # It was one order, and is over.
            await passes(8.0)
            assert len(one.events("update")) == 1

    run(scenario())


def test_a_repeated_order_is_the_same_one_and_can_be_cancelled(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), update=QUIET)
            for confirmation in range(3):  # there is no frame to make a map of
                one.autopilot.forward(UPDATE_MAP, confirmation=confirmation)
            answers = [await one.autopilot.answers.get() for _ in range(4)]
            assert {answer[1] for answer in answers} == {IN_PROGRESS}
            assert len(one.events("command")) == 1
            one.autopilot.forward(UPDATE_MAP, 1.0)
            assert (await last_answer(one))[1] == CANCELLED
            one.autopilot.forward(UPDATE_MAP, 1.0)
            assert (await last_answer(one))[1] == DENIED  # nothing is under way
            one.autopilot.forward(UPDATE_MAP)
            assert (await one.autopilot.answers.get())[1] == IN_PROGRESS
            ended = asyncio.create_task(last_answer(one))
            await passes_until(ended.done, 70.0)
            assert (await ended)[1] == FAILED

    run(scenario())


def test_what_cannot_be_done_is_answered(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, update=QUIET)
            await one.see(demo.frame(1, 0))
            for command, parameter, result in (
                (UPDATE_MAP, 0.0, BUSY),  # there is no map
                (SAVE, 0.0, DENIED),  # there is nowhere to
                (RELOAD, 0.0, DENIED),
                (31009, 0.0, UNSUPPORTED),
                (400, 1.0, UNSUPPORTED),  # arm
                (PAUSE, 0.5, DENIED),
                (UPDATE_MAP, 2.0, DENIED),
                (PAUSE, float("nan"), DENIED),
            ):
                one.autopilot.forward(command, parameter)
                assert (await last_answer(one))[:2] == (command, result)
            assert "VCL map not saved: [map] directory is not set" in one.autopilot.said_texts()
            one.autopilot.forward(31009, component=0)  # all are asked: not ours to refuse
            one.autopilot.forward(31009)
            assert await last_answer(one) == (31009, UNSUPPORTED, 255)
            assert one.autopilot.answers.empty()

    run(scenario())


@pytest.mark.parametrize(
    ("target", "system", "reason"),
    [(2, 255, "a command for somebody else"), (None, 77, "a command of a stranger")],
)
def test_only_who_may_commands_only_us(
    tmp_path: Path, target: int | None, system: int, reason: str
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, update=QUIET)
            await one.see(demo.frame(1, 0))
            one.autopilot.forward(PAUSE, 1.0, target=target, system=system)
            await until(lambda: one.autopilot_link.counters.refused.get(reason, 0) == 1)
            assert one.autopilot.answers.empty()
            assert not one.autopilot_link.poses.is_paused

    run(scenario())


def test_poses_are_held_back_until_they_are_wanted_again(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = [await members.fly(system_id, update=QUIET) for system_id in (1, 2)]
            await asyncio.gather(one.fly(0), two.fly(0))
            one.autopilot.forward(PAUSE, 1.0)
            assert await last_answer(one) == (PAUSE, ACCEPTED, 255)
            await one.fly(2)
            one.autopilot.forward(PAUSE, 0.0)
            assert await last_answer(one) == (PAUSE, ACCEPTED, 255)
            await one.fly(4)
            outcomes = [(line["outcome"], line["reason"]) for line in one.lines("frame")]
            assert outcomes[-2:] == [("refused", "paused by the ground"), ("localized", None)]
            texts = one.autopilot.said_texts()
            assert "VCL no poses are sent, as commanded" in texts
            assert "VCL poses are sent again, as commanded" in texts

    run(scenario())


def test_who_is_told_to_relocalize_looks_for_itself_anew(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = [await members.fly(system_id, update=QUIET) for system_id in (1, 2)]
            await asyncio.gather(one.fly(0), two.fly(0))
            assert one.estimator.is_localized(one.clock.now_ns())
            one.autopilot.forward(RELOCALIZE)
            assert await last_answer(one) == (RELOCALIZE, ACCEPTED, 255)
            assert not one.estimator.is_localized(one.clock.now_ns())
            await one.fly(2)
            assert one.estimator.is_localized(one.clock.now_ns())

    run(scenario())


@pytest.mark.parametrize("unused", [0.0, float("nan")])
def test_a_command_whose_answer_was_lost_is_not_obeyed_again(tmp_path: Path, unused: float) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, update=QUIET)
            await one.see(demo.frame(1, 0))
            for confirmation, n_obeyed in ((0, 1), (1, 1), (2, 1), (0, 2)):
                one.autopilot.forward(RELOCALIZE, unused, unused, confirmation=confirmation)
                assert await last_answer(one) == (RELOCALIZE, ACCEPTED, 255)
                assert len(one.events("command")) == n_obeyed
            # Of somebody else, or for something else, or long ago, it is another one.
            one.autopilot.forward(RELOCALIZE, unused, unused, confirmation=1, system=1)
            assert await last_answer(one) == (RELOCALIZE, ACCEPTED, 255)
            assert len(one.events("command")) == 3
            one.autopilot.forward(PAUSE, 1.0, unused, confirmation=3)
            assert await last_answer(one) == (PAUSE, ACCEPTED, 255)
            one.autopilot.forward(PAUSE, 0.0, unused, confirmation=1)
            assert await last_answer(one) == (PAUSE, ACCEPTED, 255)
            assert not one.autopilot_link.poses.is_paused
            await passes(3.0)
            one.autopilot.forward(PAUSE, 0.0, unused, confirmation=1)
            assert await last_answer(one) == (PAUSE, ACCEPTED, 255)
            assert len(one.events("command")) == 6

    run(scenario())


def test_no_numbers_of_a_command_do_harm(tmp_path: Path) -> None:
    numbers = (float("nan"), float("inf"), -float("inf"), 3e38, -1.0, 0.25, -1e-40)
    switches = (UPDATE_MAP, SAVE, PAUSE)

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, update=QUIET, directory=str(tmp_path / "maps"))
            await one.see(demo.frame(1, 0))
            for command in (*switches, RELOAD, RELOCALIZE, 0, 400, 65535):
                for number in numbers:
                    for confirmation in (0, 255):
                        one.autopilot.forward(command, number, number, confirmation=confirmation)
                        answer = await last_answer(one)
                        assert answer[0] == command
                        assert command not in switches or answer[1] == DENIED
            assert not one.autopilot_link.poses.is_paused
            assert list((tmp_path / "maps").iterdir()) == []

    run(scenario())
