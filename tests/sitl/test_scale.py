"""``python -m sitl scale``: the same figures every time, and a group's costs stay what they are."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from click.testing import CliRunner

from sitl.__main__ import main
from sitl.counted_loop import SkippingLoop
from sitl.scale.command import ScaleOptions, parse_drones, scale
from sitl.scale.meter import Meter, MeteredLoop, metered
from sitl.scale.swarm import Phase, ScaleTimes, run_swarm
from vcl_companion.errors import ConfigError

TIMES = ScaleTimes(start_s=5.0, settle_s=10.0, rest_s=16.0)
PHASES = ["start", "rest", "first map", "update", "rest, mapped"]


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Two and five drones that lose a tenth."""
    out = tmp_path_factory.mktemp("scale")
    told: list[str] = []
    report = scale(out, ScaleOptions((5, 2), loss=0.1, times=TIMES), told.append)
    assert told[0] == "2 drones: start"
    assert told[-1] == "5 drones: rest, mapped"
    return report, out


def phase(report: dict[str, Any], n_drones: int, name: str) -> dict[str, Any]:
    (swarm,) = (s for s in report["swarms"] if s["drones"] == n_drones)
    (found,) = (p for p in swarm["phases"] if p["name"] == name)
    assert isinstance(found, dict)
    return found


def test_everybody_holds_the_map_and_its_update(measured: tuple[dict[str, Any], Path]) -> None:
    report, out = measured
    assert report == json.loads((out / "scale.json").read_text(encoding="utf-8"))
    for swarm in report["swarms"]:
        assert [p["name"] for p in swarm["phases"]] == PHASES
        assert 0.0 < swarm["all_known_s"] < 5.0
        assert swarm["dropped_share"] == 0.0
        for name in ("first map", "update"):
            handed = phase(report, swarm["drones"], name)
            assert 0.0 < handed["held_by_half_s"] <= handed["held_by_all_s"] < 2.0
            # More than a tenth is lost by somebody, and nothing like all of it sent twice.
            sent = handed["sent_bytes_per_s"]["coordinator"] * handed["seconds"]
            assert 1.1 * handed["blob_bytes"] < sent < 4.0 * handed["blob_bytes"] + 3000.0


def test_a_map_is_handed_out_by_the_coordinator_only(
    measured: tuple[dict[str, Any], Path],
) -> None:
    """Also when its word that it has it, which is said once, is lost to one who was handed it."""
    handed = phase(measured[0], 5, "first map")
    sent = handed["sent_bytes_per_s"]
    assert sent["most"] == sent["coordinator"]
    assert 5 * sent["mean"] - sent["coordinator"] < 4 * 400.0


def test_a_group_at_rest_says_little_however_many(measured: tuple[dict[str, Any], Path]) -> None:
    for n_drones in (2, 5):
        rest = phase(measured[0], n_drones, "rest")
        assert 60.0 < rest["sent_bytes_per_s"]["most"] < 200.0
        assert set(rest["by_message"]) == {"heartbeat", "map state", "timesync"}
        # Everybody hears what all others send, less a tenth.
        heard = rest["heard_bytes_per_s"] / ((n_drones - 1) * rest["sent_bytes_per_s"]["mean"])
        assert 0.8 < heard < 1.0
        assert 0.0 < rest["cpu_share"]["mean"] <= rest["cpu_share"]["most"]


def test_of_many_nobody_hears_more_than_of_some() -> None:
    """At full pace the signs of life of 16, and no more however many there are."""
    times = ScaleTimes(3.0, 8.0, 12.0)
    some, many = (run_swarm(n_drones, 0.1, 3, times, lambda _: None) for n_drones in (22, 44))
    for at_rest in (1, -1):
        of_some, of_many = some.phases[at_rest], many.phases[at_rest]
        assert max(of_many.heard_bytes) < 1.5 * max(of_some.heard_bytes)
        # Who coordinates shows itself every second.
        assert max(of_many.sent_bytes) == of_many.sent_bytes[0] > 1.5 * min(of_many.sent_bytes)
    # Who come are at full pace until they know each other.
    assert many.known_s < 10.0
    assert many.phases[1].by_message["heartbeat"].messages <= 43 * 4 + 13


