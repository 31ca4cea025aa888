"""A map of a drone's own last frames: what it goes on by where the swarm's map ends.

Visual odometry: the frames' poses are known to the covariance that goes with them, and what their
patches say of how they lie to each other is added. A patch of the newest frame becomes a landmark
where an older one shows it: along its epipolar line, or, where these frames are too close
together for that, about where it must be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.given_depths import NOISE_PX, SceneDepth, depths_of
from vcl_companion.mapping.landmark_map import Keyframe, LandmarkMap
from vcl_companion.mapping.new_landmarks import Shown, depth_range, free_of, new_landmarks
from vcl_companion.mapping.options import NoMap
from vcl_companion.mapping.patch_table import PatchTable, Reference
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.mapping.view_adjustment import (
    Placement,
    adjusted,
    held_by_one,
    relative_map,
)
from vcl_companion.vision.patch_tables import Pyramid
from vcl_companion.vision.patches import AlignRules

# Fewer do not carry a drone on.
_LEAST_LANDMARKS = 30
# Where fewer of the patches agree, they agree on a wrong way of lying to each other.
_LEAST_SHARE = 0.5
# Patches of views that lie close together are off alike: of the motion between them it is much.
_ALIKE_PX = 0.05
# Where all depths that a scene may have lie within so much, one look finds a patch.
_SHORT_PX, _REACH_PX = 6.0, 4.0
_RULES = AlignRules(max_iterations=15, least_score=0.85, max_moved_px=3.0, settled_px=0.02)
_UNKNOWN_DEPTH = 0.3


@dataclass(frozen=True, eq=False)
class OwnView:
    """One of a drone's own frames, and where it was taken.

    Attributes:
        captured_at_ns: when, the drone's clock.
        pyramid: the image.
        features: of it.
        world_from_body: the pose.
    """

    captured_at_ns: int
    pyramid: Pyramid
    features: Shown
    world_from_body: Pose


@dataclass(frozen=True, eq=False)
class LocalMap:
    """A map of V views.

    Attributes:
        templates: the map, ready to be tracked; its keyframes are the views, the newest first. What
            it takes to be off has more after theirs: how far the parts of the newest one's scene
            are.
        placement: where these are.
    """

    templates: Templates
    placement: Placement


def scene_depth(world_from_cam: Pose, camera: Camera, points: Array) -> SceneDepth | None:
    """Return how far a view's scene may be, by (N, 3) points of it; None where it shows too few."""
    points_cam = world_from_cam.inverse().apply(points)
    points_cam = points_cam[points_cam[:, 2] > 0]
    shown = points[:0]
    if len(points_cam):
        inside = camera.shows(camera.project(points_cam), 0.0)
        shown = points_cam[inside]
    if len(shown) < _LEAST_LANDMARKS:
        return None
    least, largest = depth_range(Pose.identity(), shown)
    low, typical, high = (float(q) for q in np.quantile(1.0 / shown[:, 2], [0.05, 0.5, 0.95]))
    # What comes into view may be anywhere: half as far, or twice.
    spread = max(float(np.log(2.0)), 0.5 * float(np.log(high / low)))
    return SceneDepth(least, largest, typical, spread, spread)


