"""``python -m sitl bench``: it runs, and what it cannot use is one line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from sitl.__main__ import main
from sitl.bench.cases import grid
from sitl.bench.command import chosen
from sitl.bench.steps import STEPS
from vcl_companion.errors import ConfigError

ROOT = Path(__file__).parents[3]


def test_it_runs_as_a_command(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sitl", "bench", "--quick", "--only", "triangulate",
         "--only", "made", "--out", tmp_path / "new" / "folder"],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    steps = json.loads((tmp_path / "new" / "folder" / "steps.json").read_text(encoding="utf-8"))
    assert {row["step"] for row in steps["results"]} == {
        "relative-made", "resection-made", "triangulate"}  # fmt: skip
    assert done.stdout.splitlines()[0] == "0/3 images and map"
    assert done.stdout.rstrip().endswith("steps.md")
    assert "WRONG" not in done.stdout


def test_robust_runs_and_tells_whether_the_goal_is_met(tmp_path: Path) -> None:
    arguments = ["bench", "robust", "--quick", "--only", "planar-1px", "--out", str(tmp_path)]
    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 0, done.output
    assert "The goal is met in 2 of 2 cells" in done.stdout
    report = json.loads((tmp_path / "robust.json").read_text(encoding="utf-8"))
    assert report["seeds"] == 3
    assert {row["outliers"] for row in report["rows"]} == {0.3}
    again = CliRunner().invoke(main, arguments)
    n = len(report["rows"])
    assert again.stdout.splitlines()[0] == f"{n}/{n} robust"


def test_three_daemons_in_real_time_are_told_of_each(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sitl", "bench", "realtime", "--quick", "--out", tmp_path],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "realtime.json").read_text(encoding="utf-8"))
    assert list(report["daemons"]) == ["mav0", "mav1", "mav2"]
    for figures in report["daemons"].values():
        found = {figure["name"]: figure["value"] for figure in figures}
        assert found["frames"] == 23
        # The report's shares have six decimals.
        assert 90.0 < found["localized"] + found["dropped"] <= 100.0 + 1e-4
        assert 0.0 < found["arrival to wire, p50"] <= found["arrival to wire, p99"]
        # The daemon's own, not the harness's, which holds the rendered town.
        assert 100.0 < found["resident, most"] < 400.0
        assert 0.0 < found["share of a core"] < 300.0
    assert "| resident, most | " in (tmp_path / "realtime.md").read_text(encoding="utf-8")
    assert (tmp_path / "recording-quick" / "recording.toml").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--only", "akaz"], "--only akaz means nothing; there is detect, match, match-map"),
        (["robust", "--only", "steps"], "--only steps means nothing; there is relative-planar-"),
        (["--seeds", "3"], "--seeds is for bench robust"),
        (["speed", "--only", "fps"], "--only fps means nothing; there is frame, extension"),
        (["realtime", "--only", "mav0"], "realtime has no parts"),
        (["--out", __file__], "is a file; give a folder"),
    ],
    ids=["no step", "no cell", "seeds", "no part", "no parts", "file"],
)
def test_what_cannot_be_used_is_one_line(arguments: list[str], says: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["bench", "--out", str(tmp_path), *arguments])
    assert done.exit_code == 2
    assert done.stderr.startswith("sitl: ")
    assert done.stderr.count("\n") == 1
    assert says in done.stderr


@pytest.mark.parametrize("arguments", [["fast"], ["robust", "--seeds", "0"]])
def test_what_click_refuses_is_its_usage(arguments: list[str], tmp_path: Path) -> None:
    done = CliRunner().invoke(main, ["bench", *arguments, "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "Traceback" not in done.output
    assert not any(tmp_path.iterdir())


def test_a_name_means_whatever_has_all_its_pieces() -> None:
    names = [cell.name for cell in grid()]
    assert len(chosen(names, names, [])) == 48
    assert len(chosen(names, names, ["planar-3px"])) == 8
    assert chosen(names, names, ["80-relative-relief-1px"]) == ["relative-relief-1px-80"]
    both = chosen(names, names, ["planar-3px", "3px-80"])
    assert len(both) == 8 + 2
    assert both == [name for name in names if name in both]
    steps = [step.name for step in STEPS]
    assert chosen(steps, steps, ["match"]) == ["match", "match-map"]
    with pytest.raises(ConfigError, match="3 px"):
        chosen(names, names, ["planar", "3 px"])