def test_who_join_at_one_time_are_told_together() -> None:
    """A state each second, and a few more for those who have joined: not one for each of them."""
    start, *_ = run_swarm(12, 0.0, 1, ScaleTimes(4.0, 0.1, 0.1), lambda _: None).phases
    assert start.by_message["map state"].messages < 12 * (4 + 7)
    # Two questions in half a second, and their answers.
    assert start.by_message["timesync"].messages <= 12 * 2 * 4 * 4


def test_the_figures_are_the_same_every_time() -> None:
    def figures() -> list[object]:
        result = run_swarm(3, 0.2, 7, ScaleTimes(3.0, 2.0, 3.0), lambda _: None)
        assert [p.name for p in result.phases] == PHASES
        return [result.known_s, result.refused, *map(but_for_the_processor, result.phases)]

    assert figures() == figures()


def but_for_the_processor(of: Phase) -> tuple[object, ...]:
    return of.seconds, of.sent_bytes, of.heard_bytes, of.by_message, of.held_s, of.blob_bytes


def test_a_page_and_a_plot_show_them(measured: tuple[dict[str, Any], Path]) -> None:
    _, out = measured
    text = (out / "scale.md").read_text(encoding="utf-8")
    assert text.count("\n| 2 |") == text.count("\n| 5 |") == 5
    assert "| rest |" in text
    # A file of its own has to be XML, which a page that holds it need not be.
    picture = ElementTree.parse(out / "scale.svg").getroot()
    assert picture.tag == "{http://www.w3.org/2000/svg}svg"


def test_the_command_shows_a_table(tmp_path: Path) -> None:
    args = ["scale", "--drones", "2", "--loss", "0", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, args)
    assert result.exit_code == 0, result.output
    assert "first map" in result.output
    assert (tmp_path / "out" / "scale.json").is_file()


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--drones", "2,x"], "no list of numbers"),
        (["--drones", "1"], "1 is not 2 to 250"),
        (["--drones", "5,5"], "different numbers"),
        (["--loss", "1"], "--loss must be"),
    ],
)
def test_what_cannot_be_used_is_one_line(args: list[str], said: str, tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["scale", *args, "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert said in result.output
    assert result.output.count("\n") == 1


def test_a_folder_that_is_a_file_is_told(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("", encoding="utf-8")
    with pytest.raises(ConfigError, match="is a file"):
        scale(tmp_path / "out", ScaleOptions((2,), times=TIMES), lambda _: None)


def test_drones_are_read() -> None:
    assert parse_drones("2,30") == (2, 30)


def test_time_is_skipped_and_counted_for_whom_it_is_spent() -> None:
    async def works(seconds: float) -> float:
        began_s = asyncio.get_running_loop().time()
        for _ in range(5):
            sum(range(100_000))
            await asyncio.sleep(seconds)
        return asyncio.get_running_loop().time() - began_s

    loop, one, other = MeteredLoop(), Meter(), Meter()
    try:
        task = loop.create_task(works(1000.0), context=metered(one))
        idle = loop.create_task(works(3.0))
        assert loop.run_until_complete(task) == pytest.approx(5000.0)
        assert loop.run_until_complete(idle) == pytest.approx(15.0)
    finally:
        loop.close()
    assert one.spent_s > 0.0
    assert other.spent_s == 0.0


def test_who_waits_for_nobody_is_told() -> None:
    loop = SkippingLoop()
    try:
        with pytest.raises(RuntimeError, match="nobody is to be woken"):
            loop.run_until_complete(loop.create_future())
    finally:
        loop.close()
