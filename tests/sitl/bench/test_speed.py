"""``bench speed`` and ``bench realtime``: they run, find right poses, and judge by the goals."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sitl.bench.figures import Figure, Growth, median_and_p95
from sitl.bench.large_maps import Place, large_map, places
from sitl.bench.realtime import figures_of
from sitl.bench.speed import PARTS, bench_speed
from sitl.bench.speed_growth import CostRow, CostTable
from sitl.bench.speed_report import write_speed
from sitl.scenario import load_scenario
from vcl_companion.mapping.uncertainty import map_uncertainty

ROOT = Path(__file__).parents[3]

# Everything that a flight needs, after which no kernel may know more kinds of arguments.
_NOTHING_NEW = """
import gc, cv2
import vcl_companion.daemon.assemble
from numba.core.dispatcher import Dispatcher
from vcl_companion.wire.warm_up import warm_up
warm_up()
kernels = [k for k in gc.get_objects() if isinstance(k, Dispatcher)]
known = {k: len(k.signatures) for k in kernels}
from sitl.bench.speed_extension import extension
from sitl.bench.speed_frames import located, made_ready
from sitl.bench.speed_scene import Scene
from sitl.scenario import load_scenario
cv2.setNumThreads(1)
scene = Scene(load_scenario("demo"))
first = scene.first_map()
ready, shot = made_ready(first), scene.shot(1, 0.6)
assert located(shot, ready, True, None) and located(shot, ready, False, None)
extension(scene, first, [shot], 1)
for k in kernels:
    for signature in k.signatures[known[k]:]:
        if k.py_func.__module__.startswith("vcl_companion"):
            print(k.py_func.__module__, k.py_func.__name__, signature)
"""


def test_a_quick_run_measures_everything_and_finds_right_poses(tmp_path: Path) -> None:
    seen: list[str] = []
    result = bench_speed(tmp_path, PARTS, True, lambda part, done, total: seen.append(part))
    figures = {figure.name: figure for figure in result.figures}
    for name in ("default pipeline, right", "paper pipeline, right", "relocalization, right"):
        assert figures[name].value == 100.0
    assert 400 < figures["landmarks in view"].value < 2000
    assert figures["frames per second, default over paper"].value > 3.0
    assert figures["load beside the extension, p95"].value > 0.0
    assert all(figure.value > 0.0 for figure in result.figures)
    taken = {name: figures[f"memory, 1000 landmarks, {name}"] for name in (
        "tables", "3 revisions", "at most", "before the first map")}  # fmt: skip
    assert taken["tables"].value < taken["3 revisions"].value <= taken["at most"].value < 300.0
    # Of processes begun for that, not of this one.
    assert 80.0 < taken["before the first map"].value < 250.0
    landmarks, images = result.tables
    assert [row.size for row in landmarks.rows] == [200.0, 1000.0]
    assert landmarks.rows[0].in_view < landmarks.rows[1].in_view <= 1000
    assert landmarks.rows[1].right == 1.0
    assert [row.right for row in images.rows] == [1.0, 1.0]
    report = json.loads((tmp_path / "speed.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in report["figures"]] == list(figures)
    assert set(report["tables"][0]["growth"]) == {
        "tracking", "relocalization", "prepare", "memory"}  # fmt: skip
    text = (tmp_path / "speed.md").read_text(encoding="utf-8")
    assert "| default pipeline, frame, median | " in text
    assert "images: 320x240" in seen


def test_nothing_is_compiled_in_flight() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _NOTHING_NEW],
        cwd=ROOT, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_a_figure_is_judged_by_its_goal() -> None:
    at_most = Figure("frame", 6.0, "ms", 6.0)
    assert at_most.met
    assert replace(at_most, value=6.01).met is False
    assert replace(at_most, value=float("nan")).met is False
    assert replace(at_most, value=6.01, at_least=True).met
    assert Figure("frame", 6.0, "ms").met is None
    median, p95 = median_and_p95("frame", [1.0, 2.0, 3.0], (2.0, 2.5))
    assert (median.value, median.met) == (2.0, True)
    assert p95.value == pytest.approx(2.9)
    assert p95.met is False


def test_the_exponent_of_a_power_law_is_found() -> None:
    sizes = (200.0, 1000.0, 5000.0, 100_000.0)
    assert Growth("x", "ms", sizes, tuple(3.0 * s**0.7 for s in sizes)).exponent == pytest.approx(
        0.7, abs=1e-9
    )
    assert Growth("x", "ms", sizes, (2.0,) * 4).exponent == pytest.approx(0.0, abs=1e-9)
    assert np.isnan(Growth("x", "ms", (1.0,), (2.0,)).exponent)


def test_a_missed_goal_is_marked(tmp_path: Path) -> None:
    row = CostRow(200.0, "200", 150.0, (1.0, 2.0, 3.0, 4.0), 0.5)
    table = CostTable("landmarks", "made so", (row, replace(row, size=2000.0)))
    write_speed(tmp_path, [Figure("frame", 7.0, "ms", 6.0)], [table])
    text = (tmp_path / "speed.md").read_text(encoding="utf-8")
    assert "| frame | 7 ms | <= 6 | MISSED |  |" in text
    assert "| growth |  | ^0.00 | ^0.00 | ^0.00 | ^0.00 |  |" in text
    assert "| 200 | 150 | 1 | 2 | 3 | 4 | 50 |" in text


@cache
def two_places() -> list[Place]:
    return list(islice(places(load_scenario("demo")), 2))


def test_a_made_map_hangs_together_and_its_landmarks_are_where_they_are_seen() -> None:
    first = len(two_places()[0].points)
    assert first > 1000
    made = large_map(two_places(), first + 300)
    assert len(made.keyframes) == 4
    assert made.seen.sum(axis=1).tolist() == [2] * len(made.points_world)
    for i, keyframe in enumerate(made.keyframes):
        cam_from_world = (keyframe.world_from_body @ keyframe.body_from_cam).inverse()
        seen = made.seen[:, i]
        shown = keyframe.camera.project(cam_from_world.apply(made.points_world[seen]))
        off = np.linalg.norm(shown - made.observed_px[seen, i], axis=1)
        assert np.median(off) < 0.3
        # Rendered depth is that of a pixel's centre, a feature may lie half a pixel aside.
        assert np.quantile(off, 0.99) < 1.5
    sigma_m = np.sqrt(np.diag(map_uncertainty(made).keyframe_covariance))
    assert np.all(np.isfinite(sigma_m))
    few = large_map(two_places(), 200)
    assert (len(few.points_world), len(few.keyframes)) == (200, 2)


def test_a_daemon_is_judged_by_what_its_report_says() -> None:
    drone = {
        "frames": 200, "localized_share": 0.98, "frames_dropped": 3, "resident_mb": 250.0,
        "latency_ms": {"p50": 9.0, "p95": 14.0, "p99": None}, "cpu_share": 0.4, "ate_m": None,
    }  # fmt: skip
    figures = {figure.name: figure for figure in figures_of(drone)}
    assert (figures["dropped"].value, figures["dropped"].met) == (1.5, False)
    assert (figures["localized"].value, figures["localized"].met) == (98.0, False)
    assert figures["resident, most"].met
    assert figures["arrival to wire, p99"].met is False
    assert figures["share of a core"].value == pytest.approx(40.0)
