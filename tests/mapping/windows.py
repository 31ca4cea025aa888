"""A wall of alike windows, some of which were taken for the next ones, and a post before it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.mapping.rendered import CAMERA, rendered
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD
from vcl_companion.vision.features import Image

WALL_M, POST_M = 9.0, 5.0
PX_PER_M = 40.0
WINDOW_PX, APART_PX = 44, 80
MOUNTING = Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
BODIES = [Pose.identity(), Pose(np.eye(3), np.array([0.0, 1.2, 0.0]))]
CAMS = [body @ MOUNTING for body in BODIES]


def textured(rng: np.random.Generator, height: int, width: int) -> Image:
    """Something with a corner every few pixels."""
    grains = rng.integers(0, 256, (height // 4 + 1, width // 4 + 1)).repeat(4, 0).repeat(4, 1)
    return np.asarray(grains[:height, :width], dtype=np.uint8)


def facade(rng: np.random.Generator) -> list[tuple[float, float, Image]]:
    """A wall with a row of windows, one like the other, and a post before it."""
    wall, window = textured(rng, 320, 640), textured(rng, WINDOW_PX, WINDOW_PX)
    for left in range(20, 640 - WINDOW_PX, APART_PX):
        wall[138 : 138 + WINDOW_PX, left : left + WINDOW_PX] = window
    return [(WALL_M, -8.0, wall), (POST_M, 2.0, textured(rng, 320, 20))]


def on_wall(u: Array, v: Array) -> Array:
    """(N, 3) points of the wall's texture."""
    across = np.full(len(u), WALL_M), -8.0 + u / PX_PER_M, (v - 160.0) / PX_PER_M
    return np.stack(across, axis=1)


@dataclass(frozen=True, eq=False)
class Bent:
    """A map, and (N,) what its landmarks are: 0 the wall's, 1 the post's, 2 wrong."""

    landmark_map: LandmarkMap
    kind: NDArray[np.intp]


def bent_by_windows() -> Bent:
    """A wall, a post, and a window that was taken for the one before it."""
    rng = np.random.default_rng(7)
    scene = facade(rng)
    images = [rendered(scene, cam) for cam in CAMS]
    wall = on_wall(rng.uniform(150.0, 560.0, 500), rng.uniform(20.0, 300.0, 500))
    post = np.stack([np.full(60, POST_M), rng.uniform(2.1, 2.4, 60), rng.uniform(-2, 2, 60)], 1)
    inside = rng.uniform(6.0, WINDOW_PX - 6.0, (30, 2))
    window = on_wall(260.0 + inside[:, 0], 138.0 + inside[:, 1])
    next_one = on_wall(260.0 - APART_PX + inside[:, 0], 138.0 + inside[:, 1])
    points = np.concatenate([wall, post, window])
    kind = np.repeat([0, 1, 2], [500, 60, 30])
    first = CAMERA.project(CAMS[0].inverse().apply(points))
    second = CAMERA.project(CAMS[1].inverse().apply(points))
    second[kind == 2] = CAMERA.project(CAMS[1].inverse().apply(next_one))
    # Where both lines of sight meet: the disparity tells how far.
    disparity = first[kind == 2, 0] - second[kind == 2, 0]
    away = CAMERA.fx_px * 1.2 / disparity
    rays = points[kind == 2] / points[kind == 2, :1]
    points[kind == 2] = rays * away[:, None]
    # What the post hides is not seen.
    hidden = (kind != 1) & (
        (np.abs(first[:, 0] - 249.5) < 16) | (np.abs(second[:, 0] - 201.5) < 16)
    )
    ok = CAMERA.shows(first, 8.0) & CAMERA.shows(second, 8.0) & ~hidden
    keyframes = tuple(
        Keyframe(i + 1, i + 1, body, MOUNTING, CAMERA, encode_image(image, 90))
        for i, (body, image) in enumerate(zip(BODIES, images, strict=True))
    )
    observed = np.stack([first, second], axis=1)[ok]
    return Bent(
        LandmarkMap(
            keyframes,
            points[ok],
            observed,
            0.2,
            ("akaze",),
            (KnownDistance(0, 1, 1.2, 0.01),),
            b"",
        ),
        kind[ok],
    )
