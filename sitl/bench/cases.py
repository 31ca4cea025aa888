"""The scenes of ``bench robust``: matches of two views with noise and wrong ones, and the truth.

Nothing of ``vcl_companion.vision`` is used here: who is judged does not make the test.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, angle_between, exp_so3, orthonormalized

Task = Literal["relative", "resection"]
Shape = Literal["planar", "relief"]

TASKS: tuple[Task, ...] = ("relative", "resection")
SHAPES: tuple[Shape, ...] = ("planar", "relief")
SIGMAS_PX = (0.3, 1.0, 3.0)
OUTLIERS = (0.3, 0.5, 0.7, 0.8)
N_MATCHES = 300
FOCAL_PX = 320.0

_HALF_VIEW = np.array([1.0, 0.75])  # 640 x 480 px
_DISTANCE_M = 12.0
_RELIEF_M = 6.0
_BASELINE_M = 3.0
_TWIN_IN_FRONT = 0.9


@dataclass(frozen=True)
class Cell:
    """One cell of the grid.

    Attributes:
        task: pose of one view in the other, or of a view among landmarks.
        shape: what the scene is.
        sigma_px: noise of every image coordinate, 1 sigma.
        outliers: share of wrong matches.
    """

    task: Task
    shape: Shape
    sigma_px: float
    outliers: float

    @property
    def name(self) -> str:
        """What it is called on the command line and in file names."""
        return f"{self.task}-{self.shape}-{self.sigma_px:g}px-{100 * self.outliers:.0f}"


@dataclass(frozen=True, eq=False)
class Case:
    """Matches and the truth behind them.

    Attributes:
        points: (N, 3) landmarks in camera a, m.
        a, b: (N, 2) ideal image coordinates.
        good: (N,) bool.
        b_from_a: the truth.
        twin: the other pose that two views of a plane leave open, if any.
    """

    points: Array
    a: Array
    b: Array
    good: NDArray[np.bool_]
    b_from_a: Pose
    twin: Pose | None


def grid() -> Iterator[Cell]:
    """Yield every cell."""
    for task in TASKS:
        for shape in SHAPES:
            for sigma_px in SIGMAS_PX:
                for outliers in OUTLIERS:
                    yield Cell(task, shape, sigma_px, outliers)


def case_of(cell: Cell, seed: int) -> Case:
    """Make the ``seed``-th scene of a cell."""
    rng = np.random.default_rng([seed, SHAPES.index(cell.shape)])
    return make_case(cell.shape, cell.sigma_px, cell.outliers, rng)


def make_case(shape: Shape, sigma_px: float, outliers: float, rng: np.random.Generator) -> Case:
    """Make two views of one scene, with noise in both, and wrong matches.

    Args:
        shape: a tilted plane, or landmarks anywhere in a slab.
        sigma_px: noise of every coordinate.
        outliers: share of matches whose place in view b is anywhere in the image.
        rng: everything random comes from it.
    """
    direction = rng.standard_normal(3) * (1.0, 0.4, 0.4)
    centre = _BASELINE_M * direction / np.linalg.norm(direction)
    a_from_b = Pose(exp_so3(np.deg2rad(5.0) * rng.standard_normal(3)), centre)
    b_from_a = a_from_b.inverse()
    slope = np.tan(np.deg2rad(rng.uniform(-30.0, 30.0, 2)))
    points = np.empty((0, 3))
    while len(points) < N_MATCHES:
        rays = np.column_stack(
            [_HALF_VIEW * rng.uniform(-1.0, 1.0, (N_MATCHES, 2)), np.ones(N_MATCHES)]
        )
        if shape == "planar":
            # z = distance + slope . (x, y) along each ray
            depth = _DISTANCE_M / (1.0 - rays[:, :2] @ slope)
        else:
            depth = _DISTANCE_M + _RELIEF_M * rng.uniform(-1.0, 1.0, N_MATCHES)
        fresh = rays * depth[:, None]
        moved = b_from_a.apply(fresh)
        seen = (depth > 1.0) & (moved[:, 2] > 1.0)
        seen &= (np.abs(moved[:, :2]) < _HALF_VIEW * moved[:, 2:]).all(axis=1)
        points = np.vstack([points, fresh[seen]])[:N_MATCHES]
    moved = b_from_a.apply(points)
    a, b = points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]
    twin = None
    if shape == "planar":
        normal = np.array([-slope[0], -slope[1], 1.0])
        homography = b_from_a.rotation + np.outer(b_from_a.translation, normal) / _DISTANCE_M
        twin = _twin(homography, b_from_a, a, b)
    a = a + sigma_px / FOCAL_PX * rng.standard_normal(a.shape)
    b = b + sigma_px / FOCAL_PX * rng.standard_normal(b.shape)
    good = np.ones(N_MATCHES, dtype=np.bool_)
    good[rng.permutation(N_MATCHES)[: round(outliers * N_MATCHES)]] = False
    b[~good] = _HALF_VIEW * rng.uniform(-1.0, 1.0, ((~good).sum(), 2))
    return Case(points, a, b, good, b_from_a, twin)


def _twin(homography: Array, truth: Pose, a: Array, b: Array) -> Pose | None:
    """Return the plane's other pose, if it too has nearly all points in front of both cameras.

    Only that tells the twins apart, and a few points are as easily wrong matches.
    """
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    for rotation, translation in zip(rotations, translations, strict=True):
        pose = Pose(
            orthonormalized(np.asarray(rotation)),
            np.asarray(translation, dtype=np.float64).reshape(3),
        )
        turn = angle_between(truth.rotation, pose.rotation)
        if turn > 1e-3 and _share_in_front(pose, a, b) > _TWIN_IN_FRONT:
            return pose
    return None


def _share_in_front(b_from_a: Pose, a: Array, b: Array) -> float:
    """Return the share of matches whose rays come nearest in front of both cameras."""
    rays_a = np.column_stack([a, np.ones(len(a))]) @ b_from_a.rotation.T
    rays_b = np.column_stack([b, np.ones(len(b))])
    # Least squares of depth_a rays_a - depth_b rays_b = -t, match by match
    sides = np.stack([rays_a, -rays_b], axis=2)
    right = -np.swapaxes(sides, 1, 2) @ b_from_a.translation
    depths = np.linalg.solve(np.swapaxes(sides, 1, 2) @ sides, right[:, :, None])
    return float((depths[:, :, 0] > 0.0).all(axis=1).mean())
