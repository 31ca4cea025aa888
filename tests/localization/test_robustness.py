"""What lies to the tracker: shadows, things that move, a wrong part of the map, what repeats.

Each has its truth; the lie is a consistent one where that is harder.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.checks import assert_pose_close, nees
from tests.daemon import demo
from tests.localization.painted import MOUNTING, painted_map, photograph
from tests.scenes import PINHOLE
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.fix import Localized, Prior
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import index_map
from vcl_companion.localization.pipeline import Effort, PipelineOptions, is_doubtful, localize
from vcl_companion.localization.tracking import TrackingOptions, track
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.vision.features import FeatureOptions, Image, detect
from vcl_companion.vision.patch_tables import KeyframeImages

OPTIONS, BELIEF = TrackingOptions(), LocalizationOptions()
TRUTH = Pose(exp_so3(np.array([0.03, 0.02, -0.05])), np.array([-2.5, 0.8, -0.4]))
_SIGMA = np.repeat([0.05, 0.004], 3)


@cache
def painted(scenery: str = "boards") -> Templates:
    landmark_map = painted_map(
        np.random.default_rng(3), scenery="windows" if scenery == "windows" else "boards"
    )
    return prepare_templates(landmark_map, map_uncertainty(landmark_map))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def near(rng: np.random.Generator, truth: Pose, times: float = 1.0) -> Prior:
    sigma = times * _SIGMA
    return Prior(truth.retracted(sigma * rng.standard_normal(6)), np.diag(sigma**2))


def tracked(
    image: Image,
    templates: Templates,
    prior: Prior,
    camera: Camera = PINHOLE,
    mounting: Pose = MOUNTING,
) -> Localized:
    fix = track(image, camera, mounting, templates, prior, None, OPTIONS, BELIEF)
    assert isinstance(fix, Localized), fix.reason
    return fix


def assert_true(
    fix: Localized, truth: Pose = TRUTH, within_m: float = 0.015, within_rad: float = 1e-3
) -> None:
    """Near the truth, as near as it says."""
    assert_pose_close(fix.world_from_body, truth, within_m=within_m, within_rad=within_rad)
    assert nees(truth.local(fix.world_from_body), fix.covariance())[0] < 22.5


SHADOWS = ("half", "stripes", "gradient")


def shaded(image: Image, kind: str) -> Image:
    """Take light away from a part of an image: sharp shadows of a half, or ever less light."""
    v, u = np.indices(image.shape)
    light = {
        "half": np.where(u < image.shape[1] / 2, 0.4, 1.0),
        "stripes": np.where((u + v) % 160 < 80, 0.4, 1.0),
        "gradient": 0.4 + 0.8 * u / image.shape[1],
    }[kind]
    return np.asarray(np.clip(image * light, 0, 255), dtype=np.uint8)


@pytest.mark.parametrize("kind", SHADOWS)
def test_light_that_changes_within_the_frame(rng: np.random.Generator, kind: str) -> None:
    image = shaded(photograph(TRUTH, rng), kind)
    assert_true(tracked(image, painted(), near(rng, TRUTH)))


@pytest.mark.parametrize("kind", SHADOWS)
def test_light_that_changes_within_a_frame_of_the_town(rng: np.random.Generator, kind: str) -> None:
    """The town's own map errs; a shadow must not move the pose on it."""
    fix, clean = (in_town(rng, shaded(town(), kind)), in_town(rng, town()))
    assert_true(fix, demo.world_from_body(2, 4), within_m=0.2, within_rad=0.02)
    assert_pose_close(fix.world_from_body, clean.world_from_body, within_m=0.01, within_rad=1e-3)


def town() -> Image:
    return demo.shot(2, 4).image


def in_town(rng: np.random.Generator, image: Image) -> Localized:
    sensor = demo.sensor(2)
    return tracked(
        image, demo.templates(1, 2, 3), near(rng, demo.world_from_body(2, 4)), sensor.camera,
        sensor.body_from_cam,
    )  # fmt: skip


