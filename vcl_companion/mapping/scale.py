"""Metres and the world: a scene scaled by known distances, placed by the leader (IV-C)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.scene import Scene, views_of_scene
from vcl_companion.vision.bundle import BundleOptions, Distance, adjust


def metric(
    drones: list[DroneView],
    scene: Scene,
    observed: Array,
    distances_m: list[tuple[int, int, float]],
    options: MapOptions,
) -> LandmarkMap | NoMap:
    """Scale by the known distances, place in the leader's world, adjust once more."""
    if 0 not in scene.cams:
        return NoMap(f"the leader, drone {drones[0].drone_id}, sees too little of what others see")
    used = sorted(scene.cams)
    ids = [drones[i].drone_id for i in used]
    known = [
        Distance(ids.index(a), ids.index(b), length, options.distance_sigma_m)
        for a, b, length in distances_m
        if a in ids and b in ids
    ]
    if not known:
        return NoMap(
            f"no known distance between drones that see the same (drones {ids} do): "
            "the scale is unknown"
        )
    if drones[0].ned_from_body is None:
        raise ValueError("the leader's attitude is checked before")
    cams = [scene.cams[i] for i in used]
    # Of the cameras instead of the bodies: the adjustment settles the lever arms' share.
    ratios = [
        d.distance_m / float(np.linalg.norm(cams[d.a].translation - cams[d.b].translation))
        for d in known
    ]
    scale = float(np.median(ratios))
    leader_cam = Pose(drones[0].ned_from_body, np.zeros(3)) @ drones[0].body_from_cam
    world_from_scene = leader_cam @ cams[0].inverse()
    placed = np.isfinite(scene.points[:, 0])
    views = replace(
        views_of_scene(scene, placed),
        bodies=tuple(
            Pose(
                world_from_scene.rotation @ cam.rotation,
                _scaled(world_from_scene, scale, cam.translation, cams[0]),
            )
            @ drones[i].body_from_cam.inverse()
            for i, cam in zip(used, cams, strict=True)
        ),
        mountings=tuple(drones[i].body_from_cam for i in used),
        points=_scaled(world_from_scene, scale, scene.points[placed], cams[0]),
        distances=tuple(known),
    )
    views, noise_px = adjust(views, BundleOptions())
    seen = np.isfinite(views.ideal[:, :, :1])
    return LandmarkMap(
        keyframes=tuple(
            Keyframe(d.drone_id, d.captured_at_ns, body, d.body_from_cam, d.camera, d.image_bytes)
            for d, body in zip((drones[i] for i in used), views.bodies, strict=True)
        ),
        points_world=views.points,
        observed_px=np.where(seen, observed[placed][:, used], np.nan),
        pixel_noise_px=noise_px,
        detectors=options.detectors,
        distances=tuple(KnownDistance(d.a, d.b, d.distance_m, d.sigma_m) for d in known),
        parent=b"",
    )


def _scaled(world_from_scene: Pose, scale: float, points: Array, leader_cam: Pose) -> Array:
    """Scale about the leader's camera, then carry over to the world."""
    centre = leader_cam.translation
    return world_from_scene.apply(centre + scale * (points - centre))
