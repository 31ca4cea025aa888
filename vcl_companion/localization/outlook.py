"""What a map shows from a pose, by its geometry alone: no image of there is needed (IV-G)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.novelty import novelties_deg

# Of so many landmarks novelty is the median; less than the other tell nothing of it.
_N_LANDMARKS, _LEAST_LANDMARKS = 200, 60
# A map's oldest keyframes: so large a share of them, and no less than two.
_OLDEST_SHARE, _LEAST_OLDEST = 1.0 / 3.0, 2


def novelty_from(landmark_map: LandmarkMap, world_from_cam: Pose, camera: Camera) -> float | None:
    """Return how new a map would look, degrees (``coverage.novelty_deg``).

    Each landmark is remembered by the keyframe that saw it most alike.

    Args:
        landmark_map: the map.
        world_from_cam: where it would be looked at from.
        camera: by whom.

    Returns:
        The median over some landmarks in view; None where these are too few to tell.
    """
    shown = _in_view(landmark_map, world_from_cam, camera)
    if len(shown) < _LEAST_LANDMARKS:
        return None
    some = shown[:: -(-len(shown) // _N_LANDMARKS)]
    points = landmark_map.points_world[some]
    seen = np.isfinite(landmark_map.observed_px[some, :, 0])  # asked often: of these few only
    newness = np.full(seen.shape, np.inf)
    for i, keyframe in enumerate(landmark_map.keyframes):
        then = (keyframe.world_from_body @ keyframe.body_from_cam).translation
        rows = np.flatnonzero(seen[:, i])
        newness[rows, i] = novelties_deg(points[rows], world_from_cam.translation, then)
    return float(np.median(newness.min(axis=1)))


def held_share(landmark_map: LandmarkMap, world_from_cam: Pose, camera: Camera) -> float:
    """Return the share of the landmarks in view that the oldest keyframes have seen, 0 to 1.

    What is added there is in their frame and scale; where it is little, each addition carries
    frame and scale on from the one before, and its errors with them.

    Args:
        landmark_map: the map.
        world_from_cam: where it is looked at from.
        camera: by whom.
    """
    shown = _in_view(landmark_map, world_from_cam, camera)
    n_oldest = max(_LEAST_OLDEST, int(_OLDEST_SHARE * len(landmark_map.keyframes)))
    by_oldest = landmark_map.seen[shown, :n_oldest].any(axis=1)
    return int(np.count_nonzero(by_oldest)) / max(len(shown), 1)


def share_left(landmark_map: LandmarkMap, here: Pose, there: Pose, camera: Camera) -> float | None:
    """Return how many landmarks lie in an image from there, of as many as do from here, at most 1.

    Args:
        landmark_map: the map.
        here: world_from_cam, where it is looked at from.
        there: where it will be.
        camera: by whom.

    Returns:
        None where too few are in view here to tell.
    """
    now = len(_in_view(landmark_map, here, camera))
    if now < _LEAST_LANDMARKS:
        return None
    return min(len(_in_view(landmark_map, there, camera)) / now, 1.0)


def _in_view(landmark_map: LandmarkMap, world_from_cam: Pose, camera: Camera) -> NDArray[np.intp]:
    """Return the landmarks that lie in an image, hidden by others or not."""
    # A peer's pose and camera are bounded, and may be nonsense.
    with np.errstate(all="ignore"):
        pixels = camera.project(world_from_cam.inverse().apply(landmark_map.points_world))
    return np.flatnonzero(camera.shows(pixels, -0.5))
