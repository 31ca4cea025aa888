"""One contender on the scenes of one cell of ``bench robust``, and what counts as right.

A pose is right when it is within stated angles (and, for resection, metres) of
the truth. Two views of a plane have two poses; there the first answer may be
either, and whether the truth is among all answers is counted beside it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sitl.bench.cases import FOCAL_PX, Case, Cell, Task, case_of
from sitl.bench.contenders import Contender
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import angle_between
from vcl_companion.vision.absolute_pose import ResectionProblem
from vcl_companion.vision.relative_pose import RelativePoseProblem

RIGHT_ROTATION_DEG = 3.0
RIGHT_DIRECTION_DEG = 15.0
RIGHT_POSITION_M = 0.5


@dataclass(frozen=True)
class Score:
    """How one contender did on one scene.

    Attributes:
        first: its first answer is right (on a plane, either twin).
        among: the truth is among its answers.
        answers: how many it gave.
        turn_deg: rotation error of the right answer, None without one.
        offset: error of its direction, degrees, or of its position, m.
        milliseconds: of one thread's time, whatever else the machine did.
    """

    first: bool
    among: bool
    answers: int
    turn_deg: float | None
    offset: float | None
    milliseconds: float


def run_trial(cell: Cell, contender: Contender, threshold_px: float, scenes: int) -> list[Score]:
    """Give a contender the first ``scenes`` scenes of a cell."""
    # Once beforehand: what is compiled or loaded at the first call is not measured.
    _asked(contender, cell.task, case_of(cell, 0), threshold_px, 0)
    scores = []
    for seed in range(scenes):
        case = case_of(cell, seed)
        started = time.process_time_ns()
        poses = _asked(contender, cell.task, case, threshold_px, seed)
        spent_ms = 1e-6 * (time.process_time_ns() - started)
        scores.append(judged(cell.task, case, poses, spent_ms))
    return scores


def best_possible(cell: Cell, scenes: int) -> list[Score]:
    """Start at the truth, knowing which matches are wrong: nobody can do better."""
    scores = []
    for seed in range(scenes):
        case = case_of(cell, seed)
        started = time.process_time_ns()
        poses = [_refined_from_truth(cell.task, case, cell.sigma_px)]
        spent_ms = 1e-6 * (time.process_time_ns() - started)
        scores.append(judged(cell.task, case, poses, spent_ms))
    return scores


def judged(task: Task, case: Case, poses: Sequence[Pose], milliseconds: float) -> Score:
    """Compare answers, best first, with the truth."""
    errors = [_errors(task, pose, case.b_from_a) for pose in poses]
    right = [error for error in errors if _is_right(task, *error)]
    first = bool(errors) and _is_right(task, *errors[0])
    if task == "relative" and case.twin is not None and poses:
        first |= _is_right(task, *_errors(task, poses[0], case.twin))
    turn_deg, offset = min(right) if right else (None, None)
    return Score(first, bool(right), len(poses), turn_deg, offset, milliseconds)


def _asked(
    contender: Contender, task: Task, case: Case, threshold_px: float, seed: int
) -> list[Pose]:
    first = case.a if task == "relative" else case.points
    return contender(first, case.b, FOCAL_PX, threshold_px, seed)


def _errors(task: Task, pose: Pose, truth: Pose) -> tuple[float, float]:
    """Return the rotation error, deg, and that of the direction, deg, or of the position, m."""
    turn = float(np.rad2deg(angle_between(pose.rotation, truth.rotation)))
    if task == "resection":
        offset = pose.inverse().translation - truth.inverse().translation
        return turn, float(np.linalg.norm(offset))
    lengths = np.linalg.norm(pose.translation) * np.linalg.norm(truth.translation)
    cosine = pose.translation @ truth.translation / lengths
    return turn, float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _is_right(task: Task, turn_deg: float, offset: float) -> bool:
    limit = RIGHT_POSITION_M if task == "resection" else RIGHT_DIRECTION_DEG
    return turn_deg < RIGHT_ROTATION_DEG and offset < limit


def _refined_from_truth(task: Task, case: Case, sigma_px: float) -> Pose:
    a, b, points = case.a[case.good], case.b[case.good], case.points[case.good]
    if task == "resection":
        model = np.hstack([case.b_from_a.rotation, case.b_from_a.translation[:, None]])
        moved, _ = ResectionProblem(b, points, FOCAL_PX, 1e9).refined(model, 2.5 * sigma_px)
        return Pose(moved[:, :3], moved[:, 3])
    length = float(np.linalg.norm(case.b_from_a.translation))
    start = Pose(case.b_from_a.rotation, case.b_from_a.translation / length)
    problem = RelativePoseProblem(a, b, FOCAL_PX, 800.0, 1e9)
    return problem.refined(start, 2.5 * sigma_px)[0]
