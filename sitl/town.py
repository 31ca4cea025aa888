"""A town from its description: buildings, streets, trees, clutter, ground and sky."""

from __future__ import annotations

import msgspec
import numpy as np

from sitl import details
from sitl.building import Building, build
from sitl.faces import Face, Frame, Side, box
from sitl.street import Street, pave
from sitl.sunlight import Sun, lit
from sitl.textures import Canvas, Style, material, noise
from sitl.trees import Tree, plant
from sitl.world import Texture, World

_PAVEMENT_TEXELS_PER_M = 32.0
_SKY_TEXELS = 1024
_MOST_TEXELS = 2**30  # of all that stands there: 4 GiB while it is painted
_UPRIGHT: tuple[Side, ...] = ("front", "left", "right", "top", "back")


class Pavement(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A raised rectangle of finely drawn ground, along the axes; metres."""

    x_m: float
    y_m: float
    length_x_m: float
    length_y_m: float
    height_m: float = 0.12
    style: Style = "paving"


class Clutter(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Boxes (crates, kiosks, vans) standing about in a rectangle along the axes; metres."""

    x_m: float
    y_m: float
    length_x_m: float
    length_y_m: float
    count: int = 8
    min_size_m: float = 0.5
    max_size_m: float = 2.0

    def __post_init__(self) -> None:
        if self.min_size_m > self.max_size_m:
            raise ValueError("clutter: min_size_m is at most max_size_m")


class Town(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that stands in a scenario.

    Attributes:
        seed: of all looks.
        sun_azimuth_deg, sun_elevation_deg, sun_strength: see ``Sun``.
        texels_per_m: resolution of the buildings' paint.
        ground_half_m: the ground reaches so far from the origin.
        ground_style, ground_texels_per_m: what it is made of and how finely.
        building, pavement, clutter, street, tree: what stands there.
    """

    seed: int = 1
    sun_azimuth_deg: float = Sun.azimuth_deg
    sun_elevation_deg: float = Sun.elevation_deg
    sun_strength: float = Sun.strength
    texels_per_m: float = 56.0
    ground_half_m: float = 90.0
    ground_style: Style = "asphalt"
    ground_texels_per_m: float = 10.0
    building: tuple[Building, ...] = ()
    pavement: tuple[Pavement, ...] = ()
    clutter: tuple[Clutter, ...] = ()
    street: tuple[Street, ...] = ()
    tree: tuple[Tree, ...] = ()

    def __post_init__(self) -> None:
        if (area_m2 := self._painted_m2()) * self.texels_per_m**2 > _MOST_TEXELS:
            raise ValueError(
                f"town: {area_m2:.0f} m2 of walls, pavements and streets are too much to paint by "
                f"{self.texels_per_m:g} texels_per_m; "
                f"at most {_MOST_TEXELS / self.texels_per_m**2:.0f} m2"
            )
        self.sun()

    def _painted_m2(self) -> float:
        """Return about how much there is to paint but for the ground."""
        return sum(
            (
                *(2 * (b.width_m + b.depth_m) * b.height_m for b in self.building),
                *(p.length_x_m * p.length_y_m for p in self.pavement),
                *(5 * c.count * c.max_size_m**2 for c in self.clutter),
                *(s.length_m * (s.road_m + 2 * s.pavement_m) for s in self.street),
            )
        )

    def sun(self) -> Sun:
        """Return where the light comes from."""
        return Sun(self.sun_azimuth_deg, self.sun_elevation_deg, self.sun_strength)


def build_town(town: Town) -> World:
    """Build the world that a description asks for; the same one every time."""
    faces = [_ground(town)]
    for i, pavement in enumerate(town.pavement):
        faces += _pavement(pavement, np.random.default_rng([town.seed, 1, i]), town.texels_per_m)
    for i, building in enumerate(town.building):
        rng = np.random.default_rng([town.seed, 2, building.seed or 1000 + i])
        faces += build(building, rng, town.texels_per_m)
    for i, clutter in enumerate(town.clutter):
        rng = np.random.default_rng([town.seed, 3, i])
        faces += _clutter(clutter, rng, town.texels_per_m)
    for i, street in enumerate(town.street):
        rng = np.random.default_rng([town.seed, 5, street.seed or 1000 + i])
        faces += pave(street, rng, town.texels_per_m)
    for i, tree in enumerate(town.tree):
        faces += plant(tree, np.random.default_rng([town.seed, 6, i]), town.texels_per_m)
    return World(lit(faces, town.sun()), _sky(np.random.default_rng([town.seed, 4])))


def _flat(x_m: float, y_m: float, z_m: float) -> Frame:
    """Return a frame on the ground, seen from above with north up: right is east."""
    origin = np.array([x_m, y_m, z_m])
    return Frame(origin, np.array([0.0, 1.0, 0.0]), np.array([-1.0, 0.0, 0.0]))


def _ground(town: Town) -> Face:
    half = town.ground_half_m
    tpm = min(town.ground_texels_per_m, 8000.0 / half)
    texels = round(2 * half * tpm)
    rng = np.random.default_rng([town.seed, 0])
    canvas = material(rng, town.ground_style, (texels, texels), tpm)
    return Face(_flat(half, -half, 0.0), 2 * half, 2 * half, canvas, "ground")


def _pavement(pavement: Pavement, rng: np.random.Generator, texels_per_m: float) -> list[Face]:
    tpm = min(texels_per_m, _PAVEMENT_TEXELS_PER_M)

    def paint(side: Side, width_m: float, height_m: float) -> Canvas:
        shape = (max(2, round(height_m * tpm)), max(2, round(width_m * tpm)))
        return material(rng, pavement.style, shape, tpm)

    x, y = pavement.x_m, pavement.y_m
    south = np.array([x - pavement.length_x_m / 2, y, 0.0])
    front = Frame.facing(south, np.pi, pavement.length_y_m, pavement.height_m)
    size = (pavement.length_y_m, pavement.height_m, pavement.length_x_m)
    return box(front, size, paint, "pavement", _UPRIGHT)


def _clutter(clutter: Clutter, rng: np.random.Generator, tpm: float) -> list[Face]:
    faces = []
    styles: tuple[Style, ...] = ("plaster", "concrete", "brick", "plain")
    for _ in range(clutter.count):
        style = styles[int(rng.integers(len(styles)))]

        def paint(side: Side, width_m: float, height_m: float, style: Style = style) -> Canvas:
            shape = (max(2, round(height_m * tpm)), max(2, round(width_m * tpm)))
            canvas = material(rng, style, shape, tpm)
            if side == "top":
                return canvas
            for work in (details.poster, details.lettering, details.graffiti):
                if rng.random() < 0.5:
                    high = rng.uniform(0.25, 0.8) * height_m
                    wide = float(np.clip(high * rng.uniform(0.6, 3.0), 0.2, 0.9 * width_m))
                    left, top = (rng.random(2) * (width_m - wide, height_m - high)).tolist()
                    work(rng, canvas, (left, top, wide, high), tpm)
            return canvas

        width, height, depth = rng.uniform(clutter.min_size_m, clutter.max_size_m, 3).tolist()
        place = (rng.random(2) - 0.5) * (clutter.length_x_m, clutter.length_y_m)
        foot = np.array([clutter.x_m + place[0], clutter.y_m + place[1], 0.0])
        front = Frame.facing(foot, float(rng.uniform(0.0, 2 * np.pi)), width, height)
        faces += box(front, (width, height, depth), paint, "clutter", _UPRIGHT)
    return faces


def _sky(rng: np.random.Generator) -> Texture:
    """Paint soft clouds: bright, and without corners that a tracker could take for landmarks."""
    shape = (_SKY_TEXELS, _SKY_TEXELS)
    clouds = noise(rng, shape, _SKY_TEXELS / 10.0, 4.0, 0.3, 1.0)
    return Texture.from_image(np.clip(np.rint(205.0 + 12.0 * clouds), 0, 255).astype(np.uint8))
