"""``bench robust``: how well poses are found among wrong matches, ours beside others.

n = 300 matches, noise and share of wrong matches in a grid, planar and relief
scenes, relative pose and resection. "told" is a contender that gets a threshold
made from the true noise; the others get one threshold for everything. "best"
starts at the truth and knows which matches are wrong: nobody can do better.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2

from sitl.bench.cases import Cell, Task, grid
from sitl.bench.contenders import Contender, contenders_of
from sitl.bench.kept import read_part, stamp_of, write_part
from sitl.bench.robust_report import write_robust
from sitl.bench.rows import Row, row_of
from sitl.bench.trial import Score, best_possible, run_trial

# What those that need one are told: one threshold for all, or this many sigmas.
THRESHOLD_PX: dict[Task, float] = {"relative": 1.5, "resection": 4.0}
TOLD_SIGMAS: dict[Task, float] = {"relative": 2.5, "resection": 3.0}

# Who is told the noise is there for comparison only: every fourth scene, but no fewer than this.
_FEW_SCENES = 25
# Takes seconds where most matches are wrong, and therefore comes last.
_SLOW = "cv2 RANSAC"


@dataclass(frozen=True)
class _Part:
    """One contender in one cell; ``contender`` None is whoever starts at the truth."""

    cell: Cell
    name: str
    contender: Contender | None
    threshold_px: float
    scenes: int

    @property
    def file_name(self) -> str:
        who = self.name.replace(", ", "-").replace(" ", "-")
        return f"{self.cell.name}.{who}.json"

    def run(self) -> list[Score]:
        if self.contender is None:
            return best_possible(self.cell, self.scenes)
        return run_trial(self.cell, self.contender, self.threshold_px, self.scenes)


def bench_robust(
    out: Path,
    seeds: int,
    progress: Callable[[str, int, int], None],
    cells: Sequence[Cell] | None = None,
) -> list[Row]:
    """Run the grid; finished parts lie in ``out/robust`` and are not run again.

    ``out/robust.json`` and ``out/robust.md`` are there, and true for what is
    finished, after every part that had to be run.

    Args:
        out: folder, made if absent.
        seeds: scenes per cell.
        progress: called with what is running, how much of it is done, and of how much.
        cells: which cells, None for all.
    """
    cv2.setNumThreads(1)
    cells = list(grid() if cells is None else cells)
    parts = _parts(cells, seeds)
    settings = {"seeds": seeds, "threshold_px": THRESHOLD_PX, "told_sigmas": TOLD_SIGMAS}
    rows: dict[tuple[Cell, str], Row] = {}
    missing: list[_Part] = []
    stamps = {
        (part.name, part.cell.task): stamp_of(
            part.name, part.cell.task, (THRESHOLD_PX, TOLD_SIGMAS)
        )
        for part in parts
    }
    for part in parts:
        scores = read_part(
            out / "robust" / part.file_name, stamps[part.name, part.cell.task], part.scenes
        )
        if scores is None:
            missing.append(part)
        else:
            rows[part.cell, part.name] = row_of(part.cell, part.name, scores)
    # In the table's order, whatever was run when.
    order = [(part.cell, part.name) for cell in cells for part in parts if part.cell == cell]

    def finished() -> list[Row]:
        return [rows[key] for key in order if key in rows]

    for part in missing:
        progress(f"{part.cell.name} {part.name}", len(rows), len(parts))
        scores = part.run()
        write_part(out / "robust" / part.file_name, stamps[part.name, part.cell.task], scores)
        rows[part.cell, part.name] = row_of(part.cell, part.name, scores)
        write_robust(out, settings, finished(), len(parts) - len(rows))
    progress("robust", len(parts), len(parts))
    write_robust(out, settings, finished(), 0)
    return finished()


def _parts(cells: Sequence[Cell], seeds: int) -> list[_Part]:
    """Return every contender in every cell, in the order to run them: ours first, the slow last."""
    few = max(min(seeds, _FEW_SCENES), seeds // 4)
    parts = []
    for cell in cells:
        for name, contender in contenders_of(cell.task).items():
            parts.append(_Part(cell, name, contender, THRESHOLD_PX[cell.task], seeds))
            if name != "ours":
                told = TOLD_SIGMAS[cell.task] * cell.sigma_px
                parts.append(_Part(cell, f"{name}, told", contender, told, few))
        parts.append(_Part(cell, "best", None, 0.0, seeds))
    return sorted(parts, key=_turn)


def _turn(part: _Part) -> tuple[bool, bool, bool]:
    return part.name.startswith(_SLOW), "told" in part.name, part.name != "ours"
