"""A map made ready for patch tracking: anchors with depth and local plane, once per revision.

The map's points come from a detector's pixels, which are a quarter of a pixel
off. Two things take that error out. A landmark's patch is cut where its point
*projects* in the keyframe, not where the detector saw it, so across the line of
sight the anchor is exact by definition; and along it, the depth is measured
again by aligning the patch in the other keyframes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.drone_view import decode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.uncertainty import MapUncertainty
from vcl_companion.vision.features import Image
from vcl_companion.vision.patch_kernels import OUTSIDE
from vcl_companion.vision.patches import (
    AlignRules,
    Anchors,
    Lens,
    Pyramid,
    align_patches,
    keyframe_images,
    lens_of,
    pyramid_of,
)
from vcl_companion.vision.surface_kernels import inclinations

_HALF_PX = 4
_N_NEIGHBOURS = 12
_NEIGHBOURHOOD_PX = 40.0
# Surfaces are believed to be inclined by so much, tangent, 1 sigma.
_INCLINATION = 1.0
# A point that projects farther than this from where it was seen is a wrong one.
_MAX_REPROJECTION_PX = 2.0
_CHI2_1_99 = 6.63
_RULES = AlignRules(max_iterations=12, least_score=0.8, max_moved_px=3.0)


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
    lenses = [lens_of(k.camera) for k in landmark_map.keyframes]
    anchors, sigma = _anchored(landmark_map, uncertainty, images)
    frames = [pyramid_of(image) for image in images]
    good = np.ones(len(anchors.landmark), dtype=np.bool_)
    for _ in range(2):
        anchors = _inclined(anchors, sigma)
        anchors, sigma, good = _measured(anchors, sigma, frames, lenses)
    anchors, sigma = _only(anchors, sigma, good)
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


def _only(anchors: Anchors, sigma: Array, kept: NDArray[np.bool_]) -> tuple[Anchors, Array]:
    landmark = anchors.landmark[kept]
    first = np.searchsorted(landmark, np.arange(len(anchors.first))).astype(np.int64)
    parts = {
        name: getattr(anchors, name)[kept]
        for name in ("keyframe", "planes", "pixels", "points_world", "own", "spread", "texture")
    }
    return replace(anchors, first=first, landmark=landmark, **parts), sigma[kept]


def _inclined(anchors: Anchors, sigma: Array) -> Anchors:
    """Return the anchors with the plane that their neighbours in the same keyframe lie on."""
    planes = anchors.planes.copy()
    for i in range(len(anchors.images.worlds_from_cams)):
        rows = np.flatnonzero(anchors.keyframe == i)
        if len(rows) == 0:
            continue
        near = min(_N_NEIGHBOURS, len(rows))
        distance, other = cKDTree(anchors.pixels[rows]).query(anchors.pixels[rows], near)
        planes[rows, 3:5] = inclinations(
            np.ascontiguousarray(planes[rows, :2]),
            np.ascontiguousarray(planes[rows, 2]),
            sigma[rows],
            np.asarray(other, dtype=np.int64).reshape(len(rows), near),
            np.asarray(distance, dtype=np.float64).reshape(len(rows), near),
            _NEIGHBOURHOOD_PX,
            _INCLINATION,
        )
    return replace(anchors, planes=planes)


def _measured(
    anchors: Anchors, sigma: Array, frames: list[Pyramid], lenses: list[Lens]
) -> tuple[Anchors, Array, NDArray[np.bool_]]:
    """Measure every inverse depth by where the patch lies in the other keyframes.

    Returns:
        The anchors; (A,) sigma of the inverse depths; (A,) False where another
        keyframe sees the place and nothing like the patch is there.
    """
    n = len(anchors.landmark)
    images = anchors.images
    information, pull = 1e-6 / sigma**2, np.zeros(n)
    seen, agreed = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i, pose in enumerate(images.worlds_from_cams):
        rows = np.flatnonzero(anchors.keyframe != i)
        cam_from_world = pose.inverse()
        found = align_patches(
            anchors, rows, frames[i], lenses[i], cam_from_world, np.zeros(len(rows)), 0, _RULES
        )
        seen[rows] += found.status != OUTSIDE
        good = found.found
        agreed[rows] += good
        rows, found = rows[good], found.of(good)
        transform = images.transforms(cam_from_world)[anchors.keyframe[rows]]
        # By the inverse depth: the point moves along the line to the keyframe's centre.
        r, plane = anchors.planes[rows, 2], anchors.planes[rows]
        rays = np.column_stack([plane[:, :2], np.ones(len(rows))])
        q = np.einsum("nij,nj->ni", transform[:, :, :3], rays) + transform[:, :, 3] * r[:, None]
        ideal = q[:, :2] / q[:, 2:]
        towards = (transform[:, :2, 3] - ideal * transform[:, 2, 3:4]) / q[:, 2:]
        jacobian = np.einsum("nij,nj->ni", found.slopes, towards)
        noise = (found.noise + found.misplaced)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        weighted = np.linalg.solve(noise, jacobian[:, :, None])[:, :, 0]
        residual = found.pixels - found.predicted
        # What lies across the epipolar line cannot be depth.
        own = np.einsum("ni,ni->n", weighted, jacobian)
        step = np.einsum("ni,ni->n", weighted, residual) / np.maximum(own, 1e-12)
        left = residual - jacobian * step[:, None]
        across = np.einsum("ni,nij,nj->n", left, np.linalg.inv(noise), left)
        fits = (across < 2.0 * _CHI2_1_99) & (np.abs(step) < 6.0 * sigma[rows] + 0.05 * r)
        np.add.at(information, rows[fits], own[fits])
        np.add.at(pull, rows[fits], (own * step)[fits])
        agreed[rows[~fits]] -= 1
    planes = anchors.planes.copy()
    planes[:, 2] += pull / information
    measured = agreed > 0
    planes[~measured, 2] = anchors.planes[~measured, 2]
    planes[:, 3:5] *= (planes[:, 2] / anchors.planes[:, 2])[:, None]
    out_sigma = np.where(measured, 1.0 / np.sqrt(information), sigma)
    rays = _rays_world(replace(anchors, planes=planes))
    centres = np.stack([p.translation for p in images.worlds_from_cams])[anchors.keyframe]
    points = centres + rays / planes[:, 2:3]
    return replace(anchors, planes=planes, points_world=points), out_sigma, measured | (seen == 0)
