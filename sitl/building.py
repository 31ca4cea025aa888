"""One building: a front with windows, bays, ledges, balconies and signs, and plainer sides."""

from __future__ import annotations

from typing import Literal

import msgspec
import numpy as np

from sitl import details, roofs
from sitl.faces import Face, Frame, Side, box, reveals
from sitl.textures import Canvas, Style, material

RichSide = Literal["left", "right", "back"]


class Building(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What one building is like; places are NED, metres.

    Attributes:
        x_m, y_m: middle of the front's foot.
        facing_deg: heading that the front looks to, from north to east.
        width_m, depth_m, height_m: its size.
        style: what its walls are made of.
        columns, floors: of windows; 0 takes as many as fit.
        bays: boxes of a storey or more that stand out of the front.
        relief: scales everything that stands out of or into the front; 0 is a flat wall.
        detail: scales the number of signs, posters, graffiti, fixtures.
        alike: share of windows that look alike, and how evenly they stand: 0 makes each
            its own, 1 a block of flats.
        rich_sides: walls that are built like the front, as seen from before it; the
            others are flat and painted.
        roof: ``gable`` is tiled, its ridge along the front, with stepped gables.
        roof_deg: how steep a gable roof is.
        seed: buildings with equal seed and size look the same; 0 makes each its own.
    """

    x_m: float
    y_m: float
    facing_deg: float
    width_m: float
    depth_m: float = 9.0
    height_m: float = 11.0
    style: Style = "brick"
    columns: int = 0
    floors: int = 0
    bays: int = 1
    relief: float = 1.0
    detail: float = 1.0
    alike: float = 0.0
    rich_sides: tuple[RichSide, ...] = ()
    roof: Literal["flat", "gable"] = "flat"
    roof_deg: float = 42.0
    seed: int = 0


class _Site:
    """A wall while it grows: its grid of windows, its faces, its generator."""

    def __init__(
        self,
        building: Building,
        front: Frame,
        width_m: float,
        rng: np.random.Generator,
        texels_per_m: float,
    ) -> None:
        self.building, self.rng, self.tpm = building, rng, texels_per_m
        self.width, self.height = width_m, building.height_m
        self.front = front
        self.faces: list[Face] = []
        own_columns = building.columns if width_m == building.width_m else 0
        columns = own_columns or max(1, round(self.width / 2.7))
        floors = building.floors or max(1, round((self.height - 1.2) / 3.2))
        self.cell_m = self.width / columns
        self.storey_m = (self.height - 1.2) / floors
        middles = (np.arange(columns) + 0.5) * self.cell_m
        middles = middles + rng.uniform(-0.12, 0.12, columns) * self.cell_m
        halves = 0.5 * self.cell_m * rng.uniform(0.4, 0.62, columns)
        if building.alike > 0.0:
            even = (np.arange(columns) + 0.5) * self.cell_m
            middles = even + (1.0 - building.alike) * (middles - even)
            halves = halves[0] + (1.0 - building.alike) * (halves - halves[0])
        self.columns = np.stack([middles - halves, middles + halves], axis=1)
        tops = (
            1.2 + np.arange(floors) * self.storey_m + self.storey_m * rng.uniform(0.1, 0.2, floors)
        )
        heights = self.storey_m * rng.uniform(0.48, 0.6, floors)
        heights[-1] = 0.7 * self.storey_m  # shop windows
        self.rows = np.stack([tops, tops + heights], axis=1)
        self.free = rng.random((floors, columns)) < 0.9
        self.common_look = int(rng.integers(2**31)) if building.alike > 0.0 else 0

    def window_rng(self) -> np.random.Generator:
        """Return what the next window is drawn from: the same for all that look alike."""
        if self.building.alike > 0.0 and self.rng.random() < self.building.alike:
            return np.random.default_rng(self.common_look)
        return self.rng

    def paint(self, side: Side, width_m: float, height_m: float) -> Canvas:
        """Paint a part with the building's own material."""
        shape = (max(2, round(height_m * self.tpm)), max(2, round(width_m * self.tpm)))
        return material(self.rng, self.building.style, shape, self.tpm)

    def trim(self, side: Side, width_m: float, height_m: float) -> Canvas:
        """Paint ledges, sills and frames: lighter, worn stone."""
        shape = (max(2, round(height_m * self.tpm)), max(2, round(width_m * self.tpm)))
        return material(self.rng, "plaster", shape, self.tpm)

    def add_box(self, rect: details.Rect, out_m: float, name: str, trim: bool = True) -> None:
        """Put a box on the front: left, top, width, height in m, and how far it stands out."""
        left, top, width, height = rect
        frame = self.front.moved(left, top, out_m)
        paint = self.trim if trim else self.paint
        self.faces += box(frame, (width, height, out_m), paint, name)


def build(building: Building, rng: np.random.Generator, texels_per_m: float) -> list[Face]:
    """Build all faces of a building.

    Args:
        building: what it is like.
        rng: where its looks are drawn from.
        texels_per_m: resolution of its paint.
    """
    foot = np.array([building.x_m, building.y_m, 0.0])
    facing = np.deg2rad(building.facing_deg)
    front = Frame.facing(foot, facing, building.width_m, building.height_m)
    site = _Site(building, front, building.width_m, rng, texels_per_m)
    _rich_wall(site)
    _shell(site)
    across, inward, depth = front.right, front.inward, building.depth_m
    walls: dict[RichSide, tuple[Frame, float]] = {
        "left": (Frame(front.point(0.0, 0.0, -depth), -inward, front.down), depth),
        "right": (Frame(front.point(building.width_m, 0.0), inward, front.down), depth),
        "back": (
            Frame(front.point(building.width_m, 0.0, -depth), -across, front.down),
            building.width_m,
        ),
    }
    for side in building.rich_sides:
        beside = _Site(building, *walls[side], rng, texels_per_m)
        _rich_wall(beside)
        site.faces += beside.faces
    return site.faces


def _rich_wall(site: _Site) -> None:
    """Build a wall with everything that stands out of it and into it."""
    if site.building.relief > 0.0:
        _bays(site)
    _wall(site)
    if site.building.relief > 0.0:
        _ledges(site)
        _fixtures(site)


def _wall(site: _Site) -> None:
    """Build the front with its openings, the glass behind them, and what is painted on it."""
    tpm, relief = site.tpm, site.building.relief
    canvas = site.paint("front", site.width, site.height)
    _decorate(site, canvas)
    openings = []
    recess = float(np.clip(0.28 * relief, 0.0, 0.6))
    glass = np.full(canvas.shape, 40.0, dtype=np.float32) if recess > 0.0 else canvas
    for floor, (top, bottom) in enumerate(site.rows.tolist()):
        for column, (left, right) in enumerate(site.columns.tolist()):
            if site.free[floor, column]:
                pane = (left, top, right - left, bottom - top)
                details.window(site.window_rng(), glass, pane, tpm)
                openings.append((left, top, right, bottom))
    holes = np.array(openings).reshape(-1, 4) if recess > 0.0 else np.zeros((0, 4))
    size = (site.width, site.height)
    site.faces.append(Face(site.front, *size, canvas, "front", holes))
    if len(holes):
        site.faces.append(Face(site.front.moved(0, 0, -recess), *size, glass, "glass"))
        site.faces += reveals(site.front, size, site.columns, site.rows, recess, site.trim)


def _decorate(site: _Site, canvas: Canvas) -> None:
    """Posters, lettering, graffiti and ivy between and over the windows."""
    rng, detail, tpm = site.rng, site.building.detail, site.tpm
    area = site.width * site.height
    for paint, per_m2, low, high in (
        (details.ivy, 0.004, (2.0, 2.5), (4.0, 6.0)),
        (details.lettering, 0.02, (1.5, 0.4), (3.5, 0.8)),
        (details.graffiti, 0.012, (1.2, 0.6), (3.0, 1.2)),
        (details.poster, 0.06, (0.5, 0.7), (1.1, 1.5)),
    ):
        for _ in range(rng.poisson(per_m2 * area * detail)):
            width, height = rng.uniform(low, high).tolist()
            # People reach up to three metres; ivy climbs from the ground; signs hang anywhere.
            reach = {details.poster: 4.5, details.graffiti: 3.0}.get(paint, site.height)
            lowest = site.height - height
            top = (
                lowest
                if paint is details.ivy
                else float(rng.uniform(max(0, site.height - reach), lowest))
            )
            left = float(rng.uniform(0.0, max(0.1, site.width - width)))
            paint(rng, canvas, (left, top, width, height), tpm)


def _bays(site: _Site) -> None:
    """Boxes that stand out of the front over one or two columns; no openings behind them."""
    rng = site.rng
    floors, columns = site.free.shape
    for _ in range(site.building.bays):
        span = int(rng.integers(1, 3))
        first = int(rng.integers(0, max(1, columns - span + 1)))
        last = min(columns, first + span)
        top_floor = int(rng.integers(0, max(1, floors - 1)))
        bottom_floor = int(rng.integers(top_floor, max(top_floor + 1, floors - 1)))
        taken = site.free[top_floor : bottom_floor + 1, first:last]
        if not taken.any():
            continue
        taken[:] = False
        out_m = float(rng.uniform(0.6, 1.5)) * site.building.relief
        left = first * site.cell_m + 0.15
        width = (last - first) * site.cell_m - 0.3
        top = 1.0 + top_floor * site.storey_m
        height = (bottom_floor - top_floor + 1) * site.storey_m - 0.1

        def paint(side: Side, width_m: float, height_m: float) -> Canvas:
            canvas = site.paint(side, width_m, height_m)
            if side in ("front", "left", "right"):
                storeys = max(1, round(height_m / site.storey_m))
                for storey in range(storeys):
                    pane_top = (storey + 0.2) * height_m / storeys
                    rect = (0.15 * width_m, pane_top, 0.7 * width_m, 0.55 * height_m / storeys)
                    details.window(rng, canvas, rect, site.tpm)
            return canvas

        site.faces += box(site.front.moved(left, top, out_m), (width, height, out_m), paint, "bay")


def _ledges(site: _Site) -> None:
    """Cornice, string courses, pilasters and a drainpipe."""
    rng, relief = site.rng, site.building.relief
    site.add_box((0.0, 0.25, site.width, 0.4), 0.45 * relief, "cornice")
    for floor in range(1, site.free.shape[0]):
        if rng.random() < 0.75:
            top = 1.2 + floor * site.storey_m - 0.12
            height, out_m = rng.uniform((0.14, 0.12), (0.26, 0.28)).tolist()
            site.add_box((0.0, top, site.width, height), out_m * relief, "ledge")
    for column in range(site.free.shape[1] + 1):
        if rng.random() < 0.35:
            width = float(rng.uniform(0.25, 0.45))
            left = float(np.clip(column * site.cell_m - width / 2, 0.0, site.width - width))
            rect = (left, 0.65, width, site.height - 0.65)
            site.add_box(rect, float(rng.uniform(0.08, 0.18)) * relief, "pilaster", trim=False)
    left = float(rng.uniform(0.2, site.width - 0.4))
    site.add_box((left, 0.65, 0.12, site.height - 0.65), 0.16 * relief, "pipe")


def _fixtures(site: _Site) -> None:
    """Balconies, sills, air conditioners, shop signs and signs that hang across."""
    rng, relief, detail = site.rng, site.building.relief, site.building.detail

    def sign(side: Side, width_m: float, height_m: float) -> Canvas:
        canvas = site.trim(side, width_m, height_m)
        if side in ("front", "left", "right"):
            details.lettering(rng, canvas, (0.0, 0.0, width_m, height_m), site.tpm)
        return canvas

    last = site.free.shape[0] - 1
    for floor, (top, bottom) in enumerate(site.rows.tolist()):
        for column, (left, right) in enumerate(site.columns.tolist()):
            if not site.free[floor, column]:
                continue
            chance = rng.random()
            if floor == last:
                if chance < 0.5 * detail:
                    frame = site.front.moved(left - 0.2, top - 0.65, 0.3 * relief)
                    size = (right - left + 0.4, 0.55, 0.3 * relief)
                    site.faces += box(frame, size, sign, "shop sign")
                continue
            if chance < 0.12:
                rect = (left - 0.25, bottom - 0.75, right - left + 0.5, 0.95)
                site.add_box(rect, float(rng.uniform(0.6, 1.1)) * relief, "balcony")
            elif chance < 0.6:
                site.add_box((left - 0.08, bottom, right - left + 0.16, 0.1), 0.16 * relief, "sill")
            if rng.random() < 0.12 * detail:
                rect = (right + 0.1, bottom - 0.5, 0.7, 0.5)
                site.add_box(rect, 0.35 * relief, "air conditioner")
    for _ in range(rng.poisson(0.12 * site.width * detail)):
        left, top = rng.uniform(
            (0.3, 2.0), (site.width - 0.3, max(2.1, site.height - 4.0))
        ).tolist()
        height, out_m = rng.uniform((0.7, 0.5), (1.8, 0.9)).tolist()
        frame = site.front.moved(left, top, out_m * relief)
        site.faces += box(frame, (0.12, height, out_m * relief), sign, "hanging sign")


def _shell(site: _Site) -> None:
    """Build the other walls with painted windows, the roof, and what stands on it."""
    rng, tpm, building = site.rng, site.tpm, site.building

    def paint(side: Side, width_m: float, height_m: float) -> Canvas:
        if side == "top":
            shape = (max(2, round(height_m * 12)), max(2, round(width_m * 12)))
            return material(rng, "concrete", shape, 12.0)
        canvas = site.paint(side, width_m, height_m)
        for top, bottom in site.rows.tolist():
            for left in np.arange(1.0, width_m - 1.5, 2.8).tolist():
                if rng.random() < 0.6:
                    details.window(rng, canvas, (left, top, 1.2, bottom - top), tpm)
        return canvas

    size = (site.width, site.height, building.depth_m)
    outside: tuple[Side, ...] = ("left", "right", "top", "back")
    plain = [side for side in outside if side not in building.rich_sides]
    if building.roof == "gable":
        site.faces += box(site.front, size, paint, "shell", [s for s in plain if s != "top"])
        footprint = (site.width, building.depth_m)
        site.faces += roofs.gable(site.front, footprint, building.roof_deg, site.paint, rng, tpm)
        return
    site.faces += box(site.front, size, paint, "shell", plain)
    for _ in range(rng.poisson(1.5)):
        width, height = rng.uniform((0.5, 0.8), (1.4, 2.0)).tolist()
        left = float(rng.uniform(0.0, site.width - width))
        back = -float(rng.uniform(0.5, max(0.6, building.depth_m - 2.0)))
        frame = site.front.moved(left, -height, back)
        sides: tuple[Side, ...] = ("front", "left", "right", "top", "back")
        site.faces += box(frame, (width, height, width), site.paint, "chimney", sides)
