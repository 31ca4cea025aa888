"""How much of a view the map fills: what decides when it is to be extended (IV-G)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.landmark_map import LandmarkMap

_COLUMNS, _ROWS = 8, 6
# Fewer landmarks in a cell are chance.
_CELL_LANDMARKS = 2
# A patch is not found again in a view so many times nearer or farther, or from so far aside.
_MAX_NEARER, _MAX_FARTHER = 2.8, 6.0
_LEAST_COSINE = np.cos(np.deg2rad(50.0))


@dataclass(frozen=True)
class Coverage:
    """What a view can see of a map.

    Attributes:
        n_visible: landmarks within it that look there about as in one of their keyframes.
        share: of the image that they fill, 0 to 1, by cells of an eighth by a sixth.
        depth_m: their median distance; 0 without any.
    """

    n_visible: int
    share: float
    depth_m: float


def coverage(
    landmark_map: LandmarkMap, camera: Camera, body_from_cam: Pose, world_from_body: Pose
) -> Coverage:
    """Return what a camera at a pose can see of a map."""
    world_from_cam = world_from_body @ body_from_cam
    pixels = camera.project(world_from_cam.inverse().apply(landmark_map.points_world))
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(((pixels >= 0) & (pixels <= size - 1)).all(axis=1))
    ray = landmark_map.points_world[inside] - world_from_cam.translation
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-9)
    alike = np.zeros(len(inside), dtype=bool)
    for i, keyframe in enumerate(landmark_map.keyframes):
        origin = (keyframe.world_from_body @ keyframe.body_from_cam).translation
        then = landmark_map.points_world[inside] - origin
        length = np.maximum(np.linalg.norm(then, axis=1), 1e-9)
        closer = (length / distance) * (camera.focal_px / keyframe.camera.focal_px)
        cosine = np.einsum("ni,ni->n", ray, then) / (distance * length)
        alike |= (
            np.isfinite(landmark_map.observed_px[inside, i, 0])
            & (closer < _MAX_NEARER)
            & (closer > 1.0 / _MAX_FARTHER)
            & (cosine > _LEAST_COSINE)
        )
    seen = pixels[inside][alike]
    if len(seen) == 0:
        return Coverage(0, 0.0, 0.0)
    cell = (seen / size * (_COLUMNS, _ROWS)).astype(np.intp)
    filled = np.bincount(cell[:, 0] + _COLUMNS * cell[:, 1]) >= _CELL_LANDMARKS
    share = float(filled.sum()) / (_COLUMNS * _ROWS)
    return Coverage(len(seen), share, float(np.median(distance[alike])))
