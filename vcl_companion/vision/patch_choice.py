"""Which landmarks of a map are looked for in a frame (IV-D)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.vision import patch_views
from vcl_companion.vision.patch_tables import Anchors, Ints, Lens


@dataclass(frozen=True)
class ChoiceRules:
    """Which landmarks are worth aligning.

    Attributes:
        cell_px: side of the cells that the choice is spread over.
        grey_noise: of an image, grey levels, 1 sigma.
        misplaced_px: what any alignment is off, 1 sigma.
        misplaced_px_per_rad: per angle between the lines of sight.
        misplaced_px_per_octave: per doubling or halving of the size.
        max_octaves_nearer: a patch is not magnified more.
        max_octaves_farther: nor shrunk more.
    """

    cell_px: float
    grey_noise: float
    misplaced_px: float
    misplaced_px_per_rad: float
    misplaced_px_per_octave: float
    max_octaves_nearer: float
    max_octaves_farther: float


def choose_anchors(
    anchors: Anchors,
    lens: Lens,
    world_from_body: Pose,
    body_from_cam: Pose,
    covariance: Array,
    rules: ChoiceRules,
    wanted: int,
    margin_px: float,
) -> tuple[Ints, Array, int]:
    """Choose the landmarks that fix the pose best, spread over the image.

    Args:
        anchors: of the map.
        lens: of the frame's camera.
        world_from_body: predicted pose.
        body_from_cam: the camera's mounting.
        covariance: (6, 6) of the prediction, local.
        rules: what an alignment is worth.
        wanted: how many, at most.
        margin_px: no landmark nearer to the image's border.

    Returns:
        (K,) anchors, the best of each cell first; (K,) 3 sigma of where each will appear,
        px; how many landmarks are in view.
    """
    cam_from_world = (world_from_body @ body_from_cam).inverse()
    images = anchors.images
    return patch_views.choose(
        anchors.first,
        anchors.keyframe,
        anchors.planes,
        anchors.spread,
        anchors.texture,
        lens.table,
        lens.reach,
        images.transforms(cam_from_world),
        np.ascontiguousarray(cam_from_world.rotation),
        np.ascontiguousarray(body_from_cam.matrix()[:3]),
        np.ascontiguousarray(covariance),
        np.array([*lens.size_px, margin_px], dtype=np.float64),
        np.array(
            [
                rules.cell_px,
                rules.grey_noise,
                rules.misplaced_px,
                rules.misplaced_px_per_rad,
                rules.misplaced_px_per_octave,
                rules.max_octaves_nearer,
                rules.max_octaves_farther,
            ]
        ),
        wanted,
    )
