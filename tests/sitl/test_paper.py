"""The paper's experiments: numbers from flights with known errors, and what is kept between runs.

No flight here but where a test says so; ``tests/sitl/flights.py`` leaves them behind.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sitl import paper_fingerprint
from sitl.__main__ import main
from sitl.evaluation import upper_from_covariance
from sitl.gathered import gather
from sitl.goals import Goal
from sitl.paper import PaperResult, paper_json
from sitl.paper_estimates import by_source
from sitl.paper_experiments import (
    EXPERIMENTS,
    NOT_FUSED,
    PIPELINES,
    TABLE_I,
    Experiment,
    Pipeline,
    pipelines_named,
    settings_of,
)
from sitl.paper_figures import rotate_svg, sparse_svg
from sitl.paper_flight_figures import axis_errors_svg, footprints, trajectories_svg, urban_svg
from sitl.paper_flights import PaperFlight, flown
from sitl.paper_goals import goals
from sitl.paper_measures import compared, flight_measures, path_length_m
from sitl.paper_page import page
from sitl.paper_recordings import Rendered, rendered
from sitl.plan import FlyOptions, Setting, pipeline_of
from sitl.processes import FlightError
from sitl.report import report_of
from sitl.scenario import Scenario, load_scenario
from tests.sitl.flights import NED_FROM_WORLD, ErrorOf, Flight, at_ns, leave_behind, ned_from_body
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, euler_from_matrix, matrix_from_euler

EXPERIMENT = {experiment.name: experiment for experiment in EXPERIMENTS}
PIPELINE = PIPELINES[0]
N_FRAMES = 12


def off_by(x_cm: float, yaw_deg: float = 0.0, sign: int = 1) -> ErrorOf:
    """The leader is exact; the others are off along the world's x and in heading."""
    error = np.array([x_cm / 100.0, 0.0, 0.0, 0.0, 0.0, np.deg2rad(yaw_deg)])
    return lambda drone, frame: (
        np.zeros(6) if drone == "mav0" else error * (sign if frame % 2 else 1)
    )


def left_behind(
    folder: Path, name: str, fused: bool, flight: Flight, rows: list[dict[str, Any]] | None = None
) -> PaperFlight:
    """Write a flight with estimate rows in mav1's log and read it as the command does."""
    folder.mkdir(parents=True)
    plan, out = leave_behind(folder, flight)
    for drone in plan.drones:
        log = out / "run" / drone.name / "flight.jsonl"
        kept = [line for line in log.read_text().splitlines() if '"estimate"' not in line]
        added = [json.dumps(row) for row in rows or []] if drone.name == "mav1" else []
        log.write_text("\n".join([*kept, *added]) + "\n")
    result = gather(plan, out)
    report = report_of(result)
    (out / "report.json").write_text(json.dumps(report))
    read = {drone.name: by_source(result, drone) for drone in result.drones}
    estimates = {name: told for name, told in read.items() if told is not None}
    return PaperFlight(EXPERIMENT[name], PIPELINE, fused, out, result, report, estimates)


def estimate(
    frame: int, error: Array, sigma: float, *, host: int | None = None, fused: bool = True
) -> dict[str, Any]:
    """A line of mav1's log as the daemon writes it; ``error`` as MAVLink puts it."""
    truth = NED_FROM_WORLD.inverse() @ ned_from_body(1, frame)
    roll, pitch, yaw = np.add(euler_from_matrix(truth.rotation), error[3:])
    pose = Pose(matrix_from_euler(roll, pitch, yaw), truth.translation + error[:3])
    return {
        "kind": "estimate",
        "captured_at_ns": at_ns(1, frame),
        "source": "intra" if host is None else "inter",
        "host": host,
        "position": pose.translation.tolist(),
        "quaternion": pose.quaternion().tolist(),
        "covariance": upper_from_covariance(np.eye(6) * sigma**2).tolist(),
        "fused": fused,
        "reason": None if fused else "far off",
    }


def told_of(rows: list[Goal], what: str) -> Goal:
    return next(row for row in rows if what in row.what)


