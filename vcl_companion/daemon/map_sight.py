"""What our own vote for a map update looks at: how much of the map we see, and how well (IV-G)."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.intra import Localized
from vcl_companion.mapping.coverage import coverage
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.swarm.updates import Sight


def sight_of(
    landmark_map: LandmarkMap, camera: Camera, body_from_cam: Pose, fix: Localized | None
) -> Sight:
    """Return what a drone sees of a map in the frame that its last fix is of.

    Args:
        landmark_map: the map in use.
        camera: its intrinsics.
        body_from_cam: its mounting.
        fix: where the frame was taken; None: nobody knows.
    """
    if fix is None:
        return Sight(0)
    seen = coverage(landmark_map, camera, body_from_cam, fix.world_from_body)
    sigma_m = float(np.sqrt(np.linalg.eigvalsh(fix.covariance()[:3, :3])[-1]))
    return Sight(seen.n_visible, seen.share, sigma_m)
