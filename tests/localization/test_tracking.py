"""Patches find the pose, and say how well, whatever is done to the image or the map."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sitl.renderer import Imaging
from tests.checks import assert_pose_close, nees
from tests.localization.painted import BODIES, MOUNTING, painted_map, photograph
from tests.scenes import CAMERAS, PINHOLE, perturbed
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.tracking import TrackingOptions, track
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.vision.features import Image

OPTIONS, BELIEF = TrackingOptions(), LocalizationOptions()
# Back, aside and turned: a fifth smaller than in the keyframes.
TRUTH = Pose(exp_so3(np.array([0.03, 0.02, -0.05])), np.array([-2.5, 0.8, -0.4]))
_SIGMA = np.repeat([0.05, 0.004], 3)
# A quarter pixel in the keyframes is 10 cm of a landmark's depth; patches measure it again.
_WITHIN_M, _WITHIN_RAD = 0.03, 2e-3


def prepared(landmark_map: LandmarkMap) -> Templates:
    return prepare_templates(landmark_map, map_uncertainty(landmark_map))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="module")
def templates() -> Templates:
    return prepared(painted_map(np.random.default_rng(3)))


def near(rng: np.random.Generator, truth: Pose, sigma: Array = _SIGMA) -> Prior:
    return Prior(truth.retracted(sigma * rng.standard_normal(6)), np.diag(sigma**2))


def tracked(
    image: Image,
    templates: Templates,
    prior: Prior,
    camera: Camera = PINHOLE,
    options: TrackingOptions = OPTIONS,
    drone_id: int | None = None,
) -> Localized:
    fix = track(image, camera, MOUNTING, templates, prior, None, options, BELIEF, drone_id)
    assert isinstance(fix, Localized), fix.reason
    return fix


def assert_tracked(fix: Localized, truth: Pose, within: float = 1.0) -> None:
    """Near the truth, and within four of its own sigmas, which are no larger than need be."""
    assert_pose_close(
        fix.world_from_body, truth, within_m=within * _WITHIN_M, within_rad=within * _WITHIN_RAD
    )
    error, covariance = truth.local(fix.world_from_body), fix.covariance()
    assert nees(error, covariance)[0] < 35.0
    assert np.sqrt(np.trace(covariance[:3, :3])) < 3.0 * within * _WITHIN_M


@pytest.mark.parametrize("camera", CAMERAS, ids=["none", "radial4", "radial5", "fisheye"])
def test_a_view_from_elsewhere_is_found(camera: Camera) -> None:
    rng = np.random.default_rng(1)
    templates = prepared(painted_map(rng, camera))
    fix = tracked(photograph(TRUTH, rng, camera), templates, near(rng, TRUTH), camera)
    assert_tracked(fix, TRUTH)
    assert fix.n_inliers > 0.8 * fix.n_matched
    assert fix.rms_px < 0.4


def test_a_keyframe_itself_is_found_almost_exactly(
    rng: np.random.Generator, templates: Templates
) -> None:
    fix = tracked(photograph(BODIES[0], rng), templates, near(rng, BODIES[0]))
    assert_pose_close(fix.world_from_body, BODIES[0], within_m=0.006, within_rad=4e-4, least_m=1e-5)


def test_from_another_camera_than_the_keyframes(
    rng: np.random.Generator, templates: Templates
) -> None:
    camera = CAMERAS[3]
    assert_tracked(
        tracked(photograph(TRUTH, rng, camera), templates, near(rng, TRUTH), camera), TRUTH
    )


def test_twice_as_far_and_from_half_as_far(rng: np.random.Generator, templates: Templates) -> None:
    for place in (np.array([-11.0, 0.5, -0.5]), np.array([3.5, 0.2, 0.0])):
        truth = Pose(TRUTH.rotation, place)
        fix = tracked(photograph(truth, rng), templates, near(rng, truth))
        assert_tracked(fix, truth, within=2.5)


@pytest.mark.parametrize("direction", [0.3, 1.8, 3.6, 5.2])
def test_a_prediction_ten_pixels_off(
    rng: np.random.Generator, templates: Templates, direction: float
) -> None:
    image = photograph(TRUTH, rng)
    angle = 10.0 / PINHOLE.focal_px
    turn = angle * np.array([0.0, np.sin(direction), np.cos(direction)])
    start = TRUTH.retracted(np.concatenate([np.zeros(3), turn]))
    sigma = np.array([0.1, 0.1, 0.1, 0.01, 0.015, 0.015])
    fix = tracked(image, templates, Prior(start, np.diag(sigma**2)))
    assert_tracked(fix, TRUTH)
    exact = tracked(image, templates, Prior(TRUTH, np.diag(sigma**2)))
    assert_pose_close(fix.world_from_body, exact.world_from_body, within_m=0.01, within_rad=6e-4)


_ANY_SPEED = np.diag(np.repeat([2.0, 0.01], 3) ** 2)


def test_who_may_have_flown_far_is_found_near(
    rng: np.random.Generator, templates: Templates
) -> None:
    """As after the first fix, when no speed is known, close to what is seen."""
    image = photograph(TRUTH, rng)
    start = TRUTH.retracted(np.array([0.6, -0.5, 0.3, 0.004, -0.006, 0.005]))
    fix = tracked(image, templates, Prior(start, _ANY_SPEED))
    assert_tracked(fix, TRUTH)
    exact = tracked(image, templates, Prior(TRUTH, np.diag(_SIGMA**2)))
    assert_pose_close(fix.world_from_body, exact.world_from_body, within_m=0.01, within_rad=6e-4)


def test_of_what_is_seen_near_a_vague_prediction_most_has_to_be_there(
    rng: np.random.Generator,
) -> None:
    landmark_map = painted_map(np.random.default_rng(3))
    keyframes = [(k.world_from_body @ k.body_from_cam).translation for k in landmark_map.keyframes]
    away = landmark_map.points_world - np.mean(keyframes, axis=0)
    wrong = rng.uniform(size=len(away)) < 0.6
    moved = away * np.where(wrong, 1.3, 1.0)[:, None] + np.mean(keyframes, axis=0)
    bent = prepare_templates(
        replace(landmark_map, points_world=moved), map_uncertainty(landmark_map)
    )
    image = photograph(TRUTH, rng)
    sure = tracked(image, bent, Prior(TRUTH, np.diag(_SIGMA**2)))
    assert OPTIONS.n_coarse / 10 < sure.n_inliers < 0.5 * sure.n_matched
    why = reason(image, bent, Prior(TRUTH, _ANY_SPEED))
    assert "of a prediction that is vague" in why or "agree" in why


@pytest.mark.parametrize("gain", [0.5, 1.7])
def test_other_light(rng: np.random.Generator, templates: Templates, gain: float) -> None:
    """A factor of two between keyframe and frame; at 1.7 the brightest places are white."""
    image = photograph(TRUTH, rng, imaging=Imaging(gain=gain, vignetting=0.2))
    assert_tracked(tracked(image, templates, near(rng, TRUTH)), TRUTH, within=1.5)


def test_blur_and_noise(rng: np.random.Generator, templates: Templates) -> None:
    image = photograph(TRUTH, rng, imaging=Imaging(blur_px=1.2, noise_levels=6.0))
    assert_tracked(tracked(image, templates, near(rng, TRUTH)), TRUTH, within=1.5)


def test_motion_blur(rng: np.random.Generator, templates: Templates) -> None:
    image = cv2.blur(photograph(TRUTH, rng), (5, 1))
    assert_tracked(
        tracked(np.asarray(image, np.uint8), templates, near(rng, TRUTH)), TRUTH, within=1.5
    )


@pytest.mark.parametrize("left", [0, 200, 426])
def test_a_moving_object_over_a_third_of_the_image(
    rng: np.random.Generator, templates: Templates, left: int
) -> None:
    image = photograph(TRUTH, rng).copy()
    elsewhere = photograph(Pose(exp_so3(np.array([0.2, 0.1, 1.1])), np.zeros(3)), rng)
    image[:, left : left + 214] = elsewhere[:, left : left + 214]
    fix = tracked(image, templates, near(rng, TRUTH))
    assert_tracked(fix, TRUTH, within=1.5)
    assert 0.45 * fix.n_matched < fix.n_inliers < 0.8 * fix.n_matched


def test_an_object_that_moves_with_its_own_texture(
    rng: np.random.Generator, templates: Templates
) -> None:
    """The covered third looks right, but somewhere else: its patches are found, and wrong."""
    image = photograph(TRUTH, rng).copy()
    image[:, 8:214] = image[:, 4:210].copy()
    assert_tracked(tracked(image, templates, near(rng, TRUTH)), TRUTH, within=1.5)


def test_a_fifth_of_the_landmarks_wrong_by_a_metre_and_a_half(rng: np.random.Generator) -> None:
    landmark_map = painted_map(rng)
    points = np.array(landmark_map.points_world)
    wrong = rng.random(len(points)) < 0.2
    astray = rng.standard_normal((len(points), 3))
    points[wrong] += 1.5 * (astray / np.linalg.norm(astray, axis=1)[:, None])[wrong]
    templates = prepared(replace(landmark_map, points_world=points))
    fix = tracked(photograph(TRUTH, rng), templates, near(rng, TRUTH))
    assert_tracked(fix, TRUTH)
    assert not wrong[templates.anchors.landmark].any()


def test_landmarks_wrong_in_depth_that_the_preparation_did_not_see(
    rng: np.random.Generator, templates: Templates
) -> None:
    """Each of a fifth of the landmarks is where its patch is, but 1.5 m nearer or farther."""
    anchors = templates.anchors
    wrong = (rng.random(anchors.first.size - 1) < 0.2)[anchors.landmark]
    planes, points = anchors.planes.copy(), anchors.points_world.copy()
    shift = np.where(anchors.landmark % 2 == 0, 1.5, -1.5)
    centres = np.stack([p.translation for p in anchors.images.worlds_from_cams])[anchors.keyframe]
    stretch = 1.0 + shift * planes[:, 2]
    planes[wrong, 2:5] /= stretch[wrong, None]
    points[wrong] = (centres + (points - centres) * stretch[:, None])[wrong]
    corrupt = replace(templates, anchors=replace(anchors, planes=planes, points_world=points))
    fix = tracked(photograph(TRUTH, rng), corrupt, near(rng, TRUTH))
    assert_tracked(fix, TRUTH, within=1.5)
    assert fix.n_inliers < 0.95 * fix.n_matched


def test_the_stated_covariance_holds() -> None:
    """Maps anew, frames anew: what the errors' own covariances make of them is as many sigmas.

    Bounded on both sides; wide, because a map's keyframes are exact here while
    their stated error is counted in.
    """
    rng = np.random.default_rng(11)
    squared, own = [], []
    for _ in range(3):
        templates = prepared(painted_map(rng, n=300))
        for _ in range(4):
            truth = perturbed(rng, TRUTH, 0.8, 0.05)
            fix = tracked(photograph(truth, rng), templates, near(rng, truth))
            error = truth.local(fix.world_from_body)
            squared.append(nees(error, fix.covariance())[0])
            own.append(nees(error, fix.noise_covariance + fix.own_map_covariance)[0])
    assert 0.05 < np.median(squared) < 10.0
    assert 1.0 < np.median(own) < 18.0


def test_a_lens_that_is_off_does_not_average_out(
    rng: np.random.Generator, templates: Templates
) -> None:
    """However many landmarks agree on it, the image of another centre is taken to be turned."""
    off = replace(PINHOLE, cx_px=PINHOLE.cx_px + 0.1, cy_px=PINHOLE.cy_px - 0.1)
    image, prior = photograph(TRUTH, rng), near(rng, TRUTH)
    own = []
    for shifted_px in (1e-3, 0.1):
        options = replace(OPTIONS, shifted_px=shifted_px)
        fix = tracked(image, templates, prior, off, options)
        error = TRUTH.local(fix.world_from_body)
        own.append(nees(error, fix.noise_covariance + fix.own_map_covariance)[0])
    assert own[0] > 50.0
    assert own[1] < 20.0


def test_a_lens_that_is_off_its_calibration_errs_as_much_as_stated() -> None:
    rng = np.random.default_rng(12)
    exact = prepared(painted_map(rng, n=300))
    told = replace(exact, uncertainty=replace(exact.uncertainty, calibration_px=1.0))
    half = PINHOLE.width_px / 2.0
    unaware: list[float] = []
    aware: list[float] = []
    for _ in range(8):
        fx, fy, cx, cy = 0.5 * rng.standard_normal(4)
        off = replace(
            PINHOLE,
            fx_px=PINHOLE.fx_px * (1.0 + fx / half),
            fy_px=PINHOLE.fy_px * (1.0 + fy / half),
            cx_px=PINHOLE.cx_px + cx,
            cy_px=PINHOLE.cy_px + cy,
        )
        truth = perturbed(rng, TRUTH, 0.8, 0.05)
        image, prior = photograph(truth, rng), near(rng, truth)
        for templates, squared in ((exact, unaware), (told, aware)):
            fix = tracked(image, templates, prior, off)
            squared.append(nees(truth.local(fix.world_from_body), fix.covariance())[0])
    assert np.median(unaware) > 30.0
    assert 0.3 < np.median(aware) < 10.0


def test_where_its_own_keyframe_saw_it_a_lens_is_off_no_more_than_there(
    rng: np.random.Generator, templates: Templates
) -> None:
    told = replace(templates, uncertainty=replace(templates.uncertainty, calibration_px=1.0))
    image, prior = photograph(BODIES[0], rng), near(rng, BODIES[0])
    more = []
    for drone_id in (1, 2):
        covariances = [
            tracked(image, one, prior, drone_id=drone_id).own_map_covariance
            for one in (templates, told)
        ]
        more.append(np.sqrt(np.trace((covariances[1] - covariances[0])[3:, 3:])))
    assert more[1] * PINHOLE.focal_px > 0.3
    assert more[0] < 0.5 * more[1]


def test_no_position_is_told_better_than_a_camera_s_place_on_its_drone(
    rng: np.random.Generator, templates: Templates
) -> None:
    image, prior = photograph(BODIES[0], rng), near(rng, BODIES[0])
    covariances = []
    for mounted_m in (1e-6, 0.01):
        options = replace(OPTIONS, mounted_m=mounted_m)
        fix = tracked(image, templates, prior, options=options)
        covariances.append(fix.covariance())
    assert np.linalg.eigvalsh(covariances[1][:3, :3])[0] > 0.01**2
    expected = np.diag([0.01**2 - 1e-12] * 3 + [0.0] * 3)
    np.testing.assert_allclose(covariances[1] - covariances[0], expected, atol=1e-12)


def test_what_is_seen_where_a_keyframe_saw_it_is_shifted_no_more_than_there(
    rng: np.random.Generator, templates: Templates
) -> None:
    """The farther its own patches lie from where it saw them, the more a lens may be off."""
    keyframe = BODIES[0]
    for turned, drone_id, wanted_px in (
        (0.0, 1, 0.0),
        (0.02, 1, 0.1 * 0.02 * PINHOLE.focal_px / 40.0),
        (0.2, 1, 0.1),
        (0.0, 2, 0.1),
        (0.0, None, 0.1),
    ):
        truth = Pose(keyframe.rotation @ exp_so3(np.array([0, 0, turned])), keyframe.translation)
        image, prior = photograph(truth, rng), near(rng, truth)
        own = []
        for shifted_px in (1e-6, 0.1):
            options = replace(OPTIONS, shifted_px=shifted_px)
            fix = tracked(image, templates, prior, options=options, drone_id=drone_id)
            own.append(fix.own_map_covariance[5, 5])
        shifted_px = float(np.sqrt(max(own[1] - own[0], 0.0))) * PINHOLE.focal_px
        assert abs(shifted_px - wanted_px) < 0.006, (turned, drone_id, shifted_px)


def test_few_landmarks_are_as_many_as_wanted(
    rng: np.random.Generator, templates: Templates
) -> None:
    few = replace(OPTIONS, n_landmarks=100, n_coarse=60)
    image, prior = photograph(TRUTH, rng), near(rng, TRUTH)
    fix, more = tracked(image, templates, prior, options=few), tracked(image, templates, prior)
    assert fix.n_matched == 100
    assert_tracked(fix, TRUTH, within=2.0)
    size = [np.sqrt(np.trace(f.covariance()[:3, :3])) for f in (fix, more)]
    assert size[1] < size[0] < 2.5 * size[1]


def reason(
    image: Image,
    templates: Templates,
    prior: Prior,
    ned_from_body: Array | None = None,
    belief: LocalizationOptions = BELIEF,
) -> str:
    fix = track(image, PINHOLE, MOUNTING, templates, prior, ned_from_body, OPTIONS, belief)
    assert isinstance(fix, NotLocalized)
    return fix.reason


def test_what_is_not_believed_says_why(rng: np.random.Generator, templates: Templates) -> None:
    image, prior = photograph(TRUTH, rng), near(rng, TRUTH)
    other = rng.integers(0, 255, image.shape, dtype=np.uint8)
    assert "patches found" in reason(other, templates, prior)
    assert "patches found" in reason(np.full_like(image, 90), templates, prior)
    behind = Pose(exp_so3(np.array([0.0, 0.0, 2.5])), TRUTH.translation)
    assert "in view" in reason(image, templates, Prior(behind, prior.covariance))
    assert "uncertain" in reason(image, templates, Prior(TRUTH, 25.0 * np.eye(6)))
    strict = replace(BELIEF, max_sigma_m=1e-4)
    assert "too uncertain" in reason(image, templates, prior, belief=strict)
    tilted = TRUTH.rotation @ exp_so3(np.array([0.2, 0.0, 0.0]))
    assert "roll and pitch" in reason(image, templates, prior, tilted)
    turned = exp_so3(np.array([0.0, 0.0, 0.6])) @ TRUTH.rotation
    assert "heading" in reason(image, templates, prior, turned)
    upright = exp_so3(np.array([0.0, 0.0, 0.1])) @ TRUTH.rotation
    assert isinstance(
        track(image, PINHOLE, MOUNTING, templates, prior, upright, OPTIONS, BELIEF), Localized
    )


def test_the_same_frame_gives_the_same_pose(rng: np.random.Generator, templates: Templates) -> None:
    image, prior = photograph(TRUTH, rng), near(rng, TRUTH)
    one, two = tracked(image, templates, prior), tracked(image, templates, prior)
    assert np.array_equal(one.world_from_body.matrix(), two.world_from_body.matrix())
    assert np.array_equal(one.covariance(), two.covariance())


@pytest.mark.parametrize(
    "wrong",
    [
        {"n_coarse": 500},
        {"n_coarse": 19},
        {"least_score": 1.0},
        {"max_radius_px": 0.0},
        {"misplaced_px": -1.0},
        {"shifted_px": 0.0},
        {"mounted_m": 0.0},
    ],
)
def test_options_out_of_bounds_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        replace(OPTIONS, **wrong)  # type: ignore[arg-type]
