"""Trees: a trunk, and a crown of small leafy cards that stand every way."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np

from sitl.faces import Face, Frame, Side, box
from sitl.textures import Canvas, material, noise
from vcl_companion.geometry.rotation import exp_so3

_TEXELS_PER_M = 40.0  # at most; towns drawn more coarsely have coarser trees
_CARDS_PER_M2 = 2.6  # of the crown's surface


class Tree(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One tree; place NED, metres.

    Attributes:
        x_m, y_m: its foot.
        height_m: to the top of its crown.
        crown_m: the crown's diameter.
    """

    x_m: float
    y_m: float
    height_m: float = 6.5
    crown_m: float = 3.6

    def __post_init__(self) -> None:
        if not self.crown_m < self.height_m:
            raise ValueError("tree: height_m is above crown_m")


def plant(tree: Tree, rng: np.random.Generator, texels_per_m: float) -> list[Face]:
    """Build all faces of a tree.

    Args:
        tree: what it is like.
        rng: where its looks are drawn from.
        texels_per_m: resolution of the town's paint.
    """
    tpm = min(texels_per_m, _TEXELS_PER_M)
    trunk_m, thick_m = tree.height_m - 0.6 * tree.crown_m, 0.05 * tree.height_m

    def bark(side: Side, width_m: float, height_m: float) -> Canvas:
        shape = (max(2, round(height_m * tpm)), max(2, round(width_m * tpm)))
        return material(rng, "plaster", shape, tpm) * np.float32(0.45)

    foot = np.array([tree.x_m, tree.y_m, 0.0])
    stem = Frame.facing(foot, float(rng.uniform(0, 2 * np.pi)), thick_m, trunk_m)
    sides: tuple[Side, ...] = ("front", "left", "right", "back")
    faces = box(stem, (thick_m, trunk_m, thick_m), bark, "trunk", sides)
    radius = tree.crown_m / 2
    centre = foot - np.array([0.0, 0.0, tree.height_m - radius])
    for _ in range(round(_CARDS_PER_M2 * np.pi * tree.crown_m**2)):
        out = rng.normal(size=3)
        out *= radius * rng.uniform(0.55, 1.0) / np.linalg.norm(out)
        size = float(rng.uniform(0.16, 0.3)) * tree.crown_m
        axes = exp_so3(rng.normal(size=3) * 1.5)
        canvas = _leaves(rng, size, tpm)
        down = axes[:, 1]
        for sign in (1.0, -1.0):  # a card is seen from both sides, and throws one shadow
            right = sign * axes[:, 0]
            frame = Frame(centre + out - size / 2 * (right + down), right, down)
            casts = sign > 0.0
            faces.append(Face(frame, size, size, canvas, "leaves", casts=casts))
    return faces


def _leaves(rng: np.random.Generator, size_m: float, tpm: float) -> Canvas:
    """Paint a square of foliage with gaps of shade."""
    texels = max(4, round(size_m * tpm))
    shape = (texels, texels)
    shade = 38.0 * (1.0 + 0.3 * noise(rng, shape, tpm, 0.6, 0.1, 0.4))
    canvas = np.ascontiguousarray(shade, dtype=np.float32)
    for x, y in rng.integers(0, texels, (round(70 * size_m * size_m) + 3, 2)).tolist():
        length = rng.uniform(0.05, 0.12) * tpm
        half = (max(1, int(length)), max(1, int(0.5 * length)))
        tone = float(rng.uniform(45, 105))
        cv2.ellipse(canvas, (x, y), half, float(rng.uniform(0, 180)), 0, 360, (tone,), -1)
    return canvas
