"""What patch tracking works on, laid out as plain tables: images, lenses, anchors (IV-D).

An anchor is a landmark in one keyframe: the pixel it stands for there, how far
away it is, and how its surface is inclined. Everything a frame needs of a map
is laid out once for the compiled loops (``patch_views``,
``patch_kernels``).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision import patch_views
from vcl_companion.vision.features import Image
from vcl_companion.vision.image_noise import grey_noise

Ints = NDArray[np.int64]

_N_LEVELS = 5
_LEAST_SIDE_PX = 40
_MODELS = {"none": 0.0, "radial-tangential": 1.0, "equidistant": 2.0}


@dataclass(frozen=True, eq=False)
class Pyramid:
    """An image at full, half, quarter... resolution, in one array.

    Attributes:
        texels: (T,) grey levels of all levels, row by row.
        shelves: (L, 3) where each level begins, its height and width.
        noise: of the image's pixels, 1 sigma, grey levels.
    """

    texels: NDArray[np.uint8]
    shelves: Ints
    noise: float

    @property
    def image(self) -> Image:
        """(H, W) the image at full resolution."""
        _, height, width = self.shelves[0]
        return np.asarray(self.texels[: height * width].reshape(height, width))


def pyramid_of(image: Image, n_levels: int = _N_LEVELS) -> Pyramid:
    """Reduce an image step by step; a level's pixel (0, 0) is the full image's.

    Levels of less than 40 px a side are left out.
    """
    shelves = [(0, *image.shape)]
    while len(shelves) < n_levels and min(shelves[-1][1:]) >= 2 * _LEAST_SIDE_PX:
        start, height, width = shelves[-1]
        shelves.append((start + height * width, (height + 1) // 2, (width + 1) // 2))
    start, height, width = shelves[-1]
    texels = np.empty(start + height * width, dtype=np.uint8)
    levels = [texels[s : s + h * w].reshape(h, w) for s, h, w in shelves]
    levels[0][:] = image
    for larger, smaller in pairwise(levels):
        cv2.pyrDown(larger, smaller)
    return Pyramid(texels, np.array(shelves, dtype=np.int64), grey_noise(image))


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera as the compiled loops read it.

    Attributes:
        table: (10,) see ``patch_views``.
        reach: largest squared ideal radius in view; beyond, the distortion is no lens.
        size_px: width and height.
    """

    table: Array
    reach: float
    size_px: tuple[int, int]


@lru_cache(maxsize=64)
def lens_of(camera: Camera) -> Lens:
    """Lay out a camera's intrinsics."""
    table = np.zeros(patch_views.N_LENS)
    table[:5] = (
        _MODELS[camera.distortion_model],
        camera.fx_px,
        camera.fy_px,
        camera.cx_px,
        camera.cy_px,
    )
    table[5 : 5 + len(camera.distortion)] = camera.distortion
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    across, down = np.linspace(-0.5, right, 33), np.linspace(-0.5, bottom, 25)
    border = np.concatenate(
        [
            np.column_stack([across, np.full(33, -0.5)]),
            np.column_stack([across, np.full(33, bottom)]),
            np.column_stack([np.full(25, -0.5), down]),
            np.column_stack([np.full(25, right), down]),
        ]
    )
    square = (camera.ideal_from_pixels(border) ** 2).sum(axis=1)
    finite = square[np.isfinite(square)]
    reach = float(finite.max()) * (1.0 + 1e-9) if len(finite) else 0.0
    return Lens(table, reach, (camera.width_px, camera.height_px))


@dataclass(frozen=True, eq=False)
class Anchors:
    """Landmarks in keyframes; those of one landmark stand together.

    Attributes:
        first: (N + 1,) where each landmark's anchors begin.
        landmark: (A,) of each anchor.
        keyframe: (A,) of each anchor.
        planes: (A, 9) ideal x, y, inverse depth 1/m, its slopes by x and y; d(ideal) / d(pixel).
        pixels: (A, 2) the anchor in the keyframe's raw image.
        points_world: (A, 3) m.
        own: (A, 3) 1-sigma of its depth as a displacement of the point, world axes, m.
        spread: (A, 6) xx xy xz yy yz zz of the same, m^2. What all landmarks share through the
            keyframes tells none of them from the others, and is not in it.
        texture: (A, 3) xx xy yy of the squared gradient summed over its patch.
        images: the keyframes.
    """

    first: Ints
    landmark: Ints
    keyframe: Ints
    planes: Array
    pixels: Array
    points_world: Array
    own: Array
    spread: Array
    texture: Array
    images: KeyframeImages

    def __post_init__(self) -> None:
        # In another order the compiled loops would be compiled anew, while a frame waits.
        for name in ("planes", "pixels", "points_world", "own", "spread", "texture"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """The keyframes of a map as one table.

    Attributes:
        texels, shelves, noises: of all pyramids, (T,), (V, L, 3) and (V,).
        worlds_from_cams: V poses.
    """

    texels: NDArray[np.uint8]
    shelves: Ints
    noises: Array
    worlds_from_cams: tuple[Pose, ...]

    @cached_property
    def centres(self) -> Array:
        """(V, 3) where the cameras were, world, m."""
        return np.array([pose.translation for pose in self.worlds_from_cams]).reshape(-1, 3)

    @cached_property
    def _rotations(self) -> Array:
        return np.array([pose.rotation for pose in self.worlds_from_cams]).reshape(-1, 3, 3)

    def transforms(self, cam_from_world: Pose) -> Array:
        """Return (V, 3, 4) frame_from_key of every keyframe's camera."""
        out = np.empty((len(self.worlds_from_cams), 3, 4))
        out[:, :, :3] = cam_from_world.rotation @ self._rotations
        out[:, :, 3] = cam_from_world.apply(self.centres)
        return out


def laid_out(pyramids: list[Pyramid]) -> tuple[NDArray[np.uint8], Ints, Array]:
    """Return V images as one table: their texels, where each level lies in them, their noise.

    (T,), (V, L, 3) and (V,). All get as many levels as the smallest has; see ``Pyramid``.
    """
    n_levels = min(len(p.shelves) for p in pyramids)
    starts = np.concatenate([[0], np.cumsum([len(p.texels) for p in pyramids])[:-1]])
    shelves = np.stack(
        [p.shelves[:n_levels] + np.array([s, 0, 0]) for p, s in zip(pyramids, starts, strict=True)]
    )
    noises = np.array([p.noise for p in pyramids], dtype=np.float64)
    return np.concatenate([p.texels for p in pyramids]), shelves.astype(np.int64), noises


def keyframe_images(pyramids: list[Pyramid], worlds_from_cams: list[Pose]) -> KeyframeImages:
    """Lay out the images of V keyframes."""
    return KeyframeImages(*laid_out(pyramids), tuple(worlds_from_cams))