# As the near board moves with it, the right third weighs most; the middle one has most landmarks.
@pytest.mark.parametrize("left", [0, 213, 426])
@pytest.mark.parametrize(
    "moved",
    [
        np.array([0.0, 0.2, 0.0, 0.0, 0.0, 0.0]),
        np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]),
        np.array([-0.2, 0.2, 0.1, 0.005, -0.005, 0.005]),
        np.array([0.0, 0.0, 0.0, 0.0, 0.01, 0.02]),
    ],
    ids=["aside", "nearer", "every way", "turned"],
)
def test_a_third_of_the_image_is_right_for_another_pose(
    rng: np.random.Generator, left: int, moved: Array
) -> None:
    """A thing that moves as a whole, and shows just what the map has there."""
    image = photograph(TRUTH, rng).copy()
    image[:, left : left + 214] = photograph(TRUTH.retracted(moved), rng)[:, left : left + 214]
    for times in (1.0, 3.0):
        assert_true(tracked(image, painted(), near(rng, TRUTH, times)))


@pytest.mark.parametrize("left", [0, 107, 213])
def test_a_third_of_the_town_is_of_another_frame(rng: np.random.Generator, left: int) -> None:
    image = town().copy()
    image[:, left : left + 107] = demo.shot(2, 7).image[:, left : left + 107]
    fix, clean = in_town(rng, image), in_town(rng, town())
    assert_true(fix, demo.world_from_body(2, 4), within_m=0.2, within_rad=0.02)
    assert fix.n_inliers < 0.9 * clean.n_inliers
    assert_pose_close(fix.world_from_body, clean.world_from_body, within_m=0.05, within_rad=0.004)


def displaced(
    templates: Templates, by_m: Array, share: float, rng: np.random.Generator
) -> tuple[Templates, NDArray[np.bool_]]:
    """Move a share of the landmarks, and the keyframes that they are seen in, by one vector.

    Their patches are as right as ever, for a drone that is displaced as they are.
    """
    anchors = templates.anchors
    wrong = (rng.random(anchors.first.size - 1) < share)[anchors.landmark]
    images = anchors.images
    poses = images.worlds_from_cams
    astray = tuple(Pose(pose.rotation, pose.translation + by_m) for pose in poses)
    twice = KeyframeImages(
        images.texels,
        np.concatenate([images.shelves, images.shelves]),
        np.concatenate([images.noises, images.noises]),
        poses + astray,
    )
    points = np.where(wrong[:, None], anchors.points_world + by_m, anchors.points_world)
    keyframe = anchors.keyframe + len(poses) * wrong
    moved = replace(anchors, images=twice, keyframe=keyframe, points_world=points)
    taken_by = np.concatenate([templates.drone_ids, templates.drone_ids])
    return replace(templates, anchors=moved, drone_ids=taken_by), wrong


@pytest.mark.parametrize(
    "by_m",
    [np.array([0.0, 1.5, 0.0]), np.array([1.5, 0.0, 0.0]), np.array([0.0, 0.15, 0.0])],
    ids=["aside", "ahead", "a little aside"],
)
def test_a_fifth_of_the_landmarks_wrong_by_one_and_the_same_vector(
    rng: np.random.Generator, by_m: Array
) -> None:
    templates, wrong = displaced(painted(), by_m, 0.2, rng)
    assert 0.15 < wrong.mean() < 0.25
    image = photograph(TRUTH, rng)
    for times in (1.0, 3.0):
        fix = tracked(image, templates, near(rng, TRUTH, times))
        assert_true(fix)
        assert fix.n_inliers < 0.9 * fix.n_matched


