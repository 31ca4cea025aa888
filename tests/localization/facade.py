"""A textured wall photographed from anywhere, and a map whose keyframes are such photographs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from scipy.spatial import cKDTree

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD
from vcl_companion.vision.features import Detector, FeatureOptions, Features, Image, detect

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
MOUNTING = Pose(BODY_FROM_CAM_FORWARD, np.array([0.1, 0.0, 0.05]))
_WALL_M = 6.0
_TEXELS_PER_M = 60.0


@cache
def _texture() -> Image:
    """Return a wall of blobs of several sizes, 24 m wide and high."""
    rng = np.random.default_rng(42)
    side = int(24 * _TEXELS_PER_M)
    total = np.zeros((side, side), np.float32)
    for cells in (40, 110, 300):
        coarse = rng.standard_normal((cells, cells)).astype(np.float32)
        total += cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    levels = 128.0 + 45.0 * total
    return np.asarray(np.clip(levels, 0, 255), dtype=np.uint8)


def on_wall(world_from_cam: Pose, pixels: Array) -> Array:
    """Return (N, 3) where the rays of (N, 2) pixels meet the wall x = 6 m."""
    ideal = CAMERA.ideal_from_pixels(pixels)
    rays = np.hstack([ideal, np.ones((len(ideal), 1))]) @ world_from_cam.rotation.T
    reach = (_WALL_M - world_from_cam.translation[0]) / rays[:, 0]
    return np.asarray(world_from_cam.translation + rays * reach[:, None])


def photograph(world_from_body: Pose) -> Image:
    """Return the (240, 320) grey image of the wall."""
    v, u = np.mgrid[: CAMERA.height_px, : CAMERA.width_px].astype(np.float64)
    points = on_wall(world_from_body @ MOUNTING, np.stack([u.ravel(), v.ravel()], axis=1))
    texels = (points[:, 1:] + 12.0) * _TEXELS_PER_M
    across, down = texels.reshape(*u.shape, 2).astype(np.float32).transpose(2, 0, 1)
    sampled = cv2.remap(_texture(), across, down, cv2.INTER_LINEAR)
    return np.asarray(cv2.GaussianBlur(sampled, (0, 0), 0.6), dtype=np.uint8)


def features_from(world_from_body: Pose, detector: Detector = "akaze") -> Features:
    """Return what a detector finds in a photograph."""
    return detect(photograph(world_from_body), detector, FeatureOptions())


def photographed_map(bodies: Sequence[Pose], detector: Detector = "akaze") -> LandmarkMap:
    """Return the map of features found again in every one of some photographs."""
    images = [encode_image(photograph(body), 90) for body in bodies]
    found = [detect(decode_image(b, CAMERA), detector, FeatureOptions()).pixels for b in images]
    points = on_wall(bodies[0] @ MOUNTING, found[0])
    observed = np.full((len(points), len(bodies), 2), np.nan)
    observed[:, 0] = found[0]
    for i in range(1, len(bodies)):
        expected = CAMERA.project((bodies[i] @ MOUNTING).inverse().apply(points))
        gap, nearest = cKDTree(found[i]).query(expected)
        near = gap < 1.0
        observed[near, i] = found[i][np.atleast_1d(nearest)[near]]
    placed = np.isfinite(observed[..., 0]).sum(axis=1) >= 2
    apart = float(np.linalg.norm(bodies[0].translation - bodies[1].translation))
    return LandmarkMap(
        keyframes=tuple(
            Keyframe(i + 1, 0, body, MOUNTING, CAMERA, image)
            for i, (body, image) in enumerate(zip(bodies, images, strict=True))
        ),
        points_world=points[placed],
        observed_px=observed[placed],
        pixel_noise_px=0.3,
        detectors=(detector,),
        distances=(KnownDistance(0, 1, apart, 0.01),),
        parent=b"",
    )
