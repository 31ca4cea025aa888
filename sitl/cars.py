"""Parked cars and vans: two boxes, or one, with painted glass, wheels and lights."""

from __future__ import annotations

import cv2
import numpy as np

from sitl import details
from sitl.faces import Face, Frame, Side, box
from sitl.textures import Canvas, noise
from vcl_companion.geometry.rotation import Array

_TEXELS_PER_M = 40.0  # at most; towns drawn more coarsely have coarser cars
_CLEARANCE_M = 0.18
_UPRIGHT: tuple[Side, ...] = ("front", "left", "right", "top", "back")


def park(
    foot: Array, heading_rad: float, rng: np.random.Generator, texels_per_m: float
) -> list[Face]:
    """Build a car or, one time in six, a van.

    Args:
        foot: (3,) the middle of the ground under its left side, world frame, m.
        heading_rad: where its left side looks, from north to east: it points 90 degrees
            to the right of that.
        rng: where its looks are drawn from.
        texels_per_m: resolution of the town's paint.
    """
    paint = _Paint(rng, min(texels_per_m, _TEXELS_PER_M))
    if rng.random() < 1 / 6:
        length, width, height = rng.uniform((4.9, 1.9, 1.9), (5.9, 2.1, 2.5)).tolist()
        body = Frame.facing(_above(foot, _CLEARANCE_M), heading_rad, length, height)
        return box(body, (length, height, width), paint.van, "van", _UPRIGHT)
    length, width, height = rng.uniform((3.8, 1.65, 0.62), (4.7, 1.85, 0.78)).tolist()
    body = Frame.facing(_above(foot, _CLEARANCE_M), heading_rad, length, height)
    faces = box(body, (length, height, width), paint.body, "car", _UPRIGHT)
    cabin_m, roof_m = length * float(rng.uniform(0.48, 0.62)), float(rng.uniform(0.5, 0.65))
    left = (length - cabin_m) * float(rng.uniform(0.45, 0.8))
    cabin = body.moved(left, -roof_m, -0.09)
    return faces + box(cabin, (cabin_m, roof_m, width - 0.18), paint.cabin, "car cabin", _UPRIGHT)


def _above(foot: Array, height_m: float) -> Array:
    return np.asarray(foot - np.array([0.0, 0.0, height_m]))


class _Paint:
    """One vehicle's lacquer."""

    def __init__(self, rng: np.random.Generator, texels_per_m: float) -> None:
        self.rng, self.tpm = rng, texels_per_m
        self.tone = float(
            rng.choice([25.0, 45.0, 80.0, 120.0, 165.0, 185.0]) * rng.uniform(0.9, 1.1)
        )

    def lacquer(self, width_m: float, height_m: float) -> Canvas:
        shape = (max(2, round(height_m * self.tpm)), max(2, round(width_m * self.tpm)))
        sheen = np.linspace(1.12, 0.82, shape[0], dtype=np.float32)[:, None]
        mottled = 1.0 + 0.04 * noise(self.rng, shape, self.tpm, 2.0, 0.15, 0.8)
        return np.ascontiguousarray(np.float32(self.tone) * sheen * mottled, dtype=np.float32)

    def body(self, side: Side, width_m: float, height_m: float) -> Canvas:
        """Wheels and doors on the long sides, lights and plates on the short ones."""
        canvas = self.lacquer(width_m, height_m)
        rows, columns = canvas.shape
        if side in ("front", "back"):
            for share in (0.18, 0.8):
                centre = (int(share * columns), rows)
                cv2.circle(canvas, centre, int(0.42 * rows), (18.0,), -1)
                cv2.circle(canvas, centre, int(0.24 * rows), (110.0,), -1)
            for share in (0.32, 0.5, 0.68):
                column = int(share * columns)
                cv2.line(canvas, (column, 0), (column, int(0.85 * rows)), (0.6 * self.tone,), 1)
            handle = (int(0.45 * columns), int(0.25 * rows))
            cv2.rectangle(canvas, handle, (handle[0] + 6, handle[1] + 2), (0.5 * self.tone,), -1)
        elif side in ("left", "right"):
            for left in (0.04, 0.72):
                lamp = (int(left * columns), int(0.2 * rows))
                end = (int((left + 0.24) * columns), int(0.42 * rows))
                cv2.rectangle(canvas, lamp, end, (225.0,), -1)
                cv2.rectangle(canvas, lamp, end, (30.0,), 1)
            plate = (0.34 * width_m, 0.6 * height_m, 0.32 * width_m, 0.2 * height_m)
            details.lettering(self.rng, canvas, plate, self.tpm)
        return canvas

    def cabin(self, side: Side, width_m: float, height_m: float) -> Canvas:
        """Glass all round, posts between, a roof in the body's colour."""
        canvas = self.lacquer(width_m, height_m)
        if side == "top":
            return canvas
        rows, columns = canvas.shape
        panes = ((0.05, 0.47), (0.53, 0.95)) if side in ("front", "back") else ((0.07, 0.93),)
        for left, right in panes:
            glass = canvas[
                int(0.14 * rows) : int(0.92 * rows), int(left * columns) : int(right * columns)
            ]
            glass[:] = np.float32(self.rng.uniform(25, 50))
            glint = int(self.rng.uniform(0.1, 0.7) * glass.shape[1])
            glass[: glass.shape[0] // 2, glint : glint + 5] *= 2.4
        return canvas

    def van(self, side: Side, width_m: float, height_m: float) -> Canvas:
        """Lettering on the long sides and a windscreen at each end."""
        canvas = self.body(side, width_m, height_m)
        rows, columns = canvas.shape
        if side in ("front", "back"):
            sign = (0.1 * width_m, 0.22 * height_m, 0.5 * width_m, 0.22 * height_m)
            details.lettering(self.rng, canvas, sign, self.tpm)
            canvas[
                int(0.12 * rows) : int(0.42 * rows), int(0.72 * columns) : int(0.92 * columns)
            ] = 32.0
        elif side in ("left", "right"):
            canvas[int(0.06 * rows) : int(0.18 * rows), int(0.1 * columns) : int(0.9 * columns)] = (
                32.0
            )
        return canvas
