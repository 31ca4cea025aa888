"""Who competes in ``bench robust``: our search, OpenCV's RANSAC and MAGSAC, poselib.

Every contender gets ideal image coordinates and a threshold in px, which ours
does not look at, and returns the poses it believes in, best first.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, orthonormalized
from vcl_companion.vision.absolute_pose import resect
from vcl_companion.vision.acransac import NotFound
from vcl_companion.vision.relative_pose import essential_candidates

# (coordinates in camera a, or landmarks; coordinates in camera b; px per unit; threshold; seed)
Contender = Callable[[Array, Array, float, float, int], list[Pose]]

_MAX_SAMPLES = 20000
_CONFIDENCE = 0.9999
_NO_DISTORTION = np.zeros(4)


def contenders_of(task: Literal["relative", "resection"]) -> dict[str, Contender]:
    """Return who takes part: poselib only where it is installed."""
    return relative_contenders() if task == "relative" else resection_contenders()


def relative_contenders() -> dict[str, Contender]:
    """Return who finds b_from_a of matches (N, 2), (N, 2)."""
    found: dict[str, Contender] = {
        "ours": _our_relative,
        "cv2 RANSAC": _cv2_relative,
        "cv2 MAGSAC": _magsac_relative,
    }
    if importlib.util.find_spec("poselib"):
        found["poselib"] = _poselib_relative
    return found


def resection_contenders() -> dict[str, Contender]:
    """Return who finds cam_from_world of landmarks (N, 3) and their images (N, 2)."""
    found: dict[str, Contender] = {
        "ours": _our_resection,
        "cv2 RANSAC": _cv2_resection,
        "cv2 MAGSAC": _magsac_resection,
    }
    if importlib.util.find_spec("poselib"):
        found["poselib"] = _poselib_resection
    return found


def _our_relative(a: Array, b: Array, focal_px: float, _: float, seed: int) -> list[Pose]:
    found = essential_candidates(a, b, focal_px, np.random.default_rng(seed))
    return [candidate.b_from_a for candidate in found]


def _our_resection(points: Array, b: Array, focal_px: float, _: float, seed: int) -> list[Pose]:
    found = resect(b, points, focal_px, np.random.default_rng(seed))
    return [] if isinstance(found, NotFound) else [found.cam_from_world]


def _cv2_relative(a: Array, b: Array, focal_px: float, threshold: float, seed: int) -> list[Pose]:
    cv2.setRNGSeed(seed)
    camera = np.diag([focal_px, focal_px, 1.0])
    matrix, inliers = cv2.findEssentialMat(
        a * focal_px, b * focal_px, camera, cv2.RANSAC, _CONFIDENCE, threshold, _MAX_SAMPLES
    )
    return _recovered(matrix, inliers, a, b)


def _magsac_relative(
    a: Array, b: Array, focal_px: float, threshold: float, seed: int
) -> list[Pose]:
    eye = np.eye(3)
    matrix, inliers = cv2.findEssentialMat(
        a, b, eye, eye, _NO_DISTORTION, _NO_DISTORTION, _usac(threshold / focal_px, seed)
    )
    return _recovered(matrix, inliers, a, b)


def _recovered(matrix: object, inliers: object, a: Array, b: Array) -> list[Pose]:
    if not isinstance(matrix, np.ndarray) or matrix.shape[0] < 3:
        return []
    mask = np.array(inliers, dtype=np.uint8)
    _, rotation, translation, _ = cv2.recoverPose(matrix[:3], a, b, np.eye(3), mask=mask)
    return [_pose(rotation, translation)]


def _cv2_resection(
    points: Array, b: Array, focal_px: float, threshold: float, seed: int
) -> list[Pose]:
    cv2.setRNGSeed(seed)
    camera, pixels = np.diag([focal_px, focal_px, 1.0]), b * focal_px
    ok, _, _, inliers = cv2.solvePnPRansac(
        points,
        pixels,
        camera,
        None,
        iterationsCount=_MAX_SAMPLES,
        reprojectionError=threshold,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not ok or inliers is None or len(inliers) < 4:
        return []
    # Its own last step is EPnP, which gets half of all planes wrong: done again, better.
    chosen = inliers[:, 0]
    ok, rotation_vector, translation = cv2.solvePnP(
        points[chosen], pixels[chosen], camera, None, flags=cv2.SOLVEPNP_SQPNP
    )
    return [_pose(cv2.Rodrigues(rotation_vector)[0], translation)] if ok else []


def _magsac_resection(
    points: Array, b: Array, focal_px: float, threshold: float, seed: int
) -> list[Pose]:
    camera = np.diag([focal_px, focal_px, 1.0])
    ok, _, rotation_vector, translation, _ = cv2.solvePnPRansac(
        points, b * focal_px, camera, _NO_DISTORTION, params=_usac(threshold, seed)
    )
    return [_pose(cv2.Rodrigues(rotation_vector)[0], translation)] if ok else []


def _usac(threshold: float, seed: int) -> cv2.UsacParams:
    """Return the settings of OpenCV's USAC_MAGSAC, with our number of samples."""
    params = cv2.UsacParams()
    params.threshold = threshold
    params.confidence = _CONFIDENCE
    params.maxIterations = _MAX_SAMPLES
    params.randomGeneratorState = seed
    params.sampler = cv2.SAMPLING_UNIFORM
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.loIterations = 10
    params.loSampleSize = 50
    params.final_polisher = cv2.MAGSAC
    params.final_polisher_iterations = 3
    return params


def _poselib_relative(
    a: Array, b: Array, focal_px: float, threshold: float, seed: int
) -> list[Pose]:
    import poselib

    camera = _simple_camera(focal_px)
    options = {"max_epipolar_error": threshold, **_poselib_options(seed)}
    pose, info = poselib.estimate_relative_pose(
        a * focal_px, b * focal_px, camera, camera, options, {}
    )
    return [_pose(pose.R, pose.t)] if info["num_inliers"] else []


def _poselib_resection(
    points: Array, b: Array, focal_px: float, threshold: float, seed: int
) -> list[Pose]:
    import poselib

    options = {"max_reproj_error": threshold, **_poselib_options(seed)}
    pose, info = poselib.estimate_absolute_pose(
        b * focal_px, points, _simple_camera(focal_px), options, {}
    )
    return [_pose(pose.R, pose.t)] if info["num_inliers"] else []


def _simple_camera(focal_px: float) -> dict[str, object]:
    return {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal_px, 0.0, 0.0]}


def _poselib_options(seed: int) -> dict[str, object]:
    return {"max_iterations": _MAX_SAMPLES, "success_prob": _CONFIDENCE, "seed": seed}


def _pose(rotation: object, translation: object) -> Pose:
    turned = orthonormalized(np.asarray(rotation, dtype=np.float64))
    return Pose(turned, np.asarray(translation, dtype=np.float64).reshape(3))
