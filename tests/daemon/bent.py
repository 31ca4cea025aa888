"""Maps as a peer might hand them that is wrong: consistent in themselves, but of another world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.landmark_map import LandmarkMap


def bent(
    landmark_map: LandmarkMap,
    scale: float = 1.0,
    shift_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> LandmarkMap:
    """Scale a map about its origin, and shift it; its images show it as they did."""

    def moved(pose: Pose) -> Pose:
        return Pose(pose.rotation, scale * pose.translation + np.array(shift_m))

    keyframes = tuple(
        replace(
            k,
            world_from_body=moved(k.world_from_body),
            body_from_cam=Pose(k.body_from_cam.rotation, scale * k.body_from_cam.translation),
        )
        for k in landmark_map.keyframes
    )
    distances = tuple(replace(d, distance_m=scale * d.distance_m) for d in landmark_map.distances)
    points = scale * landmark_map.points_world + np.array(shift_m)
    return replace(landmark_map, keyframes=keyframes, distances=distances, points_world=points)
