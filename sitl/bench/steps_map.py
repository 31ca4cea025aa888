"""The map: its adjustment beside SciPy's, its index, and a frame localized in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from sitl.bench.inputs import FEATURES, Inputs
from sitl.bench.timing import Accuracy, Entry
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, angle_between, exp_so3, right_jacobian_so3
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.mapping.tracks import ideal_of_pixels, slopes_of_ideal
from vcl_companion.vision.bundle import (
    BundleOptions,
    Distance,
    Views,
    adjust,
    linearized,
    robust_cost,
)
from vcl_companion.vision.features import detect

# Of so many landmarks one is adjusted: SciPy takes its time.
_EVERY = 4
_SAME_COST = 1e-3
_RIGHT_M = 0.05
_RIGHT_DEG = 0.5
_PRIOR = np.diag([0.05**2] * 3 + [np.deg2rad(0.5) ** 2] * 3)


def adjustment(inputs: Inputs) -> list[Entry]:
    """Adjust poses and landmarks of a map, from beside where they belong."""
    start = _disturbed(inputs)
    least = robust_cost(adjust(start, BundleOptions())[0], BundleOptions().cauchy_px)
    problem = _Problem(start, BundleOptions().cauchy_px)

    def judge(views: Views) -> Accuracy:
        cost = robust_cost(views, BundleOptions().cauchy_px)
        n, v = views.ideal.shape[:2]
        return Accuracy(
            f"cost {cost:.3f} px2 ({n} landmarks, {v} views)", cost < (1.0 + _SAME_COST) * least
        )

    def by_scipy() -> Views:
        result = least_squares(
            problem.residuals, np.zeros(problem.size), problem.jacobian,
            method="trf", tr_solver="lsmr", x_scale="jac", ftol=1e-7, xtol=1e-10, gtol=1e-10,
        )  # fmt: skip
        return problem.views(result.x)

    return [
        Entry("ours", lambda: adjust(start, BundleOptions())[0], judge),
        Entry("scipy least_squares, sparse Jacobian", by_scipy, judge),
    ]


def indexing(inputs: Inputs) -> list[Entry]:
    """Make a map off the wire ready: detect in its keyframes, derive its covariance."""
    n = len(inputs.landmark_map.points_world)

    def judge(index: MapIndex) -> Accuracy:
        known = len(np.unique(index.owner))
        sigma = np.sqrt(np.trace(index.landmark_covariances, axis1=1, axis2=2))
        text = f"{known} of {n} landmarks by AKAZE, sigma {float(np.median(sigma)):.3f} m"
        return Accuracy(text, known > n // 4 and bool(np.all(np.isfinite(sigma))))

    return [Entry("ours", lambda: index_map(inputs.landmark_map, "akaze", FEATURES), judge)]


def localization(inputs: Inputs) -> list[Entry]:
    """Localize one frame from its pixels: with a prediction, without, and OpenCV all through."""
    frame, options = inputs.frame, LocalizationOptions()
    truth = frame.world_from_body
    prior = Prior(truth.retracted(np.array([0.03, -0.02, 0.02, 0.003, -0.004, 0.004])), _PRIOR)
    akaze = cv2.AKAZE.create(threshold=FEATURES.akaze_threshold)
    crossed = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matrix = np.diag([frame.camera.fx_px, frame.camera.fy_px, 1.0])
    matrix[:2, 2] = frame.camera.cx_px, frame.camera.cy_px

    def ours(believed: Prior | None) -> Pose | None:
        found: Localized | NotLocalized = localize_intra(
            detect(frame.image, "akaze", FEATURES), frame.camera, frame.body_from_cam,
            inputs.index, believed, truth.rotation, options,
        )  # fmt: skip
        return found.world_from_body if isinstance(found, Localized) else None

    def by_cv2() -> Pose | None:
        keypoints, descriptors = akaze.detectAndCompute(frame.image, None)
        matches = crossed.match(descriptors, inputs.index.entries.descriptors)
        pixels = np.array([keypoints[match.queryIdx].pt for match in matches])
        owners = inputs.index.owner[[match.trainIdx for match in matches]]
        points = inputs.landmark_map.points_world[owners]
        cv2.setRNGSeed(0)
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, matrix, None, iterationsCount=2000, reprojectionError=4.0,
            confidence=0.9999, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        if not ok:
            return None
        good = inliers[:, 0]
        turn, shift = cv2.solvePnPRefineLM(points[good], pixels[good], matrix, None, turn, shift)
        cam_from_world = Pose(exp_so3(np.ravel(turn)), np.ravel(shift))
        return (frame.body_from_cam @ cam_from_world).inverse()

    def judge(found: Pose | None) -> Accuracy:
        if found is None:
            return Accuracy("not localized", False)
        offset = float(np.linalg.norm(found.translation - truth.translation))
        turn = float(np.rad2deg(angle_between(found.rotation, truth.rotation)))
        right = offset < _RIGHT_M and turn < _RIGHT_DEG
        return Accuracy(f"{turn:.3f} deg, {1e3 * offset:.1f} mm", right)

    return [
        Entry("ours, guided", lambda: ours(prior), judge),
        Entry("ours, whole map", lambda: ours(None), judge),
        Entry("cv2 all through", by_cv2, judge),
    ]


def _disturbed(inputs: Inputs) -> Views:
    """Return the map's views, some of its landmarks, all but the first keyframe displaced."""
    landmark_map = inputs.landmark_map
    rng = np.random.default_rng(0)
    frames = landmark_map.keyframes
    cameras = [keyframe.camera for keyframe in frames]
    ideal = ideal_of_pixels(landmark_map.observed_px[::_EVERY], cameras)
    bodies = [
        keyframe.world_from_body.retracted(
            (i > 0) * rng.standard_normal(6) * np.array([0.03] * 3 + [0.003] * 3)
        )
        for i, keyframe in enumerate(frames)
    ]
    points = landmark_map.points_world[::_EVERY]
    length = frames[0].world_from_body.translation - frames[1].world_from_body.translation
    return Views(
        tuple(bodies),
        tuple(keyframe.body_from_cam for keyframe in frames),
        slopes_of_ideal(ideal, cameras),
        ideal,
        points + 0.05 * rng.standard_normal(points.shape),
        (Distance(0, 1, float(np.linalg.norm(length)), 0.01),),
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """The same problem for SciPy: residuals whose squares add up to our robust cost.

    A residual r of squared length q is shortened to length c sqrt(log(1 + q / c^2)).
    The unknowns are steps from the start: 6 for each view but the first, then 3
    for each landmark.
    """

    start: Views
    cauchy_px: float

    @property
    def size(self) -> int:
        return 6 * (len(self.start.bodies) - 1) + 3 * len(self.start.points)

    def views(self, steps: Array) -> Views:
        n_poses = len(self.start.bodies) - 1
        poses = steps[: 6 * n_poses].reshape(-1, 6)
        moved = [body.retracted(s) for body, s in zip(self.start.bodies[1:], poses, strict=True)]
        points = self.start.points + steps[6 * n_poses :].reshape(-1, 3)
        return replace(self.start, bodies=(self.start.bodies[0], *moved), points=points)

    def residuals(self, steps: Array) -> Array:
        return self._evaluated(steps)[0]

    def jacobian(self, steps: Array) -> csr_matrix:
        return self._evaluated(steps)[1]

    def _evaluated(self, steps: Array) -> tuple[Array, csr_matrix]:
        views = self.views(steps)
        n_poses = len(views.bodies) - 1
        values, rows, columns, residuals = [], [], [], []
        n_rows = 0
        for i, body in enumerate(views.bodies):
            seen = np.flatnonzero(np.isfinite(views.ideal[:, i, 0]))
            residual, by_pose, by_point = linearized(
                body, views.mountings[i], views.slopes[seen, i],
                views.points[seen], views.ideal[seen, i],
            )  # fmt: skip
            residual, shortened = _shortened(residual, self.cauchy_px)
            row = n_rows + np.arange(2 * len(seen)).reshape(-1, 2, 1)
            column = 6 * n_poses + 3 * seen[:, None, None] + np.arange(3)
            values.append((shortened @ by_point).ravel())
            rows.append(np.broadcast_to(row, (len(seen), 2, 3)).ravel())
            columns.append(np.broadcast_to(column, (len(seen), 2, 3)).ravel())
            if i > 0:
                turn = steps[6 * i - 3 : 6 * i]
                along = np.zeros((6, 6))
                # A step from the start, as one from where the steps have led
                along[:3, :3] = exp_so3(turn).T
                along[3:, 3:] = right_jacobian_so3(turn)
                values.append((shortened @ by_pose @ along).ravel())
                rows.append(np.broadcast_to(row, (len(seen), 2, 6)).ravel())
                pose_column = np.broadcast_to(6 * (i - 1) + np.arange(6), (len(seen), 2, 6))
                columns.append(pose_column.ravel())
            residuals.append(residual.ravel())
            n_rows += 2 * len(seen)
        for known in views.distances:
            a, b = views.bodies[known.a], views.bodies[known.b]
            offset = a.translation - b.translation
            length = float(np.linalg.norm(offset))
            residuals.append(np.array([(length - known.distance_m) / known.sigma_m]))
            for view, sign in ((known.a, 1.0), (known.b, -1.0)):
                if view > 0:
                    original = self.start.bodies[view].rotation
                    values.append(sign * offset / length @ original / known.sigma_m)
                    rows.append(np.full(3, n_rows))
                    columns.append(6 * (view - 1) + np.arange(3))
            n_rows += 1
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return np.concatenate(residuals), csr_matrix(entries, shape=(n_rows, self.size))


def _shortened(residual: Array, cauchy_px: float) -> tuple[Array, Array]:
    """Return (N, 2) shortened residuals, and their (N, 2, 2) slopes by the residuals."""
    squared = np.maximum((residual**2).sum(axis=1), 1e-12)
    scaled = squared / cauchy_px**2
    factor = np.sqrt(np.log1p(scaled) / scaled)
    # d factor / d squared
    slope = (1.0 / (1.0 + scaled) - factor**2) / (2.0 * factor * squared)
    outer = residual[:, :, None] * residual[:, None, :]
    return factor[:, None] * residual, (
        factor[:, None, None] * np.eye(2) + 2.0 * slope[:, None, None] * outer
    )
