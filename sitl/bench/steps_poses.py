"""Poses among wrong matches, their refinement, and triangulation, beside others'."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import cv2
import numpy as np
from scipy.optimize import least_squares

from sitl.bench.cases import FOCAL_PX, Case, Cell, Task, case_of
from sitl.bench.contenders import contenders_of
from sitl.bench.inputs import Inputs
from sitl.bench.robust import THRESHOLD_PX
from sitl.bench.timing import Accuracy, Entry
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, angle_between, exp_so3, log_so3, skew
from vcl_companion.vision.absolute_pose import ResectionProblem, resect
from vcl_companion.vision.acransac import NotFound
from vcl_companion.vision.hartley_sturm import corrected_matches
from vcl_companion.vision.resection import Resection, ResectionOptions, Sightings, refine

_RIGHT_TURN_DEG = 1.0
_RIGHT_DIRECTION_DEG = 5.0
_RIGHT_OFFSET_M = 0.1
_RIGHT_REFINED_M = 0.03
_NOISE_PX = 0.5
_MEETING = 1e-9
_SEED = 0


def relative(inputs: Inputs) -> list[Entry]:
    """Find the relative pose of two drones' cameras by their images."""
    judge = partial(_judge_relative, inputs.b_from_a, None)
    focal_px = inputs.a.camera.focal_px
    return _contest("relative", inputs.matches_a, inputs.matches_b, focal_px, judge)


def relative_made(_: Inputs) -> list[Entry]:
    """Find it by 300 matches made of relief, 1 px noise, half of them wrong."""
    case = case_of(Cell("relative", "relief", 1.0, 0.5), _SEED)
    judge = partial(_judge_relative, case.b_from_a, case.twin)
    return _contest("relative", case.a, case.b, FOCAL_PX, judge)


def resection(inputs: Inputs) -> list[Entry]:
    """Find a frame's pose by its matches with the map."""
    judge = partial(_judge_absolute, inputs.frame.cam_from_world, _RIGHT_OFFSET_M)
    focal_px = inputs.frame.camera.focal_px
    return _contest("resection", inputs.landmarks, inputs.seen, focal_px, judge)


def resection_made(_: Inputs) -> list[Entry]:
    """Find it by 300 landmarks in relief, 1 px noise, half of the matches wrong."""
    case: Case = case_of(Cell("resection", "relief", 1.0, 0.5), _SEED)
    judge = partial(_judge_absolute, case.b_from_a, _RIGHT_OFFSET_M)
    return _contest("resection", case.points, case.b, FOCAL_PX, judge)


def refinement(inputs: Inputs) -> list[Entry]:
    """Refine a frame's pose by matches that agree, from 0.1 m and 1 degree beside it."""
    camera, truth = inputs.frame.camera, inputs.frame.cam_from_world
    found = resect(inputs.seen, inputs.landmarks, camera.focal_px, np.random.default_rng(_SEED))
    agree = np.ones(len(inputs.seen), bool) if isinstance(found, NotFound) else found.inliers
    seen, points = np.ascontiguousarray(inputs.seen[agree]), inputs.landmarks[agree]
    start = Pose(
        exp_so3(np.deg2rad([0.6, -0.6, 0.5])) @ truth.rotation,
        truth.translation + np.array([0.06, -0.06, 0.05]),
    )
    sightings = Sightings(
        seen, points, np.zeros((len(points), 3, 3)), camera.focal_px, camera.pixel_slopes(seen),
        Pose.identity(), _NOISE_PX, np.zeros(len(points)),
    )  # fmt: skip
    centre = points.mean(axis=0)
    problem = ResectionProblem(
        seen, points - centre, camera.focal_px, float(camera.width_px * camera.height_px)
    )
    pixels, matrix = seen * camera.focal_px, np.diag([camera.focal_px, camera.focal_px, 1.0])

    def with_covariance() -> Pose:
        refined = refine(start.inverse(), sightings, ResectionOptions())
        return refined.world_from_body.inverse() if isinstance(refined, Resection) else start

    def likeliest() -> Pose:
        model = np.column_stack([start.rotation, start.apply(centre)])
        moved, _ = problem.refined(model, 2.5 * _NOISE_PX)
        return Pose(moved[:, :3], moved[:, 3] - moved[:, :3] @ centre)

    def by_scipy(loss: Literal["linear", "soft_l1"]) -> Pose:
        result = least_squares(
            _reprojection, _vector(start), _reprojection_slopes, loss=loss, f_scale=2 * _NOISE_PX,
            x_scale="jac", args=(points, seen, camera.focal_px),
        )  # fmt: skip
        return _pose(result.x)

    def by_cv2() -> Pose:
        turn, shift = cv2.solvePnPRefineLM(
            points, pixels, matrix, None, log_so3(start.rotation), start.translation.copy()
        )
        return Pose(exp_so3(np.ravel(turn)), np.ravel(shift))

    def judge(pose: Pose) -> Accuracy:
        return _judge_absolute(truth, _RIGHT_REFINED_M, [pose])

    return [
        Entry("ours, with covariance", with_covariance, judge),
        Entry("ours, likeliest", likeliest, judge),
        Entry("scipy least_squares", partial(by_scipy, "linear"), judge),
        Entry("scipy least_squares, soft L1", partial(by_scipy, "soft_l1"), judge),
        Entry("cv2 solvePnPRefineLM", by_cv2, judge),
    ]


