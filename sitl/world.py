"""What there is to see: flat textured rectangles in a NED frame, and exact rays through them.

Everything built here (walls, bays, reveals, ledges, clutter, ground) is a
rectangle seen from one side, so depth has a closed form and the ground truth
is exact. The frame is NED: x north, y east, z down, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.rotation import Array

Grey = NDArray[np.uint8]

SKY = -1
_MIN_TEXTURE_PX = 2
_MAX_TEXTURE_PX = 32_000  # a gigabyte, where both sides are


def _frozen(value: Array, shape: tuple[int, ...], name: str) -> Array:
    """Return a read-only copy of finite numbers of a shape (-1: any); ValueError otherwise."""
    out = np.array(value, dtype=np.float64)
    fits = out.ndim == len(shape) and all(
        s in (-1, n) for s, n in zip(shape, out.shape, strict=True)
    )
    if not fits or not np.all(np.isfinite(out)):
        raise ValueError(f"{name} must be finite with shape {shape}, got {out.shape}")
    out.flags.writeable = False
    return out


@dataclass(frozen=True, eq=False)
class Texture:
    """A grey image stretched over a rectangle, with its halved copies for far views.

    Attributes:
        texels: (T,) uint8, of all levels one after the other.
        shelves: (L, 3) int64: where each level starts, its height and width.
    """

    texels: Grey
    shelves: NDArray[np.int64]

    @classmethod
    def from_image(cls, image: Grey) -> Texture:
        """Build the levels of an (H, W) image.

        Raises:
            ValueError: it is not a grey 8-bit image of 2 to 32000 texels a side.
        """
        level = np.ascontiguousarray(image)
        if level.ndim != 2 or level.dtype != np.uint8:
            raise ValueError(f"a texture is grey and 8-bit, got {level.shape} {level.dtype}")
        if min(level.shape) < _MIN_TEXTURE_PX or max(level.shape) > _MAX_TEXTURE_PX:
            raise ValueError(
                f"a texture has {_MIN_TEXTURE_PX} to {_MAX_TEXTURE_PX} texels a side: {level.shape}"
            )
        levels = [level]
        while min(levels[-1].shape) > 1:
            height, width = levels[-1].shape
            halved = cv2.resize(
                levels[-1], ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA
            )
            levels.append(np.asarray(halved, dtype=np.uint8))
        texels = np.concatenate([image_level.ravel() for image_level in levels])
        texels.flags.writeable = False
        starts = np.cumsum([0, *(image_level.size for image_level in levels[:-1])])
        shelves = np.column_stack([starts, [each.shape for each in levels]])
        shelves.flags.writeable = False
        return cls(texels, shelves)

    @property
    def levels(self) -> tuple[Grey, ...]:
        """(H, W) images; the first is the finest.

        Each next is the area average of the one before at half its size (rounded up), the last is
        a single texel wide or high. Each spans the whole rectangle: texel (i, j) of a (h, w) level
        is the rectangle's part [j/w, (j+1)/w] x [i/h, (i+1)/h].
        """
        return tuple(
            self.texels[start : start + height * width].reshape(height, width)
            for start, height, width in self.shelves
        )


@dataclass(frozen=True, eq=False)
class Surface:
    """A textured rectangle, visible from the side where ``right`` is right and ``down`` is down.

    Attributes:
        corner: (3,) its top left corner as seen, world frame, m.
        right, down: (3,) orthogonal unit vectors along its upper and left edges, world frame.
        width_m, height_m: its size along ``right`` and ``down``.
        texture: what is painted on it.
        holes: (K, 4) left, top, right, bottom of rectangular openings, m from the corner.
        name: for messages and tests.
    """

    corner: Array
    right: Array
    down: Array
    width_m: float
    height_m: float
    texture: Texture
    holes: Array = field(default_factory=lambda: np.zeros((0, 4)))
    name: str = ""

    def __post_init__(self) -> None:
        for key, shape in (("corner", (3,)), ("right", (3,)), ("down", (3,)), ("holes", (-1, 4))):
            object.__setattr__(self, key, _frozen(getattr(self, key), shape, f"Surface.{key}"))
        axes = np.stack([self.right, self.down])
        if np.abs(axes @ axes.T - np.eye(2)).max() > 1e-9:
            raise ValueError(f"Surface {self.name!r}: right and down must be orthonormal")
        if not min(self.width_m, self.height_m) > 0.0:
            raise ValueError(f"Surface {self.name!r}: width and height must be positive")

    @cached_property
    def outward(self) -> Array:
        """The (3,) unit normal on the visible side, world frame."""
        return np.cross(self.down, self.right)

    def point(self, right_m: float, down_m: float) -> Array:
        """Return the (3,) point so far from the corner along the two edges, world frame, m."""
        return self.corner + right_m * self.right + down_m * self.down


@dataclass(frozen=True, eq=False)
class Hits:
    """What N rays met.

    Attributes:
        distance: (N,) in lengths of each ray's direction (m for unit directions,
            depth for directions whose camera z is 1); inf where only sky is.
        surface: (N,) index into ``World.surfaces``, or ``SKY``.
        points_world: (N, 3) where, world frame, m; NaN where only sky is.
    """

    distance: Array
    surface: NDArray[np.int32]
    points_world: Array


@dataclass(frozen=True, eq=False)
class World:
    """Everything that can be seen.

    Attributes:
        surfaces: the rectangles.
        sky: painted over the directions (x, y) / (0.2 - z), each from -5 to 5.
    """

    surfaces: tuple[Surface, ...]
    sky: Texture

    def intersect(self, origin: Array, directions: Array) -> Hits:
        """Find what each ray meets first.

        Args:
            origin: (3,) where all rays start, world frame, m.
            directions: (N, 3) where they go, world frame, any length but zero.

        Returns:
            N hits. A surface is only met from its visible side.
        """
        distance = np.full(len(directions), np.inf)
        index = np.full(len(directions), SKY, dtype=np.int32)
        for i, surface in enumerate(self.surfaces):
            to_corner = surface.corner - origin
            height = float(to_corner @ surface.outward)
            if height >= 0.0:  # we are behind it
                continue
            approach = directions @ surface.outward
            candidates = np.flatnonzero(approach < 0.0)
            t = height / approach[candidates]
            nearer = t < distance[candidates]
            candidates, t = candidates[nearer], t[nearer]
            ray = directions[candidates]
            u = t * (ray @ surface.right) - to_corner @ surface.right
            v = t * (ray @ surface.down) - to_corner @ surface.down
            inside = (u >= 0.0) & (u <= surface.width_m) & (v >= 0.0) & (v <= surface.height_m)
            for left, top, right, bottom in surface.holes:
                inside &= ~((u > left) & (u < right) & (v > top) & (v < bottom))
            distance[candidates[inside]] = t[inside]
            index[candidates[inside]] = i
        met = np.where(index == SKY, np.nan, distance)
        return Hits(distance, index, origin + met[:, None] * directions)
