"""Where a map's landmarks lie, on grids as fine as its images can tell.

A landmark is told by its **anchor**, the first keyframe that saw it: the pixel where that sees
it, in steps of 2^-5 px, and its inverse depth, in steps of 2^-e per metre that move what the
other keyframes see of it by no more than such a step (``exponents``). So the rounding moves a
landmark by a hundredth of a pixel, in images that were measured to a tenth, and one far away,
or seen from one place only, takes no bits for a depth that nobody knows.

What cannot be told so (behind its anchor, outside of its image, seen nowhere) is **away**: told
by x, y, z in steps of 2^-12 m.

Arithmetic of two machines may differ in the last digit of a pixel: what is coded are integers,
and the models of the coder see nothing but these. Where that moves a rounding, a pixel is a step
off there, and an update made on the other is refused by its revision.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import Keyframe
from vcl_companion.wire.landmark_kernels import MAX_DEPTH, Integers
from vcl_companion.wire.pose_codec import MAX_COORDINATE_M, rounded_pose

Flags = NDArray[np.bool_]

_STEPS_PER_M = 1 << 12
STEPS_PER_PX = 1 << 5
_MARGIN_PX = 1.0  # a subpixel peak may lie a little outside of the image
# Added to the square of every baseline: cameras are not where their bodies are.
_LEAST_BASELINE_M2 = 1.0


@dataclass(frozen=True, eq=False)
class Places:
    """Landmarks on their grids.

    Attributes:
        away: (n,) told by ``xyz``.
        xyz: (n, 3) steps of 2^-12 m, world frame; zero where not away.
        pixel: (n, 2) steps of 2^-5 px from pixel -1 on, in the anchor.
        depth: (n,) inverse depth there, steps of 2^-e per metre; zero where away.
    """

    away: Flags
    xyz: Integers
    pixel: Integers
    depth: Integers


class Views:
    """Keyframes, as whoever reads their bytes has them.

    Attributes:
        exponents: (V, V) e of a landmark with the anchor a if the other were all that saw it
            too; it has the largest one of those that did.
        largest: (V, 2) largest step of a pixel u, v.
    """

    def __init__(self, keyframes: tuple[Keyframe, ...]) -> None:
        bodies = [rounded_pose(k.world_from_body) for k in keyframes]
        self._cameras: list[Camera] = [k.camera for k in keyframes]
        self._worlds_from_cams = [
            body @ rounded_pose(k.body_from_cam) for body, k in zip(bodies, keyframes, strict=True)
        ]
        self._cams_from_worlds = [pose.inverse() for pose in self._worlds_from_cams]
        sizes_px = np.array([(c.width_px, c.height_px) for c in self._cameras], dtype=np.int64)
        self.largest: Integers = (sizes_px + int(_MARGIN_PX)) * STEPS_PER_PX
        at = np.array([body.translation for body in bodies])
        # No sums of products by a library: the same on every machine, as it has to be here.
        x, y, z = (at[:, None] - at).transpose(2, 0, 1)
        baselines_m = np.sqrt(x * x + y * y + z * z + _LEAST_BASELINE_M2)
        focal_px = np.array([c.fx_px for c in self._cameras])
        exponents = np.frexp(STEPS_PER_PX * focal_px[:, None] * baselines_m)[1]
        self.exponents: Integers = np.clip(exponents, 0, 40).astype(np.int64)

    def anchors(self, seen: Flags) -> tuple[Integers, Integers]:
        """Return the (n,) anchors of landmarks, V if there is none, and their exponents."""
        n_keyframes = seen.shape[1]
        anchors = np.where(seen.any(axis=1), seen.argmax(axis=1), n_keyframes)
        of = self.exponents[np.minimum(anchors, n_keyframes - 1)]
        return anchors, np.where(seen, of, 0).max(axis=1, initial=0)

    def places(self, points: Array, seen: Flags) -> Places:
        """Return (n, 3) points, world, m, on their grids."""
        anchors, exponents = self.anchors(seen)
        xyz = np.rint(points * _STEPS_PER_M).astype(np.int64)
        at = self._told(points, anchors, exponents)
        if at.away.any():  # what was rounded may be just inside
            rounded = self._told(xyz / _STEPS_PER_M, anchors, exponents)
            at = Places(
                rounded.away & at.away,
                xyz,
                np.where(at.away[:, None], rounded.pixel, at.pixel),
                np.where(at.away, rounded.depth, at.depth),
            )
        return Places(
            at.away,
            np.where(at.away[:, None], xyz, 0),
            np.where(at.away[:, None], 0, at.pixel),
            np.where(at.away, 0, at.depth),
        )

    def points(self, places: Places, seen: Flags) -> Array:
        """Return the (n, 3) points, world, m; NaN for what lies nowhere."""
        anchors, exponents = self.anchors(seen)
        there = self._points(places.pixel, places.depth, anchors, exponents)
        return np.where(places.away[:, None], places.xyz / _STEPS_PER_M, there)

    def guesses(self, points: Array, seen: Flags) -> Places:
        """Return where (n, 3) points would lie, the middle and depth 0 where that is nowhere."""
        return self._quantised(points, *self.anchors(seen))

    def expected(self, points: Array, seen: Flags) -> Integers:
        """Return (n, V, 2) steps where keyframes would see points; the middle if outside.

        Zero where ``seen`` does not ask for it.
        """
        out = np.zeros((*seen.shape, 2), dtype=np.int64)
        for i in range(seen.shape[1]):
            rows = np.flatnonzero(seen[:, i])
            steps, _, _ = self._projected(points[rows], i)
            out[rows, i] = steps
        return out

    def _told(self, points: Array, anchors: Integers, exponents: Integers) -> Places:
        """Return points on their anchors' grids; away if they do not come back from there."""
        at = self._quantised(points, anchors, exponents)
        back = self._points(at.pixel, at.depth, anchors, exponents)
        again = self._quantised(back, anchors, exponents)
        with np.errstate(invalid="ignore"):
            stays = (np.abs(back) <= MAX_COORDINATE_M).all(axis=1)
        stays &= (again.pixel == at.pixel).all(axis=1) & (again.depth == at.depth)
        return Places(at.away | again.away | ~stays, at.xyz, at.pixel, at.depth)

    def _quantised(self, points: Array, anchors: Integers, exponents: Integers) -> Places:
        n = len(points)
        away, xyz = np.ones(n, dtype=np.bool_), np.zeros((n, 3), dtype=np.int64)
        pixel, depth = np.zeros((n, 2), dtype=np.int64), np.zeros(n, dtype=np.int64)
        for i in range(len(self._cameras)):
            rows = np.flatnonzero(anchors == i)
            steps, inside, z = self._projected(points[rows], i)
            with np.errstate(all="ignore"):
                inverse = np.rint(np.ldexp(1.0, exponents[rows]) / z)
                inside = inside & (inverse >= 1) & (inverse <= MAX_DEPTH)
            away[rows], pixel[rows] = ~inside, steps
            depth[rows] = np.where(inside, inverse, 0).astype(np.int64)
        return Places(away, xyz, pixel, depth)

    def _projected(self, points: Array, i: int) -> tuple[Integers, Flags, Array]:
        """Return pixels, in steps, of points in a keyframe, whether they are inside; and z."""
        in_cam = _moved(self._cams_from_worlds[i], points)
        with np.errstate(all="ignore"):
            pixels = self._cameras[i].project(in_cam)
            steps = np.rint((pixels + _MARGIN_PX) * STEPS_PER_PX)
            u, v = steps.T
            inside = (u >= 0) & (v >= 0) & (u <= self.largest[i, 0]) & (v <= self.largest[i, 1])
        steps[~inside] = self.largest[i] // 2
        return steps.astype(np.int64), inside, in_cam[:, 2]

    def _points(
        self, pixel: Integers, depth: Integers, anchors: Integers, exponents: Integers
    ) -> Array:
        """Return the points on their anchors' grids; NaN where there are none."""
        out = np.full((len(pixel), 3), np.nan)
        for i, camera in enumerate(self._cameras):
            rows = np.flatnonzero((anchors == i) & (depth > 0))
            with np.errstate(all="ignore"):
                ideal = camera.ideal_from_pixels(pixel[rows] / STEPS_PER_PX - _MARGIN_PX)
                z = np.ldexp(1.0, exponents[rows]) / depth[rows]
                in_cam = np.column_stack([ideal * z[:, None], z])
                out[rows] = _moved(self._worlds_from_cams[i], in_cam)
        return out


