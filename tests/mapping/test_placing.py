"""A new view placed on a map near where it says that it was taken."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.mapping.rendered import CAMERA, rendered
from tests.mapping.windows import BODIES, MOUNTING, bent_by_windows, facade
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.culling import depth_errors
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.patch_table import PatchTable, decoded_pyramid, pyramids_of
from vcl_companion.mapping.placing import Placed, place
from vcl_companion.mapping.uncertainty import map_uncertainty, views_of
from vcl_companion.vision.resection import NotFound

THERE = Pose(np.eye(3), np.array([0.3, 0.5, 0.1]))


def corner_and_post() -> LandmarkMap:
    """Of the wall little is known, and of the post before it some spots: each decides much."""
    bent = bent_by_windows()
    known, kind = bent.landmark_map, bent.kind
    wall, post = np.flatnonzero(kind == 0), np.flatnonzero(kind == 1)
    off_px = np.linalg.norm(known.observed_px[wall, 0] - np.array([100.0, 60.0]), axis=1)
    kept = np.sort(np.append(wall[off_px < 60.0][:24], post[:4]))
    return replace(
        known, points_world=known.points_world[kept], observed_px=known.observed_px[kept]
    )


def placed_from(guess: Pose) -> Placed | NotFound:
    known = corner_and_post()
    image = encode_image(rendered(facade(np.random.default_rng(7)), THERE @ MOUNTING), 90)
    view = DroneView(3, 3, CAMERA, MOUNTING, None, image, (), guess)
    images = [(k.image_bytes, k.camera) for k in known.keyframes] + [(image, CAMERA)]
    table = PatchTable([CAMERA] * 3, pyramids_of(images, decoded_pyramid))
    sure = map_uncertainty(known)
    cams = [body @ MOUNTING for body in BODIES]
    return place(
        view, 2, guess, known, sure, depth_errors(views_of(known)), table, cams, MapOptions()
    )


def test_landmarks_that_decide_are_believed_where_the_view_says_that_they_are() -> None:
    found = placed_from(THERE)
    assert isinstance(found, Placed)
    assert len(found.landmarks) >= 20
    assert np.linalg.norm(found.world_from_body.translation - THERE.translation) < 0.02


def test_landmarks_that_decide_are_not_believed_elsewhere() -> None:
    """Looked for further around, any of them may be something that is alike."""
    aside = Pose(THERE.rotation, THERE.translation + np.array([0.0, 0.3, 0.0]))
    found = placed_from(aside)
    assert isinstance(found, NotFound)
    assert "decide" in found.reason or "left" in found.reason
