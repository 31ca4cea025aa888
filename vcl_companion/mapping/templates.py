"""A map made ready for patch tracking: anchors with depth and local plane, once per revision.

A landmark's patch is cut where its point *projects* in the keyframe, not where
it was seen there: across the line of sight the anchor is then exact by
definition, and along it the map's adjustment knows better than one view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.drone_view import decode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.surfaces import slopes_of
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.features import Image
from vcl_companion.vision.patches import (
    Anchors,
    keyframe_images,
)

_HALF_PX = 4
# A point that projects farther than this from where it was seen is a wrong one.
_MAX_REPROJECTION_PX = 2.0


@dataclass(frozen=True, eq=False)
class Templates:
    """What tracking needs of a map.

    Attributes:
        anchors: landmarks in keyframes.
        uncertainty: the map's joint covariance, as the features' pipeline has it.
    """

    anchors: Anchors
    uncertainty: MapUncertainty


def prepare_templates(landmark_map: LandmarkMap, uncertainty: MapUncertainty) -> Templates:
    """Make a map ready for patch tracking.

    Args:
        landmark_map: any revision.
        uncertainty: its own (``map_uncertainty``).

    Returns:
        The anchors; none where nothing of the map can be found again in its keyframes.

    Raises:
        ValueError: an image cannot be decoded.
    """
    images = [decode_image(k.image_bytes, k.camera) for k in landmark_map.keyframes]
    anchors, sigma = _anchored(landmark_map, uncertainty, images)
    anchors = _inclined(anchors, sigma)
    depth = 1.0 / anchors.planes[:, 2]
    own = _rays_world(anchors) * (sigma * depth**2)[:, None]
    spread = (own[:, :, None] * own[:, None, :])[:, *np.triu_indices(3)]
    return Templates(replace(anchors, own=own, spread=spread), uncertainty)


def _anchored(
    landmark_map: LandmarkMap, uncertainty: MapUncertainty, images: list[Image]
) -> tuple[Anchors, Array]:
    """Return every landmark in every keyframe that saw it, and the sigma of its inverse depth."""
    landmark, keyframe, planes, pixels, sigmas, texture = [], [], [], [], [], []
    poses = []
    for i, k in enumerate(landmark_map.keyframes):
        world_from_cam = k.world_from_body @ k.body_from_cam
        poses.append(world_from_cam)
        seen = np.flatnonzero(landmark_map.seen[:, i])
        points = world_from_cam.inverse().apply(landmark_map.points_world[seen])
        where = k.camera.project(points)
        margin = _HALF_PX + 2
        size = np.array([k.camera.width_px, k.camera.height_px])
        with np.errstate(invalid="ignore"):
            off = np.linalg.norm(where - landmark_map.observed_px[seen, i], axis=1)
            inside = (where >= margin).all(axis=1) & (where < size - 1 - margin).all(axis=1)
            fits = inside & (off < max(_MAX_REPROJECTION_PX, 4.0 * landmark_map.pixel_noise_px))
        seen, points, where = seen[fits], points[fits], where[fits]
        z = points[:, 2]
        ray = points / np.linalg.norm(points, axis=1)[:, None]
        ray_world = ray @ world_from_cam.rotation.T
        along = np.einsum(
            "ni,nij,nj->n", ray_world, uncertainty.landmark_covariance[seen], ray_world
        )
        landmark.append(seen)
        keyframe.append(np.full(len(seen), i))
        ideal = points[:, :2] / z[:, None]
        inverse = np.linalg.inv(k.camera.pixel_slopes(ideal)).reshape(-1, 4)
        planes.append(np.column_stack([ideal, 1.0 / z, np.zeros((len(z), 2)), inverse]))
        pixels.append(where)
        sigmas.append(np.sqrt(along) * ray[:, 2] / z**2)
        texture.append(_texture(images[i], where))
    owner = np.concatenate(landmark).astype(np.int64)
    order = np.argsort(owner, kind="stable")
    n = len(landmark_map.points_world)
    table = keyframe_images(images, poses)
    anchors = Anchors(
        first=np.searchsorted(owner[order], np.arange(n + 1)).astype(np.int64),
        landmark=owner[order],
        keyframe=np.concatenate(keyframe).astype(np.int64)[order],
        planes=np.concatenate(planes)[order],
        pixels=np.concatenate(pixels)[order],
        points_world=landmark_map.points_world[owner[order]],
        own=np.zeros((len(order), 3)),
        spread=np.zeros((len(order), 6)),
        texture=np.concatenate(texture)[order],
        images=table,
    )
    return anchors, np.concatenate(sigmas)[order]


def _texture(image: Image, pixels: Array) -> Array:
    """Return (M, 3) xx xy yy of the squared gradient summed over the patch at each pixel."""
    gx = cv2.Sobel(image, cv2.CV_32F, 1, 0, ksize=1) * 0.5
    gy = cv2.Sobel(image, cv2.CV_32F, 0, 1, ksize=1) * 0.5
    side = 2 * _HALF_PX + 1
    at = np.round(pixels).astype(np.intp)
    return np.column_stack(
        [
            cv2.boxFilter(product, cv2.CV_32F, (side, side), normalize=False)[at[:, 1], at[:, 0]]
            for product in (gx * gx, gx * gy, gy * gy)
        ]
    ).astype(np.float64)


def _rays_world(anchors: Anchors) -> Array:
    """Return (A, 3) displacement in the world per metre of depth."""
    rotations = np.stack([p.rotation for p in anchors.images.worlds_from_cams])
    rays = np.column_stack([anchors.planes[:, :2], np.ones(len(anchors.planes))])
    return np.asarray(np.einsum("aij,aj->ai", rotations[anchors.keyframe], rays))


def _inclined(anchors: Anchors, sigma: Array) -> Anchors:
    """Return the anchors with the plane that their neighbours in the same keyframe lie on."""
    planes = anchors.planes.copy()
    for i in range(len(anchors.images.worlds_from_cams)):
        rows = np.flatnonzero(anchors.keyframe == i)
        if len(rows) == 0:
            continue
        planes[rows, 3:5] = slopes_of(
            anchors.pixels[rows], planes[rows, :2], planes[rows, 2], sigma[rows]
        )
    return replace(anchors, planes=planes)