def test_errors_are_those_that_were_put_in(tmp_path: Path) -> None:
    flight = Flight(error=off_by(30.0, 0.4), refused=frozenset({("mav1", 3)}))
    measured = flight_measures(left_behind(tmp_path / "a", "forward_back", True, flight))
    mav1 = measured["drones"]["mav1"]
    # The world lies turned by 1.1 rad in the recording: its x is cos, sin of ours.
    assert mav1["rmse_cm"]["x"] == pytest.approx(30.0 * math.cos(1.1), abs=0.01)
    assert mav1["rmse_cm"]["y"] == pytest.approx(30.0 * math.sin(1.1), abs=0.01)
    assert mav1["rmse_cm"]["z"] == pytest.approx(0.0, abs=0.01)
    assert mav1["rmse_3d_cm"] == pytest.approx(30.0, abs=0.01)
    assert mav1["yaw_rmse_deg"] == pytest.approx(0.4, abs=0.001)
    assert mav1["localized_share"] == pytest.approx(11 / 12)
    assert mav1["after_first_map"] == {"frames": 12, "localized": 11, "refused_with_reason": 1}
    assert measured["drones"]["mav0"]["rmse_3d_cm"] == pytest.approx(0.0, abs=1e-6)


def test_fused_and_unfused_are_compared_where_both_have_a_pose(tmp_path: Path) -> None:
    """The unfused flight refuses the frames on which the fused one is bad: that is no merit."""
    hard = frozenset(("mav1", k) for k in (8, 9, 10, 11))
    fused_error: ErrorOf = lambda drone, frame: (  # noqa: E731
        np.zeros(6) if drone == "mav0" else np.array([0.8 if frame > 7 else 0.1, 0, 0, 0, 0, 0])
    )
    fused = left_behind(tmp_path / "f", "forward_back", True, Flight(error=fused_error))
    unfused = left_behind(
        tmp_path / "u", "forward_back", False, Flight(error=off_by(20.0), refused=hard)
    )
    told = compared(fused.drone("mav1"), unfused.drone("mav1"))
    assert told is not None
    assert told["frames"] == 8
    assert told["fused_cm"]["3d"] == pytest.approx(10.0, abs=0.01)
    assert told["ratio"] == pytest.approx(0.5, abs=0.001)


def test_nees_by_source_is_that_of_the_errors(tmp_path: Path) -> None:
    error = np.array([0.02, 0.02, 0.0, 0.0, 0.0, 0.0])
    rows = [estimate(k, error, 0.01) for k in range(4)]
    rows += [estimate(k, error, 0.02, host=1) for k in range(4)]
    rows.append(estimate(4, 10 * error, 0.01, host=1, fused=False))
    flight = left_behind(tmp_path / "a", "rotate", True, Flight(), rows)
    told = flight_measures(flight)["drones"]["mav1"]
    assert told["nees_median"]["intra"] == pytest.approx(8.0, rel=1e-3)
    assert told["nees_median"]["inter"] == pytest.approx(2.0, rel=1e-3)
    assert told["nees_median"]["inter_refused"] == pytest.approx(800.0, rel=1e-2)
    assert told["estimates"] == {
        "intra": 4, "inter": 4, "inter_refused": 1, "inter_by_host": {"mav0": 4}
    }  # fmt: skip
    judged = goals({("rotate", True): flight}, whole=True)
    assert told_of(judged, "NEES median, intra").verdict == "met"
    assert told_of(judged, "NEES median, fused").verdict == "not met"  # zero: far too cautious


def test_the_surest_host_is_the_one_with_the_smaller_heading_sigma(tmp_path: Path) -> None:
    none = np.zeros(6)
    rows = [estimate(k, none, 0.01 if k < 6 else 0.03, host=1) for k in range(12)]
    rows += [estimate(k, none, 0.02, host=3) for k in range(12)]
    # The surest of all was refused.
    rows.append(estimate(2, none, 0.001, host=3, fused=False))
    flight = left_behind(tmp_path / "a", "rotate", True, Flight(n_drones=3), rows)
    instants, hosts = flight.estimates["mav1"].surest_host()
    assert instants.tolist() == [at_ns(1, k) for k in range(12)]
    assert hosts == ["mav0"] * 6 + ["mav2"] * 6


def test_a_log_without_estimates_has_none_and_a_broken_one_says_where(tmp_path: Path) -> None:
    flight = left_behind(tmp_path / "a", "rotate", True, Flight())
    assert flight.estimates == {}
    assert flight_measures(flight)["drones"]["mav1"]["nees_median"]["inter"] is None
    row = estimate(0, np.zeros(6), 0.01)
    for n, broken in enumerate(
        ({**row, "covariance": [1.0] * 20}, {**row, "quaternion": [0.0, 0.0, 0.0, 0.0]})
    ):
        with pytest.raises(FlightError, match=r"flight(\.jsonl, row| log is no pose)"):
            left_behind(tmp_path / f"b{n}", "rotate", True, Flight(), [broken])


