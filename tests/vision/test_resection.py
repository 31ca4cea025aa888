from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.checks import assert_consistent, assert_pose_close, nees
from tests.scenes import (
    CAMERAS,
    PINHOLE,
    Scene,
    facade_scene,
    observe,
    perturbed,
)
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD
from vcl_companion.vision.resection import (
    NotFound,
    Resection,
    ResectionOptions,
    Sightings,
    Undecided,
    refine,
    search,
)

OPTIONS = ResectionOptions()


def sightings_of(scene: Scene, points: Array | None = None, sigma_m: float = 0.0) -> Sightings:
    """What the second view saw; the landmarks as the map has them, give or take ``sigma_m``."""
    seen = scene.seen[:, 1]
    n = int(seen.sum())
    return Sightings(
        scene.ideal[seen, 1],
        (scene.points_world if points is None else points)[seen],
        np.tile(sigma_m**2 * np.eye(3), (n, 1, 1)),
        scene.camera.focal_px,
        scene.slopes[seen, 1],
        scene.mountings[1],
        max(scene.noise_px, 0.3),
        np.zeros(n),
    )


def found(result: Resection | NotFound) -> Resection:
    assert isinstance(result, Resection), result.reason
    return result


def wrong_of(scene: Scene) -> NDArray[np.bool_]:
    return np.asarray(scene.wrong[scene.seen[:, 1], 1])


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.distortion_model)
@pytest.mark.parametrize("relief_m", [0.0, 3.0])
def test_exact_sightings_give_the_exact_pose(camera: Camera, relief_m: float) -> None:
    rng = np.random.default_rng(1)
    scene = facade_scene(rng, 120, relief_m, camera=camera, lever_arm_m=0.4)
    start = perturbed(rng, scene.bodies[1], 0.1, 0.01)
    result = found(refine(start, sightings_of(scene), OPTIONS))
    assert_pose_close(result.world_from_body, scene.bodies[1], within_m=1e-6, within_rad=1e-7)
    # A corner of the fisheye may go: in the ideal plane, far outside, it has great leverage.
    assert result.inliers.mean() > (0.95 if camera.distortion_model == "equidistant" else 0.999)
    assert result.rms_px < 1e-4


@pytest.mark.parametrize("relief_m", [0.0, 3.0])
def test_covariance_is_that_of_many_noise_draws(relief_m: float) -> None:
    errors, covariances = [], []
    for seed in range(300):
        scene = facade_scene(np.random.default_rng(seed), 200, relief_m, noise_px=0.7)
        result = found(refine(scene.bodies[1], sightings_of(scene), OPTIONS))
        errors.append(scene.bodies[1].local(result.world_from_body))
        covariances.append(result.noise_covariance)
        assert 0.85 * 0.7 * 2**0.5 < result.rms_px < 1.15 * 0.7 * 2**0.5
    # Tight enough to see the 11 % of the variance that the robust weights cost.
    assert_consistent(errors, np.array(covariances), confidence=0.99)


def test_detector_bias_is_part_of_the_uncertainty() -> None:
    errors, covariances = [], []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        scene = facade_scene(rng, 150, 3.0, noise_px=0.4)
        sightings = sightings_of(scene)
        bias_px = rng.uniform(0.2, 2.0, len(sightings.points))
        moved = bias_px[:, None] * rng.standard_normal((len(bias_px), 2)) / sightings.focal_px
        sightings = replace(sightings, ideal=sightings.ideal + moved, bias_px=bias_px)
        result = found(refine(scene.bodies[1], sightings, OPTIONS))
        errors.append(scene.bodies[1].local(result.world_from_body))
        covariances.append(result.noise_covariance + result.bias_covariance)
    assert_consistent(errors, np.array(covariances), slack=1.1)


