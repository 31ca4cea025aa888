"""Homographies of matches on a plane, and the relative poses behind them (IV-B), compiled.

A facade is nearly a plane; its homography is fixed by four matches, is told from
chance by far fewer than an essential matrix, and shows both planar twins.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from vcl_companion.compiled import compiled
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, orthonormalized
from vcl_companion.vision.acransac import THRESHOLD_SIGMAS, Indices


@dataclass(frozen=True, eq=False)
class HomographyProblem:
    """Homographies b ~ H a for ``ac_ransac``; the error is b's distance from where H takes a.

    Attributes:
        a, b: (N, 2) ideal image coordinates in the two cameras.
        focal_px: px per ideal unit.
        area_px2: of the part of image b in which wrong matches lie.
    """

    a: Array
    b: Array
    focal_px: float
    area_px2: float
    sample_size: int = 4
    max_models: int = 1
    dimension: int = 2

    @property
    def n_data(self) -> int:
        """How many matches there are."""
        return len(self.a)

    @property
    def log_alpha(self) -> float:
        """Log of the share of the image within 1 px of a point."""
        return float(np.log(np.pi / self.area_px2))

    def fit(self, samples: Indices) -> Array:
        """Return (K, 3, 3) homographies of (B, 4) samples."""
        return _homographies(self.a, self.b, samples)

    def squared_errors(self, models: Array) -> Array:
        """Return (K, N) squared transfer errors, px^2."""
        return _squared_transfer(models, self.a, self.b, self.focal_px)

    def refit(self, model: Array, threshold: float) -> Array:
        """Return the homography with the least weighted transfer error."""
        sigma_px = threshold / THRESHOLD_SIGMAS
        return _refined_homography(model, self.a, self.b, self.focal_px, sigma_px, 5)


def poses_of_homography(homography: Array) -> list[Pose]:
    """Return the b_from_a, translations of length 1, that may lie behind a plane's homography."""
    if not np.all(np.isfinite(homography)):
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    poses = []
    for rotation, column in zip(rotations, translations, strict=True):
        translation = np.asarray(column, dtype=np.float64)[:, 0]
        length = float(np.linalg.norm(translation))
        # A camera that only turned has no translation to speak of.
        if length > 1e-6 and np.linalg.det(rotation) > 0.0:
            turned = orthonormalized(np.asarray(rotation, dtype=np.float64))
            poses.append(Pose(turned, translation / length))
    return poses


@compiled
def _homographies(a: Array, b: Array, samples: Indices) -> Array:
    """Return the (K, 3, 3) homographies of all (B, 4) samples, by elimination with h22 = 1."""
    found = np.empty((len(samples), 3, 3))
    count = 0
    m = np.empty((8, 9))
    for k in range(len(samples)):
        for i in range(4):
            x, y = a[samples[k, i], 0], a[samples[k, i], 1]
            u, v = b[samples[k, i], 0], b[samples[k, i], 1]
            for j in range(9):
                m[2 * i, j] = m[2 * i + 1, j] = 0.0
            m[2 * i, 0], m[2 * i, 1], m[2 * i, 2] = x, y, 1.0
            m[2 * i, 6], m[2 * i, 7], m[2 * i, 8] = -u * x, -u * y, u
            m[2 * i + 1, 3], m[2 * i + 1, 4], m[2 * i + 1, 5] = x, y, 1.0
            m[2 * i + 1, 6], m[2 * i + 1, 7], m[2 * i + 1, 8] = -v * x, -v * y, v
        if not _solved(m):
            continue
        for i in range(8):
            found[count, i // 3, i % 3] = m[i, 8]
        found[count, 2, 2] = 1.0
        front = True
        for i in range(4):
            x, y = a[samples[k, i], 0], a[samples[k, i], 1]
            front = front and found[count, 2, 0] * x + found[count, 2, 1] * y + 1.0 > 0.0
        if front:
            count += 1
    return found[:count].copy()


@compiled
def _solved(m: Array) -> bool:
    """Solve (8, 8 | 1) in place by Gauss-Jordan; False where singular."""
    for k in range(8):
        pivot = k
        for i in range(k + 1, 8):
            if abs(m[i, k]) > abs(m[pivot, k]):
                pivot = i
        if not abs(m[pivot, k]) > 1e-9:
            return False
        if pivot != k:
            for j in range(k, 9):
                m[k, j], m[pivot, j] = m[pivot, j], m[k, j]
        inverse = 1.0 / m[k, k]
        for j in range(k, 9):
            m[k, j] *= inverse
        for i in range(8):
            if i == k:
                continue
            factor = m[i, k]
            for j in range(k, 9):
                m[i, j] -= factor * m[k, j]
    return True


@compiled
def _squared_transfer(models: Array, a: Array, b: Array, focal_px: float) -> Array:
    out = np.empty((len(models), len(a)))
    scale = focal_px * focal_px
    for k in range(len(models)):
        h = models[k]
        for i in range(len(a)):
            x, y = a[i, 0], a[i, 1]
            w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
            u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w - b[i, 0]
            v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w - b[i, 1]
            # Behind the plane's horizon nothing is seen.
            out[k, i] = scale * (u * u + v * v) if w > 0.0 else np.inf
    return out


@compiled
def _refined_homography(
    model: Array, a: Array, b: Array, focal_px: float, sigma_px: float, rounds: int
) -> Array:
    """Gauss-Newton on eight entries, a Gaussian weight that forgets what is far off."""
    h = np.empty((3, 3))
    h[:] = model / model[2, 2]
    jacobian = np.zeros((2, 8))
    for _ in range(rounds):
        normal, right = np.zeros((8, 8)), np.zeros(8)
        for i in range(len(a)):
            x, y = a[i, 0], a[i, 1]
            w = h[2, 0] * x + h[2, 1] * y + h[2, 2]
            if not w > 1e-9:
                continue
            u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / w
            v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / w
            du, dv = u - b[i, 0], v - b[i, 1]
            squared = (du * du + dv * dv) * (focal_px / sigma_px) ** 2
            if squared > 16.0:
                continue
            weight = np.exp(-0.25 * squared)
            jacobian[0, 0] = jacobian[1, 3] = x / w
            jacobian[0, 1] = jacobian[1, 4] = y / w
            jacobian[0, 2] = jacobian[1, 5] = 1.0 / w
            jacobian[0, 6], jacobian[0, 7] = -u * x / w, -u * y / w
            jacobian[1, 6], jacobian[1, 7] = -v * x / w, -v * y / w
            for p in range(8):
                right[p] -= weight * (jacobian[0, p] * du + jacobian[1, p] * dv)
                for q in range(p + 1):
                    normal[p, q] += weight * (
                        jacobian[0, p] * jacobian[0, q] + jacobian[1, p] * jacobian[1, q]
                    )
        for p in range(8):
            for q in range(p):
                normal[q, p] = normal[p, q]
            normal[p, p] += 1e-9 * normal[p, p] + 1e-12
        step = np.linalg.solve(normal, right)
        for p in range(8):
            h[p // 3, p % 3] += step[p]
    return h
