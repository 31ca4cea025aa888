"""Where an image shows landmarks of a map, measured before it was encoded.

An encoded image is some tenths of a pixel off here and there, and a view is placed on the map by
what is measured in it. Whoever took it has the image itself, and tells in some hundred
bytes what that shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap

MAX_SEEN = 1024
MAX_ASIDE_PX = 4.0


@dataclass(frozen=True, eq=False)
class SeenLandmarks:
    """Landmarks of a map in one image.

    Attributes:
        revision: of the map.
        landmarks: (M,) which of its landmarks, rising.
        aside_px: (M, 2) where they are seen, raw px, less where they project from where the
            drone says that it was; ``MAX_ASIDE_PX`` at most.

    Raises:
        ValueError: the landmarks do not rise, there are more than ``MAX_SEEN``, or one is seen
            farther aside than allowed.
    """

    revision: bytes
    landmarks: NDArray[np.int64]
    aside_px: Array

    def __post_init__(self) -> None:
        n = len(self.landmarks)
        if n > MAX_SEEN or self.aside_px.shape != (n, 2):
            raise ValueError(f"{n} landmarks seen, {len(self.aside_px)} told, {MAX_SEEN} at most")
        if n and (self.landmarks[0] < 0 or (np.diff(self.landmarks) <= 0).any()):
            raise ValueError("the landmarks that an image shows do not rise")
        if not (np.abs(self.aside_px) <= MAX_ASIDE_PX).all():
            raise ValueError(f"a landmark is seen more than {MAX_ASIDE_PX:g} px aside")


def told_pixels(
    seen: SeenLandmarks | None,
    revision: bytes,
    landmark_map: LandmarkMap,
    camera: Camera,
    world_from_cam: Pose,
) -> Array | None:
    """Return (N, 2) raw px of all landmarks of a map in an image; NaN where nothing is told.

    Args:
        seen: what its drone tells, if it does.
        revision: of the map.
        landmark_map: the map.
        camera: the image's.
        world_from_cam: where its drone says that it was.

    Returns:
        The pixels; None where nothing is told of this map.
    """
    n = len(landmark_map.points_world)
    if seen is None or seen.revision != revision or len(seen.landmarks) == 0:
        return None
    if seen.landmarks[-1] >= n:
        return None
    out = np.full((n, 2), np.nan)
    points = world_from_cam.inverse().apply(landmark_map.points_world[seen.landmarks])
    pixels = camera.project(points) + seen.aside_px
    inside = camera.shows(pixels, 0.0)
    out[seen.landmarks[inside]] = pixels[inside]
    return out
