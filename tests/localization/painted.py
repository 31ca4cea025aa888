"""A painted world with depth, photographed from anywhere, and a true map of it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import cv2
import numpy as np

from sitl.renderer import Imaging, Renderer
from sitl.world import Surface, Texture, World
from tests.scenes import PINHOLE
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.fix import Localized, Prior
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.tracking import TrackingOptions, track
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.mapping.templates import prepare_templates
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD
from vcl_companion.vision.features import FeatureOptions, Image, detect

MOUNTING = Pose(BODY_FROM_CAM_FORWARD @ exp_so3(np.array([0.01, 0.02, 0.0])), np.array([0.1, 0, 0]))
# Three drones side by side, as at the start of a flight.
BODIES = (
    Pose.identity(),
    Pose(exp_so3(np.array([0.01, 0.0, -0.03])), np.array([0.1, 1.6, 0.2])),
    Pose(exp_so3(np.array([0.0, -0.02, 0.02])), np.array([-0.2, -1.5, -0.3])),
)


def _paint(rng: np.random.Generator, width_m: float, height_m: float) -> Texture:
    """Return blobs of three sizes, as rich close by as from afar."""
    size = round(width_m * 50), round(height_m * 50)
    total = np.zeros(size[::-1], np.float32)
    for texels in (10, 30, 90):
        cells = size[1] // texels + 2, size[0] // texels + 2
        coarse = rng.standard_normal(cells).astype(np.float32)
        total += cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)
    return Texture.from_image(np.clip(128.0 + 38.0 * total, 0, 255).astype(np.uint8))


Scenery = Literal["boards", "windows", "wall"]


def _windows(width_m: float, height_m: float, every_m: float) -> Texture:
    """Return one small picture over and over: nothing tells two of them apart."""
    side = round(every_m * 50)
    coarse = np.random.default_rng(9).standard_normal((8, 8)).astype(np.float32)
    one = 128.0 + 45.0 * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    size = round(width_m * 50), round(height_m * 50)
    all_of_them = np.tile(one, (size[1] // side + 1, size[0] // side + 1))[: size[1], : size[0]]
    return Texture.from_image(np.clip(all_of_them, 0, 255).astype(np.uint8))


@cache
def world(scenery: Scenery = "boards") -> World:
    """Return a wall at 16 m, two inclined boards at 8 to 12 m before it, and the ground.

    With "windows" the wall is the same again every 0.8 m; "wall" is the wall alone.
    """
    rng = np.random.default_rng(5)

    def board(corner: Array, turn: Array, width_m: float, height_m: float) -> Surface:
        axes = exp_so3(turn)
        paint = _paint(rng, width_m, height_m)
        return Surface(corner, axes[:, 1], axes[:, 2], width_m, height_m, paint)

    wall = board(np.array([16.0, -30.0, -20.0]), np.zeros(3), 60.0, 23.0)
    before_it = (
        board(np.array([12.0, -8.0, -5.0]), np.array([0.0, 0.0, 0.5]), 5.0, 7.0),
        board(np.array([8.0, 1.5, -3.0]), np.array([0.0, 0.1, -0.6]), 4.5, 5.0),
        board(np.array([16.0, -30.0, 3.0]), np.array([0.0, -np.pi / 2, 0.0]), 60.0, 30.0),
    )
    if scenery == "windows":
        wall = replace(wall, texture=_windows(60.0, 23.0, every_m=0.8))
    surfaces = (wall,) if scenery == "wall" else (wall, *before_it)
    return World(surfaces, Texture.from_image(np.full((4, 4), 90, dtype=np.uint8)))


@cache
def _renderer(camera: Camera, imaging: Imaging, scenery: Scenery) -> Renderer:
    return Renderer(world(scenery), camera, imaging)


def photograph(
    world_from_body: Pose,
    rng: np.random.Generator | None = None,
    camera: Camera = PINHOLE,
    imaging: Imaging | None = None,
    scenery: Scenery = "boards",
) -> Image:
    """Return a picture; with an rng, with the sensor's noise."""
    renderer = _renderer(camera, imaging or Imaging(), scenery)
    return renderer.render(world_from_body @ MOUNTING, rng)


