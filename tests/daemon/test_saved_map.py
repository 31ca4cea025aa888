"""The map that the ground has saved: flown on after a restart, and when it is reloaded."""

import asyncio
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.swarm import Drone, Swarm, swarm
from tests.daemon.waiting import computed, passes, passes_until, run, until
from vcl_companion.daemon.map_in_flight import NOTE_FILE
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of

SAVE, RELOAD = 31011, 31012
ACCEPTED, BUSY, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS, CANCELLED = range(7)
MAP, NEXT = demo.encoded_map(1, 2), demo.encoded_update()
SAVED = "saved.vclmap"


async def answered(drone: Drone, command: int, parameter: float = 0.0) -> int:
    """Give a command; return what ends it."""
    drone.autopilot.forward(command, parameter)
    while True:
        told, result, _ = await drone.autopilot.answers.get()
        assert told == command
        if result != IN_PROGRESS:
            return result


def test_what_was_saved_is_flown_on_after_a_restart_until_it_is_forgotten(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            place = tmp_path / "maps"
            one = await members.start(1, flies_on=(1, 2), directory=str(place))
            await one.see(demo.frame(1, 0))
            assert await answered(one, SAVE) == ACCEPTED
            assert (place / SAVED).read_bytes() == MAP
            await until(lambda: (place / NOTE_FILE).exists())
            assert sorted(path.name for path in place.iterdir()) == [NOTE_FILE, SAVED]
            n_landmarks = len(demo.map_index(1, 2).landmark_map.points_world)
            assert f"VCL map saved: {n_landmarks} landmarks" in one.autopilot.said_texts()
            await members.stop(one)

            again = await members.start(1, directory=str(place))
            await computed(lambda: again.events("saved map") == ["begins on the saved map"])
            assert again.revision == revision_of(MAP)
            await again.see(demo.frame(1, 0))
            assert await answered(again, SAVE, 1.0) == ACCEPTED
            assert again.revision == revision_of(MAP)  # it stays until the end
            assert not (place / SAVED).exists()
            assert await answered(again, SAVE, 1.0) == ACCEPTED  # there is none any more
            assert await answered(again, RELOAD) == FAILED
            assert "VCL saved map not taken: there is none" in again.autopilot.said_texts()
            await members.stop(again)

            anew = await members.start(1, directory=str(place))
            await passes(1.0)
            assert anew.revision == b""

    run(scenario())


def test_who_begins_on_a_saved_map_hands_it_to_those_who_have_none(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            (tmp_path / SAVED).write_bytes(MAP)
            one = await members.start(1, directory=str(tmp_path))
            two = await members.start(2)
            await computed(lambda: two.revision == one.revision == revision_of(MAP))

    run(scenario())


def test_a_reload_goes_back_to_the_saved_map_and_looks_for_the_drone_anew(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.fly(1, flies_on=(1, 2), directory=str(tmp_path))
            await one.fly(0)
            assert one.estimator.is_localized(one.clock.now_ns())
            assert await answered(one, SAVE) == ACCEPTED
            one.maps.replace(NEXT, demo.update_index())
            await one.fly(2)
            n_resets = one.estimator.n_resets
            unused = float("nan")
            one.autopilot.forward(RELOAD, unused, unused)
            one.autopilot.forward(RELOAD, unused, unused, confirmation=1)
            one.autopilot.forward(SAVE)
            answers = [await one.autopilot.answers.get() for _ in range(3)]
            assert answers == [
                (RELOAD, IN_PROGRESS, 255), (RELOAD, IN_PROGRESS, 255), (SAVE, BUSY, 255),
            ]  # fmt: skip
            await computed(lambda: not one.autopilot.answers.empty())
            assert one.autopilot.answers.get_nowait() == (RELOAD, ACCEPTED, 255)
            assert one.revision == revision_of(MAP)
            assert not one.estimator.is_localized(one.clock.now_ns())
            assert (tmp_path / SAVED).read_bytes() == MAP
            await one.fly(4)
            assert one.estimator.is_localized(one.clock.now_ns())
            assert one.estimator.n_resets == n_resets + 1  # the autopilot is told of a jump

    run(scenario())


async def gone_on(members: Swarm, path: Path) -> tuple[Drone, Drone]:
    """Start two drones that have saved their first map, and fly on the next revision."""
    drones = []
    for system_id in (1, 2):
        place = path / str(system_id)
        place.mkdir()
        (place / SAVED).write_bytes(MAP)
        drones.append(await members.start(system_id, directory=str(place)))
    one, two = drones
    await computed(lambda: one.revision == two.revision == revision_of(MAP))
    for drone in drones:
        drone.maps.replace(NEXT, demo.update_index())
        await drone.see(demo.frame(drone.system_id, 0))
    await passes(3.0)
    return one, two


def test_drones_that_all_go_back_stay_there(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await gone_on(members, tmp_path)
            assert one.revision == two.revision == revision_of(NEXT)
            done = [asyncio.create_task(answered(drone, RELOAD)) for drone in (one, two)]
            await computed(lambda: all(task.done() for task in done))
            assert [task.result() for task in done] == [ACCEPTED, ACCEPTED]
            for _ in range(60):
                await passes(1.0)
                assert one.revision == two.revision == revision_of(MAP)

    run(scenario())


def test_a_drone_that_goes_back_alone_is_given_the_others_map_again(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = await gone_on(members, tmp_path)
            done = asyncio.create_task(answered(two, RELOAD))
            await computed(done.done)
            assert (done.result(), two.revision) == (ACCEPTED, revision_of(MAP))
            # Not at once: the others may be about to go back as well.
            await passes(25.0)
            assert two.revision == revision_of(MAP)
            await passes_until(lambda: two.revision == revision_of(NEXT), at_most_s=400.0)
            assert one.revision == revision_of(NEXT)

    run(scenario())


def test_nothing_is_saved_before_there_is_a_map(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, directory=str(tmp_path / "maps"))
            await one.see(demo.frame(1, 0))
            assert await answered(one, SAVE) == BUSY
            assert "VCL map not saved: there is none yet" in one.autopilot.said_texts()
            assert list((tmp_path / "maps").iterdir()) == []

    run(scenario())


def test_a_full_disk_is_told_and_leaves_what_was_saved(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            place = tmp_path / "maps"
            place.mkdir()
            (place / SAVED).write_bytes(NEXT)
            (place / "saved.partial").symlink_to("/dev/full")
            one = await members.start(1, flies_on=(1, 2), directory=str(place))
            await computed(lambda: one.revision == revision_of(NEXT))
            await one.see(demo.frame(1, 0))
            assert await answered(one, SAVE) == FAILED
            assert "VCL map not saved: No space left on device" in one.autopilot.said_texts()
            assert (place / SAVED).read_bytes() == NEXT

    run(scenario())


@pytest.mark.parametrize("broken", [b"", b"no map", MAP[:-1], MAP[:200] + b"\xff" + MAP[201:]])
def test_a_broken_file_is_told_and_nobody_flies_on_it(tmp_path: Path, broken: bytes) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            (tmp_path / SAVED).write_bytes(broken)
            one = await members.start(1, directory=str(tmp_path))
            await computed(lambda: bool(one.events("saved map")))
            (why,) = one.events("saved map")
            assert why.startswith("saved map not taken: ")
            assert one.revision == b""
            await one.see(demo.frame(1, 0))
            assert await answered(one, RELOAD) == FAILED
            assert len(one.events("saved map")) == 2

    run(scenario())


def test_a_map_of_another_world_is_not_gone_over_to_in_flight(tmp_path: Path) -> None:
    other = encode_map(decode_map(demo.encoded_map(1, 2, 3)))

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), directory=str(tmp_path))
            await one.see(demo.frame(1, 0))
            (tmp_path / SAVED).write_bytes(other)
            done = asyncio.create_task(answered(one, RELOAD))
            await computed(done.done)
            assert await done == FAILED
            assert one.revision == revision_of(MAP)
            texts = one.autopilot.said_texts()
            assert any("it is of another world than the map in use" in text for text in texts)

    run(scenario())


def test_a_reload_waits_for_no_update_and_an_update_for_no_reload(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), directory=str(tmp_path))
            (tmp_path / SAVED).write_bytes(NEXT)
            one.autopilot.forward(31010)  # there is no frame to make one of
            await until(lambda: not one.autopilot.answers.empty())
            one.autopilot.forward(RELOAD)
            results = {one.autopilot.answers.get_nowait()[0]}
            while results != {31010, RELOAD}:
                command, result, _ = await one.autopilot.answers.get()
                assert result == (BUSY if command == RELOAD else IN_PROGRESS)
                results.add(command)
            assert one.revision == revision_of(MAP)

    run(scenario())
