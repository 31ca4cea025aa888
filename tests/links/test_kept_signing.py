"""Key files and the timestamps that outlive a process, on a real disk."""

import asyncio
import hashlib
import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.links import signed
from tests.links.running import running
from tests.links.signed import NOON, NOON_S, Clocks
from vcl_companion.errors import ConfigError
from vcl_companion.links.kept_signing import KeptSigning
from vcl_companion.links.key_file import install_key_file, make_key_file, read_key_file
from vcl_companion.links.signing import SigningOptions
from vcl_companion.links.timestamp_file import TimestampFile, Timestamps

S = 100_000  # ticks
STREAM = (2, 197, 0)


def kept(folder: Path, clocks: Clocks) -> KeptSigning:
    key = folder / "swarm.key"
    if not key.exists():
        signed.key_file(key)
    return KeptSigning(str(key), str(folder / "state" / "x.json"), SigningOptions(), clocks.now)


def test_a_drone_without_a_clock_goes_on_above_all_that_it_has_signed(tmp_path: Path) -> None:
    clocks = Clocks()
    before = kept(tmp_path, clocks)
    last = before.signing.time.next(clocks.pass_s(4.9))
    # Power is cut, and the clock starts in 1970.
    after = kept(tmp_path, Clocks(wall_s=20.0))
    first = after.signing.time.next(Clocks(wall_s=20.0).now())
    assert last < first < last + 10 * S
    again = kept(tmp_path, Clocks(wall_s=20.0))
    assert again.signing.time.next(Clocks(wall_s=20.0).now()) > first


def test_the_file_stays_ahead_and_takes_along_what_was_heard(tmp_path: Path) -> None:
    async def scenario() -> None:
        clocks = Clocks()
        flying = kept(tmp_path, clocks)
        file = TimestampFile(tmp_path / "state" / "x.json")
        assert file.read() == Timestamps(NOON + 10 * S, {})
        async with running(flying.run()):
            assert flying.signing.refusal(signed_by_key_file(NOON), clocks.now()) is None
            clocks.pass_s(5.5)
            while file.read().reserved == NOON + 10 * S:
                await asyncio.sleep(0.01)
            assert file.read() == Timestamps(NOON + round(15.5 * S), {STREAM: NOON})
            # The swarm's time jumps: the file follows at once, not seconds later.
            clocks.wall_s += 3600.0
            while file.read().reserved < NOON + 3600 * S:
                await asyncio.sleep(0.01)
            clocks.pass_s(3.0)
        # A clean end leaves nothing reserved that is of no use.
        assert file.read().reserved == NOON + round((3600 + 5.5 + 3.0 + 1.0) * S)

    asyncio.run(scenario())


def signed_by_key_file(timestamp: int) -> bytes:
    return signed.frame(timestamp, secret=hashlib.sha256(b"0f" * 32).digest())


def test_what_was_heard_is_refused_after_a_restart(tmp_path: Path) -> None:
    clocks = Clocks()
    recorded = signed_by_key_file(NOON)
    first = kept(tmp_path, clocks)
    assert first.signing.refusal(recorded, clocks.now()) is None

    async def ends() -> None:
        async with running(first.run()):
            await asyncio.sleep(0)

    asyncio.run(ends())
    second = kept(tmp_path, clocks)
    assert second.signing.refusal(recorded, clocks.now()) == "replayed"


def test_a_disk_that_fails_does_not_end_the_flight(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        clocks = Clocks()
        flying = kept(tmp_path, clocks)
        (tmp_path / "state" / "x.json").unlink()
        (tmp_path / "state").rmdir()
        async with running(flying.run()):
            clocks.pass_s(6.0)
            while not caplog.records:
                await asyncio.sleep(0.01)
            assert flying.signing.time.next(clocks.now()) == NOON + 6 * S

    asyncio.run(scenario())
    assert [r.getMessage() for r in caplog.records] == [
        "timestamps of signed frames cannot be kept: No such file or directory"
    ]


def test_a_disk_that_is_full_keeps_no_restart_from_flying_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    last = kept(tmp_path, Clocks()).signing.time.next(Clocks().now())
    (tmp_path / "state" / ".x.json.partial").symlink_to("/dev/full")
    again = kept(tmp_path, Clocks())
    assert again.signing.time.next(Clocks().now()) > last
    assert "No space left on device" in caplog.text


def test_a_folder_that_cannot_be_written_is_told_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file")
    with pytest.raises(ConfigError, match=r"x\.json: "):
        kept(tmp_path, Clocks())
    (tmp_path / "state").unlink()
    (tmp_path / "state" / "x.json").mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"x\.json: Is a directory"):
        kept(tmp_path, Clocks())


