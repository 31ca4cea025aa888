"""``bench robust``: its scenes are what they are said to be, its parts are kept, its goals hold."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sitl.bench.cases import N_MATCHES, SHAPES, Cell, Shape, case_of, grid, make_case
from sitl.bench.kept import read_part, sources_behind, stamp_of, write_part
from sitl.bench.robust import bench_robust
from sitl.bench.rows import Row, row_of, verdicts
from sitl.bench.trial import Score, best_possible, judged, run_trial
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, skew
from vcl_companion.vision.relative_pose import in_front

FOCAL_PX = 320.0
RELIEF = Cell("relative", "relief", 1.0, 0.3)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_case_holds_the_noise_and_the_wrong_matches_it_is_said_to(shape: Shape) -> None:
    squared, wrong = [], []
    for seed in range(5):
        case = make_case(shape, 1.0, 0.5, np.random.default_rng(seed))
        assert len(case.a) == len(case.b) == len(case.points) == N_MATCHES
        assert case.good.sum() == N_MATCHES // 2
        moved = case.b_from_a.apply(case.points)
        off = FOCAL_PX * (case.b - moved[:, :2] / moved[:, 2:])
        squared.append((off[case.good] ** 2).mean())
        wrong.append(np.linalg.norm(off[~case.good], axis=1))
        assert np.abs(case.b[~case.good]).max() <= 1.0
    assert 0.9 < np.mean(squared) < 1.1
    assert np.median(wrong) > 100.0


def test_the_twin_explains_the_plane_as_well_as_the_truth() -> None:
    twins = 0
    for seed in range(20):
        case = make_case("planar", 0.0, 0.0, np.random.default_rng(seed))
        if case.twin is None:
            continue
        twins += 1
        ha, hb = (np.column_stack([side, np.ones(N_MATCHES)]) for side in (case.a, case.b))
        essential = skew(case.twin.translation) @ case.twin.rotation
        assert np.abs(np.einsum("ni,ij,nj->n", hb, essential, ha)).max() < 1e-9
        assert in_front(case.twin, case.a, case.b).mean() > 0.9
    assert 2 <= twins <= 15
    assert make_case("relief", 0.0, 0.0, np.random.default_rng(0)).twin is None


def test_the_grid_is_the_issue_s_and_every_cell_has_a_name_of_its_own() -> None:
    cells = list(grid())
    assert len({cell.name for cell in cells}) == len(cells) == 2 * 2 * 3 * 4
    assert Cell("resection", "planar", 0.3, 0.8).name == "resection-planar-0.3px-80"


def test_an_answer_is_right_within_its_limits_and_not_beyond() -> None:
    case = case_of(RELIEF, 0)
    turned = Pose(case.b_from_a.rotation @ exp_so3(np.array([0.0, 0.0, np.deg2rad(3.5)])),
                  case.b_from_a.translation)  # fmt: skip
    near = Pose(case.b_from_a.rotation @ exp_so3(np.array([0.0, 0.0, np.deg2rad(2.5)])),
                case.b_from_a.translation)  # fmt: skip
    assert judged("relative", case, [near], 1.0).first
    second = judged("relative", case, [turned, near], 1.0)
    assert (second.first, second.among, second.answers) == (False, True, 2)
    assert second.turn_deg == pytest.approx(2.5)
    backwards = Pose(case.b_from_a.rotation, -case.b_from_a.translation)
    assert not judged("relative", case, [backwards], 1.0).among
    moved = Pose(case.b_from_a.rotation, case.b_from_a.translation + np.array([0.0, 0.0, 0.6]))
    assert not judged("resection", case, [moved], 1.0).first
    assert judged("resection", case, [case.b_from_a], 1.0) == Score(True, True, 1, 0.0, 0.0, 1.0)
    assert judged("resection", case, [], 1.0) == Score(False, False, 0, None, None, 1.0)


def test_on_a_plane_the_twin_is_right_first_but_not_the_truth() -> None:
    cell = Cell("relative", "planar", 0.3, 0.3)
    case = next(c for c in (case_of(cell, seed) for seed in range(50)) if c.twin is not None)
    assert case.twin is not None
    assert judged("relative", case, [case.twin], 1.0).first
    assert not judged("relative", case, [case.twin], 1.0).among


def test_who_knows_the_truth_finds_it() -> None:
    for cell in (RELIEF, Cell("resection", "planar", 3.0, 0.8)):
        scores = best_possible(cell, 3)
        assert all(score.first and score.among for score in scores)
        assert all(0.0 < (score.turn_deg or 0.0) < 1.0 for score in scores)


def test_a_run_writes_a_table_and_every_number(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    cells = [cell for cell in grid() if (cell.shape, cell.sigma_px, cell.outliers) == (
        "relief", 1.0, 0.3)]  # fmt: skip
    rows = bench_robust(tmp_path, 2, lambda *step: seen.append(step), cells)
    assert seen[0] == ("relative-relief-1px-30 ours", 0, len(rows))
    assert [done for _, done, _ in seen] == list(range(len(rows) + 1))
    report = json.loads((tmp_path / "robust.json").read_text(encoding="utf-8"))
    assert len(report["rows"]) == len(rows)
    assert report["unfinished"] == 0
    assert [verdict["missed"] for verdict in report["verdicts"]] == [[], []]
    text = (tmp_path / "robust.md").read_text(encoding="utf-8")
    assert "met in 2 of 2 cells" in text
    for row in rows:
        assert row.contender in text
        if row.contender in ("ours", "best"):
            assert row.success == row.among == 1.0
            assert row.failed == ()
    assert {row.contender for row in rows} >= {"ours", "cv2 RANSAC", "cv2 MAGSAC", "best"}

    # What is finished is not run again, and gives the same result.
    seen.clear()
    assert bench_robust(tmp_path, 2, lambda *step: seen.append(step), cells) == rows
    assert seen == [("robust", len(rows), len(rows))]
    # Other scenes are.
    seen.clear()
    more = bench_robust(tmp_path, 3, lambda *step: seen.append(step), cells[:1])
    assert len(seen) == len(more) + 1
    assert {row.scenes for row in more} == {3}


def test_a_trial_is_the_same_whenever_it_is_run() -> None:
    def turned(a: object, b: object, focal: float, threshold: float, seed: int) -> list[Pose]:
        return [Pose(exp_so3(np.full(3, 1e-3 * seed)), np.array([threshold, 0.0, 0.0]))]

    once, twice = (run_trial(RELIEF, turned, 1.5, 3) for _ in range(2))
    assert [replace(s, milliseconds=0.0) for s in once] == [
        replace(s, milliseconds=0.0) for s in twice
    ]


def test_a_kept_part_is_read_back_only_while_it_is_true(tmp_path: Path) -> None:
    file, stamp = tmp_path / "parts" / "one.json", {"code": "a", "numpy": "2"}
    scores = [Score(True, True, 2, 0.25, 1.5, 3.0), Score(False, False, 0, None, None, 4.0)]
    assert read_part(file, stamp, 2) is None
    write_part(file, stamp, scores)
    assert read_part(file, stamp, 2) == scores
    assert read_part(file, stamp, 3) is None
    assert read_part(file, {**stamp, "code": "b"}, 2) is None
    assert read_part(file, {**stamp, "numpy": "3"}, 2) is None
    for broken in ('{"stamp": ', "[]", '{"stamp": {"code": "a", "numpy": "2"}, "scores": [1, 2]}'):
        file.write_text(broken, encoding="utf-8")
        assert read_part(file, stamp, 2) is None
    assert [path.name for path in file.parent.iterdir()] == ["one.json"]


def test_our_parts_depend_on_all_of_our_vision_and_a_rival_s_on_none() -> None:
    files = {path.name for path in sources_behind(["vcl_companion.vision.relative_pose"])}
    assert files >= {"relative_pose.py", "acransac.py", "five_point.py", "pose.py", "rotation.py"}
    without = sources_behind(["sitl.bench.trial"], "vcl_companion.vision.")
    assert {path.parent.name for path in without} == {"bench", "geometry"}
    ours, rival = (stamp_of(name, "relative", 1) for name in ("ours", "poselib, told"))
    assert ours["code"] != rival["code"]
    assert "poselib" in rival
    assert "poselib" not in ours
    assert stamp_of("ours", "relative", 1) == ours != stamp_of("ours", "relative", 2)
    assert stamp_of("ours", "resection", 1)["code"] != ours["code"]
    assert stamp_of("poselib, told", "resection", 1) == rival


def of(contender: str, cell: Cell, success: float, among: float) -> Row:
    return Row(cell, contender, 100, success, among, 2.0, 0.1, 1.0, 5.0, 9.0, ())


def test_a_goal_that_is_missed_is_named() -> None:
    planar = Cell("relative", "planar", 1.0, 0.5)
    rivals = [of("poselib", planar, 0.985, 0.5), of("poselib, told", planar, 1.0, 1.0)]
    (verdict,) = verdicts([of("ours", planar, 0.97, 0.97), *rivals])
    assert verdict.rival == "poselib"
    assert len(verdict.missed) == 3
    assert verdicts([of("ours", planar, 0.985, 0.98), *rivals])[0].missed == ()
    # A plane whose truth is not among the answers is missed, whatever comes first.
    assert len(verdicts([of("ours", planar, 1.0, 0.97), *rivals])[0].missed) == 1


@pytest.mark.parametrize(("sigma_px", "missed"), [(0.3, 0), (1.0, 1), (3.0, 1)])
def test_only_little_noise_leaves_two_points(sigma_px: float, missed: int) -> None:
    cell = Cell("resection", "relief", sigma_px, 0.8)
    found = verdicts([of("ours", cell, 0.98, 0.98), of("cv2 RANSAC", cell, 1.0, 1.0)])
    assert len(found[0].missed) == missed
    lost = verdicts([of("ours", cell, 0.979, 0.979), of("cv2 RANSAC", cell, 1.0, 1.0)])
    assert len(lost[0].missed) == 1


def test_a_row_says_which_scenes_failed() -> None:
    scores = [
        Score(True, True, 2, 1.0, 4.0, 3.0),
        Score(False, False, 1, None, None, 9.0),
        Score(True, False, 1, None, None, 4.0),
        Score(True, True, 2, 3.0, 8.0, 5.0),
    ]
    row = row_of(RELIEF, "ours", scores)
    assert (row.success, row.among, row.answers, row.failed) == (0.75, 0.5, 1.5, (1,))
    assert (row.error_deg, row.offset, row.milliseconds, row.slowest_ms) == (2.0, 6.0, 4.5, 9.0)
