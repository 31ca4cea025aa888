"""What is painted on a wall: windows, signs, posters, graffiti, ivy.

All work in place on a canvas of grey levels (see ``sitl.textures``); a
rectangle is left, top, width, height in metres from the canvas's corner and is
cut off at the canvas's edge.
"""

from __future__ import annotations

import cv2
import numpy as np

from sitl.textures import Canvas, noise

_Rng = np.random.Generator
Rect = tuple[float, float, float, float]

_LETTERS = "ABCDEFGHJKLMNPQRSTUVWXYZ23456789&"
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
)


def _region(canvas: Canvas, rect: Rect, texels_per_m: float) -> Canvas:
    """Return the view of the canvas that a rectangle covers; may be empty."""
    left, top, width, height = (round(m * texels_per_m) for m in rect)
    return canvas[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)]


def window(rng: _Rng, canvas: Canvas, rect: Rect, texels_per_m: float) -> None:
    """Paint a window: dark panes with what shows in them, a frame, mullions."""
    pane = _region(canvas, rect, texels_per_m)
    if min(pane.shape, default=0) < 4:
        return
    height, width = pane.shape
    fall = np.linspace(1.15, 0.8, height, dtype=np.float32)[:, None]
    pane[:] = np.float32(rng.uniform(30, 65)) * fall
    pane *= 1.0 + 0.22 * noise(rng, (height, width), texels_per_m, 1.2, 0.15, 0.3)
    kind = rng.random()
    if kind < 0.35:  # curtains, drawn to differing widths, in folds
        folds = 1.0 + 0.15 * np.sin(np.arange(width) / width * rng.uniform(25, 60))
        for side in (
            slice(0, int(width * rng.uniform(0.1, 0.45))),
            slice(int(width * rng.uniform(0.55, 0.9)), width),
        ):
            pane[:, side] = np.float32(rng.uniform(90, 150)) * folds[side].astype(np.float32)
    elif kind < 0.6:  # a blind, let down to some height
        drop = int(height * rng.uniform(0.2, 0.9))
        slats = np.arange(drop) % max(2, int(0.06 * texels_per_m)) == 0
        pane[:drop] = np.where(slats, 75.0, rng.uniform(100, 140))[:, None]
    for _ in range(int(rng.integers(2, 7))):  # plants, lamps, reflections
        size = rng.uniform(0.06, 0.3) * texels_per_m
        centre = (int(rng.uniform(0, width)), int(rng.uniform(0.3, 1) * height))
        axes = (max(1, int(size)), max(1, int(size * rng.uniform(0.3, 1.2))))
        shade = float(rng.choice([rng.uniform(15, 35), rng.uniform(100, 190)]))
        cv2.ellipse(pane, centre, axes, float(rng.uniform(0, 180)), 0, 360, (shade,), -1)
    frame = float(rng.choice([rng.uniform(45, 70), rng.uniform(175, 205)]))
    bar = max(1, int(rng.uniform(0.05, 0.08) * texels_per_m))
    pane[:bar], pane[-bar:], pane[:, :bar], pane[:, -bar:] = frame, frame, frame, frame
    for share in ([0.5], [1 / 3, 2 / 3], [rng.uniform(0.3, 0.7)])[int(rng.integers(3))]:
        pane[:, int(share * width) : int(share * width) + bar] = frame
    if rng.random() < 0.7:
        row = int(rng.uniform(0.25, 0.45) * height)
        pane[row : row + bar] = frame


