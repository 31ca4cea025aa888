"""The landmarks of a map in a frame, all that can be found: for whoever extends the map by it."""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.fix import Prior
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.patch_table import EXACTLY
from vcl_companion.mapping.seen_landmarks import MAX_ASIDE_PX, SeenLandmarks
from vcl_companion.mapping.templates import Templates
from vcl_companion.vision.features import Image
from vcl_companion.vision.patch_choice import choose_anchors
from vcl_companion.vision.patch_tables import lens_of, pyramid_of
from vcl_companion.vision.patches import align_patches

_MARGIN_PX = 6.0


def seen_by_patches(
    image: Image,
    camera: Camera,
    body_from_cam: Pose,
    templates: Templates,
    revision: bytes,
    where: Prior,
    options: TrackingOptions,
    wanted: int,
) -> SeenLandmarks | None:
    """Measure where a frame shows landmarks of a map.

    Args:
        image: (H, W) grey, as the camera gave it.
        camera: its intrinsics.
        body_from_cam: its mounting.
        templates: the map, prepared.
        revision: of the map.
        where: the frame was taken, to a pixel.
        options: what an alignment is worth.
        wanted: at most so many, those that fix the pose best.

    Returns:
        What is seen; None where that is nothing.
    """
    lens = lens_of(camera)
    rows, _, _ = choose_anchors(
        templates.anchors, lens, where.world_from_body, body_from_cam, where.covariance,
        options.choice(), wanted, _MARGIN_PX,
    )  # fmt: skip
    if len(rows) == 0:
        return None
    cam_from_world = (where.world_from_body @ body_from_cam).inverse()
    found = align_patches(
        templates.anchors, rows, pyramid_of(image), lens, cam_from_world, np.zeros(len(rows)), 0,
        EXACTLY,
    )  # fmt: skip
    found = found.of(found.found)
    aside = found.pixels - camera.project(cam_from_world.apply(found.points_world))
    near = np.flatnonzero((np.abs(aside) <= MAX_ASIDE_PX).all(axis=1))
    if len(near) == 0:
        return None
    landmarks, first = np.unique(templates.anchors.landmark[found.anchors[near]], return_index=True)
    return SeenLandmarks(revision, landmarks, aside[near[first]])
