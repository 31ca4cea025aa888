"""What ``bench robust`` says of one contender in one cell, and whether ours reaches the goal.

The goal, cell by cell: right at least as often as each rival where the noise is
1 px and more, and within 2 points of the best where it is less. On a plane the
first answer is right, either twin, in 98 % of the scenes, and so often the
truth is among all answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sitl.bench.cases import Cell
from sitl.bench.trial import Score

RIVALS = ("cv2 RANSAC", "cv2 MAGSAC", "poselib")
_EXACT_FROM_PX = 1.0
_SLACK = 0.02
_PLANAR = 0.98


@dataclass(frozen=True)
class Row:
    """One contender in one cell of the grid.

    Attributes:
        cell: which.
        contender: who.
        scenes: how many it was given.
        success: share of the scenes whose first answer is right (on a plane, either twin).
        among: share of the scenes with the truth among all answers.
        answers: mean number of them.
        error_deg: median rotation error of the answer nearest to the truth, when right.
        offset: median error of direction, degrees, or of position, m, likewise.
        milliseconds: median time of one thread.
        slowest_ms: longest.
        failed: numbers of the scenes whose first answer is wrong.
    """

    cell: Cell
    contender: str
    scenes: int
    success: float
    among: float
    answers: float
    error_deg: float | None
    offset: float | None
    milliseconds: float
    slowest_ms: float
    failed: tuple[int, ...]


@dataclass(frozen=True)
class Verdict:
    """Whether ours reaches the goal in one cell.

    Attributes:
        cell: which.
        ours: our success.
        rival: who of the rivals is best, None when ours was alone.
        rivals: the best one's success.
        missed: what is missed, in words; empty when the goal is reached.
    """

    cell: Cell
    ours: float
    rival: str | None
    rivals: float
    missed: tuple[str, ...]


def row_of(cell: Cell, contender: str, scores: Sequence[Score]) -> Row:
    """Put together what one contender did in one cell; at least one scene."""
    turns = [score.turn_deg for score in scores if score.turn_deg is not None]
    offsets = [score.offset for score in scores if score.offset is not None]
    times = [score.milliseconds for score in scores]
    return Row(
        cell=cell,
        contender=contender,
        scenes=len(scores),
        success=float(np.mean([score.first for score in scores])),
        among=float(np.mean([score.among for score in scores])),
        answers=float(np.mean([score.answers for score in scores])),
        error_deg=float(np.median(turns)) if turns else None,
        offset=float(np.median(offsets)) if offsets else None,
        milliseconds=float(np.median(times)),
        slowest_ms=float(np.max(times)),
        failed=tuple(seed for seed, score in enumerate(scores) if not score.first),
    )


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """Judge every cell that ours has run in."""
    return [
        _verdict(row, [other for other in rows if other.cell == row.cell])
        for row in rows
        if row.contender == "ours"
    ]


def _verdict(ours: Row, there: Sequence[Row]) -> Verdict:
    rivals = [row for row in there if row.contender in RIVALS]
    best = max(rivals, key=lambda row: row.success, default=None)
    slack = 0.0 if ours.cell.sigma_px >= _EXACT_FROM_PX else _SLACK
    missed = []
    if best is not None and ours.success < best.success - slack - 1e-9:
        missed.append(f"{ours.success:.1%}, {best.contender} {best.success:.1%}")
    if ours.cell.shape == "planar" and ours.success < _PLANAR - 1e-9:
        missed.append(f"first answer right in {ours.success:.1%}, 98 % wanted on a plane")
    if ours.cell.shape == "planar" and ours.among < _PLANAR - 1e-9:
        missed.append(f"truth among the answers in {ours.among:.1%}, 98 % wanted on a plane")
    return Verdict(
        ours.cell,
        ours.success,
        None if best is None else best.contender,
        0.0 if best is None else best.success,
        tuple(missed),
    )
