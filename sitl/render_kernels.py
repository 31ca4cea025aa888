"""Compiled loops of the renderer: which rectangle each sample sees, and how light it is there.

Layout of the tables:
  forms (M, 3, 3) float32: take (x, y, 1) of the ideal image plane to (u, v, 1) / depth, where u
    and v are metres along a rectangle's edges
  holes (K, 4) float32: left, top, right, bottom of openings, m; those of rectangle m are the rows
    first_hole[m] to first_hole[m + 1]
  x, y (H, W) float32: ideal coordinates of the samples
  texels (uint8), shelves (L, 3) int64: start, height, width of each level of a texture
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled
from vcl_companion.geometry.rotation import Array

# Of a texel.
_STEPS = 32

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Texels = NDArray[np.uint8]


@compiled
def boxes_of(
    corners: Array,
    near_m: float,
    columns: tuple[Floats, Floats],
    rows: tuple[Floats, Floats],
) -> Ints:
    """Return (M, 4) first and one past the last row and column of samples that may see rectangles.

    Args:
        corners: (M, 4, 3) in camera axes, m, in their order around each rectangle.
        near_m: what is nearer is not seen.
        columns: (W,) least and largest ideal x of each column of samples.
        rows: (H,) least and largest ideal y of each row.

    Returns:
        Zero where none can.
    """
    out = np.zeros((len(corners), 4), np.int64)
    for m in range(len(corners)):
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for i in range(4):
            a, b = corners[m, i], corners[m, (i + 1) % 4]
            if a[2] >= near_m:
                x, y = a[0] / a[2], a[1] / a[2]
                left, right = min(left, x), max(right, x)
                top, bottom = min(top, y), max(bottom, y)
            if (a[2] >= near_m) != (b[2] >= near_m):
                share = (near_m - a[2]) / (b[2] - a[2])
                x = (a[0] + share * (b[0] - a[0])) / near_m
                y = (a[1] + share * (b[1] - a[1])) / near_m
                left, right = min(left, x), max(right, x)
                top, bottom = min(top, y), max(bottom, y)
        if not left <= right:
            continue
        out[m, 0], out[m, 1] = _within(rows[0], rows[1], top, bottom)
        out[m, 2], out[m, 3] = _within(columns[0], columns[1], left, right)
    return out


@compiled
def _within(least: Floats, most: Floats, begin: float, end: float) -> tuple[int, int]:
    """Return the first and one past the last of some ranges that meet one."""
    first, past = 0, 0
    for i in range(len(least)):
        if least[i] <= end and most[i] >= begin:
            if past == 0:
                first = i
            past = i + 1
    return first, past


@compiled
def find_nearest(
    chosen: Ints,
    forms: Floats,
    boxes: Ints,
    sizes: Floats,
    first_hole: Ints,
    holes: Floats,
    x: Floats,
    y: Floats,
    inverse_depth: Floats,
    nearest: NDArray[np.int16],
) -> None:
    """Enter in every sample the nearest rectangle that it sees, and one over its depth.

    Args:
        chosen: (C,) rectangles that may be seen; the nearer ones first, that is faster.
        forms: (C, 3, 3) of these, see the module.
        boxes: (C, 4) of these, as ``boxes_of`` returns them.
        sizes: (M, 2) width and height of all rectangles, m.
        first_hole: (M + 1,) see the module, as the next three.
        holes: (K, 4).
        x: of the samples.
        y: likewise.
        inverse_depth: (H, W) zero where only sky has been seen so far.
        nearest: (H, W) to be filled.
    """
    for i in range(len(chosen)):
        m, f = chosen[i], forms[i]
        width, height = sizes[m, 0], sizes[m, 1]
        u0, u1, u2 = f[0, 0], f[0, 1], f[0, 2]
        v0, v1, v2 = f[1, 0], f[1, 1], f[1, 2]
        q0, q1, q2 = f[2, 0], f[2, 1], f[2, 2]
        index = np.int16(m)
        for r in range(boxes[i, 0], boxes[i, 1]):
            x_row, y_row, depths, seen = x[r], y[r], inverse_depth[r], nearest[r]
            for c in range(boxes[i, 2], boxes[i, 3]):
                q = q0 * x_row[c] + (q1 * y_row[c] + q2)
                if not q > depths[c]:
                    continue
                u = u0 * x_row[c] + (u1 * y_row[c] + u2)
                v = v0 * x_row[c] + (v1 * y_row[c] + v2)
                if not (u >= 0.0 and v >= 0.0 and u <= width * q and v <= height * q):
                    continue
                through = False
                for k in range(first_hole[m], first_hole[m + 1]):
                    if (
                        u > holes[k, 0] * q
                        and v > holes[k, 1] * q
                        and u < holes[k, 2] * q
                        and v < holes[k, 3] * q
                    ):
                        through = True
                        break
                if not through:
                    depths[c], seen[c] = q, index


@compiled
def shade(
    members: Ints,
    x: Floats,
    y: Floats,
    form: Floats,
    size: tuple[float, float],
    spacing: float,
    texels: Texels,
    shelves: Ints,
    light: Floats,
) -> None:
    """Enter the light of samples of one rectangle, each filtered to its footprint.

    Args:
        members: (N,) which samples.
        x: (S,) ideal coordinates of all samples.
        y: likewise.
        form: (3, 3) of the rectangle, see the module.
        size: its width and height, m.
        spacing: of samples on the ideal image plane.
        texels: of its texture, see the module.
        shelves: likewise.
        light: (S,) to be filled.
    """
    width, height = size
    across, down, depth = form[0], form[1], form[2]
    determinant = abs(
        across[0] * (down[1] * depth[2] - down[2] * depth[1])
        - across[1] * (down[0] * depth[2] - down[2] * depth[0])
        + across[2] * (down[0] * depth[1] - down[1] * depth[0])
    )
    per_m = math.sqrt(shelves[0, 1] * shelves[0, 2] / (width * height))
    base = math.log2(spacing * per_m)
    for i in members:
        z = 1.0 / (depth[0] * x[i] + (depth[1] * y[i] + depth[2]))
        u = (across[0] * x[i] + (across[1] * y[i] + across[2])) * z
        v = (down[0] * x[i] + (down[1] * y[i] + down[2])) * z
        # The footprint: between its geometric mean and its root mean square, which
        # on grazing surfaces trades a little aliasing against losing all texture.
        area = determinant * z * z * z
        squares = (across[0] - u * depth[0]) ** 2 + (across[1] - u * depth[1]) ** 2
        squares += (down[0] - v * depth[0]) ** 2 + (down[1] - v * depth[1]) ** 2
        level = 0.25 * math.log2(area * (0.5 * squares * z * z)) + base
        light[i] = _trilinear(texels, shelves, u / width, v / height, level)


@compiled
def look_up(
    members: Ints, across: Floats, along: Floats, texels: Texels, shelves: Ints, light: Floats
) -> None:
    """Enter the light of samples at (N,) fractions of a texture's finest level."""
    for n in range(len(members)):
        light[members[n]] = _trilinear(texels, shelves, across[n], along[n], 0.0)


