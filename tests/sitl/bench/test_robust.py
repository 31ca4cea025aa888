import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sitl.bench_robust import N_MATCHES, SHAPES, Row, Shape, bench_robust, goals, grid, make_case
from vcl_companion.geometry.rotation import skew
from vcl_companion.vision.relative_pose import in_front

FOCAL_PX = 320.0


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


def test_a_run_writes_a_table_and_every_number(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    cells = [cell for cell in grid() if cell[1:] == ("relief", 1.0, 0.3)]
    rows = bench_robust(tmp_path, 2, lambda *step: seen.append(step), cells)
    assert seen == [("robust", 0, 2), ("robust", 1, 2), ("robust", 2, 2)]
    report = json.loads((tmp_path / "robust.json").read_text(encoding="utf-8"))
    assert len(report["rows"]) == len(rows)
    assert report["goals"] == []
    text = (tmp_path / "robust.txt").read_text(encoding="utf-8")
    for row in rows:
        assert row.contender in text
        if row.contender in ("ours", "best"):
            assert row.success == row.among == 1.0
    assert {row.contender for row in rows} >= {"ours", "cv2 RANSAC", "cv2 MAGSAC", "best"}


def test_a_goal_that_is_missed_is_named() -> None:
    ours = Row("relative", "planar", 1.0, 0.5, "ours", 100, 0.97, 0.97, 2.0, 0.1, 1.0, 5.0, 9.0)
    rival = replace(ours, contender="poselib", success=0.98)
    told = replace(ours, contender="poselib, told", success=1.0)
    assert len(goals([ours, rival, told])) == 2
    assert goals([replace(ours, success=0.98, among=0.98), rival, told]) == []
    quiet = {"sigma_px": 0.3, "shape": "relief"}
    assert goals([replace(ours, **quiet), replace(rival, **quiet)]) == []  # type: ignore[arg-type]
