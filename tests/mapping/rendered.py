"""Small rendered views of textured panels, with exact poses: real features from real pixels."""

from __future__ import annotations

import cv2
import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.keyframe_image import decode_image, encode_image
from vcl_companion.mapping.options import MapOptions
from vcl_companion.vision.features import FeatureOptions, Image, detect

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
_PX_PER_M = 40.0


def panels(rng: np.random.Generator, n: int = 8) -> list[tuple[float, float, Image]]:
    """Return (depth in m north, left edge in m east, texture) of panels side by side."""
    out = []
    for k in range(n):
        coarse = rng.integers(20, 236, (64, 32), dtype=np.uint8)
        fine = rng.normal(0.0, 25.0, (320, 160))
        smooth = cv2.resize(coarse, (160, 320), interpolation=cv2.INTER_NEAREST).astype(float)
        blurred = cv2.GaussianBlur(smooth + fine, (0, 0), 1.0)
        depth_m = 9.0 + float(rng.uniform(-1.5, 1.5))
        out.append((depth_m, 4.0 * (k - n / 2), np.clip(blurred, 0, 255).astype(np.uint8)))
    return out


def rendered(
    scene: list[tuple[float, float, Image]], world_from_cam: Pose, camera: Camera = CAMERA
) -> Image:
    """Return the image of panels across north, each by its homography, far ones first."""
    image = np.full((camera.height_px, camera.width_px), 128, np.uint8)
    matrix = np.array([[camera.fx_px, 0, camera.cx_px], [0, camera.fy_px, camera.cy_px], [0, 0, 1]])
    cam_from_world = world_from_cam.inverse()
    for depth_m, left_m, texture in sorted(scene, key=lambda panel: -panel[0]):
        # Texture (u, v) lies at north depth, east left + u / px, down v / px - half the height.
        axes = np.array(
            [[0.0, 0.0, depth_m], [1.0, 0.0, left_m], [0.0, 1.0, -0.5 * len(texture) / _PX_PER_M]]
        )
        axes[:, :2] /= _PX_PER_M
        to_cam = cam_from_world.rotation @ axes
        to_cam[:, 2] += cam_from_world.translation
        cv2.warpPerspective(
            texture,
            matrix @ to_cam,
            (camera.width_px, camera.height_px),
            dst=image,
            flags=cv2.INTER_AREA,
            borderMode=cv2.BORDER_TRANSPARENT,
        )
    return image


def rendered_view(
    scene: list[tuple[float, float, Image]],
    drone_id: int,
    captured_at_ns: int,
    world_from_body: Pose,
    body_from_cam: Pose,
    options: MapOptions,
) -> DroneView:
    """Return what a drone would send from there."""
    image = rendered(scene, world_from_body @ body_from_cam)
    data = encode_image(image, options.keyframe_quality)
    decoded = decode_image(data, CAMERA)
    features = tuple(detect(decoded, d, FeatureOptions()) for d in options.detectors)
    return DroneView(
        drone_id, captured_at_ns, CAMERA, body_from_cam, world_from_body.rotation, data, features
    )
