"""What walls and grounds are made of: procedural, irregular, drawn from a given generator.

Everything is painted as reflected light under the open sky, in grey levels on
float32 canvases; ``sitl.sunlight`` adds sun and shadows and makes textures of them.
A feature detector must find the same corner from three metres further on, so
what matters is structure of 5 to 50 cm that occurs only once.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Canvas = NDArray[np.float32]
Style = Literal[
    "brick", "ashlar", "plaster", "concrete", "plain", "asphalt", "paving", "tiles", "grass"
]

_Rng = np.random.Generator


def noise(
    rng: _Rng,
    shape: tuple[int, int],
    texels_per_m: float,
    coarsest_m: float,
    finest_m: float,
    roughness: float = 0.5,
) -> Canvas:
    """Draw fractal noise of mean 0 and standard deviation about 1.

    Args:
        rng: where it is drawn from.
        shape: rows and columns of texels.
        texels_per_m: resolution.
        coarsest_m: longest wavelength.
        finest_m: shortest one, at least 1.5 texels.
        roughness: each octave is weaker than the one twice as long by 2 to the power of minus this.
    """
    ratio = max(coarsest_m / max(finest_m, 1.5 / texels_per_m), 1.0)
    octaves = 1 + int(np.log2(ratio) + 1e-9)
    step = coarsest_m * texels_per_m / 2.0**octaves  # texels between finest grid points
    # Grids are built from the coarsest to the finest, each the one before at twice the size.
    shapes = [tuple(int(np.ceil(n / step)) + 2 for n in shape)]
    while len(shapes) < octaves:
        shapes.append((shapes[-1][0] // 2 + 2, shapes[-1][1] // 2 + 2))
    grid = np.zeros(shapes[-1], dtype=np.float32)
    weight, total = 1.0, 0.0
    for rows, columns in reversed(shapes):
        if grid.shape != (rows, columns):
            doubled = cv2.resize(grid, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
            grid = np.asarray(doubled, dtype=np.float32)[1 : rows + 1, 1 : columns + 1]
        grid = grid + np.float32(weight) * rng.standard_normal((rows, columns), dtype=np.float32)
        total += weight * weight
        weight *= 2.0**-roughness
    shift = rng.random(2)  # so that no grid's points line up with the corner
    warp = np.array([[step, 0.0, -shift[0] * step], [0.0, step, -shift[1] * step]])
    layer = cv2.warpAffine(grid, warp, shape[::-1], flags=cv2.INTER_CUBIC)
    # Cubic interpolation between independent values keeps about 0.7 of their spread.
    return np.asarray(layer, dtype=np.float32) / np.float32(0.75 * np.sqrt(total))


def material(rng: _Rng, style: Style, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    """Paint a wall or ground of one style, (H, W) of ``shape``."""
    painters = {
        "brick": _brick,
        "ashlar": _ashlar,
        "plaster": _plaster,
        "concrete": _concrete,
        "plain": _plain,
        "asphalt": _asphalt,
        "paving": _paving,
        "tiles": _tiles,
        "grass": _grass,
    }
    return painters[style](rng, shape, texels_per_m)


def stains(rng: _Rng, canvas: Canvas, texels_per_m: float, per_m2: float) -> None:
    """Add drips, splashes and repaired patches to a wall, in place."""
    height, width = canvas.shape
    for _ in range(rng.poisson(per_m2 * height * width / texels_per_m**2)):
        x, y = rng.integers(0, width), rng.integers(0, height)
        kind = rng.random()
        factor = float(rng.uniform(0.6, 0.85) if rng.random() < 0.65 else rng.uniform(1.12, 1.3))
        size = rng.uniform(0.1, 0.6) * texels_per_m
        mask = np.zeros_like(canvas, shape=(int(4 * size) + 3, int(2 * size) + 3))
        if kind < 0.35:  # a drip that fades downwards
            half = max(1, int(size * rng.uniform(0.1, 0.35)))
            middle = mask.shape[1] // 2
            fade = np.linspace(1.0, 0.0, mask.shape[0], dtype=np.float32)[:, None]
            mask[:, middle - half : middle + half] = fade
        elif kind < 0.75:  # an irregular patch
            mask = _blob(rng, (int(2 * size) + 3, int(2 * size) + 3))
        else:  # a mended rectangle with a seam
            h, w = int(size * rng.uniform(0.5, 1.5)) + 2, int(size * rng.uniform(0.5, 1.5)) + 2
            mask = np.ones((h, w), dtype=np.float32)
            mask[:1], mask[-1:], mask[:, :1], mask[:, -1:] = 1.6, 1.6, 1.6, 1.6
        _blend(canvas, mask, factor, int(y), int(x))


def _blob(rng: _Rng, shape: tuple[int, int]) -> Canvas:
    """Paint an irregular star-shaped patch, 0 to 1."""
    n = int(rng.integers(5, 11))
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, n))
    radius = rng.uniform(0.35, 1.0, n)
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radius[:, None]
    centre = (np.array(shape[::-1]) - 1) / 2
    mask = np.zeros(shape, dtype=np.float32)
    cv2.fillPoly(mask, [np.rint(centre + points * centre).astype(np.int32)], (1.0,))
    return mask


def _blend(canvas: Canvas, mask: Canvas, factor: float, top: int, left: int) -> None:
    """Multiply the canvas by ``factor`` where ``mask`` is 1, as far as the mask lies on it."""
    part = canvas[top : top + mask.shape[0], left : left + mask.shape[1]]
    part *= 1.0 + np.float32(factor - 1.0) * mask[: part.shape[0], : part.shape[1]]


def _cracks(rng: _Rng, canvas: Canvas, texels_per_m: float, per_m2: float) -> None:
    height, width = canvas.shape
    tone = float(canvas.mean())
    for _ in range(rng.poisson(per_m2 * height * width / texels_per_m**2)):
        n = int(rng.integers(4, 12))
        heading = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0.0, 0.5, n))
        steps = np.stack([np.cos(heading), np.sin(heading)], axis=1) * 0.12 * texels_per_m
        points = rng.uniform(0, 1, 2) * (width, height) + np.cumsum(steps, axis=0)
        shade = tone * float(rng.uniform(0.4, 0.7))
        thickness = int(rng.integers(1, 3))
        cv2.polylines(canvas, [points.astype(np.int32)], False, (shade,), thickness)


def _plaster(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    tone = rng.uniform(120, 170)
    out = tone * (1.0 + 0.05 * noise(rng, shape, texels_per_m, 6.0, 0.08, 0.7))
    flaked = noise(rng, shape, texels_per_m, 1.6, 0.08, 0.7)
    worn = noise(rng, shape, texels_per_m, 0.8, 0.08, 0.6)
    out = np.where(flaked > 1.6, out * 0.76, out)
    out = np.where(worn > 1.8, out * 1.14, np.where(worn < -1.8, out * 0.84, out))
    canvas = np.ascontiguousarray(out, dtype=np.float32)
    _cracks(rng, canvas, texels_per_m, 0.15)
    stains(rng, canvas, texels_per_m, 0.8)
    return canvas


def _concrete(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    tone = rng.uniform(105, 145)
    canvas = np.asarray(
        tone * (1.0 + 0.07 * noise(rng, shape, texels_per_m, 3.0, 0.08, 0.7)), dtype=np.float32
    )
    # Formwork panels, each poured on its own day, with the holes of their ties.
    pitch_y, pitch_x = (max(4, int(m * texels_per_m)) for m in (1.3, 2.6))
    for top in range(0, shape[0], pitch_y):
        for left in range(0, shape[1], pitch_x):
            part = canvas[top : top + pitch_y, left : left + pitch_x]
            part *= np.float32(rng.uniform(0.88, 1.12))
            part[:1] *= 0.6
            part[:, :1] *= 0.6
            for x in (0.2, 0.8):
                centre = (left + int(x * pitch_x), top + pitch_y // 2)
                cv2.circle(canvas, centre, max(1, int(0.04 * texels_per_m)), (tone * 0.5,), -1)
    _cracks(rng, canvas, texels_per_m, 0.2)
    stains(rng, canvas, texels_per_m, 1.5)
    return canvas


def _brick(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    tone = rng.uniform(85, 125)
    course, length = 0.075 * texels_per_m, 0.25 * texels_per_m
    rows = (np.arange(shape[0]) / course).astype(np.int32)
    offsets = (rows % 2) * 0.5 * length
    columns = ((np.arange(shape[1])[None, :] + offsets[:, None]) / length).astype(np.int32)
    tones = rng.normal(1.0, 0.06, (rows[-1] + 1, columns.max() + 1)).astype(np.float32)
    odd = rng.random(tones.shape)
    tones[odd < 0.05] *= 0.68  # overburnt headers
    tones[odd > 0.97] *= 1.35  # replaced ones
    out = np.float32(tone) * tones[rows[:, None], columns]
    bed = (np.arange(shape[0]) % course) < 0.012 * texels_per_m
    butt = ((np.arange(shape[1])[None, :] + offsets[:, None]) % length) < 0.012 * texels_per_m
    out = np.where(bed[:, None] | butt, np.float32(tone * 1.2), out)
    weather = noise(rng, shape, texels_per_m, 5.0, 0.1, 0.7)
    canvas = np.asarray(out * (1.0 + 0.09 * weather), dtype=np.float32)
    soot = noise(rng, shape, texels_per_m, 1.5, 0.08, 0.6)
    canvas[soot > 1.6] *= 0.76
    canvas[soot < -1.8] *= 1.2
    stains(rng, canvas, texels_per_m, 1.2)
    return canvas


def _ashlar(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    tone = rng.uniform(125, 165)
    out = np.full(shape, tone * 0.62, dtype=np.float32)
    joint = max(1, int(0.02 * texels_per_m))
    top = 0
    while top < shape[0]:
        height = int(rng.uniform(0.22, 0.45) * texels_per_m)
        left = -int(rng.uniform(0.0, 0.5) * texels_per_m)
        while left < shape[1]:
            width = int(rng.uniform(0.3, 0.95) * texels_per_m)
            shade = tone * rng.normal(1.0, 0.08)
            out[top : top + height - joint, max(left, 0) : max(left + width - joint, 0)] = shade
            left += width
        top += height
    canvas = np.asarray(
        out * (1.0 + 0.06 * noise(rng, shape, texels_per_m, 2.0, 0.08, 0.6)), dtype=np.float32
    )
    stains(rng, canvas, texels_per_m, 0.7)
    return canvas


def _plain(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    tone = rng.uniform(130, 170)
    faint = 0.02 * noise(rng, shape, texels_per_m, 4.0, 0.2, 0.8)
    return np.asarray(tone * (1.0 + faint), dtype=np.float32)


def _asphalt(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    grain = noise(rng, shape, texels_per_m, 8.0, 0.06, 0.5)
    canvas = np.asarray(88.0 * (1.0 + 0.07 * grain), dtype=np.float32)
    _cracks(rng, canvas, texels_per_m, 0.06)
    stains(rng, canvas, texels_per_m, 0.25)
    return canvas


def _paving(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    pitch = max(4, int(0.6 * texels_per_m))
    rows, columns = np.arange(shape[0]) // pitch, np.arange(shape[1]) // pitch
    tones = rng.normal(1.0, 0.09, (rows[-1] + 1, columns[-1] + 1)).astype(np.float32)
    out = np.float32(125.0) * tones[rows[:, None], columns[None, :]]
    joint = max(1, int(0.02 * texels_per_m))
    seam = (np.arange(shape[0]) % pitch < joint)[:, None] | (np.arange(shape[1]) % pitch < joint)
    out = np.where(seam, np.float32(80.0), out)
    out *= 1.0 + 0.05 * noise(rng, shape, texels_per_m, 4.0, 0.08, 0.6)
    canvas = np.asarray(out, dtype=np.float32)
    stains(rng, canvas, texels_per_m, 0.4)
    return canvas


def _tiles(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    """Paint a roof: overlapping courses, each shading the next, with moss and mended places."""
    tone = rng.uniform(70, 105)
    course, breadth = 0.33 * texels_per_m, 0.24 * texels_per_m
    rows = (np.arange(shape[0]) / course).astype(np.int32)
    offsets = (rows % 2) * 0.5 * breadth
    columns = ((np.arange(shape[1])[None, :] + offsets[:, None]) / breadth).astype(np.int32)
    tones = rng.normal(1.0, 0.09, (rows[-1] + 1, columns.max() + 1)).astype(np.float32)
    tones[rng.random(tones.shape) < 0.04] *= 1.4
    fall = 1.1 - 0.35 * ((np.arange(shape[0]) % course) / course) ** 3
    out = np.float32(tone) * tones[rows[:, None], columns] * fall[:, None].astype(np.float32)
    out *= 1.0 + 0.06 * noise(rng, shape, texels_per_m, 4.0, 0.1, 0.7)
    moss = noise(rng, shape, texels_per_m, 2.0, 0.1, 0.6)
    canvas = np.asarray(np.where(moss > 1.5, out * 0.72, out), dtype=np.float32)
    stains(rng, canvas, texels_per_m, 0.5)
    return canvas


def _grass(rng: _Rng, shape: tuple[int, int], texels_per_m: float) -> Canvas:
    """Paint a mown meadow: soft mottling, hardly a corner."""
    tone = 78.0 * (1.0 + 0.07 * noise(rng, shape, texels_per_m, 12.0, 0.8, 0.3))
    return np.asarray(
        tone * (1.0 + 0.03 * noise(rng, shape, texels_per_m, 0.8, 0.1, 0.2)), np.float32
    )