@pytest.mark.parametrize(
    ("error_cm", "without_cm", "rmse", "never_worse"),
    [(20.0, 30.0, "met", "met"), (23.0, 20.0, "met", "not met"), (30.0, 35.0, "not met", "met")],
)
def test_forward_back_is_judged_by_the_numbers_of_the_issue(
    tmp_path: Path, error_cm: float, without_cm: float, rmse: str, never_worse: str
) -> None:
    flights = {
        ("forward_back", fused): left_behind(
            tmp_path / str(fused), "forward_back", fused, Flight(n_drones=3, error=off_by(cm))
        )
        for fused, cm in ((True, error_cm), (False, without_cm))
    }
    # The leader is exact by construction; it must not decide.
    rows = goals(flights, whole=True)
    assert told_of(rows, "fused 3-D RMSE").verdict == rmse
    worse = told_of(rows, "never more than")
    assert f"mav1 {error_cm / without_cm:.2f}" in worse.measured
    assert worse.verdict == never_worse
    for row in goals(flights, whole=False):
        assert row.verdict in ("reported", "not judged")


def test_rotate_and_urban_are_judged_by_the_numbers_of_the_issue(tmp_path: Path) -> None:
    wild: ErrorOf = lambda drone, frame: (  # noqa: E731
        np.array([0, 0, 0, 0, 0, np.deg2rad(0.4 if frame == 7 else 0.01)])
    )
    rotate = left_behind(tmp_path / "r", "rotate", True, Flight(error=wild))
    rows = goals({("rotate", True): rotate}, whole=True)
    assert [row.verdict for row in rows[:3]] == ["met", "met", "not met"]
    assert "0.39°" in rows[1].measured or "0.40°" in rows[1].measured
    urban = Flight(n_drones=3, refused=frozenset({("mav2", 4)}))
    fine = left_behind(tmp_path / "u", "urban", True, urban)
    forgets = left_behind(
        tmp_path / "v", "urban", True, replace(urban, unlogged=frozenset({("mav1", 6)}))
    )
    for flight, verdict in ((fine, "met"), (forgets, "not met")):
        assert told_of(goals({("urban", True): flight}, whole=True), "every frame").verdict == (
            verdict
        )


def test_the_way_is_that_of_the_truth(tmp_path: Path) -> None:
    flight = left_behind(tmp_path / "a", "urban", True, Flight(n_frames=5))
    step = np.linalg.norm([0.4, -0.1, 0.0])
    assert path_length_m(flight.drone("mav1")) == pytest.approx(np.arange(5) * step)


def test_an_unfused_flight_stays_unfused_whatever_is_given() -> None:
    given = (Setting(("inter", "every_n_frames"), 3), Setting(("map", "min_landmarks"), 80))
    rotate = EXPERIMENT["rotate"]
    assert Setting(("inter", "every_n_frames"), 1) in settings_of(rotate, PIPELINE, True, ())
    assert settings_of(rotate, PIPELINE, True, given)[-2:] == given
    assert settings_of(rotate, PIPELINE, False, given)[-1] == NOT_FUSED
    once = {e.name for e in EXPERIMENTS if e.variants() == (True,)}
    assert once == {"forward_back_noisy", "urban"}