def test_who_is_where_the_wrong_landmarks_say_finds_out_when_there_is_time_to_doubt(
    rng: np.random.Generator,
) -> None:
    """A wrong fifth of the map confirms a prediction that is wrong like it."""
    by_m = np.array([0.0, 1.5, 0.0])
    landmark_map = painted_map(rng, n=800, recognisable=True)
    right = prepare_templates(landmark_map, map_uncertainty(landmark_map))
    templates, wrong = displaced(right, by_m, 0.2, rng)
    points = np.array(landmark_map.points_world)
    points[np.unique(templates.anchors.landmark[wrong])] += by_m
    index = index_map(replace(landmark_map, points_world=points), "akaze", FeatureOptions())
    image, there = photograph(TRUTH, rng), Pose(TRUTH.rotation, TRUTH.translation + by_m)
    expected, options = near(rng, there), PipelineOptions(FeatureOptions(), BELIEF, OPTIONS)

    def found(prior: Prior, may_doubt: bool) -> Localized:
        fix = localize(
            image, PINHOLE, MOUNTING, index, templates, prior, None, options,
            Effort(may_doubt=may_doubt),
        )  # fmt: skip
        assert isinstance(fix, Localized), fix.reason
        return fix

    misled = found(expected, may_doubt=False)
    assert_pose_close(misled.world_from_body, there, within_m=0.1, within_rad=0.01)
    assert is_doubtful(misled)
    assert_true(found(expected, may_doubt=True))
    # Where most agree there is nothing to ask.
    sure = found(near(rng, TRUTH), may_doubt=True)
    assert not is_doubtful(sure)
    assert_true(sure)


def test_a_map_with_a_fifth_wrong_by_one_vector_is_recognised_rightly(
    rng: np.random.Generator,
) -> None:
    """Without a prediction: a fifth of the matches agree on another place, exactly."""
    landmark_map = painted_map(rng, n=800, recognisable=True)
    points = np.array(landmark_map.points_world)
    wrong = rng.random(len(points)) < 0.2
    points[wrong] += np.array([0.0, 1.5, 0.0])
    index = index_map(replace(landmark_map, points_world=points), "akaze", FeatureOptions())
    features = detect(photograph(TRUTH, rng), "akaze", FeatureOptions())
    fix = localize_intra(features, PINHOLE, MOUNTING, index, None, None, BELIEF)
    assert isinstance(fix, Localized), fix.reason
    assert_true(fix, within_m=0.15, within_rad=0.01)


@pytest.mark.parametrize("direction", np.linspace(0.0, 2 * np.pi, 8, endpoint=False))
def test_a_wall_of_windows_all_alike_and_a_prediction_ten_pixels_off(
    rng: np.random.Generator, direction: float
) -> None:
    """The windows are 14 px apart: the wrong ones are nearer to the prediction than the right."""
    image = photograph(TRUTH, rng, scenery="windows")
    turn = 10.0 / PINHOLE.focal_px * np.array([0.0, np.sin(direction), np.cos(direction)])
    start = TRUTH.retracted(np.concatenate([np.zeros(3), turn]))
    sigma = np.array([0.1, 0.1, 0.1, 0.01, 0.015, 0.015])
    assert_true(tracked(image, painted("windows"), Prior(start, np.diag(sigma**2))))


def test_where_nothing_but_windows_is_seen_a_sure_prediction_chooses_the_right_ones(
    rng: np.random.Generator,
) -> None:
    landmark_map = painted_map(rng, scenery="windows")
    first = landmark_map.keyframes[0]
    far = first.world_from_body @ first.body_from_cam
    on_wall = far.inverse().apply(landmark_map.points_world)[:, 2] > 15.0
    only = replace(
        landmark_map,
        points_world=landmark_map.points_world[on_wall],
        observed_px=landmark_map.observed_px[on_wall],
    )
    templates = prepare_templates(only, map_uncertainty(only))
    image = photograph(TRUTH, rng, scenery="windows")
    for _ in range(3):
        fix = track(image, PINHOLE, MOUNTING, templates, near(rng, TRUTH), None, OPTIONS, BELIEF)
        assert isinstance(fix, Localized), fix.reason
        assert_true(fix, within_m=0.05, within_rad=3e-3)