def painted_map(
    rng: np.random.Generator,
    camera: Camera = PINHOLE,
    n: int = 500,
    noise_px: float = 0.1,
    bodies: tuple[Pose, ...] = BODIES,
    recognisable: bool = False,
    scenery: Scenery = "boards",
) -> LandmarkMap:
    """Return the map of places that are visible from all of its keyframes.

    With ``recognisable`` they are what a detector finds in the first one. Poses are
    true; a landmark lies on the truth up to its depth, which is as wrong as
    ``noise_px`` in the keyframes leave it: of patches, by default.
    """
    cams = [body @ MOUNTING for body in bodies]
    size = np.array([camera.width_px, camera.height_px])
    found = rng.uniform(20.0, size - 21.0, (8 * n, 2))
    if recognisable:
        found = detect(
            photograph(bodies[0], None, camera, scenery=scenery), "akaze", FeatureOptions()
        ).pixels
        found = rng.permutation(found)
    rays = np.column_stack([camera.ideal_from_pixels(found), np.ones(len(found))])
    hits = world(scenery).intersect(cams[0].translation, rays @ cams[0].rotation.T)
    points = hits.points_world[np.isfinite(hits.distance)]
    seen = np.stack([camera.project(cam.inverse().apply(points)) for cam in cams], axis=1)
    visible = ((seen > 12.0) & (seen < size - 13.0)).all(axis=(1, 2))
    for cam in cams:
        again = world(scenery).intersect(cam.translation, points - cam.translation).points_world
        visible &= np.linalg.norm(again - points, axis=1) < 1e-3
    points, seen = points[visible][:n], seen[visible][:n]
    baseline = min(float(np.linalg.norm(b.translation)) for b in bodies[1:])
    rays_first = points - cams[0].translation
    depth = rays_first @ cams[0].rotation[:, 2]
    off = noise_px * depth / (camera.focal_px * baseline) * rng.standard_normal(len(points))
    points = points + rays_first * off[:, None]
    return LandmarkMap(
        keyframes=tuple(
            Keyframe(
                i + 1, 0, body, MOUNTING, camera,
                encode_image(photograph(body, rng, camera, scenery=scenery), 90),
            )
            for i, body in enumerate(bodies)
        ),
        points_world=points,
        observed_px=seen + noise_px * rng.standard_normal(seen.shape),
        pixel_noise_px=noise_px,
        detectors=("akaze",),
        distances=(KnownDistance(0, 1, float(np.linalg.norm(bodies[1].translation)), 0.01),),
        parent=b"",
    )  # fmt: skip


def carried_on(landmark_map: LandmarkMap, share: float) -> LandmarkMap:
    """The map after a long flight: four more keyframes, and landmarks that the first did not see.

    Args:
        landmark_map: of three keyframes.
        share: of the landmarks that are still those of the beginning.
    """
    later_ns = 10**9
    newer = tuple(
        replace(k, captured_at_ns=k.captured_at_ns + later_ns) for k in landmark_map.keyframes
    )
    new = np.random.default_rng(5).random(len(landmark_map.points_world)) >= share
    then, now = landmark_map.observed_px.copy(), landmark_map.observed_px.copy()
    then[new] = np.nan
    return replace(
        landmark_map,
        keyframes=landmark_map.keyframes + newer,
        observed_px=np.concatenate([then, now], axis=1),
    )


def found_in(landmark_map: LandmarkMap, body: Pose) -> Localized:
    """What a picture of the painted world, taken there, gives by the patches of a map of it."""
    fix = track(
        photograph(body, np.random.default_rng(4)), PINHOLE, MOUNTING,
        prepare_templates(landmark_map, map_uncertainty(landmark_map)),
        Prior(body, np.diag(np.full(6, 1e-4))), None, TrackingOptions(), LocalizationOptions(),
    )  # fmt: skip
    assert isinstance(fix, Localized), fix.reason
    return fix
