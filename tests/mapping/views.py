"""A synthetic scene as what the drones would send: features with descriptors, attitudes, no images.

A landmark's descriptor is random and unique, the same in every image up to a
few flipped bits. The image bytes are opaque to the reconstruction.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tests.scenes import Scene
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_euler
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.vision.features import Features

# How the leader stands when it takes off: tilted a little, heading south-east.
LEADER_ATTITUDE = matrix_from_euler(0.03, -0.05, 2.2)


def world_from_scene() -> Pose:
    """Return the map's world by the scene's, in which the leader is the identity."""
    return Pose(LEADER_ATTITUDE, np.zeros(3))


def descriptors_of(rng: np.random.Generator, n: int) -> NDArray[np.uint8]:
    """Return (n, 61) random descriptors, about 244 of 488 bits apart from each other."""
    return rng.integers(0, 256, (n, 61), dtype=np.uint8)


def drone_views(
    rng: np.random.Generator,
    scene: Scene,
    drone_ids: Sequence[int],
    *,
    attitude_sigma_rad: float = 0.0,
    attitudes: bool = True,
) -> list[DroneView]:
    """Return one view for each drone of a scene.

    Args:
        rng: of descriptors, order of features and attitude errors.
        scene: who sees what from where.
        drone_ids: system ids, the leader's first.
        attitude_sigma_rad: error of each follower's attitude, 1 sigma per axis.
        attitudes: whether the followers' autopilots send any.
    """
    landmark = descriptors_of(rng, len(scene.points_world))
    views = []
    for i, drone_id in enumerate(drone_ids):
        seen = rng.permutation(np.flatnonzero(scene.seen[:, i]))
        flips = np.uint8(1) << rng.integers(0, 8, (len(seen), 4), dtype=np.uint8)
        found = landmark[seen]
        found[:, :4] ^= flips
        error = Pose.identity().retracted(
            np.r_[np.zeros(3), attitude_sigma_rad * rng.standard_normal(3)]
        )
        attitude: Array | None = LEADER_ATTITUDE @ scene.bodies[i].rotation
        if i > 0:
            attitude = attitude @ error.rotation if attitudes and attitude is not None else None
        views.append(
            DroneView(
                drone_id,
                1_000_000 + i,
                scene.camera,
                scene.mountings[i],
                attitude,
                b"image %d" % drone_id,
                (Features(scene.observed_px[seen, i], found),),
            )
        )
    return views


def map_of(scene: Scene, sigma_m: float = 0.01, noise_px: float | None = None) -> LandmarkMap:
    """Return a scene as the map that knows it exactly, with the distance from drone 0 to 1.

    Landmarks seen by fewer than two cameras are no part of it.
    """
    placed = scene.seen.sum(axis=1) >= 2
    return LandmarkMap(
        keyframes=tuple(
            Keyframe(i + 1, 0, body, mounting, scene.camera, b"")
            for i, (body, mounting) in enumerate(zip(scene.bodies, scene.mountings, strict=True))
        ),
        points_world=scene.points_world[placed],
        observed_px=scene.observed_px[placed],
        pixel_noise_px=noise_px or max(scene.noise_px, 0.3),
        detectors=("akaze",),
        distances=(KnownDistance(0, 1, scene.baseline_m(0, 1), sigma_m),),
        parent=b"",
    )