def test_gain_carries_the_landmarks_errors_over_to_the_pose() -> None:
    errors, covariances = [], []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        scene = facade_scene(rng, 150, 3.0, noise_px=0.4)
        sigma_m = 0.03
        points = scene.points_world + sigma_m * rng.standard_normal(scene.points_world.shape)
        result = found(refine(scene.bodies[1], sightings_of(scene, points, sigma_m), OPTIONS))
        by_landmark = result.gain @ result.jacobian_points
        own = sigma_m**2 * (by_landmark @ np.swapaxes(by_landmark, 1, 2)).sum(axis=0)
        errors.append(scene.bodies[1].local(result.world_from_body))
        covariances.append(result.noise_covariance + own)
    # ``own`` lacks what robust weights cost (11 % of the variance).
    assert_consistent(errors, np.array(covariances), slack=1.15)


def test_gain_is_the_poses_answer_to_one_residual() -> None:
    scene = facade_scene(np.random.default_rng(2), 60, 3.0)
    sightings = sightings_of(scene)
    at_rest = found(refine(scene.bodies[1], sightings, OPTIONS))
    for j, axis in ((0, 0), (17, 1)):
        ideal = sightings.ideal.copy()
        ideal[j, axis] -= 0.01 / sightings.focal_px  # projected minus seen grows by 0.01 px
        pushed = found(refine(scene.bodies[1], replace(sightings, ideal=ideal), OPTIONS))
        answer = at_rest.world_from_body.local(pushed.world_from_body)
        np.testing.assert_allclose(
            answer, -0.01 * at_rest.gain[j, :, axis], rtol=1e-2, atol=1e-3 * np.abs(answer).max()
        )


def test_a_bad_depth_does_not_pull_when_it_is_known_to_be_bad() -> None:
    rng = np.random.default_rng(3)
    scene = facade_scene(rng, 120, 3.0, noise_px=0.3)
    origin = scene.worlds_from_cams[0].translation
    ray = scene.points_world - origin
    bad = np.arange(len(ray)) % 2 == 0
    points = np.where(bad[:, None], origin + 1.3 * ray, scene.points_world)
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    along = np.where(bad, 4.0, 0.01)[:, None, None] ** 2 * np.einsum(
        "ni,nj->nij", direction, direction
    )
    sightings = sightings_of(scene, points)
    aware = replace(sightings, point_covariances=along[scene.seen[:, 1]])
    result = found(refine(scene.bodies[1], aware, OPTIONS))
    error = scene.bodies[1].local(result.world_from_body)
    assert 1e-3 < np.linalg.norm(error[:3]) < 0.1
    assert result.inliers.all()


@pytest.mark.parametrize("relief_m", [0.0, 0.5, 3.0])
def test_half_of_the_matches_may_be_wrong(relief_m: float) -> None:
    errors, covariances = [], []
    for seed in range(12):
        scene = facade_scene(np.random.default_rng(seed), 150, relief_m, noise_px=0.5, outliers=0.5)
        sightings = sightings_of(scene)
        start = search(sightings, OPTIONS)
        assert isinstance(start, Pose), start
        assert_pose_close(start, scene.bodies[1], within_m=0.6, within_rad=0.05)
        result = found(refine(start, sightings, OPTIONS))
        wrong = wrong_of(scene)
        assert result.inliers[~wrong].mean() > 0.98
        assert result.inliers[wrong].sum() <= 2
        errors.append(scene.bodies[1].local(result.world_from_body))
        covariances.append(result.noise_covariance)
    assert_consistent(errors, np.array(covariances), slack=1.2)


@pytest.mark.parametrize("camera", CAMERAS[:3], ids=lambda c: c.distortion_model)
def test_everything_a_found_pose_rests_on_is_in_front_of_it(camera: Camera) -> None:
    for seed in range(6):
        scene = facade_scene(
            np.random.default_rng(seed), 100, 0.0, camera=camera, noise_px=0.5, outliers=0.4
        )
        sightings = sightings_of(scene)
        start = search(sightings, OPTIONS)
        assert isinstance(start, Pose), start
        result = found(refine(start, sightings, OPTIONS))
        cam_from_world = (result.world_from_body @ sightings.body_from_cam).inverse()
        assert (cam_from_world.apply(sightings.points[result.inliers])[:, 2] > 0.0).all()