def lettering(rng: _Rng, canvas: Canvas, rect: Rect, texels_per_m: float) -> None:
    """Paint a sign: a board with a border and a line of glyphs that occurs nowhere else."""
    board = _region(canvas, rect, texels_per_m)
    if min(board.shape, default=0) < 6:
        return
    dark = rng.random() < 0.5
    ground, ink = (rng.uniform(35, 70), rng.uniform(170, 215))
    if not dark:
        ground, ink = ink, ground
    board[:] = ground
    board *= 1.0 + 0.04 * noise(rng, (board.shape[0], board.shape[1]), texels_per_m, 1.0, 0.1)
    cv2.rectangle(board, (1, 1), (board.shape[1] - 2, board.shape[0] - 2), (ink,), 2)
    font = _FONTS[int(rng.integers(len(_FONTS)))]
    scale = 0.62 * board.shape[0] / 22.0
    thickness = max(1, int(board.shape[0] * 0.07))
    x = int(0.25 * board.shape[0])
    while x < board.shape[1] - 0.6 * board.shape[0]:
        glyph = _LETTERS[int(rng.integers(len(_LETTERS)))]
        if rng.random() < 0.12:
            radius = max(1, int(board.shape[0] * rng.uniform(0.12, 0.3)))
            cv2.circle(board, (x + radius, board.shape[0] // 2), radius, (ink,), thickness)
            x += 3 * radius
            continue
        cv2.putText(board, glyph, (x, int(0.8 * board.shape[0])), font, scale, (ink,), thickness)
        x += int(0.68 * board.shape[0] * rng.uniform(0.9, 1.5))


def poster(rng: _Rng, canvas: Canvas, rect: Rect, texels_per_m: float) -> None:
    """Paint a poster: paper, shapes, lines of small print."""
    paper = _region(canvas, rect, texels_per_m)
    if min(paper.shape, default=0) < 8:
        return
    height, width = paper.shape
    paper[:] = rng.uniform(60, 200)
    for _ in range(int(rng.integers(4, 9))):
        shade = float(rng.uniform(25, 220))
        n = int(rng.integers(3, 6))
        corners = rng.uniform(0.05, 0.95, (n, 2)) * (width, height)
        if rng.random() < 0.4:
            radius = max(1, int(rng.uniform(0.06, 0.25) * width))
            cv2.circle(paper, (int(corners[0, 0]), int(corners[0, 1])), radius, (shade,), -1)
        else:
            cv2.fillPoly(paper, [corners.astype(np.int32)], (shade,))
    ink = float(rng.uniform(20, 60))
    for row in range(int(height * 0.72), height - 4, max(3, int(0.07 * texels_per_m))):
        x = int(0.08 * width)
        while x < 0.9 * width:
            word = int(rng.uniform(0.05, 0.2) * width)
            cv2.line(paper, (x, row), (min(x + word, width - 3), row), (ink,), 2)
            x += word + max(2, int(0.04 * width))
    border = float(rng.uniform(120, 220))
    cv2.rectangle(paper, (0, 0), (width - 1, height - 1), (border,), 1)


def graffiti(rng: _Rng, canvas: Canvas, rect: Rect, texels_per_m: float) -> None:
    """Spray a tag: thick curved strokes over whatever is there."""
    wall = _region(canvas, rect, texels_per_m)
    if min(wall.shape, default=0) < 8:
        return
    shade = float(rng.choice([rng.uniform(20, 50), rng.uniform(190, 225)]))
    thickness = max(1, int(rng.uniform(0.03, 0.08) * texels_per_m))
    x = 0.1
    while x < 0.9:
        n = int(rng.integers(5, 9))
        angles = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.uniform(-1.6, 1.6, n))
        points = np.cumsum(np.stack([np.cos(angles), np.sin(angles)], axis=1), axis=0)
        points = points / np.abs(points).max() * 0.4 * wall.shape[0]
        points += (x * wall.shape[1], 0.5 * wall.shape[0])
        cv2.polylines(wall, [points.astype(np.int32)], False, (shade,), thickness, cv2.LINE_AA)
        x += float(rng.uniform(0.08, 0.25))


def ivy(rng: _Rng, canvas: Canvas, rect: Rect, texels_per_m: float) -> None:
    """Let leaves climb over the wall, denser towards the bottom."""
    wall = _region(canvas, rect, texels_per_m)
    if min(wall.shape, default=0) < 8:
        return
    height, width = wall.shape
    cover = noise(rng, (height, width), texels_per_m, 2.0, 0.25, 0.6)
    n = int(45 * rect[2] * rect[3])
    for x, y in (rng.random((n, 2)) * (width, height)).astype(int):
        if cover[y, x] < 0.9 - 1.6 * y / height:
            continue
        size = rng.uniform(0.04, 0.11) * texels_per_m
        axes = (max(1, int(size)), max(1, int(size * rng.uniform(0.4, 0.8))))
        shade = float(rng.uniform(30, 110))
        centre = (int(x), int(y))
        cv2.ellipse(wall, centre, axes, float(rng.uniform(0, 180)), 0, 360, (shade,), -1)
