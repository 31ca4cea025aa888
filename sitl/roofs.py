"""Tiled roofs with a ridge along the front: two slopes, stepped gables, dormers, chimneys.

All parts of a world are rectangles, so the triangle under each end of the
ridge is a gable wall of steps, as many old towns have them.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from sitl import details
from sitl.faces import Face, Frame, Paint, Side, box
from sitl.textures import Canvas, material

_STEPS = 4
_GABLE_M = 0.4
_UPRIGHT: tuple[Side, ...] = ("front", "left", "right", "top", "back")


def gable(
    front: Frame,
    footprint_m: tuple[float, float],
    roof_deg: float,
    wall: Paint,
    rng: np.random.Generator,
    texels_per_m: float,
) -> list[Face]:
    """Build the roof of a house.

    Args:
        front: frame of the house's front, its top edge at the eaves.
        footprint_m: width and depth of the house.
        roof_deg: how steep it is.
        wall: paints gables and chimneys.
        rng: where its looks are drawn from.
        texels_per_m: resolution of its paint.
    """
    width, depth = footprint_m
    steepness = float(np.tan(np.deg2rad(roof_deg)))
    faces = _slopes(front, footprint_m, steepness, rng, texels_per_m)
    faces += _gables(front, footprint_m, steepness, wall)
    faces += _dormers(front, footprint_m, steepness, rng, texels_per_m)
    for _ in range(1 + rng.poisson(0.6)):
        wide, high = rng.uniform((0.6, 0.8), (1.1, 1.5)).tolist()
        back = float(rng.uniform(0.35, 0.65)) * depth - wide / 2
        left = float(rng.uniform(_GABLE_M, width - _GABLE_M - wide))
        top = steepness * depth / 2 + high
        stands = front.moved(left, -top, -back)
        faces += box(stands, (wide, top, wide), wall, "chimney", _UPRIGHT)
    return faces


def _slopes(
    front: Frame,
    footprint_m: tuple[float, float],
    steepness: float,
    rng: np.random.Generator,
    tpm: float,
) -> list[Face]:
    """Build both tiled slopes, with skylights, and the gutters at their lower edges."""
    width, depth = footprint_m
    rise = steepness * depth / 2
    length = float(np.hypot(depth / 2, rise))
    fall = (rise * front.down - depth / 2 * front.inward) / length
    back = (rise * front.down + depth / 2 * front.inward) / length
    faces = []
    for name, corner, right, down in (
        ("roof", front.point(0.0, -rise, -depth / 2), front.right, fall),
        ("roof back", front.point(width, -rise, -depth / 2), -front.right, back),
    ):
        shape = (max(2, round(length * tpm)), max(2, round(width * tpm)))
        canvas = material(rng, "tiles", shape, tpm)
        for _ in range(rng.poisson(0.1 * width)):
            left, top = rng.uniform((0.6, 0.8), (width - 1.4, length - 1.6)).tolist()
            details.window(rng, canvas, (left, top, 0.8, 1.1), tpm)
        faces.append(Face(Frame(corner, right, down), width, length, canvas, name))

    def lead(side: Side, width_m: float, height_m: float) -> Canvas:
        return material(
            rng, "plain", (max(2, round(height_m * tpm)), max(2, round(width_m * tpm))), tpm
        )

    gutter: tuple[Side, ...] = ("front", "left", "right", "top", "bottom", "back")
    for out_m in (0.18, -depth):
        faces += box(front.moved(0.0, -0.05, out_m), (width, 0.16, 0.18), lead, "gutter", gutter)
    return faces


def _gables(
    front: Frame, footprint_m: tuple[float, float], steepness: float, wall: Paint
) -> list[Face]:
    """Build the stepped walls that close both ends and rise a little above the tiles."""
    width, depth = footprint_m
    faces = []
    inner = np.linspace(0.0, 0.5 * depth - 0.5, _STEPS + 1).tolist()
    low = 0.0
    for start, end in pairwise(inner):
        high = steepness * end + 0.25
        for left in (0.0, width - _GABLE_M):
            step = front.moved(left, -high, -start)
            size = (_GABLE_M, high - low, depth - 2 * start)
            faces += box(step, size, wall, "gable", _UPRIGHT)
        low = high
    crest = steepness * depth / 2 + 0.35
    for left in (0.0, width - _GABLE_M):
        faces += box(
            front.moved(left, -crest, -inner[-1]),
            (_GABLE_M, crest - low, depth - 2 * inner[-1]),
            wall,
            "gable",
            _UPRIGHT,
        )
    return faces


def _dormers(
    front: Frame,
    footprint_m: tuple[float, float],
    steepness: float,
    rng: np.random.Generator,
    tpm: float,
) -> list[Face]:
    """Build boxes with a window that stand out of the front slope, some of the places taken."""
    width, depth = footprint_m
    rise = steepness * depth / 2

    def paint(side: Side, width_m: float, height_m: float) -> Canvas:
        shape = (max(2, round(height_m * tpm)), max(2, round(width_m * tpm)))
        canvas = material(rng, "plaster" if side == "front" else "tiles", shape, tpm)
        if side == "front":
            pane = (0.15, 0.2, width_m - 0.3, min(1.2, height_m - 0.35))
            details.window(rng, canvas, pane, tpm)
        return canvas

    faces = []
    places = max(1, int((width - 1.6) / 3.2))
    pitch = width / places
    for place in range(places):
        if rng.random() > 0.65:
            continue
        wide, high = rng.uniform((1.1, 1.3), (1.6, 1.7)).tolist()
        set_back = 0.12 * depth
        top = steepness * set_back + high
        if top > rise - 0.1:
            continue
        left = (place + 0.5) * pitch - wide / 2 + float(rng.uniform(-0.3, 0.3))
        reach = top / steepness - set_back  # until its flat top meets the slope
        stands = front.moved(left, -top, -set_back)
        faces += box(
            stands, (wide, high, reach), paint, "dormer", ("front", "left", "right", "top")
        )
    return faces