def test_a_pose_that_looks_the_other_way_is_refused() -> None:
    scene = facade_scene(np.random.default_rng(4), 100, 2.0)
    turned = scene.bodies[1].retracted(np.array([0.0, 0.0, 0.0, 0.0, 0.0, np.pi]))
    assert isinstance(refine(turned, sightings_of(scene), OPTIONS), NotFound)


def flat_scene_with_one_landmark_off_it(
    rng: np.random.Generator, shift_px: float
) -> tuple[Sightings, Pose]:
    """A small flat patch far away, which leaves sideways and yaw hard to tell apart, and one
    landmark half way there that was matched ``shift_px`` beside its place; it comes last.
    """
    points = np.column_stack([np.full(60, 25.0), rng.uniform(-3.0, 3.0, (60, 2))])
    points = np.vstack([points, [13.0, 1.0, -1.0]])
    mounting = Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
    truth = Pose.identity()
    scene = observe(rng, points, (truth, truth), (mounting, mounting), PINHOLE, noise_px=0.3)
    scene.observed_px[-1, 1, 0] += shift_px
    return sightings_of(scene), truth


@pytest.mark.parametrize("shift_px", [0.0, 3.0, 8.0, 15.0])
def test_one_landmark_off_a_flat_scene_does_not_decide(shift_px: float) -> None:
    errors, covariances = [], []
    for seed in range(20):
        sightings, truth = flat_scene_with_one_landmark_off_it(
            np.random.default_rng(seed), shift_px
        )
        result = found(refine(truth, sightings, OPTIONS))
        assert not result.inliers[-1]
        assert result.inliers[:-1].mean() > 0.9
        errors.append(truth.local(result.world_from_body))
        covariances.append(result.noise_covariance)
    assert float(np.sqrt(np.trace(covariances[0][:3, :3]))) > 0.3  # honest: hardly known without it
    assert_consistent(errors, np.array(covariances), slack=1.5)  # far from linear


def test_what_does_not_stand_without_one_landmark_is_undecided_and_says_where_it_would_be() -> None:
    sightings, truth = flat_scene_with_one_landmark_off_it(np.random.default_rng(3), 0.0)
    last = np.r_[:14, 60]
    few = replace(
        sightings, ideal=sightings.ideal[last], points=sightings.points[last],
        point_covariances=sightings.point_covariances[last], bias_px=sightings.bias_px[last],
        slopes=sightings.slopes[last],
    )  # fmt: skip
    result = refine(truth, few, OPTIONS)
    assert isinstance(result, Undecided)
    assert result.reason == "14 landmarks left, 15 needed"
    error = truth.local(result.found.world_from_body)
    assert np.linalg.norm(error[:3]) < 4.0 * np.sqrt(
        np.trace(result.found.noise_covariance[:3, :3])
    )


def test_few_landmarks_are_refused_with_a_reason() -> None:
    scene = facade_scene(np.random.default_rng(5), 100, 3.0)
    sightings = sightings_of(scene)
    few = replace(
        sightings, ideal=sightings.ideal[:14], points=sightings.points[:14],
        point_covariances=sightings.point_covariances[:14], bias_px=sightings.bias_px[:14],
    )  # fmt: skip
    for result in (search(few, OPTIONS), refine(scene.bodies[1], few, OPTIONS)):
        assert result == NotFound("14 landmarks matched, 15 needed")


def test_pure_noise_is_refused() -> None:
    rng = np.random.default_rng(6)
    for _ in range(5):
        scene = facade_scene(rng, 100, 3.0, outliers=1.0)
        sightings = sightings_of(scene)
        start = search(sightings, OPTIONS)
        if isinstance(start, Pose):
            assert isinstance(refine(start, sightings, OPTIONS), NotFound)


