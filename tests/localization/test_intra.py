"""One image, one map: the pose, how sure it is, and when there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent, assert_pose_close, nees
from tests.localization.maps import Descriptors, flat_map, index_of, index_of_scene, seen_from
from tests.mapping.views import descriptors_of, map_of
from tests.scenes import RADIAL_TANGENTIAL, facade_scene, perturbed
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.localization.fix import Localized, NotLocalized, Prior
from vcl_companion.localization.intra import localize_intra
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.lens_errors import N_LENS, lens_px
from vcl_companion.vision.features import Features, joined_features

# Between the two keyframes and a little nearer to the facade.
TRUTH = Pose(matrix_from_euler(0.02, -0.03, 0.05), np.array([1.0, 0.8, -0.3]))
OPTIONS = LocalizationOptions()
# Detectors that misplace nothing, for maps whose every error is known.
UNBIASED = LocalizationOptions(bias_px_per_deg=1e-9, bias_px_per_octave=1e-9)


def localize(
    features: Features,
    index: MapIndex,
    prior: Prior | None = None,
    attitude: Array | None = None,
    options: LocalizationOptions = OPTIONS,
) -> Localized | NotLocalized:
    first = index.landmark_map.keyframes[0]
    return localize_intra(
        features, first.camera, first.body_from_cam, index, prior, attitude, options
    )


def located(
    features: Features,
    index: MapIndex,
    prior: Prior | None = None,
    options: LocalizationOptions = OPTIONS,
) -> Localized:
    fix = localize(features, index, prior, options=options)
    assert isinstance(fix, Localized), fix
    return fix


def prior_at(pose: Pose, sigma_m: float, sigma_rad: float) -> Prior:
    return Prior(pose, np.diag([sigma_m**2] * 3 + [sigma_rad**2] * 3))


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.fixture
def relief(rng: np.random.Generator) -> tuple[MapIndex, Descriptors]:
    return index_of_scene(rng, facade_scene(rng, 250, relief_m=4.0, n_views=3))


def test_a_lens_that_is_off_its_calibration_errs_as_much_as_stated(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    exact, descriptors = relief
    told = replace(exact, uncertainty=replace(exact.uncertainty, calibration_px=3.0))
    camera = exact.landmark_map.keyframes[0].camera
    unaware: list[float] = []
    aware: list[float] = []
    for _ in range(20):
        features = seen_from(rng, exact.landmark_map, descriptors, TRUTH, noise_px=0.4)
        off_px = lens_px(camera, features.pixels, 3.0) @ rng.standard_normal(N_LENS)
        features = replace(features, pixels=features.pixels + off_px)
        for index, squared in ((exact, unaware), (told, aware)):
            fix = located(features, index, options=UNBIASED)
            squared.append(nees(TRUTH.local(fix.world_from_body), fix.covariance())[0])
    assert np.mean(unaware) > 20.0
    assert 3.0 < np.mean(aware) < 10.0


@pytest.mark.parametrize("guided", [False, True])
def test_without_noise_the_pose_is_exact(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors], guided: bool
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    prior = prior_at(perturbed(rng, TRUTH, 0.05, 0.003), 0.05, 0.003) if guided else None
    fix = located(features, index, prior)
    assert_pose_close(fix.world_from_body, TRUTH, within_m=1e-6, within_rad=1e-7)
    assert fix.guided == guided
    assert fix.n_inliers == fix.n_matched == len(features)
    assert fix.rms_px < 1e-4


def test_features_anywhere_around_vague_landmarks_are_no_place(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    # Half a metre, 12 m away: more than the eight pixels within which they are looked for.
    vague = replace(index, landmark_covariances=index.landmark_covariances + 0.5**2 * np.eye(3))
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    located(features, vague)
    angle, radius = rng.uniform(0, 2 * np.pi, len(features)), np.sqrt(rng.random(len(features)))
    off_px = 7.0 * radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    found = localize(replace(features, pixels=features.pixels + off_px), vague)
    assert isinstance(found, NotLocalized)
    assert "somewhere alike" in found.reason


@pytest.mark.parametrize("camera", [RADIAL_TANGENTIAL], ids=["distorted"])
def test_a_distorted_camera_is_as_exact(rng: np.random.Generator, camera: Camera) -> None:
    index, descriptors = index_of_scene(rng, facade_scene(rng, 250, 4.0, camera=camera))
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    fix = located(features, index)
    assert_pose_close(fix.world_from_body, TRUTH, within_m=1e-6, within_rad=1e-7)


def test_pixel_noise_moves_the_pose_as_much_as_stated(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    errors, sigma = [], []
    for _ in range(40):
        truth = perturbed(rng, TRUTH, 0.3, 0.02)
        features = seen_from(rng, index.landmark_map, descriptors, truth, noise_px=0.5)
        fix = located(features, index, options=UNBIASED)
        errors.append(truth.local(fix.world_from_body))
        sigma.append(fix.noise_covariance)
        assert 0.5 < fix.rms_px < 0.9
    # The robust weight discards a little of what it could use.
    assert_consistent(errors, sigma, slack=1.2)


def perturbed_map(index: MapIndex, keyframe_errors: Array, landmark_errors: Array) -> LandmarkMap:
    """Return the map moved by (6V,) errors of its keyframes and (N, 3) of its landmarks' own."""
    m = index.landmark_map
    shared = index.uncertainty.landmark_lever @ keyframe_errors
    return replace(
        m,
        points_world=m.points_world + shared + landmark_errors,
        keyframes=tuple(
            replace(k, world_from_body=k.world_from_body.retracted(keyframe_errors[6 * i :][:6]))
            for i, k in enumerate(m.keyframes)
        ),
    )


