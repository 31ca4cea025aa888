"""What a drone tells of its image before it was encoded: taken for what it is, or not at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.rendered import CAMERA, panels, rendered, rendered_view
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler
from vcl_companion.localization.fix import Prior
from vcl_companion.localization.seen_by_patches import seen_by_patches
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.seen_landmarks import MAX_SEEN, SeenLandmarks, told_pixels
from vcl_companion.mapping.templates import prepare_templates
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.update import extend_map
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD

MOUNTING = Pose(BODY_FROM_CAM_FORWARD, np.array([0.1, 0.0, 0.05]))
OPTIONS = MapOptions(detectors=("akaze",), keyframe_quality=95)
REVISION = b"revision"
GUESS = np.diag(np.repeat([0.02, 0.002], 3) ** 2)


def at(x: float, y: float, z: float = 0.0) -> Pose:
    return Pose(matrix_from_euler(0.02, -0.03, 0.0), np.array([x, y, z]))


BODIES = (at(0.0, 0.0), at(0.2, 1.5, -0.3))
NEXT = tuple(at(-0.3 - 0.1 * k, 0.4 * k, 0.1 * (k % 3)) for k in range(6))
SCENE = panels(np.random.default_rng(3))


@pytest.fixture(scope="module")
def first() -> LandmarkMap:
    views = [
        rendered_view(SCENE, k + 1, k, body, MOUNTING, OPTIONS) for k, body in enumerate(BODIES)
    ]
    known = float(np.linalg.norm(BODIES[0].translation - BODIES[1].translation))
    made = reconstruct(views, 1, [(1, 2, known)], OPTIONS)
    assert isinstance(made, LandmarkMap), made
    return made


def seen(first: LandmarkMap, body: Pose) -> SeenLandmarks:
    """What a drone measures of the map in its own image."""
    image = rendered(SCENE, body @ MOUNTING)
    templates = prepare_templates(first, map_uncertainty(first))
    found = seen_by_patches(
        image, CAMERA, MOUNTING, templates, REVISION, Prior(body, GUESS), TrackingOptions(), 500
    )
    assert found is not None
    return found


def coarse(body: Pose) -> DroneView:
    """What comes of the image where bytes are few."""
    image = encode_image(rendered(SCENE, body @ MOUNTING), 12)
    return DroneView(3, 9, CAMERA, MOUNTING, None, image, (), body)


def error_of(first: LandmarkMap, view: DroneView, body: Pose) -> float:
    found = extend_map(first, REVISION, [view], OPTIONS)
    assert isinstance(found, LandmarkMap), found
    return float(np.linalg.norm(body.local(found.keyframes[2].world_from_body)[:3]))


def told(first: LandmarkMap, body: Pose) -> np.ndarray:
    pixels = told_pixels(seen(first, body), REVISION, first, CAMERA, body @ MOUNTING)
    assert pixels is not None
    return pixels


def test_most_of_the_map_is_seen_to_a_tenth_of_a_pixel(first: LandmarkMap) -> None:
    pixels = told(first, NEXT[1])
    points = (NEXT[1] @ MOUNTING).inverse().apply(first.points_world)
    off = np.linalg.norm(pixels - CAMERA.project(points), axis=1)
    assert np.isfinite(off).sum() > 0.5 * len(first.points_world)
    # The first map errs a little itself.
    assert np.nanmedian(off) < 0.15


def test_a_coarse_image_is_placed_better_by_what_the_image_showed(first: LandmarkMap) -> None:
    alone = [error_of(first, coarse(body), body) for body in NEXT]
    helped = [
        error_of(first, replace(coarse(body), told_px=told(first, body)), body) for body in NEXT
    ]
    assert np.median(helped) < 0.8 * np.median(alone), (helped, alone)


def test_what_the_image_does_not_show_as_well_is_not_believed(first: LandmarkMap) -> None:
    body = NEXT[2]
    lied = told(first, body) + np.array([3.0, -2.0])
    honest = error_of(first, coarse(body), body)
    assert error_of(first, replace(coarse(body), told_px=lied), body) == honest


@pytest.mark.parametrize("lie", ["shifted", "scaled"])
def test_what_is_off_as_a_whole_is_not_believed(first: LandmarkMap, lie: str) -> None:
    """No single landmark of it is as far off as an encoder may put it."""
    body = NEXT[2]
    honest = told(first, body)
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px])
    off = np.array([0.25, -0.2]) if lie == "shifted" else 0.003 * (honest - centre)
    assert np.nanmax(np.linalg.norm(honest + off - honest, axis=1)) < 0.7
    alone = error_of(first, coarse(body), body)
    assert error_of(first, replace(coarse(body), told_px=honest + off), body) == alone
    assert error_of(first, replace(coarse(body), told_px=honest), body) != alone


def test_of_another_map_nothing_is_told(first: LandmarkMap) -> None:
    body = NEXT[0]
    one, where = seen(first, body), body @ MOUNTING
    assert told_pixels(one, b"another!", first, CAMERA, where) is None
    assert told_pixels(None, REVISION, first, CAMERA, where) is None
    beyond = replace(one, landmarks=one.landmarks + len(first.points_world))
    assert told_pixels(beyond, REVISION, first, CAMERA, where) is None
    # Behind the camera nothing is seen, whoever says so.
    behind = told_pixels(one, REVISION, first, CAMERA, at(200.0, 0.0) @ MOUNTING)
    assert behind is None or not np.isfinite(behind).any()


def test_what_no_image_shows_is_refused() -> None:
    one, two = np.array([4], dtype=np.int64), np.array([4, 4], dtype=np.int64)
    with pytest.raises(ValueError, match="do not rise"):
        SeenLandmarks(REVISION, two, np.zeros((2, 2)))
    with pytest.raises(ValueError, match="do not rise"):
        SeenLandmarks(REVISION, -one, np.zeros((1, 2)))
    for aside in (4.5, np.nan):
        with pytest.raises(ValueError, match="more than 4 px aside"):
            SeenLandmarks(REVISION, one, np.full((1, 2), aside))
    many = np.arange(MAX_SEEN + 1)
    with pytest.raises(ValueError, match="1025 landmarks seen"):
        SeenLandmarks(REVISION, many, np.zeros((len(many), 2)))