def test_a_bad_row_costs_only_itself() -> None:
    scene = facade_scene(np.random.default_rng(7), 100, 3.0)
    sightings = sightings_of(scene)
    ideal, points = sightings.ideal.copy(), sightings.points.copy()
    covariances = sightings.point_covariances.copy()
    ideal[3, 1] = points[5, 0] = covariances[7, 2, 2] = np.nan
    holed = replace(sightings, ideal=ideal, points=points, point_covariances=covariances)
    start = search(holed, OPTIONS)
    assert isinstance(start, Pose)
    result = found(refine(start, holed, OPTIONS))
    assert_pose_close(result.world_from_body, scene.bodies[1], within_m=1e-5, within_rad=1e-6)
    np.testing.assert_array_equal(np.flatnonzero(~result.inliers), [3, 5, 7])


def test_degenerate_sightings_are_refused_and_raise_nothing() -> None:
    scene = facade_scene(np.random.default_rng(8), 60, 3.0)
    good = sightings_of(scene)
    n = len(good.points)
    line = np.column_stack([np.full(n, 10.0), np.linspace(-5.0, 5.0, n), np.zeros(n)])
    one_place = np.tile([10.0, 0.0, 0.0], (n, 1))
    cases = {
        "one landmark": replace(good, points=one_place),
        "one pixel": replace(good, ideal=np.zeros((n, 2))),
        "one match": replace(good, points=one_place, ideal=np.zeros((n, 2))),
        "a line": replace(good, points=line),
        "all unseen": replace(good, ideal=np.full((n, 2), np.nan)),
        "unplaced": replace(good, points=np.full((n, 3), np.nan)),
        "unknown": replace(good, point_covariances=np.full((n, 3, 3), np.nan)),
        "nothing": Sightings(
            good.ideal[:0], good.points[:0], good.point_covariances[:0], 320.0,
            good.slopes[:0], good.body_from_cam, 0.5, good.bias_px[:0],
        ),
    }  # fmt: skip
    at_it = Pose(scene.bodies[1].rotation, np.array([9.9999, 0.0, 0.0]))
    for name, sightings in cases.items():
        start = search(sightings, OPTIONS)
        guesses = [scene.bodies[1], Pose.identity(), at_it]
        guesses += [start] if isinstance(start, Pose) else []
        for guess in guesses:
            result = refine(guess, sightings, OPTIONS)
            assert isinstance(result, NotFound), name
            assert result.reason, name


def test_the_same_sightings_give_the_same_pose() -> None:
    scene = facade_scene(np.random.default_rng(9), 120, 2.0, noise_px=0.5, outliers=0.4)
    one, two = (search(sightings_of(scene), OPTIONS) for _ in range(2))
    assert isinstance(one, Pose)
    assert isinstance(two, Pose)
    np.testing.assert_array_equal(one.matrix(), two.matrix())


def test_covariance_grows_with_the_square_of_the_noise() -> None:
    scene = facade_scene(np.random.default_rng(10), 100, 3.0)
    one, two = (
        found(refine(scene.bodies[1], replace(sightings_of(scene), noise_px=px), OPTIONS))
        for px in (0.5, 1.0)
    )
    np.testing.assert_allclose(two.noise_covariance, 4.0 * one.noise_covariance, rtol=1e-6)
    assert nees(np.full(6, 1e-3), one.noise_covariance)[0] > 0.0


@pytest.mark.parametrize("bad", [{"min_inliers": 5}, {"max_samples": 9}], ids=str)
def test_senseless_options_are_errors(bad: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="resection needs"):
        ResectionOptions(**bad)


@pytest.mark.parametrize("noise_px", [0.0, -1.0, float("nan")])
def test_no_noise_at_all_is_an_error(noise_px: float) -> None:
    scene = facade_scene(np.random.default_rng(11), 30)
    with pytest.raises(ValueError, match="noise_px must be positive"):
        replace(sightings_of(scene), noise_px=noise_px)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.distortion_model)
def test_a_distorted_lens_s_noise_is_weighed_in_pixels(camera: Camera) -> None:
    errors, covariances = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        scene = facade_scene(rng, 150, 2.0, noise_px=0.5, camera=camera)
        result = found(refine(scene.bodies[1], sightings_of(scene), OPTIONS))
        errors.append(scene.bodies[1].local(result.world_from_body))
        covariances.append(result.noise_covariance)
    assert_consistent(errors, np.array(covariances), slack=1.1)
