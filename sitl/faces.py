"""Painted rectangles and boxes before the sun shines on them, the parts a town is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from sitl.textures import Canvas
from vcl_companion.geometry.rotation import Array

Side = Literal["front", "left", "right", "top", "bottom", "back"]
Paint = Callable[[Side, float, float], Canvas]  # side, width and height in m to a canvas

OPEN_SIDES: tuple[Side, ...] = ("front", "left", "right", "top", "bottom")


@dataclass(frozen=True, eq=False)
class Frame:
    """A place to build on: an upright rectangle's top left corner and its axes.

    Attributes:
        origin: (3,) world frame, m.
        right, down: (3,) unit vectors as its viewer sees them, world frame.
    """

    origin: Array
    right: Array
    down: Array

    @classmethod
    def facing(
        cls, centre_foot: Array, facing_rad: float, width_m: float, height_m: float
    ) -> Frame:
        """Return the frame of an upright rectangle standing on its foot's centre, NED.

        Args:
            centre_foot: (3,) middle of its lower edge, m.
            facing_rad: heading of its outward normal, from north to east.
            width_m: how wide it is.
            height_m: how high it is.
        """
        right = np.array([np.sin(facing_rad), -np.cos(facing_rad), 0.0])
        down = np.array([0.0, 0.0, 1.0])
        return cls(centre_foot - 0.5 * width_m * right - height_m * down, right, down)

    @cached_property
    def inward(self) -> Array:
        """The (3,) unit vector away from the viewer."""
        return np.cross(self.right, self.down)

    def point(self, right_m: float, down_m: float, out_m: float = 0.0) -> Array:
        """Return the (3,) point so far right, down and towards the viewer of the origin."""
        across = self.origin + right_m * self.right + down_m * self.down
        return np.asarray(across - out_m * self.inward)

    def moved(self, right_m: float, down_m: float, out_m: float = 0.0) -> Frame:
        """Return the parallel frame whose origin is that point."""
        return Frame(self.point(right_m, down_m, out_m), self.right, self.down)


@dataclass(frozen=True, eq=False)
class Face:
    """A rectangle with its paint.

    Attributes:
        frame: where its top left corner is and how it lies.
        width_m, height_m: its size.
        canvas: (H, W) reflected light under the open sky, grey levels.
        holes: (K, 4) openings, left top right bottom, m.
        name: what it is.
        casts: whether it throws a shadow; the second side of a thin thing need not.
    """

    frame: Frame
    width_m: float
    height_m: float
    canvas: Canvas
    name: str
    holes: Array = field(default_factory=lambda: np.zeros((0, 4)))
    casts: bool = True


def box(
    front: Frame,
    size_m: tuple[float, float, float],
    paint: Paint,
    name: str,
    sides: Iterable[Side] = OPEN_SIDES,
) -> list[Face]:
    """Build the sides of a box.

    Args:
        front: frame of its front side.
        size_m: width, height and depth (away from the viewer).
        paint: called once a side, in the order given.
        name: what it is.
        sides: which ones can ever be seen.
    """
    width, height, depth = size_m
    right, down, inward = front.right, front.down, front.inward
    far = -depth
    places: dict[Side, tuple[Frame, float, float]] = {
        "front": (front, width, height),
        "left": (Frame(front.point(0, 0, far), -inward, down), depth, height),
        "right": (Frame(front.point(width, 0), inward, down), depth, height),
        "top": (Frame(front.point(0, 0, far), right, -inward), width, depth),
        "bottom": (Frame(front.point(0, height), right, inward), width, depth),
        "back": (Frame(front.point(width, 0, far), -right, down), width, height),
    }
    faces = []
    for side in sides:
        frame, face_width, face_height = places[side]
        canvas = paint(side, face_width, face_height)
        faces.append(Face(frame, face_width, face_height, canvas, f"{name} {side}"))
    return faces


def reveals(
    front: Frame,
    size_m: tuple[float, float],
    columns: Array,
    rows: Array,
    recess_m: float,
    paint: Paint,
) -> list[Face]:
    """Build the flanks of all openings of a wall, which stand in common columns and rows.

    A flank runs the whole height or width of the wall behind it: between the
    openings the wall hides it, so one face serves a whole column or row.

    Args:
        front: frame of the wall.
        size_m: width and height of the wall.
        columns: (C, 2) left and right edges of the openings, m.
        rows: (F, 2) upper and lower edges, m.
        recess_m: depth of the openings.
        paint: as for ``box``.
    """
    width, height = size_m
    right, down, inward = front.right, front.down, front.inward
    faces = []
    for start, end in columns.tolist():
        for side, frame in (
            ("right", Frame(front.point(start, 0), inward, down)),
            ("left", Frame(front.point(end, 0, -recess_m), -inward, down)),
        ):
            canvas = paint("left" if side == "left" else "right", recess_m, height)
            faces.append(Face(frame, recess_m, height, canvas, f"reveal {side}"))
    for start, end in rows.tolist():
        for side, frame in (
            ("bottom", Frame(front.point(0, start), right, inward)),
            ("top", Frame(front.point(0, end, -recess_m), right, -inward)),
        ):
            canvas = paint("bottom" if side == "bottom" else "top", width, recess_m)
            faces.append(Face(frame, width, recess_m, canvas, f"reveal {side}"))
    return faces
