"""``sitl paper`` as a person runs it: real daemons, ended in the middle, and gone on with."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 240.0


def command(out: Path) -> list[str]:
    arguments = ["--out", str(out), "--only", "rotate", "--seconds", "0.4"]
    arguments += ["--pipeline", "default"]
    return [sys.executable, "-m", "sitl", "paper", *arguments]


def test_an_interrupted_run_goes_on_where_it_was(tmp_path: Path) -> None:
    """The second flight is ended by Ctrl-C; the next run flies that one only."""
    out = tmp_path / "out put"
    # A test run in the background ignores Ctrl-C; what it starts must not inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        command(out),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        bufsize=1,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as run:
        signal.signal(signal.SIGINT, before)
        try:
            assert run.stdout is not None
            told = []
            for line in iter(run.stdout.readline, ""):
                told.append(line)
                if line.startswith("rotate, default, unfused: making the first map"):
                    break
            run.send_signal(signal.SIGINT)
            _, errors = run.communicate(timeout=TIMEOUT_S)
        finally:
            run.kill()
    assert run.returncode == 130, errors
    assert "the same command goes on from here" in errors
    assert "Traceback" not in errors
    assert any(line.startswith("rotate, default, fused: flown") for line in told)
    assert not (out / "paper.json").exists()

    done = subprocess.run(
        command(out), cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "rotate: recording reused" in done.stdout
    assert "rotate, default, fused: flight reused" in done.stdout
    assert "rotate, default, unfused: flown, " in done.stdout
    assert str(out / "paper.html") in done.stdout.replace("\n", "")

    paper = json.loads((out / "paper.json").read_text())
    assert paper["failures"] == []
    assert paper["whole"] is False
    told_of = paper["pipelines"]["default"]
    # Two images of each drone prove that it runs, and nothing else.
    assert {goal["verdict"] for goal in told_of["must_show"]} == {"not judged"}
    rotate = told_of["experiments"]["rotate"]
    assert rotate["seconds"] == 0.4
    for variant, asks in (("fused", 1), ("unfused", 0)):
        flight = rotate[variant]
        asked = {"inter.every_n_frames": asks}
        assert {k: flight["settings"][k] for k in asked} == asked
        assert set(flight["drones"]) == {"mav0", "mav1", "mav2"}
        for drone in flight["drones"].values():
            assert drone["frames"] == 2
            assert drone["unaccounted"] == drone["frames_dropped"] == 0
            assert drone["localized_share"] == 1.0
            assert drone["rmse_3d_cm"] < 10.0
    assert rotate["unfused"]["drones"]["mav0"]["estimates"]["inter"] == 0
    # It may ask, and does not: nobody is surer of it than it is.
    assert rotate["fused"]["drones"]["mav0"]["estimates"]["inter"] == 0
    assert (out / "paper.html").stat().st_size > 50_000