def broken_texts() -> st.SearchStrategy[bytes]:
    good = json.dumps({"reserved": NOON, "streams": [[2, 197, 0, NOON]]}).encode()
    cut = st.integers(0, len(good) - 1).map(lambda n: good[:n])
    values = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
    shaped = st.fixed_dictionaries({"reserved": values, "streams": values})
    return st.binary() | cut | (values | shaped).map(lambda v: json.dumps(v).encode())


@given(broken_texts())
def test_a_broken_file_is_as_good_as_none(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "broken.json"
    path.write_bytes(data)
    read = TimestampFile(path).read()
    assert 0 <= read.reserved < 2**48
    assert all(0 <= at < 2**48 for at in read.streams.values())


@given(
    st.integers(0, 2**48 - 1),
    st.dictionaries(st.tuples(*[st.integers(0, 255)] * 3), st.integers(0, 2**48 - 1)),
)
def test_timestamps_come_back_as_they_went(
    tmp_path_factory: pytest.TempPathFactory,
    reserved: int,
    streams: dict[tuple[int, int, int], int],
) -> None:
    file = TimestampFile(tmp_path_factory.getbasetemp() / "timestamps.json")
    assert file.write(Timestamps(reserved, streams)) == ""
    assert file.read() == Timestamps(reserved, streams)


def test_a_new_key_is_its_owner_s_alone_and_no_other_is_like_it(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        one, two = (make_key_file(tmp_path / name) for name in ("one", "two"))
    finally:
        os.umask(old)
    assert (tmp_path / "one").stat().st_mode & 0o777 == 0o600
    assert one.fingerprint != two.fingerprint
    assert read_key_file(tmp_path / "one").fingerprint == one.fingerprint
    text = (tmp_path / "one").read_text()
    assert len(bytes.fromhex(text.strip())) == 32
    with pytest.raises(ConfigError, match="is there already"):
        make_key_file(tmp_path / "one")
    assert (tmp_path / "one").read_text() == text


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o620, 0o602, 0o666, 0o601])
def test_a_key_that_others_can_read_or_change_is_refused(tmp_path: Path, mode: int) -> None:
    path = signed.key_file(tmp_path / "key")
    path.chmod(mode)
    with pytest.raises(ConfigError, match=rf"others can read or change.*mode {mode:o}.*chmod 600"):
        read_key_file(path)


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o640, 0o440])
def test_a_key_of_its_owner_and_its_group_is_taken(tmp_path: Path, mode: int) -> None:
    path = signed.key_file(tmp_path / "key")
    path.chmod(mode)
    assert len(read_key_file(path).fingerprint) == 16


@pytest.mark.parametrize(
    "text", ["", "0f" * 31, "0f" * 33, "0g" * 32, "0f" * 32 + "\n" + "0f" * 32, "x" * 5000, "\xff"]
)
def test_what_is_no_key_is_refused_without_showing_it(tmp_path: Path, text: str) -> None:
    path = signed.key_file(tmp_path / "key")
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError) as wrong:
        read_key_file(path)
    assert str(wrong.value) == f"{path}: is no key file; `vcl keys new` makes one"


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for name, why in (("pipe", "is no file"), ("none", "No such file"), ("", "Is a directory")):
        with pytest.raises(ConfigError, match=why):
            read_key_file(tmp_path / name)


def test_an_installed_key_is_for_who_reads_the_configuration(tmp_path: Path) -> None:
    source, target = signed.key_file(tmp_path / "key"), tmp_path / "installed"
    config = tmp_path / "drone.toml"
    config.write_text("")
    for config_mode, mode in ((0o600, 0o600), (0o640, 0o640), (0o644, 0o600)):
        config.chmod(config_mode)
        installed = install_key_file(source, target, like=config)
        assert installed.fingerprint == read_key_file(target).fingerprint
        assert target.stat().st_mode & 0o777 == mode
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drone.toml", "installed", "key"]
    with pytest.raises(ConfigError, match="cannot be installed"):
        install_key_file(source, tmp_path / "nowhere" / "key")


def test_a_clock_that_is_right_needs_no_memory(tmp_path: Path) -> None:
    key = signed.key_file(tmp_path / "key")
    clocks = Clocks(wall_s=NOON_S)
    ours = KeptSigning(str(key), "", SigningOptions(), clocks.now)
    assert ours.signing.time.next(clocks.now()) == NOON
    asyncio.run(ours.run())
    assert [p.name for p in tmp_path.iterdir()] == ["key"]
