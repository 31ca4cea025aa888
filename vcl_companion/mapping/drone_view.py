"""What one drone contributes to a map: an image, where it looked, and what is in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision.features import Features


@dataclass(frozen=True, eq=False)
class DroneView:
    """One image of one drone.

    Attributes:
        drone_id: its system id.
        captured_at_ns: when, on its own clock.
        camera: its intrinsics.
        body_from_cam: its camera's mounting.
        ned_from_body: (3, 3) attitude from its autopilot at that instant, or None.
        image_bytes: the encoded image, as exchanged.
        features: found in that image, one set for each detector the builder uses.
        world_from_body: where the drone's own localization on the map puts it, or None.
        has_heading: whether the attitude's heading is by the north of the others; else only its
            roll and pitch count.
        told_px: (N, 2) where the image, before it was encoded, shows the landmarks of the map that
            it extends, raw px; NaN where that is not told. None: of none.
    """

    drone_id: int
    captured_at_ns: int
    camera: Camera
    body_from_cam: Pose
    ned_from_body: Array | None
    image_bytes: bytes
    features: tuple[Features, ...]
    world_from_body: Pose | None = None
    has_heading: bool = True
    told_px: Array | None = None

    @property
    def pixels(self) -> Array:
        """(N, 2) raw pixels of all its features, one detector after the other."""
        return np.concatenate([f.pixels for f in self.features])
