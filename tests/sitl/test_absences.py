"""Daemons that are late or killed: the options, the camera behind them, and what a report says."""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sitl.absences import (
    Absence,
    Blindness,
    check_absences,
    check_times,
    parse_blind,
    parse_kill,
    parse_late,
)
from sitl.frame_server import FrameServer
from sitl.gathered import gather
from sitl.lives import Life, Lives, log_path, write_lives
from sitl.report import report_of, write_report
from sitl.result import FlightResult
from tests.sitl.flights import PERIOD_NS, START_NS, Flight, leave_behind
from tests.sitl.test_frame_server import png, soon
from vcl_companion.cameras.stream import Answer, encode_answer
from vcl_companion.errors import ConfigError

NAMES = ("mav0", "mav1", "mav2")


def test_who_is_late_and_who_is_killed_on_the_command_line() -> None:
    assert parse_late("mav2=8") == Absence("mav2", 0.0, 8.0)
    assert parse_kill("mav0=12") == Absence("mav0", 12.0, math.inf)
    assert parse_kill(" mav0 = 12.5-20") == Absence("mav0", 12.5, 20.0)
    for said in ("--late mav2=8", "--kill mav0=12", "--kill mav0=12.5-20"):
        option, text = said.split()
        assert str((parse_late if option == "--late" else parse_kill)(text)) == said


def test_whose_camera_dies_on_the_command_line() -> None:
    assert parse_blind("mav0=12") == Blindness("mav0", 12.0, math.inf)
    dead = parse_blind(" mav0 = 12.5-20")
    assert (dead, str(dead)) == (Blindness("mav0", 12.5, 20.0), "--blind mav0=12.5-20")
    seen = [(at_s, dead.has("mav0", at_s)) for at_s in (12.4, 12.5, 19.9, 20.0)]
    assert seen == [(12.4, False), (12.5, True), (19.9, True), (20.0, False)]
    assert not dead.has("mav1", 15.0)
    with pytest.raises(ConfigError, match="--blind mav0=20-12: must end after it has begun"):
        parse_blind("mav0=20-12")
    with pytest.raises(ConfigError, match="--blind mav7=8: 'mav7' does not fly"):
        check_times([parse_blind("mav7=8")], NAMES, 28.4)
    with pytest.raises(ConfigError, match=r"--blind mav0=30: the flight is over after 28\.4 s"):
        check_times([parse_blind("mav0=30")], NAMES, 28.4)


@pytest.mark.parametrize("text", ["", "mav2", "mav2=", "=8", "mav2=0", "mav2=x", "mav2=1.2.3"])
def test_what_is_no_time_says_what_would_be(text: str) -> None:
    with pytest.raises(ConfigError, match=r"--late .*like mav2=8 \(its daemon"):
        parse_late(text)
    with pytest.raises(ConfigError, match=r"--kill .*like mav0=12 \(killed"):
        parse_kill(text)
    with pytest.raises(ConfigError, match=r"--blind .*like mav0=12 \(dead"):
        parse_blind(text)


@pytest.mark.parametrize("text", ["mav2=1-2", "mav2=-3"])
def test_a_late_drone_stays(text: str) -> None:
    with pytest.raises(ConfigError, match="--late"):
        parse_late(text)


def test_a_daemon_is_killed_before_it_is_started_again() -> None:
    with pytest.raises(ConfigError, match="must be started after it is killed"):
        parse_kill("mav0=12-12")


@pytest.mark.parametrize(
    ("absences", "says"),
    [
        (["mav7=8"], "'mav7' does not fly (mav0, mav1, mav2)"),
        (["mav0=30"], "--kill mav0=30: the flight is over after 28.4 s"),
        (["mav0=12-28.4"], "--kill mav0=12-28.4: the flight is over after 28.4 s"),
        (["mav0=12-20", "mav0=15"], "--kill mav0=15: no longer runs then, by --kill mav0=12-20"),
        (["mav0=12", "mav0=15"], "--kill mav0=15: no longer runs then, by --kill mav0=12"),
    ],
)
def test_absences_that_cannot_be_are_one_clear_line(absences: list[str], says: str) -> None:
    with pytest.raises(ConfigError) as raised:
        check_absences([parse_kill(text) for text in absences], NAMES, 28.4)
    assert says in str(raised.value)


def test_somebody_is_there_from_the_start() -> None:
    late = [parse_late(f"{name}=8") for name in NAMES]
    check_absences([*late[:2], parse_kill("mav1=9-12"), parse_kill("mav1=13")], NAMES, 28.4)
    with pytest.raises(ConfigError, match="nobody is there from the start"):
        check_absences(late, NAMES, 28.4)


