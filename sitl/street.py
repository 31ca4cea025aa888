"""A straight street: the road with its markings, kerbs and pavements, parked cars, lamps."""

from __future__ import annotations

from typing import Literal

import cv2
import msgspec
import numpy as np

from sitl import cars
from sitl.faces import Face, Frame, Side, box
from sitl.textures import Canvas, Style, material, noise, stains
from vcl_companion.geometry.rotation import Array

_TEXELS_PER_M = 28.0  # at most; towns drawn more coarsely have coarser streets
_ROAD_M = 0.03  # above the ground it lies on
_KERB_M = 0.14
_PLACE_M = 6.0  # a parking place's length


class Street(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A street from one place to another along its middle; places NED, metres.

    Attributes:
        from_x_m, from_y_m, to_x_m, to_y_m: the ends of its middle line.
        road_m: width between the kerbs.
        pavement_m: width of each pavement; 0 has none.
        parked: share of the parking places along both kerbs that are taken.
        lamp_every_m: distance between lamp posts, on both sides in turn; 0 has none.
        crossings: zebra crossings so many metres from the start.
        style: of the road; anything but asphalt has no markings.
        seed: streets with equal seed and size look the same; 0 makes each its own.
    """

    from_x_m: float
    from_y_m: float
    to_x_m: float
    to_y_m: float
    road_m: float = 8.0
    pavement_m: float = 2.5
    parked: float = 0.5
    lamp_every_m: float = 16.0
    crossings: tuple[float, ...] = ()
    style: Literal["asphalt", "paving"] = "asphalt"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.length_m < 5.0 or 0.0 < self.lamp_every_m < 1.0:
            raise ValueError("street: 5 m or longer, lamp_every_m is 0 or 1 m and more")

    @property
    def length_m(self) -> float:
        """From end to end."""
        return float(np.hypot(self.to_x_m - self.from_x_m, self.to_y_m - self.from_y_m))


def pave(street: Street, rng: np.random.Generator, texels_per_m: float) -> list[Face]:
    """Build all faces of a street.

    Args:
        street: what it is like.
        rng: where its looks are drawn from.
        texels_per_m: resolution of the town's paint.
    """
    tpm = min(texels_per_m, _TEXELS_PER_M)
    start = np.array([street.from_x_m, street.from_y_m, 0.0])
    along = np.array([street.to_x_m, street.to_y_m, 0.0]) - start
    along /= street.length_m
    right = np.array([-along[1], along[0], 0.0])  # of who walks from the start to the end
    shape = (round(street.road_m * tpm), round(street.length_m * tpm))
    canvas = material(rng, street.style, shape, tpm)
    if street.style == "asphalt":
        _wear(rng, canvas, tpm)
        _mark(rng, canvas, street, tpm)
    _covers(rng, canvas, tpm)
    # Seen from above with the start on the left, the right of the walk is down.
    corner = start - street.road_m / 2 * right - np.array([0.0, 0.0, _ROAD_M])
    faces = [Face(Frame(corner, along, right), street.length_m, street.road_m, canvas, "road")]
    for side in (-1.0, 1.0):
        faces += _pavement(street, start, along, side * right, rng, tpm)
        faces += _parked(street, start, along, side * right, rng, texels_per_m)
    if street.lamp_every_m > 0.0:
        for n, at in enumerate(np.arange(3.0, street.length_m, street.lamp_every_m)):
            out = (1.0 if n % 2 else -1.0) * right
            foot = start + at * along + (street.road_m / 2 + 0.4) * out
            faces += _lamp(foot, out, rng, tpm)
    return faces


def _wear(rng: np.random.Generator, canvas: Canvas, tpm: float) -> None:
    """Patch, seal and stain a road, in place."""
    rows, columns = canvas.shape
    stains(rng, canvas, tpm, 0.6)
    for _ in range(rng.poisson(0.035 * rows * columns / tpm**2)):
        high, wide = (rng.uniform((0.5, 0.8), (2.2, 5.0)) * tpm).astype(int)
        top, left = int(rng.integers(0, rows)), int(rng.integers(0, columns))
        patch = canvas[top : top + high, left : left + wide]
        patch *= np.float32(rng.uniform(0.68, 1.25))
        seal = (int(left), int(top)), (int(left + wide), int(top + high))
        cv2.rectangle(canvas, *seal, (42.0,), 2)
    for share in (0.22, 0.42, 0.6, 0.8):  # where wheels run
        middle = int(share * rows)
        canvas[max(0, middle - int(0.29 * tpm)) : middle + int(0.29 * tpm)] *= np.float32(0.93)


def _mark(rng: np.random.Generator, canvas: Canvas, street: Street, tpm: float) -> None:
    """Paint worn lines: dashes in the middle, parking bays at the kerbs, crossings."""
    rows, columns = canvas.shape
    lines = np.zeros_like(canvas)
    bar = max(2, int(0.13 * tpm))
    for left in range(0, columns, int(4.5 * tpm)):
        lines[rows // 2 - bar // 2 : rows // 2 + bar // 2 + 1, left : left + int(2.4 * tpm)] = 1.0
    bay = int(2.05 * tpm)
    for top in (bay, rows - bay):
        lines[top : top + bar // 2 + 1] = 1.0
    for left in range(0, columns, int(_PLACE_M * tpm)):
        lines[:bay, left : left + bar // 2 + 1] = 1.0
        lines[rows - bay :, left : left + bar // 2 + 1] = 1.0
    for at_m in street.crossings:
        left = int((at_m - 1.5) * tpm)
        lines[:, max(0, left - int(0.6 * tpm)) : left + int(3.6 * tpm)] = 0.0
        for top in range(int(0.3 * tpm), rows, int(1.0 * tpm)):
            lines[top : top + int(0.5 * tpm), max(0, left) : left + int(3.0 * tpm)] = 1.0
    worn = noise(rng, (rows, columns), tpm, 1.5, 0.08, 0.4)
    lines *= np.clip(0.9 - 0.35 * worn, 0.15, 1.0)
    canvas += lines * (np.float32(165.0) - canvas)


def _covers(rng: np.random.Generator, canvas: Canvas, tpm: float) -> None:
    """Set iron covers and gullies into a road, in place."""
    rows, columns = canvas.shape
    for _ in range(rng.poisson(0.016 * rows * columns / tpm**2)):
        centre = int(rng.integers(0, columns)), int(rng.integers(0, rows))
        radius = int(rng.uniform(0.28, 0.4) * tpm)
        cv2.circle(canvas, centre, radius + 2, (45.0,), -1)
        cv2.circle(canvas, centre, radius, (75.0,), -1)
        for ring in (0.75, 0.45):
            cv2.circle(canvas, centre, int(ring * radius), (40.0,), 1)
        turn = float(rng.uniform(0, 90))
        cv2.ellipse(canvas, centre, (radius, 2), turn, 0, 360, (38.0,), -1)
    for left in np.arange(4.0, columns / tpm, 11.0).tolist():
        for top in (0.02, rows / tpm - 0.42):
            x, y = int(left * tpm), int(top * tpm)
            canvas[y : y + int(0.4 * tpm), x : x + int(0.5 * tpm)] = 55.0
            canvas[y : y + int(0.4 * tpm), x : x + int(0.5 * tpm) : 3] = 22.0


def _pavement(
    street: Street, start: Array, along: Array, out: Array, rng: np.random.Generator, tpm: float
) -> list[Face]:
    """Lay one pavement, ``out`` from the middle line."""
    if street.pavement_m == 0.0:
        return []

    def paint(side: Side, width_m: float, height_m: float) -> Canvas:
        shape = (max(2, round(height_m * tpm)), max(2, round(width_m * tpm)))
        style: Style = "paving" if side == "top" else "concrete"
        canvas = material(rng, style, shape, tpm)
        if side == "top":
            stains(rng, canvas, tpm, 1.0)
        return canvas

    middle = start + street.length_m / 2 * along + street.road_m / 2 * out
    facing = float(np.arctan2(-out[1], -out[0]))
    kerb = Frame.facing(middle, facing, street.length_m, _KERB_M)
    size = (street.length_m, _KERB_M, street.pavement_m)
    return box(kerb, size, paint, "pavement", ("front", "left", "right", "top", "back"))


def _parked(
    street: Street, start: Array, along: Array, out: Array, rng: np.random.Generator, tpm: float
) -> list[Face]:
    """Park cars along one kerb."""
    faces = []
    facing = float(np.arctan2(-out[1], -out[0]))  # their sides look to the middle of the road
    for at in np.arange(_PLACE_M / 2, street.length_m - _PLACE_M / 2, _PLACE_M).tolist():
        blocked = any(abs(at - crossing) < 4.5 for crossing in street.crossings)
        if rng.random() > street.parked or blocked:
            continue
        where = at + float(rng.uniform(-0.5, 0.5))
        foot = start + where * along + (street.road_m / 2 - 2.0) * out
        faces += cars.park(foot, facing + float(rng.normal(0.0, 0.02)), rng, tpm)
    return faces


def _lamp(foot: Array, out: Array, rng: np.random.Generator, tpm: float) -> list[Face]:
    """Put up a lamp post whose head hangs over the road."""

    def metal(side: Side, width_m: float, height_m: float) -> Canvas:
        shape = (max(2, round(height_m * tpm)), max(2, round(width_m * tpm)))
        return material(rng, "plain", shape, tpm) * np.float32(0.45)

    facing = float(np.arctan2(-out[1], -out[0]))
    height = 4.6
    every: tuple[Side, ...] = ("front", "left", "right", "back")
    post = Frame.facing(foot, facing, 0.14, height)
    faces = box(post, (0.14, height, 0.14), metal, "lamp post", every)
    head = post.moved(-0.1, -0.16, 0.9)
    solid: tuple[Side, ...] = ("front", "left", "right", "top", "bottom", "back")
    return faces + box(head, (0.34, 0.16, 1.1), metal, "lamp", solid)
