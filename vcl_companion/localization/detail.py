"""How much detail an image needs that a map is made of, or extended by: bytes are few (IV-G)."""

from __future__ import annotations

from typing import Literal

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.outlook import held_share
from vcl_companion.mapping.landmark_map import LandmarkMap

Detail = Literal["all", "fine", "coarse"]
"""All of an image, to be recognised by; what is around its corners; the same, but coarsely."""

# A view no newer than this shows the map from near by: a flight has its map extended for views
# that will be 8 degrees new, and is a little farther then. Photographs metres apart are farther.
_COARSE_DEG = 10.0
# So many of the landmarks in view are the oldest keyframes' too where an image may be coarse.
_HELD_SHARE = 0.5


def needed_detail(
    fix: Localized | None, landmark_map: LandmarkMap, camera: Camera, body_from_cam: Pose
) -> Detail:
    """Return how much of a frame a map is extended by.

    Patches near by are found in coarse images as well. What is matched from far apart needs
    more; so does what frame and scale are carried on by, where the map began out of sight.

    Args:
        fix: what the frame gave; None where the map is not recognised in it.
        landmark_map: what may be extended.
        camera: the frame's.
        body_from_cam: its mounting.
    """
    if fix is None:
        return "all"
    if fix.by != "patches" or fix.novelty_deg > _COARSE_DEG:
        return "fine"
    held = held_share(landmark_map, fix.world_from_body @ body_from_cam, camera)
    return "coarse" if held >= _HELD_SHARE else "fine"