def correction(inputs: Inputs) -> list[Entry]:
    """Move matches until their rays meet (Hartley and Sturm)."""
    pose, focal_px = inputs.b_from_a, inputs.a.camera.focal_px
    a, b = inputs.matches_a, inputs.matches_b
    length = float(np.linalg.norm(pose.translation))
    essential = skew(pose.translation / length) @ pose.rotation

    def by_cv2() -> tuple[Array, Array]:
        moved_a, moved_b = cv2.correctMatches(essential, a[None], b[None])
        return moved_a[0], moved_b[0]

    def judge(moved: tuple[Array, Array]) -> Accuracy:
        rays_a, rays_b = (np.column_stack([side, np.ones(len(side))]) for side in moved)
        apart = float(np.abs(np.einsum("ni,ij,nj->n", rays_b, essential, rays_a)).max())
        squared = ((moved[0] - a) ** 2 + (moved[1] - b) ** 2).sum(axis=1)
        rms_px = focal_px * float(np.sqrt(squared.mean()))
        return Accuracy(f"moved by {rms_px:.6f} px, apart by {apart:.0e}", apart < _MEETING)

    return [
        Entry("ours", lambda: corrected_matches(pose, a, b), judge),
        Entry("cv2 correctMatches", by_cv2, judge),
    ]


def _contest(
    task: Task,
    first: Array,
    second: Array,
    focal_px: float,
    judge: Callable[[list[Pose]], Accuracy],
) -> list[Entry]:
    return [
        Entry(name, partial(contender, first, second, focal_px, THRESHOLD_PX[task], _SEED), judge)
        for name, contender in contenders_of(task).items()
    ]


def _judge_relative(truth: Pose, twin: Pose | None, poses: list[Pose]) -> Accuracy:
    if not poses:
        return Accuracy("nothing found", False)
    options = []
    for pose in (truth,) if twin is None else (truth, twin):
        lengths = np.linalg.norm(poses[0].translation) * np.linalg.norm(pose.translation)
        cosine = poses[0].translation @ pose.translation / lengths
        options.append(
            (_turn_deg(poses[0], pose), float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))))
        )
    turn, direction = min(options)
    right = turn < _RIGHT_TURN_DEG and direction < _RIGHT_DIRECTION_DEG
    return Accuracy(f"{turn:.3f} deg, direction {direction:.2f} deg", right)


def _judge_absolute(truth: Pose, limit_m: float, poses: list[Pose]) -> Accuracy:
    if not poses:
        return Accuracy("nothing found", False)
    turn = _turn_deg(poses[0], truth)
    offset = float(np.linalg.norm(poses[0].inverse().translation - truth.inverse().translation))
    right = turn < _RIGHT_TURN_DEG and offset < limit_m
    return Accuracy(f"{turn:.3f} deg, {1e3 * offset:.1f} mm", right)


def _turn_deg(one: Pose, other: Pose) -> float:
    return float(np.rad2deg(angle_between(one.rotation, other.rotation)))


def _vector(pose: Pose) -> Array:
    return np.concatenate([log_so3(pose.rotation), pose.translation])


def _pose(vector: Array) -> Pose:
    return Pose(exp_so3(vector[:3]), vector[3:])


def _reprojection(vector: Array, points: Array, seen: Array, focal_px: float) -> Array:
    projected, _ = cv2.projectPoints(
        points, vector[:3], vector[3:], np.diag([focal_px, focal_px, 1.0]), None
    )
    return np.asarray(projected.reshape(-1) - focal_px * seen.reshape(-1))


def _reprojection_slopes(vector: Array, points: Array, seen: Array, focal_px: float) -> Any:
    _, slopes = cv2.projectPoints(
        points, vector[:3], vector[3:], np.diag([focal_px, focal_px, 1.0]), None
    )
    return slopes[:, :6]
