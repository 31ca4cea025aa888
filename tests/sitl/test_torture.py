"""``python -m sitl torture``: what hostile peers send harms nothing, and it would be seen."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sitl.__main__ import main
from sitl.counted_loop import CountedLoop
from sitl.torture.command import torture, torture_once_more
from sitl.torture.dice import Dice
from sitl.torture.frames import COMPANION, frame, hostile, tunnel
from sitl.torture.mutations import mutated
from sitl.torture.report import MOST_GROWTH_BYTES, TortureOptions, grown_bytes, is_good, report_of
from sitl.torture.session import Failure, SessionResult
from vcl_companion.daemon.workshop import Workshop
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.wire import frame_codec
from vcl_companion.wire.pose_codec import take_image
from vcl_companion.wire.reader import Reader

QUICK = TortureOptions(payloads=4_000, seed=3, processes=1, session=4_000)


def run(out: Path, options: TortureOptions) -> dict[str, Any]:
    return torture(out, options, lambda done, total: None)


def test_tens_of_thousands_of_payloads_harm_nothing_and_reach_everything(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    options = TortureOptions(payloads=24_000, seed=0, processes=1, session=8_000)
    report = torture(tmp_path, options, lambda *step: seen.append(step))
    assert report["failures_by_kind"] == []
    assert is_good(report)
    assert seen == [(8_000, 24_000), (16_000, 24_000), (24_000, 24_000)]
    assert report == json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert list((tmp_path / "failures").iterdir()) == []
    outcomes = report["outcomes"]
    for message in (
        "Chunk", "TransferStatus", "FrameRequest", "MapState", "MapRefused", "PoseProposal",
        "PoseRefused",
    ):  # fmt: skip
        assert outcomes[f"accepted: {message}"] > 50
    for kind in ("frame answer", "passed frame", "pose request", "map", "map update"):
        for became in ("accepted", "refused"):
            assert any(outcome.startswith(f"{kind} {became}") for outcome in outcomes), kind
    for outcome in (
        "link: wrong checksum", "link: tunnel length is a lie", "link: not a member",
        "link: garbage bytes", "exchange: payload", "exchange: frame", "exchange: map",
        "exchange: passed frame", "exchange: pose request", "exchange: pose nobody asked for",
        "drone: another map is in use", "drone: pose of a peer: fused",
    ):  # fmt: skip
        assert outcomes[outcome] > 0


def test_a_fault_in_a_decoder_is_found_and_can_be_had_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def faulty(reader: Reader) -> bytes:
        image_bytes = take_image(reader)
        if image_bytes[-1] == 0:
            raise KeyError("planted")
        return image_bytes

    monkeypatch.setattr(frame_codec, "take_image", faulty)
    report = run(tmp_path / "all", QUICK)
    assert not is_good(report)
    (index, *_) = {kind["first_index"] for kind in report["failures_by_kind"]}
    assert all("KeyError: 'planted'" in kind["what"] for kind in report["failures_by_kind"])
    text = (tmp_path / "all" / "failures" / f"{index}.txt").read_text(encoding="utf-8")
    assert "take_frame_body" in text

    failures = torture_once_more(tmp_path / "one", QUICK, index)
    assert {failure.index for failure in failures} == {index}
    for suffix in ("bin", "blob"):
        name = f"failures/{index}.{suffix}"
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "all" / name).read_bytes()
    assert torture_once_more(tmp_path / "before", QUICK, index - 1) == []

    monkeypatch.undo()
    assert torture_once_more(tmp_path / "mended", QUICK, index) == []


def test_a_fault_behind_the_event_loop_is_found_though_a_net_holds_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def faulty(*_: object) -> None:
        raise ZeroDivisionError("planted")

    monkeypatch.setattr(Workshop, "look_at", faulty)
    report = run(tmp_path, QUICK)
    assert report["failures"] > 0
    whats = [kind["what"] for kind in report["failures_by_kind"]]
    assert whats
    assert all(what.startswith("ZeroDivisionError: planted") for what in whats)


def test_a_part_of_the_daemon_that_ends_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vcl_companion.swarm.transfer.Transfers.poll", lambda self, now_s: 1 // 0)
    report = run(tmp_path, TortureOptions(50, seed=1, processes=1))
    assert report["failures"] > 1  # another drone takes its place, and the next payloads
    assert report["payloads"] == 50


def test_two_processes_do_the_same_as_one(tmp_path: Path) -> None:
    one, two = (
        run(tmp_path / str(n), TortureOptions(1_500, seed=2, processes=n, session=500))
        for n in (1, 2)
    )
    assert one["outcomes"] == two["outcomes"]
    assert one["processes"] == 1
    assert two["payloads"] == 1_500


def test_the_command_says_how_it_went(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = ["torture", "--payloads", "600", "--processes", "1", "--out", str(tmp_path)]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "nothing failed" in done.stdout
    assert "10 million take" in done.stdout
    again = CliRunner().invoke(main, [*arguments, "--only", "20"])
    assert again.exit_code == 0
    assert "payload 20 does not fail" in again.stdout

    def faulty(*_: object) -> None:
        raise KeyError("planted")

    monkeypatch.setattr("sitl.torture.judging.decode_payload", faulty)
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 1
    assert "--seed 0 --session 20000 --only" in done.stdout
    index = done.stdout.split("--only ")[1].split()[0]
    again = CliRunner().invoke(main, [*arguments, "--only", index])
    assert again.exit_code == 1
    assert "KeyError: 'planted'" in again.stdout


@pytest.mark.parametrize("arguments", [["--out", __file__], ["--payloads", "0"], ["--only", "-1"]])
def test_what_cannot_be_used_is_said(arguments: list[str], tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["torture", "--out", str(tmp_path), *arguments])
    assert done.exit_code == 2
    assert "Traceback" not in done.output


def test_our_frames_are_those_of_the_codec() -> None:
    rng = np.random.default_rng(0)
    for n in (1, 5, 127, 128):
        payload = rng.bytes(n - 1) + b"\x01"
        theirs = Codec(3, COMPANION, LinkTally()).tunnel(2, 33100, payload)
        assert tunnel((33100, payload), 3, 2) == theirs
    codec = Codec(2, COMPANION, LinkTally())
    (heartbeat,) = codec.decode_datagram(frame(0, bytes(9), 4))
    assert heartbeat.sender_system == 4


def test_mutations_are_wrong_in_many_ways_and_the_same_for_the_same_seed() -> None:
    data, other = bytes(range(1, 129)), bytes(128)
    once, twice = (
        [mutated(data, dice, other) for _ in range(500)]
        for dice in (Dice(np.random.default_rng(1)), Dice(np.random.default_rng(1)))
    )
    assert once == twice
    assert len(set(once)) > 400
    assert sum(m == data for m in once) < 25
    assert {len(m) for m in once} >= {0, 127, 128, 129}
    datagrams = {hostile((33101, data), 1, 2, Dice(np.random.default_rng(k))) for k in range(200)}
    assert len(datagrams) > 100


def test_time_passes_when_it_is_said_to_and_work_is_done_at_once() -> None:
    loop = CountedLoop()

    async def scenario() -> list[float]:
        began_s, told = loop.time(), []
        sleeper = asyncio.ensure_future(asyncio.sleep(100.0))
        await asyncio.sleep(0)  # it begins
        told.append(await loop.run_in_executor(None, lambda: 7.0))
        with pytest.raises(ZeroDivisionError):
            await loop.run_in_executor(None, lambda: 1 // 0)
        told.append(loop.time() - began_s)
        loop.now_s += 100.0
        await asyncio.sleep(0)
        await sleeper
        told.append(loop.time() - began_s)
        return told

    try:
        assert loop.run_until_complete(scenario()) == [7.0, 0.0, 100.0]
    finally:
        loop.close()


def test_growth_is_what_a_process_keeps_beyond_its_first_session() -> None:
    def session(number: int, pid: int, turn: int, mib: int) -> SessionResult:
        return SessionResult(number, pid=pid, turn=turn, kept_bytes=mib << 20, payloads=1)

    first = [session(0, 1, 0, 100), session(1, 2, 0, 150)]
    assert grown_bytes(first) is None
    more = [*first, session(2, 1, 1, 120), session(3, 2, 1, 140), session(4, 1, 2, 110)]
    assert grown_bytes(more) == 20 << 20
    assert is_good(report_of(QUICK, more, 1.0))
    too_much = [*more, session(5, 2, 2, 151 + (MOST_GROWTH_BYTES >> 20))]
    assert not is_good(report_of(QUICK, too_much, 1.0))
    failed = SessionResult(6, 1, failures=[Failure(7, "x", "", b"")], n_failures=1)
    assert not is_good(report_of(QUICK, [*more, failed], 1.0))
