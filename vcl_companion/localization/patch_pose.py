"""The pose that patches found in one frame agree on, whatever covers a part of it (eq. 4)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.fix import NotLocalized, Prior
from vcl_companion.vision.patches import Alignment
from vcl_companion.vision.pose_kernels import CONVERGED, converged, supported

_CHI2_2_99 = 9.21
_WIDE, _NARROW = np.array([8.0, 3.0, 1.0]), np.array([1.0])
# Fewer than this share of the patches found on a pose: something else may have led to it.
_AGREED = 0.7
_N_STRIPS = 3

System = tuple[Array, Array, Array, Array, Array, Array, Array]
Support = tuple[NDArray[np.bool_], Array, Array, Array, Array, Array, float]


@dataclass(frozen=True, eq=False)
class PatchPoses:
    """Poses from the patches of one camera.

    Attributes:
        body_from_cam: the camera's mounting.
        size_px: width and height of its image.
        min_inliers: landmarks that must agree.
    """

    body_from_cam: Pose
    size_px: tuple[int, int]
    min_inliers: int

    def led(self, found: Alignment, pose: Pose, prior: Prior | None) -> Pose | NotLocalized:
        """Refine a pose that may be some px off; with ``prior``, no farther than that allows."""
        return self._refined(found, pose, prior, _WIDE)

    def settled(self, found: Alignment, pose: Pose) -> Pose | NotLocalized:
        """Refine a pose that is right to a few sigmas of its patches."""
        return self._refined(found, pose, None, _NARROW)

    def rivals(self, found: Alignment, pose: Pose) -> list[Pose] | NotLocalized:
        """Refine a pose that may be some px off; where many patches disagree, in several ways.

        A thing that moves has patches that agree with each other, and when it is
        near or well seen they may draw the refinement to them. Where many disagree
        with what came out, every third of the image, upright and across, is left out
        in turn.

        Returns:
            The pose that most patches agree on, and after it those that mostly others
            agree on.
        """
        first = self.led(found, pose, None)
        if isinstance(first, NotLocalized):
            return first
        candidates = [(first, self._agreeing(found, first))]
        if candidates[0][1].sum() >= _AGREED * len(found.anchors):
            return [first]
        for part in self._without_a_third(found.pixels):
            other = self.led(found.of(part), pose, None)
            if not isinstance(other, NotLocalized):
                candidates.append((other, self._agreeing(found, other)))
        candidates.sort(key=lambda one: -int(one[1].sum()))
        kept: list[tuple[Pose, NDArray[np.bool_]]] = []
        for candidate, agreeing in candidates:
            n = int(agreeing.sum())
            is_new = all((agreeing & others).sum() < 0.5 * n for _, others in kept)
            if not kept or (is_new and n >= self.min_inliers):
                kept.append((candidate, agreeing))
        return [candidate for candidate, _ in kept]

    def n_agreeing(self, found: Alignment, pose: Pose) -> int:
        """Return how many patches agree with a pose."""
        return int(self._agreeing(found, pose).sum())

    def support(self, found: Alignment, pose: Pose) -> Support:
        """Return who agrees with a pose, and how they fix it (``pose_kernels.supported``)."""
        return supported(*self._system(pose, found), 2.0 * _CHI2_2_99)

    def _agreeing(self, found: Alignment, pose: Pose) -> NDArray[np.bool_]:
        return self.support(found, pose)[0]

    def _without_a_third(self, pixels: Array) -> Iterator[NDArray[np.bool_]]:
        for axis in (0, 1):
            strip = np.floor((pixels[:, axis] + 0.5) * _N_STRIPS / self.size_px[axis])
            for k in range(_N_STRIPS):
                yield strip != k

    def _refined(
        self, found: Alignment, pose: Pose, prior: Prior | None, scales: Array
    ) -> Pose | NotLocalized:
        n = len(found.anchors)
        if n < self.min_inliers:
            return NotLocalized(f"{n} patches found, {self.min_inliers} needed", n)
        known = np.zeros((6, 6))
        if prior is not None:
            known = np.asarray(np.linalg.inv(prior.covariance), dtype=np.float64)
        matrix, outcome = converged(*self._system(pose, found), known, scales)
        if outcome != CONVERGED:
            return NotLocalized("the patches found do not fix a pose", n)
        return Pose(matrix[:, :3], matrix[:, 3])

    def _system(self, pose: Pose, found: Alignment) -> System:
        return (
            np.ascontiguousarray(pose.matrix()[:3]),
            np.ascontiguousarray(self.body_from_cam.matrix()[:3]),
            found.ideal,
            found.slopes,
            found.points_world,
            found.spread,
            found.noise + found.misplaced,
        )