def local_map(
    views: list[OwnView],
    covariance: Array,
    camera: Camera,
    body_from_cam: Pose,
    drone_id: int,
    scene: SceneDepth,
) -> LocalMap | NoMap:
    """Make a map of a drone's own views.

    Args:
        views: V of them, the newest first.
        covariance: (6V, 6V) of their bodies' poses together, local perturbations, m and rad.
        camera: what took them.
        body_from_cam: its mounting.
        drone_id: system id of the drone.
        scene: how far what the newest one shows may be.

    Returns:
        The map, its keyframes the views; or why there is none.
    """
    v = len(views)
    bodies = [view.world_from_body for view in views]
    cams = [body @ body_from_cam for body in bodies]
    table = PatchTable([camera] * v, [view.pyramid for view in views])
    observed, inverse_depths = _found(views, cams, camera, scene, table)
    if len(observed) < _LEAST_LANDMARKS:
        return NoMap(f"our own frames show {len(observed)} patches alike")
    relative = relative_map(bodies)
    parts = scene.parts(observed[:, 0], camera)
    try:
        learnt = adjusted(
            observed, inverse_depths, bodies, body_from_cam, camera, scene, parts,
            relative @ covariance @ relative.T,
        )  # fmt: skip
        placement = held_by_one(bodies, covariance, learnt, scene)
    except ValueError as error:
        return NoMap(str(error))
    bodies = placement.bodies
    depths = depths_of(
        observed, learnt.inverse_depths, bodies, body_from_cam, camera, scene, learnt.parts
    )
    n_found, n_fit = np.isfinite(observed[:, 1:, 0]).sum(axis=1), depths.fits[:, 1:].sum(axis=1)
    good = (n_fit >= 1) & (2 * n_fit >= n_found)
    if np.count_nonzero(good) < max(_LEAST_LANDMARKS, _LEAST_SHARE * len(good)):
        return NoMap(f"of {len(good)} patches {np.count_nonzero(good)} lie where one depth says")
    names = [b"%d" % view.captured_at_ns for view in views]
    pyramids = {name: view.pyramid for name, view in zip(names, views, strict=True)}
    keyframes = tuple(
        Keyframe(drone_id, view.captured_at_ns, body, body_from_cam, camera, name)
        for name, view, body in zip(names, views, bodies, strict=True)
    )
    observed = np.where(depths.fits[:, :, None], observed, np.nan)[good]
    landmark_map = LandmarkMap(keyframes, depths.points[good], observed, NOISE_PX, (), (), b"")
    # What the scene's parts are off are further errors that landmarks share.
    lever = np.concatenate([depths.lever, depths.by_parts], axis=2)
    uncertainty = MapUncertainty(
        block_diag(placement.covariance, np.eye(depths.by_parts.shape[2])),
        depths.covariance[good],
        np.ascontiguousarray(lever[good], dtype=np.float32),
        alike_px=_ALIKE_PX,
    )
    templates = prepare_templates(landmark_map, uncertainty, lambda name, _: pyramids[name])
    return LocalMap(templates, placement)


def _found(
    views: list[OwnView], cams: list[Pose], camera: Camera, scene: SceneDepth, table: PatchTable
) -> tuple[Array, Array]:
    """Return (N, V, 2) where patches of the newest view are, and (N,) their inverse depths."""
    v = len(views)
    range_of_depth = scene.least, scene.largest
    features = {i: view.features for i, view in enumerate(views)}
    observed, points = new_landmarks(
        0, list(range(1, v)), features, [camera] * v, cams, range_of_depth, table
    )
    inverse_depths = 1.0 / cams[0].inverse().apply(points)[:, 2]
    rest = free_of(features[0], observed[:, 0])
    rays = np.column_stack([rest.ideal, np.ones(len(rest.ideal))])
    beside = cams[1].inverse() @ cams[0]
    far, near = (camera.project(beside.apply(rays / r)) for r in range_of_depth)
    with np.errstate(invalid="ignore"):
        short = np.flatnonzero(np.linalg.norm(far - near, axis=1) < _SHORT_PX)
    if len(short) == 0:
        return observed, inverse_depths
    reference = Reference(
        np.zeros(len(short), dtype=np.intp),
        rest.features.pixels[short],
        cams[0].apply(rays[short] / scene.typical),
        np.full(len(short), _UNKNOWN_DEPTH),
    )
    more = table.found(reference, cams, list(range(1, v)), _RULES, reach_px=_REACH_PX).pixels
    more = more[np.isfinite(more[:, 1:, 0]).any(axis=1)]
    return (
        np.concatenate([observed, more]),
        np.concatenate([inverse_depths, np.full(len(more), scene.typical)]),
    )
