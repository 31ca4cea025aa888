"""Patches of keyframes found again in a frame: pyramids, anchors, choice and alignment (IV-D).

An anchor is a landmark in one keyframe: the pixel it stands for there, how far
away it is, and how its surface is inclined. Everything a frame needs of a map
is laid out once as plain tables for the compiled loops (``patch_views``,
``patch_kernels``).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision import patch_kernels as kernels
from vcl_companion.vision import patch_views
from vcl_companion.vision.features import Image

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
    """

    texels: NDArray[np.uint8]
    shelves: Ints

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
    return Pyramid(texels, np.array(shelves, dtype=np.int64))


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
        texels, shelves: of all pyramids, (T,) and (V, L, 3).
        worlds_from_cams: V poses.
    """

    texels: NDArray[np.uint8]
    shelves: Ints
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


def laid_out(pyramids: list[Pyramid]) -> tuple[NDArray[np.uint8], Ints]:
    """Return the texels of V images in one array, and (V, L, 3) where each level lies in it.

    All get as many levels as the smallest has; see ``Pyramid``.
    """
    n_levels = min(len(p.shelves) for p in pyramids)
    starts = np.concatenate([[0], np.cumsum([len(p.texels) for p in pyramids])[:-1]])
    shelves = np.stack(
        [p.shelves[:n_levels] + np.array([s, 0, 0]) for p, s in zip(pyramids, starts, strict=True)]
    )
    return np.concatenate([p.texels for p in pyramids]), shelves.astype(np.int64)


def keyframe_images(pyramids: list[Pyramid], worlds_from_cams: list[Pose]) -> KeyframeImages:
    """Lay out the images of V keyframes."""
    return KeyframeImages(*laid_out(pyramids), tuple(worlds_from_cams))


@dataclass(frozen=True)
class ChoiceRules:
    """Which landmarks are worth aligning.

    Attributes:
        cell_px: side of the cells that the choice is spread over.
        grey_noise: of an image, grey levels, 1 sigma.
        misplaced_px: what any alignment is off, 1 sigma.
        misplaced_px_per_rad: per angle between the lines of sight.
        misplaced_px_per_octave: per doubling or halving of the size.
        max_octaves_nearer: a patch is not magnified more.
        max_octaves_farther: nor shrunk more.
    """

    cell_px: float
    grey_noise: float
    misplaced_px: float
    misplaced_px_per_rad: float
    misplaced_px_per_octave: float
    max_octaves_nearer: float
    max_octaves_farther: float


def choose_anchors(
    anchors: Anchors,
    lens: Lens,
    world_from_body: Pose,
    body_from_cam: Pose,
    covariance: Array,
    rules: ChoiceRules,
    wanted: int,
    margin_px: float,
) -> tuple[Ints, Array, int]:
    """Choose the landmarks that fix the pose best, spread over the image.

    Args:
        anchors: of the map.
        lens: of the frame's camera.
        world_from_body: predicted pose.
        body_from_cam: the camera's mounting.
        covariance: (6, 6) of the prediction, local.
        rules: what an alignment is worth.
        wanted: how many, at most.
        margin_px: no landmark nearer to the image's border.

    Returns:
        (K,) anchors, the best of each cell first; (K,) 3 sigma of where each will appear,
        px; how many landmarks are in view.
    """
    cam_from_world = (world_from_body @ body_from_cam).inverse()
    images = anchors.images
    return patch_views.choose(
        anchors.first,
        anchors.keyframe,
        anchors.planes,
        anchors.spread,
        anchors.texture,
        lens.table,
        lens.reach,
        images.transforms(cam_from_world),
        np.ascontiguousarray(cam_from_world.rotation),
        np.ascontiguousarray(body_from_cam.matrix()[:3]),
        np.ascontiguousarray(covariance),
        np.array([*lens.size_px, margin_px], dtype=np.float64),
        np.array(
            [
                rules.cell_px,
                rules.grey_noise,
                rules.misplaced_px,
                rules.misplaced_px_per_rad,
                rules.misplaced_px_per_octave,
                rules.max_octaves_nearer,
                rules.max_octaves_farther,
            ]
        ),
        wanted,
    )


@dataclass(frozen=True)
class AlignRules:
    """How patches are aligned, and what is thought of the result.

    Attributes:
        max_iterations: of one patch.
        least_score: zero-mean normalised correlation of an aligned patch, at least.
        max_moved_px: farther from where it began an alignment is not believed, level px.
        settled_px: a step below this is the last.
        misplaced_px: what an alignment is off whatever the view, 1 sigma.
        misplaced_px_per_rad: per angle between the lines of sight.
        misplaced_px_per_octave: per doubling or halving of the distance.
        misplaced_by_residual: per sigma that the residual of the grey levels explains.
    """

    max_iterations: int = 10
    least_score: float = 0.75
    max_moved_px: float = 3.0
    settled_px: float = 0.05
    misplaced_px: float = 0.04
    misplaced_px_per_rad: float = 0.5
    misplaced_px_per_octave: float = 0.03
    misplaced_by_residual: float = 0.7


@dataclass(frozen=True, eq=False)
class Alignment:
    """Patches looked for in one frame; what was not found is NaN or zero.

    Attributes:
        anchors: (M,) which.
        points_world: (M, 3) where they are in the map, m, and
        spread: (M, 6) how exactly it knows (``Anchors.spread``).
        predicted: (M, 2) raw px.
        pixels: (M, 2) where they were found, raw px.
        ideal: (M, 2) the same as ideal image coordinates.
        slopes: (M, 2, 2) d(pixel) / d(ideal) there.
        noise: (M, 3) xx xy yy of ``pixels`` by the residual of the grey levels, px^2.
        misplaced: (M, 3) of what is the same in every frame taken from here, px^2.
        scores: (M,) correlation.
        status: (M,) FOUND or why not.
    """

    anchors: Ints
    points_world: Array
    spread: Array
    predicted: Array
    pixels: Array
    ideal: Array
    slopes: Array
    noise: Array
    misplaced: Array
    scores: Array
    status: Ints

    @property
    def found(self) -> NDArray[np.bool_]:
        """(M,) which were found."""
        return np.asarray(self.status == kernels.FOUND)

    def of(self, kept: NDArray[np.bool_]) -> Alignment:
        """Return some of them."""
        rows = np.flatnonzero(kept)
        return Alignment(*(getattr(self, one.name).take(rows, axis=0) for one in fields(self)))


def align_patches(
    anchors: Anchors,
    chosen: Ints,
    frame: Pyramid,
    lens: Lens,
    cam_from_world: Pose,
    radii_px: Array,
    level: int,
    rules: AlignRules,
) -> Alignment:
    """Find the patches of chosen anchors in a frame.

    Args:
        anchors: of the map.
        chosen: (M,) which.
        frame: the image.
        lens: of its camera.
        cam_from_world: predicted pose.
        radii_px: (M,) how far to search before aligning; below one pixel of the level not at all.
        level: of the pyramid, 0 the full resolution; capped by what there is.
        rules: when an alignment is believed.
    """
    images = anchors.images
    views, seen = patch_views.viewed(
        chosen,
        anchors.keyframe,
        anchors.planes,
        lens.table,
        lens.reach,
        images.transforms(cam_from_world),
    )
    pixels, noise, misplaced, scores, status = kernels.align(
        views,
        seen,
        anchors.keyframe.take(chosen),
        anchors.pixels.take(chosen, axis=0),
        images.texels,
        images.shelves,
        frame.texels,
        frame.shelves,
        radii_px,
        np.array(
            [
                rules.max_iterations,
                rules.least_score,
                rules.max_moved_px,
                rules.settled_px,
                rules.misplaced_px,
                rules.misplaced_px_per_rad,
                rules.misplaced_px_per_octave,
                rules.misplaced_by_residual,
            ],
            dtype=np.float64,
        ),
        min(level, len(frame.shelves) - 1),
    )
    ideal, slopes = patch_views.unbent(lens.table, pixels, views)
    predicted = np.where(seen[:, None], views[:, 3:5], np.nan)
    return Alignment(
        chosen,
        anchors.points_world.take(chosen, axis=0),
        anchors.spread.take(chosen, axis=0),
        predicted,
        pixels,
        ideal,
        slopes,
        noise,
        misplaced,
        scores,
        status,
    )