def test_a_camera_outlives_its_daemon() -> None:
    async def work() -> None:
        server = FrameServer("mav0")
        port = await server.start()
        _, first = await asyncio.open_connection("127.0.0.1", port)
        await server.connected()
        server.give(3, 100, png())
        server.give(4, 200, png())
        first.write(encode_answer(Answer(3, "localized")))
        await first.drain()
        first.close()
        await server.was_killed()
        assert (server.given, server.outcomes) == ([3], {3: "localized"})
        assert not server.is_connected
        await server.answered()
        _, second = await asyncio.open_connection("127.0.0.1", port)
        await server.connected()
        server.give(7, 300, png())
        assert server.unanswered() == [7]
        second.write(encode_answer(Answer(7, "refused")))
        await server.answered()
        assert server.given == [3, 7]
        second.close()
        await server.close()

    soon(work())


def killed_and_late(tmp_path: Path) -> tuple[FlightResult, Path]:
    """A flight in which mav0 was killed at its frame 6, and mav1 came for its frames from 4 on."""
    plan, out = leave_behind(tmp_path, Flight(unlogged=frozenset(("mav1", k) for k in range(4))))
    # The last frame that was logged had not been answered; half of a line follows it.
    run = out / "run" / "mav0"
    lines = (run / "flight.jsonl").read_text().splitlines()
    frames = [n for n, line in enumerate(lines) if json.loads(line)["kind"] == "frame"]
    (run / "flight.jsonl").unlink()
    log_path(run, 0).write_text("\n".join(lines[: frames[6] + 1]) + '\n{"kind": "frame", "seq')
    received = out / "mav1" / "received.jsonl"
    heard = [json.loads(line) for line in received.read_text().splitlines()]
    kept = [line for line in heard if line["fields"].get("usec", 1 << 62) * 1000 >= at(4)]
    received.write_text("".join(json.dumps(line) + "\n" for line in kept))
    received = out / "mav0" / "received.jsonl"
    heard = [json.loads(line) for line in received.read_text().splitlines()]
    kept = [line for line in heard if line["fields"].get("usec", 0) * 1000 <= at(6)]
    received.write_text("".join(json.dumps(line) + "\n" for line in kept))
    run = out / "run" / "mav1" / "flight.jsonl"
    said = run.read_text().replace(f'"at_ns": {START_NS + 3_000_000}', f'"at_ns": {at(5)}')
    run.write_text(said)
    lives = {
        "mav0": Lives([Life(START_NS, START_NS, at(6))], list(range(6))),
        "mav1": Lives([Life(at(2), at(4))], list(range(4, 12))),
    }
    write_lives(out, lives)
    absences = (parse_late("mav1=0.4"), parse_kill("mav0=1.2"))
    options = replace(plan.options, absences=absences)
    return gather(replace(plan, options=options), out), out


def at(k: int) -> int:
    return START_NS + k * PERIOD_NS


def test_frames_count_while_a_daemon_lives(tmp_path: Path) -> None:
    result, _ = killed_and_late(tmp_path)
    report = report_of(result)
    assert [event for event in report["events"] if event["kind"] == "harness"] == []
    for name, n_frames in (("mav0", 6), ("mav1", 8)):
        drone = report["drones"][name]
        assert (drone["frames"], drone["frames_localized"]) == (n_frames, n_frames)
        assert drone["localized_share"] == 1.0
        assert drone["unaccounted"] == 0
    assert report["drones"]["mav0"]["peer_bytes_sent"] is None
    assert report["map"]["landmarks"] == 200  # mav1's, who was there at the end


def test_the_report_says_who_was_late_and_how_soon_it_flew(tmp_path: Path) -> None:
    result, out = killed_and_late(tmp_path)
    report: dict[str, Any] = write_report(result, out, start_s=1.0, flight_s=2.0, late_ms=None)
    assert report["options"]["absences"] == ["--late mav1=0.4", "--kill mav0=1.2"]
    (first,) = report["drones"]["mav0"]["lives"]
    assert (first["started_s"], first["ready_s"], first["killed_s"]) == (0.0, 0.0, 1.2)
    assert first["seconds_to_map"] is None  # the recording waited for it
    (late,) = report["drones"]["mav1"]["lives"]
    assert (late["started_s"], late["ready_s"], late["killed_s"]) == (0.4, 0.8, None)
    assert late["seconds_to_map"] == late["seconds_to_newest_map"] == pytest.approx(0.2)
    assert late["seconds_to_localized"] == pytest.approx(0.003 + 0.024)
    page = (out / "report.html").read_text()
    assert "Lives of the daemons" in page
    assert "--late mav1=0.4, --kill mav0=1.2" in page


def test_a_flight_without_absences_says_nothing_of_them(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    result = gather(plan, out)
    report = write_report(result, out, start_s=1.0, flight_s=2.0, late_ms=None)
    assert report["options"]["absences"] == []
    assert report["drones"]["mav0"]["lives"] == []
    assert "Lives of the daemons" not in (out / "report.html").read_text()
