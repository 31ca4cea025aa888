"""What a frame's pose rests on: patches where they can be had, features where they are needed."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_pose_close, nees
from tests.daemon import demo
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, exp_so3
from vcl_companion.localization.fix import Localized, NotLocalized, Prior, Recognised
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import index_map
from vcl_companion.localization.pipeline import Effort, PipelineOptions, follow, localize
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.vision.features import Image

DRONE, FRAME = 2, 4
OPTIONS = PipelineOptions(demo.FEATURES, LocalizationOptions(), TrackingOptions())
PAPER, DEFAULT = False, True
_SIGMA = np.diag(np.repeat([0.1, 0.01], 3) ** 2)
_OFF = np.array([0.08, -0.08, 0.08, 0.008, -0.008, 0.008])


def answered(
    tracked: bool,
    prior: Prior | None,
    image: Image | None = None,
    recognisable: bool = True,
) -> Localized | NotLocalized:
    """A frame of the demo against the map of the drones' first frames."""
    index, sensor = demo.map_index(1, 2, 3), demo.sensor(DRONE)
    if not recognisable:
        index = demo.unrecognisable(index)
    shot = demo.shot(DRONE, FRAME)
    return localize(
        shot.image if image is None else image, sensor.camera, sensor.body_from_cam,
        index, demo.templates(1, 2, 3) if tracked else None, prior,
        shot.ned_from_body.rotation, OPTIONS,
    )  # fmt: skip


def found(fix: Localized | NotLocalized, by: Recognised) -> Localized:
    """Near the truth, within what it says of itself."""
    assert isinstance(fix, Localized), fix.reason
    assert fix.by == by
    truth = demo.world_from_body(DRONE, FRAME)
    assert_pose_close(fix.world_from_body, truth, within_m=0.2, within_rad=0.02)
    assert nees(truth.local(fix.world_from_body), fix.covariance())[0] < 35.0
    return fix


def prior(moved: Pose | None = None) -> Prior:
    truth = demo.world_from_body(DRONE, FRAME)
    return Prior((moved or Pose.identity()) @ truth.retracted(_OFF), _SIGMA)


def test_a_predicted_frame_is_tracked_and_no_feature_looked_for() -> None:
    """Nothing of this map could be recognised by a feature."""
    found(answered(DEFAULT, prior(), recognisable=False), "patches")
    assert isinstance(answered(PAPER, prior(), recognisable=False), NotLocalized)


def test_without_a_prediction_features_lead_the_patches() -> None:
    by_features = found(answered(PAPER, None), "features")
    by_patches = found(answered(DEFAULT, None), "patches")
    sigmas = [np.sqrt(np.trace(fix.noise_covariance)) for fix in (by_patches, by_features)]
    assert sigmas[0] < 0.5 * sigmas[1]
    # Wherever they are led from, patches say the same.
    predicted = found(answered(DEFAULT, prior()), "patches")
    assert_pose_close(
        by_patches.world_from_body, predicted.world_from_body, within_m=0.01, within_rad=1e-3
    )


@pytest.mark.parametrize(
    "moved",
    [
        Pose(np.eye(3), np.array([0.0, 4.0, 0.0])),
        Pose(exp_so3(np.array([0.0, 0.0, 2.5])), np.zeros(3)),
    ],
    ids=["elsewhere", "turned away"],
)
def test_a_prediction_that_is_wrong_is_got_over(moved: Pose) -> None:
    found(answered(DEFAULT, prior(moved)), "patches")


@pytest.mark.parametrize(("share", "enough"), [(0.12, False), (0.25, True)])
def test_what_hardly_any_of_the_landmarks_tried_agree_on_is_no_pose(
    share: float, enough: bool
) -> None:
    """All but a share of the image, in windows of 40 px, shows something else."""
    shot, sensor = demo.shot(DRONE, FRAME), demo.sensor(DRONE)
    rng = np.random.default_rng(5)
    something_else = rng.integers(0, 256, shot.image.shape, dtype=np.uint8)
    is_shown = np.kron(rng.random((6, 8)) < share, np.ones((40, 40), dtype=np.bool_))
    fix = localize(
        np.where(is_shown, shot.image, something_else), sensor.camera, sensor.body_from_cam,
        demo.map_index(1, 2, 3), demo.templates(1, 2, 3), prior(), shot.ned_from_body.rotation,
        OPTIONS, Effort(may_search=False),
    )  # fmt: skip
    if enough:
        found(fix, "patches")
    else:
        assert isinstance(fix, NotLocalized)
        assert re.fullmatch(r"only \d\d of 400 landmarks tried agree on a pose", fix.reason)


