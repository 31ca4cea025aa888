"""``bench steps``: every answer is right, its judges tell wrong ones, its rivals do the same."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sitl.bench import steps_images, steps_map, steps_poses
from sitl.bench.inputs import Inputs, prepare
from sitl.bench.steps import STEPS, bench_steps
from sitl.bench.steps_report import write_steps
from sitl.bench.timing import Accuracy, Effort, Entry, Measured, measured
from tests.checks import numeric_jacobian
from vcl_companion.geometry.pose import Pose
from vcl_companion.vision.bundle import robust_cost


@cache
def inputs() -> Inputs:
    return prepare()


def test_a_quick_run_finds_every_answer_right(tmp_path: Path) -> None:
    seen: list[str] = []
    results = bench_steps(tmp_path, STEPS, True, lambda part, done, total: seen.append(part))
    assert seen == ["images and map", *(step.name for step in STEPS), "steps"]
    wrong = [(result.step, result.name) for result in results if not result.accuracy.right]
    assert wrong == []
    assert [r.name.startswith("ours") for r in results if r.ratio == 1.0] == [True] * len(STEPS)
    assert all(0.0 < result.median_ms <= result.p95_ms for result in results)
    report = json.loads((tmp_path / "steps.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in report["results"]] == [result.name for result in results]
    assert "cores" in report["machine"]
    text = (tmp_path / "steps.md").read_text(encoding="utf-8")
    for result in results:
        assert f"| {result.name} |" in text


def test_repetitions_are_interleaved_and_measured_by_the_call() -> None:
    calls: list[str] = []

    def work(name: str, turns: int) -> Entry:
        def run() -> int:
            calls.append(name)
            return sum(range(turns))

        return Entry(name, run, lambda answer: Accuracy(str(answer), answer > 0))

    few, many = measured("add", [work("few", 200_000), work("many", 800_000)], Effort(0.0, 5, 5))
    # One call for the answer, one to see how long it takes, then in turns.
    assert "".join(name[0] for name in calls).endswith("fmfm")
    assert (few.repetitions, many.repetitions) == (5, 5)
    assert few.ratio == 1.0
    assert 2.0 < many.ratio < 8.0
    assert many.ratio == pytest.approx(many.median_ms / few.median_ms)
    assert few.accuracy == Accuracy(str(sum(range(200_000))), True)


def test_short_calls_are_repeated_until_they_can_be_measured() -> None:
    calls = [0]

    def run() -> None:
        calls[0] += 1

    (found,) = measured("none", [Entry("none", run, lambda _: Accuracy("", True))], Effort(0, 3, 3))
    assert calls[0] > 100
    assert found.median_ms < 0.1


def test_a_wrong_answer_has_no_ratio(tmp_path: Path) -> None:
    right = Measured("one", "ours", 2.0, 3.0, 5, 1.0, Accuracy("0.1 deg", True))
    wrong = replace(right, name="theirs", ratio=0.5, accuracy=Accuracy("90 deg", False))
    write_steps(tmp_path, [right, wrong])
    lines = (tmp_path / "steps.md").read_text(encoding="utf-8").splitlines()
    assert lines[-2] == "| one | ours | 2 | 3 | 1.00 | 0.1 deg |"
    assert lines[-1] == "|  | theirs | 2 | 3 | - | WRONG: 90 deg |"


def test_judges_of_matches_tell_wrong_ones() -> None:
    for entries in (steps_images.matching(inputs()), steps_images.guided_matching(inputs())):
        ours = entries[0]
        a, b = ours.run()
        assert ours.judge((a, b)).right
        assert not ours.judge((a, np.roll(b, 7))).right
        assert not ours.judge((a[:100], b[:100])).right  # right, but few
        assert not ours.judge((a[:0], b[:0])).right


def test_judges_of_poses_tell_wrong_ones() -> None:
    off = Pose.identity().retracted(np.array([0.15, 0.0, 0.0, 0.03, 0.0, 0.0]))
    for entries in (
        steps_poses.relative(inputs()),
        steps_poses.relative_made(inputs()),
        steps_poses.resection(inputs()),
        steps_poses.resection_made(inputs()),
    ):
        found = entries[0].run()
        assert entries[0].judge(found).right
        assert not entries[0].judge([off @ found[0]]).right
        assert not entries[0].judge([]).right
    refined = steps_poses.refinement(inputs())[0]
    near = Pose.identity().retracted(np.array([0.0, 0.04, 0.0, 0.0, 0.0, 0.0]))
    assert not refined.judge(refined.run() @ near).right
    localized = steps_map.localization(inputs())[0]
    assert not localized.judge(localized.run() @ off).right
    assert not localized.judge(None).right
    moved_a, moved_b = (corrected := steps_poses.correction(inputs())[0]).run()
    assert not corrected.judge((moved_a + 1e-6, moved_b)).right


def test_the_adjustment_s_rival_solves_the_same_problem() -> None:
    start = steps_map._disturbed(inputs())
    problem = steps_map._Problem(start, 1.5)
    rng = np.random.default_rng(0)
    steps = 0.01 * rng.standard_normal(problem.size)
    residuals = problem.residuals(steps)
    cost = robust_cost(problem.views(steps), 1.5)
    assert float(residuals @ residuals) == pytest.approx(cost, rel=1e-9)
    # All poses, and the first landmarks.
    n = 6 * (len(start.bodies) - 1) + 9
    numeric = numeric_jacobian(
        lambda d: problem.residuals(steps + np.pad(d, (0, problem.size - n))), np.zeros(n)
    )
    exact = problem.jacobian(steps).toarray()[:, :n]
    assert np.abs(exact - numeric).max() < 1e-5 * np.abs(numeric).max()
    ours = steps_map.adjustment(inputs())[0]
    assert ours.judge(ours.run()).right
    assert not ours.judge(start).right