def test_a_keyframe_s_error_moves_the_pose_by_the_lever(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    lever = located(features, index, options=UNBIASED).map_lever
    n = len(index.landmark_map.points_world)
    for k in range(6, lever.shape[1]):
        step = np.zeros(lever.shape[1])
        step[k] = 1e-4
        moved = index_of(perturbed_map(index, step, np.zeros((n, 3))), descriptors)
        fix = located(features, moved, options=UNBIASED)
        np.testing.assert_allclose(TRUTH.local(fix.world_from_body), lever @ step, atol=4e-6)
    assert np.abs(lever[:, 6:]).max() > 0.3


def test_a_drone_where_the_keyframe_is_errs_as_the_keyframe(rng: np.random.Generator) -> None:
    """Seen from keyframe 1, landmarks that moved with it put the drone where it claims to be."""
    scene = facade_scene(rng, 250, relief_m=4.0, n_views=2)
    index, descriptors = index_of_scene(rng, scene)
    body = scene.bodies[1]
    mounting = scene.mountings[1]
    features = Features(
        index.landmark_map.observed_px[:, 1][index.landmark_map.seen[:, 1]],
        descriptors[index.landmark_map.seen[:, 1]],
    )
    fix = localize_intra(features, scene.camera, mounting, index, None, None, UNBIASED)
    assert isinstance(fix, Localized)
    assert_pose_close(fix.world_from_body, body, within_m=1e-5, within_rad=1e-6)
    sigma = np.sqrt(np.diag(index.uncertainty.keyframe_covariance)[6:])
    step = np.concatenate([np.zeros(6), sigma])
    # To the extent that landmarks follow both of the views that placed them.
    difference = (fix.map_lever @ step - step[6:]) / sigma
    assert np.abs(difference).max() < 1.0


def test_the_map_s_own_errors_move_the_pose_as_much_as_stated(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    exact = index.landmark_map
    factor = np.linalg.cholesky(index.uncertainty.landmark_covariance)
    errors, sigma = [], []
    for _ in range(40):
        own = np.einsum("nij,nj->ni", factor, rng.standard_normal((len(factor), 3)))
        moved = perturbed_map(index, np.zeros(18), own)
        features = seen_from(rng, exact, descriptors, TRUTH)
        fix = located(features, replace(index, landmark_map=moved), options=UNBIASED)
        errors.append(TRUTH.local(fix.world_from_body))
        sigma.append(fix.own_map_covariance)
    assert_consistent(errors, sigma, slack=1.2)


def test_the_whole_covariance_covers_noise_and_map(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    exact = index.landmark_map
    factor = np.linalg.cholesky(index.uncertainty.landmark_covariance)
    keyframe_factor = np.zeros((18, 18))
    keyframe_factor[6:, 6:] = np.linalg.cholesky(index.uncertainty.keyframe_covariance[6:, 6:])
    errors, sigma = [], []
    for _ in range(40):
        own = np.einsum("nij,nj->ni", factor, rng.standard_normal((len(factor), 3)))
        moved = perturbed_map(index, keyframe_factor @ rng.standard_normal(18), own)
        truth = perturbed(rng, TRUTH, 0.3, 0.02)
        features = seen_from(rng, exact, descriptors, truth, noise_px=0.5)
        fix = located(features, index_of(moved, descriptors), options=UNBIASED)
        errors.append(truth.local(fix.world_from_body))
        sigma.append(fix.covariance())
    assert_consistent(errors, sigma, slack=1.2)


def test_a_place_that_looks_different_from_here_is_less_sure(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    near = Pose(TRUTH.rotation, np.array([5.0, 0.0, 0.0]))
    features = seen_from(rng, index.landmark_map, descriptors, near)
    biased, unbiased = located(features, index), located(features, index, options=UNBIASED)
    growth = np.trace(biased.own_map_covariance) / np.trace(unbiased.own_map_covariance)
    assert growth > 1.5
    at_keyframe = seen_from(rng, index.landmark_map, descriptors, Pose.identity())
    biased = located(at_keyframe, index)
    unbiased = located(at_keyframe, index, options=UNBIASED)
    growth = np.trace(biased.own_map_covariance) / np.trace(unbiased.own_map_covariance)
    assert growth < 1.2


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_wrong_matches_do_not_move_the_pose(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors], share: float
) -> None:
    index, descriptors = relief
    for _ in range(5):
        features = seen_from(
            rng, index.landmark_map, descriptors, TRUTH, noise_px=0.5, outliers=share
        )
        fix = located(features, index)
        error = TRUTH.local(fix.world_from_body)
        covariance = fix.noise_covariance + fix.own_map_covariance
        assert error @ np.linalg.solve(covariance, error) < 27.9
        assert fix.n_inliers == pytest.approx((1.0 - share) * len(features), rel=0.25)


def repeated_structure(rng: np.random.Generator) -> tuple[MapIndex, Descriptors]:
    """Return a map in which every landmark looks like another one elsewhere."""
    landmark_map = map_of(facade_scene(rng, 250, relief_m=4.0, n_views=2))
    n = len(landmark_map.points_world)
    order = np.argsort(landmark_map.points_world[:, 1])
    descriptors = np.empty((n, 61), np.uint8)
    descriptors[order] = np.resize(descriptors_of(rng, n // 2), (n, 61))
    return index_of(landmark_map, descriptors), descriptors


def test_a_prediction_finds_what_the_whole_map_cannot_tell_apart(
    rng: np.random.Generator,
) -> None:
    index, descriptors = repeated_structure(rng)
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH, noise_px=0.3)
    lost = localize(features, index)
    assert isinstance(lost, NotLocalized)
    assert "needed" in lost.reason
    prior = prior_at(perturbed(rng, TRUTH, 0.05, 0.003), 0.1, 0.005)
    fix = located(features, index, prior)
    assert fix.guided
    assert_pose_close(fix.world_from_body, TRUTH, within_m=0.05, within_rad=0.005, least_m=1e-5)


def test_a_wrong_prediction_that_look_alikes_confirm_is_found_out(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    # 0.5 m beside it: within reach of what guides, far outside what pixel noise explains.
    wrong = Pose(TRUTH.rotation, TRUTH.translation + np.array([0.0, 0.5, 0.0]))
    order = rng.permutation(len(descriptors))
    alike, others = np.split(order, [len(order) // 4])
    whole = index.landmark_map
    features = joined_features(
        [
            seen_from(
                rng,
                replace(
                    whole,
                    points_world=whole.points_world[those],
                    observed_px=whole.observed_px[those],
                ),
                descriptors[those],
                pose,
                noise_px=0.3,
            )
            for those, pose in ((others, TRUTH), (alike, wrong))
        ]
    )
    prior = prior_at(perturbed(rng, wrong, 0.05, 0.002), 0.15, 0.005)
    led = located(features, index, prior)
    assert not led.guided
    assert_pose_close(led.world_from_body, TRUTH, within_m=0.05, within_rad=0.005, least_m=1e-5)


@pytest.mark.parametrize(
    ("prior", "why"),
    [
        (prior_at(TRUTH, 5.0, 0.5), "too vague to guide"),
        (prior_at(Pose(TRUTH.rotation, np.array([1.0, 5.0, 2.0])), 0.01, 0.001), "wrong"),
        (prior_at(Pose(exp_so3(np.array([0.0, 0.0, np.pi])), np.zeros(3)), 0.1, 0.01), "behind"),
        (prior_at(Pose(TRUTH.rotation, np.array([500.0, 0.0, 0.0])), 0.1, 0.01), "past it"),
    ],
    ids=lambda p: p if isinstance(p, str) else "",
)
def test_a_prediction_that_does_not_help_is_no_harm(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors], prior: Prior, why: str
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    fix = located(features, index, prior)
    assert_pose_close(fix.world_from_body, TRUTH, within_m=1e-6, within_rad=1e-7)
    assert not fix.guided, why


def test_attitude_that_agrees_is_no_obstacle(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    for off_deg in ((4.0, 0.0, 0.0), (0.0, -4.0, 0.0), (0.0, 0.0, 20.0), (0.0, 0.0, -20.0)):
        attitude = matrix_from_euler(*np.deg2rad(off_deg)) @ TRUTH.rotation
        assert isinstance(localize(features, index, attitude=attitude), Localized)


@pytest.mark.parametrize(
    ("off_deg", "reason"),
    [
        ((8.0, 0.0, 0.0), "roll and pitch by 8 degrees"),
        ((0.0, -9.0, 0.0), "roll and pitch by 9 degrees"),
        ((0.0, 0.0, 30.0), "heading by 30 degrees"),
        ((0.0, 0.0, -170.0), "heading by 170 degrees"),
        ((180.0, 0.0, 0.0), "roll and pitch by 180 degrees"),
    ],
)
def test_a_pose_against_the_autopilot_s_attitude_is_refused(
    rng: np.random.Generator,
    relief: tuple[MapIndex, Descriptors],
    off_deg: tuple[float, float, float],
    reason: str,
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    attitude = matrix_from_euler(*np.deg2rad(off_deg)) @ TRUTH.rotation
    refused = localize(features, index, attitude=attitude)
    assert isinstance(refused, NotLocalized)
    assert reason in refused.reason
    assert refused.n_inliers == len(features)


def test_few_matches_are_refused(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    for n in (0, 1, 14):
        refused = localize(features.subset(np.arange(n)), index)
        assert refused == NotLocalized(f"{n} landmarks matched, 15 needed", n)


def test_an_image_of_another_place_is_refused(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, _ = relief
    pixels = rng.random((400, 2)) * (639.0, 479.0)
    refused = localize(Features(pixels, descriptors_of(rng, 400)), index)
    assert isinstance(refused, NotLocalized)
    assert "needed" in refused.reason


def test_matches_that_agree_on_nothing_are_refused(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    features = Features(rng.random((len(descriptors), 2)) * (639.0, 479.0), descriptors)
    refused = localize(features, index)
    assert isinstance(refused, NotLocalized)
    assert refused.n_matched > 200


def test_a_pose_too_uncertain_is_refused(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    refused = localize(features, index, options=LocalizationOptions(max_sigma_m=0.001))
    assert isinstance(refused, NotLocalized)
    assert refused.reason == "too uncertain: 0.0 m, 0.0 m allowed"
    assert refused.n_inliers == len(features)


def degenerate_places() -> dict[str, Array]:
    """Return (N, 3) landmarks that no pose can be told from, seen from (nearly) everywhere."""
    n = 60
    spread = np.linspace(-3.0, 3.0, n)[:, None]
    centre = np.array([12.0, 0.5, 0.3])
    return {
        "one point": centre + np.zeros((n, 3)),
        "a line": centre + spread * [0.0, 1.0, 0.2],
        "a line of sight": np.array([1.0, 0.04, 0.02]) * (10.0 + spread),
        "two points": centre + np.where(spread > 0, 1.0, -1.0) * [0.0, 1.0, 0.0],
        "far beyond": centre * 3e4 + spread * [0.0, 1.0, 0.5],
    }


@pytest.mark.parametrize("place", degenerate_places())
@pytest.mark.parametrize("guided", [False, True])
def test_degenerate_landmarks_are_refused(
    rng: np.random.Generator,
    relief: tuple[MapIndex, Descriptors],
    place: str,
    guided: bool,
) -> None:
    index, _ = relief
    points = degenerate_places()[place]
    n = len(points)
    descriptors = descriptors_of(rng, n)
    m = index.landmark_map
    flat = replace(
        index,
        landmark_map=replace(m, points_world=points, observed_px=m.observed_px[:n]),
        uncertainty=replace(
            index.uncertainty,
            landmark_covariance=index.uncertainty.landmark_covariance[:n],
            landmark_lever=index.uncertainty.landmark_lever[:n],
        ),
        landmark_covariances=index.landmark_covariances[:n],
        entries=Features(np.zeros((n, 2)), descriptors),
        owner=np.arange(n),
    )
    features = seen_from(rng, flat.landmark_map, descriptors, TRUTH, noise_px=0.3)
    prior = prior_at(TRUTH, 0.05, 0.005) if guided else None
    assert isinstance(localize(features, flat, prior), NotLocalized)


def test_a_landmark_known_to_nothing_along_its_ray_is_no_harm(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    vague = index.landmark_covariances.copy()
    ray = index.landmark_map.points_world[::7]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    vague[::7] = 1e12 * ray[:, :, None] * ray[:, None, :]
    own = index.uncertainty.landmark_covariance.copy()
    own[::7] = vague[::7]
    unsure = replace(
        index,
        landmark_covariances=vague,
        uncertainty=replace(index.uncertainty, landmark_covariance=own),
    )
    features = seen_from(rng, index.landmark_map, descriptors, TRUTH)
    fix = located(features, unsure)
    assert_pose_close(fix.world_from_body, TRUTH, within_m=1e-5, within_rad=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_landmark_that_may_lie_at_the_lens_agrees_with_nothing(seed: int) -> None:
    # Its own error moves it across the whole image: whatever it is matched to would agree, and
    # nothing fixes a pose as much as what is so near.
    rng = np.random.default_rng(seed)
    landmark_map = flat_map(rng, 6.0, 90)
    descriptors = descriptors_of(rng, 90)
    index = index_of(landmark_map, descriptors)
    truth = Pose(TRUTH.rotation, np.array([-6.0, 0.8, -0.3]))
    features = seen_from(rng, landmark_map, descriptors, truth, noise_px=0.3)
    expected = located(features, index, options=UNBIASED)
    here = rng.choice(90, 12, replace=False)
    rays = np.column_stack([rng.uniform(-0.2, 0.2, (12, 2)), np.ones(12)])
    points, own = landmark_map.points_world.copy(), index.uncertainty.landmark_covariance.copy()
    world_from_cam = truth @ landmark_map.keyframes[0].body_from_cam
    points[here] = world_from_cam.apply(rng.uniform(-0.6, 0.3, (12, 1)) * rays)
    own[here] = 0.15**2 * np.eye(3)
    whole = index.landmark_covariances.copy()
    whole[here] += own[here]
    near = replace(
        index,
        landmark_map=replace(landmark_map, points_world=points),
        uncertainty=replace(index.uncertainty, landmark_covariance=own),
        landmark_covariances=whole,
    )
    fix = located(features, near, options=UNBIASED)
    assert_pose_close(fix.world_from_body, expected.world_from_body, within_m=0.05, within_rad=3e-3)


def test_a_feature_where_the_lens_model_has_no_inverse_is_left_out(
    rng: np.random.Generator, relief: tuple[MapIndex, Descriptors]
) -> None:
    index, descriptors = relief
    barrel = Camera(640, 480, 320.0, 320.0, 319.5, 239.5, "radial-tangential", (-0.4, 0, 0, 0))
    mounting = index.landmark_map.keyframes[0].body_from_cam
    cam = index.landmark_map.points_world
    points_cam = (TRUTH @ mounting).inverse().apply(cam)
    central = np.flatnonzero(np.hypot(points_cam[:, 0], points_cam[:, 1]) < 0.6 * points_cam[:, 2])
    pixels = barrel.project(points_cam[central])
    lost = np.setdiff1d(np.arange(len(cam)), central)[:10]
    corner = rng.random((len(lost), 2)) * 5.0
    features = Features(
        np.vstack([corner, pixels]), np.vstack([descriptors[lost], descriptors[central]])
    )
    fix = localize_intra(features, barrel, mounting, index, None, None, OPTIONS)
    assert isinstance(fix, Localized), fix
    assert_pose_close(fix.world_from_body, TRUTH, within_m=1e-6, within_rad=1e-7)
    assert fix.n_inliers == len(central)


@pytest.mark.parametrize(
    "name",
    [
        "guided_radius_px",
        "noise_floor_px",
        "bias_px_per_deg",
        "bias_px_per_octave",
        "max_sigma_m",
        "max_tilt_deg",
        "max_heading_deg",
    ],
)
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_options_must_be_positive(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must be positive"):
        LocalizationOptions(**{name: value})  # type: ignore[arg-type]


def test_a_pose_needs_six_inliers() -> None:
    with pytest.raises(ValueError, match="min_inliers must be at least 6"):
        LocalizationOptions(min_inliers=5)