def test_what_one_detector_does_not_recognise_another_may() -> None:
    shot, sensor = demo.shot(DRONE, FRAME), demo.sensor(DRONE)
    akaze = demo.unrecognisable(demo.map_index(1, 2, 3))
    sift = index_map(akaze.landmark_map, "sift", OPTIONS.features)
    for fallback, recognised in ((None, False), (sift, True)):
        fix = localize(
            shot.image, sensor.camera, sensor.body_from_cam, replace(akaze, fallback=fallback),
            demo.templates(1, 2, 3), None, shot.ned_from_body.rotation, OPTIONS,
        )  # fmt: skip
        assert isinstance(fix, Localized) == recognised


def test_without_time_for_a_search_patches_are_followed_and_nothing_is_looked_for() -> None:
    shot, sensor = demo.shot(DRONE, FRAME), demo.sensor(DRONE)
    hasty = Effort(may_search=False)
    for expected in (prior(), None):
        fix = localize(
            shot.image, sensor.camera, sensor.body_from_cam, demo.map_index(1, 2, 3),
            demo.templates(1, 2, 3), expected, shot.ned_from_body.rotation, OPTIONS, hasty,
        )  # fmt: skip
        if expected is not None:
            found(fix, "patches")
        else:
            assert fix == NotLocalized("lost, and not looked for again yet")


@pytest.mark.parametrize("axis", [1, 2])
def test_an_attitude_that_has_swung_farther_than_it_says_costs_no_search(axis: int) -> None:
    """By six degrees of pitch or yaw, where it says a third of one."""
    shot, sensor = demo.shot(DRONE, FRAME), demo.sensor(DRONE)
    swung = exp_so3(np.deg2rad(6.0) * np.eye(3)[axis])
    truth, sure = demo.world_from_body(DRONE, FRAME), np.diag(np.repeat([0.05, 0.005], 3) ** 2)
    expected = Prior(Pose(truth.rotation @ swung, truth.translation), sure)
    attitude, templates = shot.ned_from_body.rotation, demo.templates(1, 2, 3)
    followed = follow(
        shot.image, sensor.camera, sensor.body_from_cam, templates, expected, attitude, OPTIONS
    )
    assert isinstance(followed, NotLocalized)
    fix = localize(
        shot.image, sensor.camera, sensor.body_from_cam, demo.map_index(1, 2, 3), templates,
        expected, attitude, OPTIONS, Effort(may_search=False),
    )  # fmt: skip
    found(fix, "patches")
    nothing = np.random.default_rng(2).integers(0, 256, shot.image.shape, dtype=np.uint8)
    refused = localize(
        nothing, sensor.camera, sensor.body_from_cam, demo.map_index(1, 2, 3), templates,
        expected, attitude, OPTIONS, Effort(may_search=False),
    )  # fmt: skip
    assert isinstance(refused, NotLocalized)


@pytest.mark.parametrize("expected", [None, prior()], ids=["lost", "predicted"])
def test_an_autopilot_without_a_north_contradicts_no_heading(expected: Prior | None) -> None:
    shot, sensor = demo.shot(DRONE, FRAME), demo.sensor(DRONE)
    turned = about_down(2.0) @ shot.ned_from_body.rotation
    tilted = turned @ exp_so3(np.deg2rad([20.0, 0.0, 0.0]))

    def seen(ned_from_body: Array, has_heading: bool) -> Localized | NotLocalized:
        return localize(
            shot.image, sensor.camera, sensor.body_from_cam, demo.map_index(1, 2, 3),
            demo.templates(1, 2, 3), expected, ned_from_body, OPTIONS,
            Effort(has_heading=has_heading),
        )  # fmt: skip

    found(seen(turned, False), "patches")
    refused = seen(turned, True)
    assert isinstance(refused, NotLocalized)
    assert "heading" in refused.reason
    refused = seen(tilted, False)
    assert isinstance(refused, NotLocalized)
    assert "roll and pitch" in refused.reason
    # Who goes on by own frames asks for patches alone, by the same rule.
    by_patches = [
        follow(
            shot.image, sensor.camera, sensor.body_from_cam, demo.templates(1, 2, 3), prior(),
            turned, OPTIONS.by_heading(has_heading),
        )
        for has_heading in (True, False)
    ]  # fmt: skip
    assert [isinstance(fix, Localized) for fix in by_patches] == [False, True]


def test_the_paper_s_pipeline_finds_features_only() -> None:
    found(answered(PAPER, prior()), "features")


@pytest.mark.parametrize("tracked", [PAPER, DEFAULT])
def test_a_frame_that_shows_nothing_is_refused_by_what_was_tried_last(tracked: bool) -> None:
    fog = demo.blank(DRONE)
    for expected in (None, prior()):
        refused = answered(tracked, expected, image=fog)
        assert isinstance(refused, NotLocalized)
        assert refused == answered(PAPER, None, image=fog)
