"""A map made ready for patch tracking: anchors with depth and local plane, once per revision.

A landmark's patch is cut where its point *projects* in the keyframe, not where
it was seen there: across the line of sight the anchor is then exact by
definition, and along it the map's adjustment knows better than one view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.patch_table import PyramidOf, decoded_pyramid
from vcl_companion.mapping.surfaces import slopes_of
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.patch_tables import Anchors, keyframe_images
from vcl_companion.vision.texture import textures

_HALF_PX = 4
# A point that projects farther than this from where it was seen is a wrong one.
_MAX_REPROJECTION_PX = 2.0


@dataclass(frozen=True, eq=False)
class Templates:
    """What tracking needs of a map.

    Attributes:
        anchors: landmarks in keyframes.
        uncertainty: the map's joint covariance, as the features' pipeline has it.
        drone_ids: (V,) system ids of those who took the keyframes.
    """

    anchors: Anchors
    uncertainty: MapUncertainty
    drone_ids: NDArray[np.int64]


def prepare_templates(
    landmark_map: LandmarkMap,
    uncertainty: MapUncertainty,
    pyramid_of: PyramidOf = decoded_pyramid,
) -> Templates:
    """Make a map ready for patch tracking.

    Args:
        landmark_map: any revision.
        uncertainty: its own (``map_uncertainty``).
        pyramid_of: decodes an image.

    Returns:
        The anchors; none where nothing of the map can be found again in its keyframes.

    Raises:
        ValueError: an image cannot be decoded.
    """
    pyramids = [pyramid_of(k.image_bytes, k.camera) for k in landmark_map.keyframes]
    poses = [k.world_from_body @ k.body_from_cam for k in landmark_map.keyframes]
    views = [_anchored(landmark_map, i, pose) for i, pose in enumerate(poses)]
    is_anchor = np.zeros(landmark_map.seen.shape, dtype=bool)
    for i, view in enumerate(views):
        is_anchor[view.landmarks, i] = True
    # Those of one landmark stand together. The tables are the largest part of a map: each view
    # writes its rows where they stay.
    landmark, keyframe = np.nonzero(is_anchor)
    n = len(landmark)
    planes, pixels, texture = np.empty((n, 9)), np.empty((n, 2)), np.empty((n, 3))
    own, spread = np.empty((n, 3)), np.empty((n, 6))
    for i, view in enumerate(views):
        rows = np.flatnonzero(keyframe == i)
        if len(rows) == 0:
            continue
        camera = landmark_map.keyframes[i].camera
        pixels[rows] = view.pixels
        texture[rows] = textures(pyramids[i].image, view.pixels, _HALF_PX)
        planes[rows], own[rows] = _planes(view, camera, poses[i], uncertainty)
        spread[rows] = (own[rows, :, None] * own[rows, None, :])[:, *np.triu_indices(3)]
    n_anchors = np.concatenate([[0], is_anchor.sum(axis=1)])
    anchors = Anchors(
        first=np.cumsum(n_anchors).astype(np.int64),
        landmark=landmark.astype(np.int64),
        keyframe=keyframe.astype(np.int64),
        planes=planes,
        pixels=pixels,
        points_world=landmark_map.points_world[landmark],
        own=own,
        spread=spread,
        texture=texture,
        images=keyframe_images(pyramids, poses),
    )
    drone_ids = np.array([k.drone_id for k in landmark_map.keyframes], dtype=np.int64)
    return Templates(anchors, uncertainty, drone_ids)


@dataclass(frozen=True, eq=False)
class _View:
    """Landmarks in a keyframe: which (M,), where in camera axes (M, 3), m, and pixels (M, 2)."""

    landmarks: NDArray[np.intp]
    points_cam: Array
    pixels: Array


def _anchored(landmark_map: LandmarkMap, i: int, world_from_cam: Pose) -> _View:
    """Return the landmarks that a keyframe saw, and that project to where it did."""
    camera = landmark_map.keyframes[i].camera
    seen = np.flatnonzero(landmark_map.seen[:, i])
    points = world_from_cam.inverse().apply(landmark_map.points_world[seen])
    where = camera.project(points)
    margin = _HALF_PX + 2
    size = np.array([camera.width_px, camera.height_px])
    with np.errstate(invalid="ignore"):
        off = np.linalg.norm(where - landmark_map.observed_px[seen, i], axis=1)
        inside = (where >= margin).all(axis=1) & (where < size - 1 - margin).all(axis=1)
        fits = inside & (off < max(_MAX_REPROJECTION_PX, 4.0 * landmark_map.pixel_noise_px))
    return _View(seen[fits], points[fits], where[fits])


def _planes(
    view: _View, camera: Camera, world_from_cam: Pose, uncertainty: MapUncertainty
) -> tuple[Array, Array]:
    """Return the local planes (``Anchors.planes``), with slopes by neighbours in the keyframe.

    And (M, 3) 1 sigma of each depth as a displacement in the world, m.
    """
    points, z = view.points_cam, view.points_cam[:, 2]
    ray = points / np.linalg.norm(points, axis=1)[:, None]
    ray_world = ray @ world_from_cam.rotation.T
    covariance = uncertainty.landmark_covariance[view.landmarks]
    along = np.einsum("ni,nij,nj->n", ray_world, covariance, ray_world)
    sigma = np.sqrt(along) * ray[:, 2] / z**2
    ideal, inverse_depth = points[:, :2] / z[:, None], 1.0 / z
    slopes = slopes_of(view.pixels, ideal, inverse_depth, sigma)
    lens = np.linalg.inv(camera.pixel_slopes(ideal)).reshape(-1, 4)
    planes = np.column_stack([ideal, inverse_depth, slopes, lens])
    per_metre = np.column_stack([ideal, np.ones(len(z))]) @ world_from_cam.rotation.T
    return planes, per_metre * (sigma / inverse_depth**2)[:, None]
