"""A service that is killed in the air goes on with its map at once; one on the ground does not."""

from __future__ import annotations

import asyncio
import logging
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.swarm import Flyer, Swarm, swarm
from tests.daemon.waiting import computed, hurry, passes, run, until
from vcl_companion.daemon import map_in_flight
from vcl_companion.daemon.map_in_flight import NOTE_FILE, MapInFlight
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.wire.map_codec import revision_of

MAP, NEXT = demo.encoded_map(1, 2), demo.encoded_update()
ARDUPILOT, ARMED, DISARMED = 3, 128, 0
GOES_ON = "goes on with the map of before"


async def killed(members: Swarm, path: Path) -> None:
    """Have drone 1 fly on a map, and its service killed."""
    drone = await members.fly(1, directory=str(path))
    assert await drone.exchange.go_back_to(MAP) == ""
    await computed(lambda: (path / NOTE_FILE).exists())
    await drone.fly(0)
    assert drone.estimator.is_localized(drone.clock.now_ns())
    await members.stop(drone, dies=True)


async def restarted(members: Swarm, path: Path, mode: int) -> Flyer:
    """Start its service anew, its autopilot in a mode."""
    again = await members.fly(1, directory=str(path))
    again.autopilot.beat(ARDUPILOT, mode, 0)
    return again


def test_a_drone_alone_goes_on_where_its_service_was_killed(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            await killed(members, tmp_path / "maps")
            again = await restarted(members, tmp_path / "maps", ARMED)
            await computed(lambda: again.events("saved map") == [GOES_ON])
            await again.fly(2)
            assert again.estimator.is_localized(again.clock.now_ns())
            assert f"VCL {GOES_ON}" in again.autopilot.said_texts()

    run(scenario())


def test_it_is_given_what_the_others_have_come_to(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            two = await members.start(2, flies_on=(1, 2))
            await killed(members, tmp_path / "maps")
            assert await two.exchange.go_back_to(NEXT) == ""
            again = await restarted(members, tmp_path / "maps", ARMED)
            await computed(lambda: GOES_ON in again.events("saved map"))
            await computed(lambda: again.revision == two.revision == revision_of(NEXT))
            assert again.estimator.n_resets == 0

    run(scenario())


@pytest.mark.parametrize("mode", [DISARMED, None])
def test_on_the_ground_it_begins_anew(tmp_path: Path, mode: int | None) -> None:
    """Or where nobody knows: it may have been carried to somewhere else."""

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            await killed(members, tmp_path / "maps")
            again = await members.fly(1, directory=str(tmp_path / "maps"))
            if mode is not None:
                again.autopilot.beat(ARDUPILOT, mode, 0)
            await passes(5.0)
            assert (again.revision, again.events("saved map")) == (b"", [])

    run(scenario())


def test_what_was_saved_is_begun_with_where_there_is_no_other(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            place = tmp_path / "maps"
            await killed(members, place)
            (place / "saved.vclmap").write_bytes(NEXT)
            again = await restarted(members, place, DISARMED)
            await computed(lambda: again.events("saved map") == ["begins on the saved map"])
            await members.stop(again, dies=True)
            in_the_air = await restarted(members, place, ARMED)
            await computed(lambda: in_the_air.events("saved map") == ["begins on the saved map"])

    run(scenario())


def test_a_map_that_it_dies_of_is_tried_once(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            place = tmp_path / "maps"
            await killed(members, place)
            again = await restarted(members, place, ARMED)
            await computed(lambda: again.events("saved map") == [GOES_ON])
            await passes(5.0)
            assert not (place / NOTE_FILE).exists()
            hurry(10.0)
            await until(lambda: (place / NOTE_FILE).exists())
            await members.stop(again, dies=True)
            proven = await restarted(members, place, ARMED)
            await computed(lambda: proven.events("saved map") == [GOES_ON])
            await members.stop(proven, dies=True)
            at_once = await restarted(members, place, ARMED)
            await passes(5.0)
            assert at_once.revision == b""

    run(scenario())


def test_who_is_asked_to_end_begins_anew(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            place = tmp_path / "maps"
            one = await members.start(1, directory=str(place))
            assert await one.exchange.go_back_to(MAP) == ""
            await until(lambda: (place / NOTE_FILE).exists())
            await members.stop(one)
            assert not (place / NOTE_FILE).exists()

    run(scenario())


def noted(path: Path) -> MapInFlight:
    """One that has noted a map in use, of a service that is no more."""
    maps = MapStore(str(path))

    async def scenario() -> None:
        maps.keep(maps.replace(MAP, demo.map_index(1, 2)))
        with ThreadPoolExecutor(1) as disk:
            noting = asyncio.create_task(MapInFlight(maps, disk).run())
            await until(lambda: (path / NOTE_FILE).exists())
            noting.cancel()

    run(scenario())
    return MapInFlight(MapStore(str(path)), ThreadPoolExecutor(1))


def test_the_map_that_was_in_use_is_found_once(tmp_path: Path) -> None:
    last = noted(tmp_path)
    assert last.left_behind() == MAP
    assert last.left_behind() == b""
    assert MapInFlight(MapStore(""), ThreadPoolExecutor(1)).left_behind() == b""


@pytest.mark.parametrize(("later_s", "is_found"), [(-1, False), (59, True), (60, False)])
def test_a_note_is_good_for_a_minute(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, later_s: int, is_found: bool
) -> None:
    monkeypatch.setattr(map_in_flight, "_now_s", lambda: 1000)
    last = noted(tmp_path)
    monkeypatch.setattr(map_in_flight, "_now_s", lambda: 1000 + later_s)
    assert last.left_behind() == (MAP if is_found else b"")


def test_a_note_of_another_run_of_the_computer_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    last = noted(tmp_path)
    monkeypatch.setattr(map_in_flight, "_boot_id", lambda: "another")
    assert last.left_behind() == b""


@pytest.mark.parametrize(
    "note", [b"", b"\xff" * 4096, b"../../etc/passwd x 1\n", b"0123456789abcdef"]
)
def test_what_is_no_note_says_nothing(tmp_path: Path, note: bytes) -> None:
    last = noted(tmp_path)
    (tmp_path / NOTE_FILE).write_bytes(note)
    assert last.left_behind() == b""


def test_a_map_that_is_not_there_any_more_is_none(tmp_path: Path) -> None:
    last = noted(tmp_path)
    (tmp_path / f"{revision_of(MAP).hex()}.vclmap").unlink()
    assert last.left_behind() == b""


def test_a_folder_that_cannot_be_written_is_told_of_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    maps = MapStore(str(tmp_path))
    in_flight = MapInFlight(maps, ThreadPoolExecutor(1))
    (tmp_path / NOTE_FILE).mkdir()
    with caplog.at_level(logging.ERROR):
        in_flight._write(revision_of(MAP))
        in_flight._write(revision_of(MAP))
    (said,) = caplog.messages
    assert said.startswith("the map in use cannot be noted: ")
    in_flight.ended()
