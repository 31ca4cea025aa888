"""The current map: what those who wait are told, and what is on the disk."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.waiting import run
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.errors import ConfigError
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of

DATA = demo.encoded_map(1, 2)
INDEX = demo.map_index(1, 2)


async def waiter(maps: MapStore) -> asyncio.Task[object]:
    """Somebody who waits for a first map by now."""
    task: asyncio.Task[object] = asyncio.create_task(maps.decided())
    await asyncio.sleep(0)
    assert not task.done()
    return task


def test_who_waits_gets_the_map() -> None:
    async def scenario() -> None:
        maps = MapStore("")
        assert maps.current is None
        waiting = await waiter(maps)
        stored = maps.replace(DATA, INDEX)
        assert await waiting is stored is maps.current is await maps.decided()
        assert stored.revision == revision_of(DATA)
        assert stored.n_landmarks == len(INDEX.landmark_map.points_world)
        maps.keep(stored)

    run(scenario())


def test_a_refusal_is_told_once_and_the_next_attempt_is_waited_for() -> None:
    async def scenario() -> None:
        maps = MapStore("")
        waiting = await waiter(maps)
        maps.refuse("fog")
        assert await waiting is None
        assert maps.refusal == "fog"
        again = await waiter(maps)
        stored = maps.replace(DATA, INDEX)
        assert await again is stored
        assert maps.refusal == ""

    run(scenario())


def test_a_refusal_does_not_touch_a_map_in_use() -> None:
    async def scenario() -> None:
        maps = MapStore("")
        stored = maps.replace(DATA, INDEX)
        maps.refuse("a late round")
        assert (maps.refusal, maps.current) == ("", stored)
        assert await maps.decided() is stored

    run(scenario())


def test_every_revision_is_kept_whole(tmp_path: Path) -> None:
    directory = tmp_path / "deep" / "maps"
    maps = MapStore(str(directory))
    other = encode_map(decode_map(demo.encoded_map(1, 2, 3)))
    for data, index in ((DATA, INDEX), (other, demo.map_index(1, 2, 3))):
        maps.keep(maps.replace(data, index))
    names = {f"{revision_of(data).hex()}.vclmap" for data in (DATA, other)}
    assert {path.name for path in directory.iterdir()} == names
    assert (directory / f"{revision_of(DATA).hex()}.vclmap").read_bytes() == DATA


def test_the_oldest_revisions_go_when_there_is_no_room_for_them(tmp_path: Path) -> None:
    maps = MapStore(str(tmp_path), kept_bytes=2 * len(DATA))
    old = [tmp_path / f"{k:016x}.vclmap" for k in range(3)]
    others = [tmp_path / name for name in ("saved.vclmap", "mine.vclmap", "0123.vclmap")]
    for k, path in enumerate((*old, *others)):
        path.write_bytes(bytes(len(DATA) // 2))
        os.utime(path, ns=(k, k))
    maps.keep(maps.replace(DATA, INDEX))
    left = {old[1], old[2], *others, tmp_path / f"{revision_of(DATA).hex()}.vclmap"}
    assert set(tmp_path.iterdir()) == left


def test_what_this_flight_wrote_is_newest_whatever_the_clock_says(tmp_path: Path) -> None:
    maps = MapStore(str(tmp_path), kept_bytes=2 * len(DATA))
    tomorrow = tmp_path / f"{1:016x}.vclmap"
    tomorrow.write_bytes(DATA)
    os.utime(tomorrow, ns=(1 << 62, 1 << 62))
    other = encode_map(decode_map(demo.encoded_map(1, 2, 3)))
    stored = [
        maps.replace(data, index)
        for data, index in ((other, demo.map_index(1, 2, 3)), (DATA, INDEX))
    ]
    for one in stored:
        maps.keep(one)
        assert (tmp_path / f"{one.revision.hex()}.vclmap").exists()
    assert not tomorrow.exists()


def test_the_newest_revision_stays_however_large_it_is(tmp_path: Path) -> None:
    maps = MapStore(str(tmp_path), kept_bytes=1)
    maps.keep(maps.replace(DATA, INDEX))
    assert [path.name for path in tmp_path.iterdir()] == [f"{revision_of(DATA).hex()}.vclmap"]


def test_a_full_disk_leaves_no_half_map_and_the_flight_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    maps = MapStore(str(tmp_path))
    # Where it will write first: a device that is always full.
    (tmp_path / f"{revision_of(DATA).hex()}.partial").symlink_to("/dev/full")
    stored = maps.replace(DATA, INDEX)
    maps.keep(stored)
    assert maps.current is stored
    assert list(tmp_path.iterdir()) == []
    assert "No space left on device" in caplog.text


@pytest.mark.parametrize("directory", ["/proc", "/proc/maps", "/dev/null/maps", "nul\0byte"])
def test_a_directory_that_takes_no_file_is_a_wrong_configuration(directory: str) -> None:
    with pytest.raises(ConfigError, match=r"^\[map\] directory '.*': \w") as raised:
        MapStore(directory)
    assert "\n" not in str(raised.value)
