"""From a stored map and one image, without any prediction: where a drone is, at the first frame."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from tests.checks import assert_pose_close, nees
from tests.localization.maps import flat_map, index_of, seen_from
from tests.localization.painted import BODIES, MOUNTING, Scenery, painted_map, photograph
from tests.mapping.views import descriptors_of
from tests.scenes import PINHOLE
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.map_building import build_map
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, matrix_from_euler, quaternion_from_matrix
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.localization.pipeline import PipelineOptions, localize
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.vision.features import FeatureOptions
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.map_codec import decode_map, encode_map

OPTIONS = PipelineOptions(FeatureOptions(), LocalizationOptions(), TrackingOptions())
# The map is made at the origin, looking at a wall 16 m ahead.
PLACES = {
    "as then": Pose(exp_so3(np.array([0.03, 0.02, -0.05])), np.array([-2.5, 0.8, -0.4])),
    "nearer": Pose(exp_so3(np.array([0.0, 0.05, 0.1])), np.array([7.0, 0.0, 0.0])),
    "turned": Pose(exp_so3(np.array([0.0, 0.0, 0.7])), np.array([-2.0, 1.0, 0.0])),
    "from above": Pose(exp_so3(np.array([0.0, -0.35, 0.0])), np.array([2.0, 0.0, -7.0])),
}
AT_A_WALL = {
    "aslant": Pose(exp_so3(np.array([0.02, 0.0, 0.8])), np.array([4.0, -11.0, 0.0])),
    "far": Pose(exp_so3(np.array([0.0, 0.0, 0.1])), np.array([-14.0, 1.0, 0.0])),
    # By features alone, 1.7 m uncertain.
    "very far": Pose(exp_so3(np.array([0.0, 0.0, 0.1])), np.array([-25.0, 1.0, 0.0])),
}
CASES = [("boards", name) for name in PLACES] + [("wall", name) for name in (*PLACES, *AT_A_WALL)]


@cache
def stored(scenery: Scenery) -> tuple[MapIndex, Templates]:
    """A map as it comes back from where it was stored."""
    made = painted_map(np.random.default_rng(3), n=800, recognisable=True, scenery=scenery)
    landmark_map = decode_map(encode_map(made))
    index = index_map(landmark_map, "akaze", OPTIONS.features)
    return index, prepare_templates(landmark_map, index.uncertainty)


@pytest.mark.parametrize("north", [True, False], ids=["attitude", "no attitude"])
@pytest.mark.parametrize(("scenery", "place"), CASES, ids=[" ".join(case) for case in CASES])
def test_the_first_image_is_enough(scenery: Scenery, place: str, north: bool) -> None:
    """A flat wall too, with what its other solution would be; the filter begins from it."""
    rng = np.random.default_rng(1)
    truth = {**PLACES, **AT_A_WALL}[place]
    noise = exp_so3(np.deg2rad(0.5) * rng.standard_normal(3))
    attitude = truth.rotation @ noise if north else None
    index, templates = stored(scenery)
    image = photograph(truth, rng, scenery=scenery)
    fix = localize(image, PINHOLE, MOUNTING, index, templates, None, attitude, OPTIONS)
    assert isinstance(fix, Localized), fix.reason
    assert fix.by == "patches"
    # The farther the wall, the less its patches tell a step aside from a turn.
    farther = max(1.0, (16.0 - truth.translation[0]) / 16.0)
    assert_pose_close(fix.world_from_body, truth, within_m=0.02 * farther, within_rad=1e-3)
    assert nees(truth.local(fix.world_from_body), fix.covariance())[0] < 22.5
    estimator = Estimator(FilterOptions(), OPTIONS.localization, lambda _: None)
    assert isinstance(estimator.take_fix(None, fix, 0, attitude), FilterState)
    assert estimator.is_localized(0)


@pytest.mark.parametrize("scenery", ["boards", "windows"])
def test_from_anywhere_before_the_scene_the_right_place_or_none(scenery: Scenery) -> None:
    """Where single landmarks decide what features say, the patches settle it.

    With windows all alike too: most patches must be where they should be.
    """
    rng = np.random.default_rng(11)
    index, templates = stored(scenery)
    found = []
    for _ in range(12):
        place = np.array([rng.uniform(-20, 6), rng.uniform(-12, 12), rng.uniform(-4, 1)])
        yaw = np.arctan2(-0.8 * place[1], 15.0 - place[0]) + rng.uniform(-0.3, 0.3)
        truth = Pose(exp_so3(np.array([0.0, rng.uniform(-0.1, 0.1), yaw])), place)
        image = photograph(truth, rng, scenery=scenery)
        fix = localize(image, PINHOLE, MOUNTING, index, templates, None, None, OPTIONS)
        found.append(isinstance(fix, Localized))
        if isinstance(fix, Localized):
            assert_pose_close(fix.world_from_body, truth, within_m=0.05, within_rad=3e-3)
            assert nees(truth.local(fix.world_from_body), fix.covariance())[0] < 35.0
    assert sum(found) >= 8


def test_a_flat_wall_s_map_that_the_drones_make_themselves() -> None:
    """Three views of nothing but a plane: gravity and the third view settle the two solutions."""
    rng = np.random.default_rng(0)
    answers = []
    for i, body in enumerate(BODIES):
        noise = exp_so3((i > 0) * np.deg2rad(0.5) * rng.standard_normal(3))
        image = encode_image(photograph(body, rng, scenery="wall"), 80)
        attitude = quaternion_from_matrix(body.rotation @ noise)
        answers.append(FrameAnswer(i + 1, 1, 0, 0.0, attitude, MOUNTING, PINHOLE, image))
    apart_m = float(np.linalg.norm(BODIES[1].translation))
    memory, options = FeatureMemory(OPTIONS.features), MapOptions(detectors=("akaze",))
    made = build_map(answers, 1, ((1, 2, apart_m),), options, memory)
    assert isinstance(made, LandmarkMap), made
    for keyframe, body in zip(made.keyframes, BODIES, strict=True):
        assert_pose_close(keyframe.world_from_body, body, within_m=0.01, within_rad=1e-3)
    index = index_map(made, "akaze", OPTIONS.features)
    templates = prepare_templates(made, index.uncertainty)
    for place in (PLACES["as then"], Pose(exp_so3(np.array([0, 0, 0.5])), np.array([1.0, -5, 0]))):
        image_now = photograph(place, rng, scenery="wall")
        for attitude_now in (place.rotation, None):
            fix = localize(
                image_now, PINHOLE, MOUNTING, index, templates, None, attitude_now, OPTIONS
            )
            assert isinstance(fix, Localized), fix.reason
            assert_pose_close(fix.world_from_body, place, within_m=0.02, within_rad=1e-3)


@pytest.mark.parametrize("pitch", [False, True], ids=["aslant", "from above"])
@pytest.mark.parametrize(("half_m", "depth_m"), [(3.0, 8.0), (2.0, 10.0), (1.0, 10.0)])
def test_a_small_flat_thing_gives_the_right_pose_or_none(
    half_m: float, depth_m: float, pitch: bool
) -> None:
    """A plane seen under a small angle has two poses that look alike; the wrong one never comes.

    Where the image cannot tell them apart the pose is too uncertain to be sent.
    """
    rng = np.random.default_rng(2)
    found = 0
    for angle in np.repeat([0.0, 0.3, 0.6, 0.9], 5):
        landmark_map = flat_map(rng, half_m)
        descriptors = descriptors_of(rng, len(landmark_map.points_world))
        yaw_rad, pitch_rad = (0.0, angle) if pitch else (angle, 0.0)
        rotation = matrix_from_euler(0.0, -pitch_rad, yaw_rad)
        truth = Pose(rotation, np.array([12.0, 0.0, 0.0]) - depth_m * rotation[:, 0])
        first = landmark_map.keyframes[0]
        fix = localize_intra(
            seen_from(rng, landmark_map, descriptors, truth, noise_px=0.5),
            first.camera, first.body_from_cam, index_of(landmark_map, descriptors), None,
            truth.rotation @ exp_so3(np.deg2rad(0.5) * rng.standard_normal(3)),
            OPTIONS.localization,
        )  # fmt: skip
        if isinstance(fix, NotLocalized):
            assert "uncertain" in fix.reason or "fix" in fix.reason, fix.reason
            continue
        found += 1
        assert nees(truth.local(fix.world_from_body), fix.covariance())[0] < 35.0
    assert found >= (10 if half_m == 3.0 else 4 if half_m == 2.0 else 0)