class _Balanced(HTMLParser):
    """Knows whether every element is closed, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_has_table_one_with_a_column_for_each_pipeline(tmp_path: Path) -> None:
    flight = Flight(n_drones=3, error=off_by(12.0))
    rows = [estimate(k, np.zeros(6), 0.02, host=1) for k in range(0, 12, 3)]
    rows += [estimate(k, np.zeros(6), 0.01) for k in range(12)]
    one = left_behind(tmp_path / "a", "rotate", True, flight, rows)
    flights = {
        (name, fused): replace(one, experiment=EXPERIMENT[name], fused=fused)
        for name in EXPERIMENT
        for fused in EXPERIMENT[name].variants()
    }
    of_other = {key: flight for key, flight in flights.items() if key[0] == "forward_back"}
    other = Pipeline("other", "another <pipeline>", 1.0)
    scenarios = {name: load_scenario(name) for name in EXPERIMENT}
    result = PaperResult(EXPERIMENTS, scenarios)
    for pipeline, its in ((PIPELINE, flights), (other, of_other)):
        result.flights[pipeline.name] = its
        result.goals[pipeline.name] = goals(its, whole=True)
    paper = json.loads(json.dumps(paper_json(result, (PIPELINE, other)), allow_nan=False))
    html = page(result, (PIPELINE, other), paper)
    parser = _Balanced()
    parser.feed(html)
    assert parser.open == []
    assert "another &lt;pipeline&gt;" in html
    x_cm, y_cm = 12.0 * math.cos(1.1), 12.0 * math.sin(1.1)
    assert f"<td>2.5 (3.6)</td><td>{x_cm:.1f} ({x_cm:.1f})</td>" in html
    assert f"<td>23.9 (35.2)</td><td>{y_cm:.1f} ({y_cm:.1f})</td>" in html
    assert "24.0 (35.5)" in html
    assert set(paper["pipelines"]) == {"default", "other"}
    assert paper["table_1_of_the_paper"]["mav2"]["fused_cm"] == list(TABLE_I["mav2"].fused_cm)
    for figure in ("Fig. 5", "Fig. 7", "Fig. 8", "Fig. 9", "Fig. 10", "Fig. 12"):
        assert figure in html
    # Names of SVG's vocabularies are no addresses to fetch from.
    assert not re.search(r"src=|href=.?http|url\(.?http|@import", html)


def test_figures_are_drawn_of_flights_that_localized_nothing(tmp_path: Path) -> None:
    nobody = frozenset((f"mav{n}", k) for n in (1, 2) for k in range(N_FRAMES))
    lost = left_behind(tmp_path / "a", "forward_back", True, Flight(n_drones=3, refused=nobody))
    for svg in (
        axis_errors_svg(lost, None, "mav1"),
        trajectories_svg(lost, lost),
        sparse_svg(lost, lost),
        urban_svg(lost, None),
        rotate_svg(lost),
    ):
        assert svg.startswith("<svg role=")
    assert "measured" not in goals({("forward_back", True): lost}, whole=True)[4].measured
    assert told_of(goals({("forward_back", True): lost}, whole=True), "3-D").verdict == "not met"


def test_a_building_stands_behind_its_front() -> None:
    scenario = load_scenario("urban")
    first = scenario.world.building[0]
    assert (first.facing_deg, first.x_m, first.y_m, first.width_m) == (90.0, -8.0, -8.6, 13.0)
    corners = footprints(scenario)[0]
    assert corners.min(axis=0) == pytest.approx([-14.5, -8.6 - first.depth_m])
    assert corners.max(axis=0) == pytest.approx([-1.5, -8.6])


def test_a_flight_that_fits_is_taken_and_not_flown(tmp_path: Path) -> None:
    """There is no daemon that could fly these images: a flight would fail."""
    before = left_behind(tmp_path / "a", "rotate", True, Flight())
    recording = Rendered(tmp_path / "a" / "recording", {"scenario": "s"}, reused=True)
    options = FlyOptions(speed=math.inf, start_timeout_s=3.0)
    mark = before.folder / "run" / "fingerprint.json"
    paper_fingerprint.write(mark, paper_fingerprint.of_flight(recording.fingerprint, options))
    told: list[str] = []
    again = flown(
        before.experiment, PIPELINE, True, recording, before.folder, options,
        lambda stage, done, total: told.append(stage),
    )  # fmt: skip
    assert again.reused
    assert told == ["comparing with the truth"]
    assert flight_measures(again) == flight_measures(before)


def test_the_pipelines_are_flown_side_by_side_and_differ_in_one_setting() -> None:
    rotate = EXPERIMENT["rotate"]
    asked = {p.name: pipeline_of(settings_of(rotate, p, True, ())) for p in PIPELINES}
    assert asked == {"default": "default", "paper": "paper"}
    assert [p.name for p in pipelines_named(("paper",))] == ["paper"]
    assert pipelines_named(()) == PIPELINES


@pytest.mark.parametrize("changed", ["recording", "settings", "speed", "seed", "code", "libraries"])
def test_whatever_a_flight_results_from_counts(changed: str) -> None:
    options = FlyOptions()
    now = paper_fingerprint.of_flight({"scenario": "s"}, options)
    others = {
        "recording": paper_fingerprint.of_flight({"scenario": "t"}, options),
        "settings": paper_fingerprint.of_flight(
            {"scenario": "s"}, replace(options, settings=(NOT_FUSED,))
        ),
        "speed": paper_fingerprint.of_flight({"scenario": "s"}, replace(options, speed=math.inf)),
        "seed": paper_fingerprint.of_flight({"scenario": "s"}, replace(options, seed=1)),
        "code": {**now, "code": "0"},
        "libraries": {**now, "libraries": {"numpy": "0"}},
    }
    assert paper_fingerprint.differences(now, json.loads(json.dumps(now))) == []
    assert paper_fingerprint.differences(others[changed], now) == [changed]


def test_daemon_and_harness_count_as_code_of_a_flight_but_no_page() -> None:
    flying = paper_fingerprint.imported_files(("sitl.swarm", "vcl_companion.cli"))
    assert {
        "vcl_companion/__init__.py",
        "vcl_companion/localization/intra.py",
        "vcl_companion/daemon/companion.py",
        "sitl/daemon_config.py",
    } <= flying
    assert not [file for file in flying if "report" in file or "paper" in file]
    rendering = paper_fingerprint.imported_files(("sitl.render",))
    assert {"sitl/renderer.py", "sitl/building.py", "vcl_companion/geometry/camera.py"} <= rendering
    assert not [file for file in rendering if "daemon" in file or "localization" in file]


SMALL = """
name = "small"
frame_rate_hz = 4.0
duration_s = 0.5
[camera]
width_px = 64
height_px = 48
focal_px = 40.0
[world]
ground_half_m = 15.0
texels_per_m = 8.0
[[world.building]]
x_m = 8.0
y_m = 0.0
facing_deg = 180.0
width_m = 8.0
height_m = 8.0
[[drone]]
name = "mav0"
[drone.flight]
waypoints = [[0.0, 0.0, 0.0, -3.0, 0.0]]
"""


def small(tmp_path: Path, text: str = SMALL) -> Scenario:
    path = tmp_path / "small.toml"
    path.write_text(text)
    return load_scenario(path)


def test_a_scenario_is_rendered_once_and_anew_when_it_changed(tmp_path: Path) -> None:
    folder, frames = tmp_path / "kept", []

    def seen(done: int, total: int) -> None:
        frames.append((done, total))

    first = rendered(small(tmp_path), "small", folder, seen)
    assert (first.reused, first.why, frames) == (False, "", [(1, 2), (2, 2)])
    again = rendered(small(tmp_path), "small", folder, seen)
    assert again.reused
    assert again.fingerprint == first.fingerprint
    assert len(frames) == 2
    longer = small(tmp_path, SMALL.replace("0.5", "0.75"))
    changed = rendered(longer, "small", folder, seen)
    assert (changed.reused, changed.why) == (False, "scenario changed")
    assert len(list((folder / "small" / "mav0" / "cam0" / "data").iterdir())) == 3
    assert sorted(path.name for path in folder.iterdir()) == ["small", "small.rendered.json"]


def test_an_interrupted_rendering_is_begun_again(tmp_path: Path) -> None:
    folder = tmp_path / "kept"

    def interrupted(done: int, total: int) -> None:
        raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            rendered(small(tmp_path), "small", folder, interrupted)
        assert not (folder / "small").exists()
    assert not rendered(small(tmp_path), "small", folder, lambda done, total: None).reused
    # A run that was killed could not clean up.
    (folder / ".small.4711.partial" / "mav0").mkdir(parents=True)
    # What is removed for a new one counts as removed, however far that got.
    with pytest.raises(KeyboardInterrupt):
        rendered(small(tmp_path, SMALL.replace("0.5", "0.75")), "small", folder, interrupted)
    assert not rendered(small(tmp_path), "small", folder, lambda done, total: None).reused
    assert sorted(path.name for path in folder.iterdir()) == ["small", "small.rendered.json"]


def test_a_recording_of_unknown_making_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "kept" / "small").mkdir(parents=True)
    with pytest.raises(ConfigError, match=r"no small\.rendered\.json beside it"):
        rendered(small(tmp_path), "small", tmp_path / "kept", lambda done, total: None)
    assert (tmp_path / "kept" / "small").is_dir()


def test_input_that_cannot_be_used_is_one_line_and_status_2(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letters").touch()
    out = tmp_path / "out"
    for arguments, message in (
        (("--out", out, "--only", "rotat"), "no such experiment; there are: rotate, sparse"),
        (("--out", out, "--seconds", "0"), "--seconds must be positive"),
        (("--out", out, "--set", "log.level=debug"), "a string needs quotes"),
        (("--out", tmp_path / "file", "--only", "rotate"), "is a file"),
        (("--out", tmp_path / "out", "--set", "foo=1"), "--set: foo: unknown key"),
        (("--out", tmp_path / "out", "--start-timeout", "0"), "--start-timeout must be positive"),
        (("--out", tmp_path / "full", "--only", "rotate"), "holds something else"),
    ):
        done = CliRunner().invoke(main, ["paper", *map(str, arguments)])
        assert done.exit_code == 2, done.output
        assert message in done.stderr
        assert done.stderr.startswith("sitl: ")
        assert done.stderr.count("\n") == 1
        assert not out.exists()


def test_an_experiment_names_drones_of_its_scenario() -> None:
    for experiment in EXPERIMENTS:
        names = [drone.name for drone in load_scenario(experiment.scenario).drone]
        assert set(experiment.targets) <= set(names)
        assert isinstance(experiment, Experiment)
