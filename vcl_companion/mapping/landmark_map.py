"""The map the swarm shares: keyframes and the landmarks seen in them (IV-C).

Descriptors are not part of it: whoever needs them computes them from the
keyframe images, which every holder of the map has. Neither is the covariance:
it follows from the geometry (``map_uncertainty``).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.vision.information import is_covariance

# A revision, and with it a world, is named by so many bytes.
NAME_BYTES = 8
# What tells that there is none where there are always so many.
NO_NAME = bytes(NAME_BYTES)
# Of the maps that were merged into one the newest are remembered.
MAX_JOINED = 16


@dataclass(frozen=True, eq=False)
class Keyframe:
    """One image that landmarks are anchored in.

    Attributes:
        drone_id: system id of the drone that took it.
        captured_at_ns: when, on that drone's own clock.
        world_from_body: where that drone was.
        body_from_cam: its camera's mounting.
        camera: its camera's intrinsics.
        image_bytes: the encoded image, byte for byte as exchanged.
    """

    drone_id: int
    captured_at_ns: int
    world_from_body: Pose
    body_from_cam: Pose
    camera: Camera
    image_bytes: bytes


@dataclass(frozen=True)
class KnownDistance:
    """A measured distance between the bodies of two keyframes: where metres come from."""

    keyframe_a: int
    keyframe_b: int
    distance_m: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class JoinedMap:
    """A map that was merged into another one, or into one that this was made from.

    Attributes:
        revision: of the map.
        world: that it was in: the revision of the first map of its line.
        world_from_other: takes that world to the one of the map that this is a part of.
    """

    revision: bytes
    world: bytes
    world_from_other: Similarity

    def __post_init__(self) -> None:
        for name in ("revision", "world"):
            if len(getattr(self, name)) != NAME_BYTES or getattr(self, name) == NO_NAME:
                raise ValueError(f"JoinedMap.{name} must have {NAME_BYTES} bytes, not all 0")


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """One immutable revision of the shared map.

    Attributes:
        keyframes: V images; the first one fixes the frame, the leader's of the start until
            that is too old to matter.
        points_world: (N, 3) landmarks, world frame, m.
        observed_px: (N, V, 2) pixel of every landmark in every keyframe's raw
            image; NaN where it was not seen there.
        pixel_noise_px: 1-sigma noise of ``observed_px``, as the adjustment found it.
        detectors: which features the landmarks are: akaze, sift, orb.
        distances: what the scale rests on.
        parent: revision this one was made from; empty for a first map.
        anchor_covariance: (6, 6) local, m and rad, of the first keyframe in the world: none
            at the start, later what was known of its successor when it took its place.
        world: the frame that it is in: the revision of the first map of its line; empty for
            a first map, whose world is its own revision (``world_of``).
        joined: the maps that were merged into this one or one that it was made from, the
            newest last.
    """

    keyframes: tuple[Keyframe, ...]
    points_world: Array
    observed_px: Array
    pixel_noise_px: float
    detectors: tuple[str, ...]
    distances: tuple[KnownDistance, ...]
    parent: bytes
    anchor_covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    world: bytes = b""
    joined: tuple[JoinedMap, ...] = ()

    def __post_init__(self) -> None:
        n, v = len(self.points_world), len(self.keyframes)
        shapes = {
            "points_world": (n, 3),
            "observed_px": (n, v, 2),
            "anchor_covariance": (6, 6),
        }
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"LandmarkMap.{name} has shape {value.shape}, expected {shape}")
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if not np.all(np.isfinite(self.points_world)):
            raise ValueError("LandmarkMap.points_world must be finite")
        if not is_covariance(self.anchor_covariance):
            raise ValueError("LandmarkMap.anchor_covariance must be a covariance")
        if not (np.isfinite(self.pixel_noise_px) and self.pixel_noise_px > 0):
            raise ValueError(f"LandmarkMap.pixel_noise_px must be positive: {self.pixel_noise_px}")
        for distance in self.distances:
            if not (0 <= distance.keyframe_a < v and 0 <= distance.keyframe_b < v):
                raise ValueError(f"LandmarkMap: a known distance names no keyframe: {distance}")
        is_name = len(self.world) in (0, NAME_BYTES) and self.world != NO_NAME
        if not is_name or (self.world and not self.parent):
            raise ValueError(f"LandmarkMap.world is none of a map of parent {self.parent!r}")
        if len(self.joined) > MAX_JOINED or (self.joined and not self.world):
            raise ValueError(
                f"LandmarkMap: {len(self.joined)} maps cannot have been merged into it"
            )

    def joined_with(self, world: bytes) -> JoinedMap | None:
        """Return the last map of another world that was merged into this one; None for none."""
        return next((j for j in reversed(self.joined) if j.world == world), None)

    def world_of(self, revision: bytes) -> bytes:
        """Return the name of the world that the map is in, given its own revision."""
        return self.world or revision

    def of_landmarks(self, some: slice | NDArray[np.bool_] | NDArray[np.intp]) -> LandmarkMap:
        """Return the same map with some of its landmarks alone."""
        return replace(
            self, points_world=self.points_world[some], observed_px=self.observed_px[some]
        )

    @property
    def n_pixels(self) -> int:
        """How many pixels its images have, all together."""
        return sum(k.camera.width_px * k.camera.height_px for k in self.keyframes)

    def ranges_m(self) -> Array:
        """Return (N, V) how far each landmark is from the body of each keyframe, m."""
        bodies = np.array([k.world_from_body.translation for k in self.keyframes])
        return np.asarray(np.linalg.norm(self.points_world[:, None] - bodies, axis=2))

    @property
    def seen(self) -> np.ndarray[tuple[int, int], np.dtype[np.bool_]]:
        """(N, V) whether landmark j was seen in keyframe i."""
        return np.asarray(np.isfinite(self.observed_px[:, :, 0]))