def steps_of_pixels(observed_px: Array) -> Integers:
    """Return (..., 2) pixels in steps of 2^-5 px from pixel -1 on; -1 where there is none.

    Raises:
        ValueError: an observation has one of its coordinates only, or lies before that.
    """
    seen = np.isfinite(observed_px)
    if (seen[..., 0] != seen[..., 1]).any():
        raise ValueError("an observation has only one of its two coordinates")
    steps = np.rint((np.where(seen, observed_px, 0.0) + _MARGIN_PX) * STEPS_PER_PX)
    if (seen & (steps < 0)).any():
        raise ValueError("an observation lies outside of its image")
    return np.where(seen, steps, -1).astype(np.int64)


def pixels_of_steps(steps: Integers) -> Array:
    """Return (..., 2) pixels of steps, NaN where there is none."""
    return np.where(steps < 0, np.nan, steps / STEPS_PER_PX - _MARGIN_PX)


def _moved(a_from_b: Pose, points: Array) -> Array:
    """Return points of b in a: like ``apply``, but one of them as many of them, to the last bit."""
    x, y, z = np.ascontiguousarray(points.T)
    rows = zip(a_from_b.rotation, a_from_b.translation, strict=True)
    return np.stack([x * r[0] + y * r[1] + z * r[2] + t for r, t in rows], axis=1)