@compiled
def _trilinear(texels: Texels, shelves: Ints, across: float, along: float, level: float) -> float:
    """Return the light at fractions of a texture's width and height, between two levels.

    ``level`` is the logarithm to base 2 of the footprint in texels of the finest one.
    """
    # Written so that what is no number counts as zero: nothing else is looked up by it.
    level = min(level, len(shelves) - 1.0) if level > 0.0 else 0.0
    lower = int(level)
    share = level - lower
    grey = _bilinear(texels, shelves[lower], across, along)
    if share > 0.0:
        grey += share * (_bilinear(texels, shelves[lower + 1], across, along) - grey)
    return grey


@compiled
def _bilinear(texels: Texels, shelf: Ints, across: float, along: float) -> float:
    """Return the light at fractions of one level; its edge texels go on beyond it.

    As OpenCV's ``remap`` does it, to a thirty-second of a texel and to whole grey levels: pictures
    of a scenario stay what they were.
    """
    start, height, width = shelf[0], shelf[1], shelf[2]
    # Texel (0, 0) is centred half a texel inside the rectangle.
    u, v = across * width - 0.5, along * height - 0.5
    u = min(u, width - 1.0) if u > 0.0 else 0.0
    v = min(v, height - 1.0) if v > 0.0 else 0.0
    fine_u, fine_v = int(np.rint(u * _STEPS)), int(np.rint(v * _STEPS))
    column, row = fine_u // _STEPS, fine_v // _STEPS
    right = column + 1 if column + 1 < width else column
    under = row + 1 if row + 1 < height else row
    a, b = fine_u - column * _STEPS, fine_v - row * _STEPS
    above, below = start + row * width, start + under * width
    upper = (_STEPS - a) * int(texels[above + column]) + a * int(texels[above + right])
    lower = (_STEPS - a) * int(texels[below + column]) + a * int(texels[below + right])
    half = _STEPS * _STEPS // 2
    return float(((_STEPS - b) * upper + b * lower + half) // (_STEPS * _STEPS))
