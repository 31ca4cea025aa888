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
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.vision.bundle import BundleOptions, Distance, adjust

# Known distances that miss what another says of them by so many sigmas contradict it.
_CONTRADICTS = 4.0


def metric(
    drones: list[DroneView],
    scene: Scene,
    observed: Array,
    distances_m: list[tuple[int, int, float]],
    options: MapOptions,
) -> LandmarkMap | NoMap:
    """Scale by the known distances, place in the leader's world, adjust once more.

    Args:
        drones: all views, the leader's first.
        scene: those that could be registered, of unknown scale.
        observed: (N, V, 2) pixels of its landmarks.
        distances_m: (drone, drone, metres) between bodies.
        options: how well the distances are known.

    Returns:
        The metric map; or why there is none: no distance between drones of this
        scene, one that is none, or several that contradict each other.
    """
    if 0 not in scene.cams:
        return NoMap(f"the leader, drone {drones[0].drone_id}, sees too little of what others see")
    used = sorted(scene.cams)
    ids = [drones[i].drone_id for i in used]
    known = []
    for a, b, length in distances_m:
        if a not in ids or b not in ids:
            continue
        if a == b or not (np.isfinite(length) and length > 0.0):
            return NoMap(f"a known distance of {length} m between drones {a} and {b} is none")
        known.append(Distance(ids.index(a), ids.index(b), length, options.distance_sigma_m))
    if not known:
        return NoMap(
            f"no known distance between drones that see the same (drones {ids} do): "
            "the scale is unknown"
        )
    known.sort(key=lambda d: -d.distance_m)
    if len(known) > 1:
        # The longest knows the scale best: what it says of the others they have to bear out.
        reason = _contradiction(
            _scaled_map(drones, scene, observed, known[:1], options), known, options
        )
        if reason:
            return NoMap(reason)
    return _scaled_map(drones, scene, observed, known, options)


def _contradiction(landmark_map: LandmarkMap, known: list[Distance], options: MapOptions) -> str:
    """Say which known distance a map made by the first of them contradicts; empty for none."""
    try:
        covariance = map_uncertainty(landmark_map, options.calibration_px).keyframe_covariance
    except ValueError as error:
        return str(error)
    keyframes = landmark_map.keyframes
    for d in known[1:]:
        a, b = keyframes[d.a].world_from_body, keyframes[d.b].world_from_body
        offset = a.translation - b.translation
        length = float(np.linalg.norm(offset))
        by_pose = np.zeros(len(covariance))
        by_pose[6 * d.a : 6 * d.a + 3] = offset / max(length, 1e-9) @ a.rotation
        by_pose[6 * d.b : 6 * d.b + 3] = -offset / max(length, 1e-9) @ b.rotation
        sigma_m = float(np.sqrt(by_pose @ covariance @ by_pose + d.sigma_m**2))
        if abs(length - d.distance_m) > _CONTRADICTS * sigma_m:
            first, second, third, fourth = (
                keyframes[k].drone_id for k in (known[0].a, known[0].b, d.a, d.b)
            )
            return (
                f"the known distances contradict each other: by {known[0].distance_m:.2f} m "
                f"between drones {first} and {second}, drones {third} and {fourth} are "
                f"{length:.2f} m apart (sigma {sigma_m:.2f} m), not {d.distance_m:.2f} m"
            )
    return ""


def _scaled_map(
    drones: list[DroneView],
    scene: Scene,
    observed: Array,
    known: list[Distance],
    options: MapOptions,
) -> LandmarkMap:
    """Return the map that keeps these distances."""
    if drones[0].ned_from_body is None:
        raise ValueError("the leader's attitude is checked before")
    used = sorted(scene.cams)
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
