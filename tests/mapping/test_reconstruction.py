"""The first map: metric, in the leader's world, as good as it says, or refused with a reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent, assert_pose_close
from tests.mapping.views import (
    LEADER_ATTITUDE,
    descriptors_of,
    drone_views,
    map_of,
    world_from_scene,
)
from tests.scenes import (
    PINHOLE,
    RADIAL_TANGENTIAL,
    RADIAL_TANGENTIAL_5,
    Scene,
    facade_scene,
    observe,
)
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.relative_attitude import RelativeAttitude
from vcl_companion.geometry.rotation import Array, about_down, exp_so3
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import MapOptions, NoMap, accepted, reconstruct
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.visibility import choose_hypothesis
from vcl_companion.vision.essential import RelativePose
from vcl_companion.vision.features import Features

OPTIONS = MapOptions(detectors=("akaze",))


def built(
    rng: np.random.Generator,
    scene: Scene,
    *,
    options: MapOptions = OPTIONS,
    distance_error_m: float = 0.0,
    attitude_sigma_rad: float = 0.02,
) -> LandmarkMap:
    ids = list(range(1, scene.n_views + 1))
    views = drone_views(rng, scene, ids, attitude_sigma_rad=attitude_sigma_rad)
    known = [(1, 2, scene.baseline_m(0, 1) + distance_error_m)]
    landmark_map = reconstruct(views, 1, known, options)
    assert isinstance(landmark_map, LandmarkMap), landmark_map
    return landmark_map


def refusal(views: list[DroneView], leader: int, known: list[tuple[int, int, float]]) -> str:
    result = reconstruct(views, leader, known, OPTIONS)
    assert isinstance(result, NoMap)
    return result.reason


def landmarks_of(scene: Scene, landmark_map: LandmarkMap) -> Array:
    """Return (N,) which landmark of the scene each of the map's is, by its pixels."""
    first = scene.observed_px[:, 0]
    gap = np.linalg.norm(first[None] - landmark_map.observed_px[:, :1], axis=2)
    index = np.nanargmin(gap, axis=1)
    assert np.all(gap[np.arange(len(index)), index] == 0.0)
    return np.asarray(index)


@pytest.mark.parametrize(
    ("n_views", "camera"),
    [(2, RADIAL_TANGENTIAL), (3, PINHOLE)],
    ids=["two, distorted", "three, pinhole"],
)
def test_without_noise_the_map_is_exact(n_views: int, camera: Camera) -> None:
    rng = np.random.default_rng(0)
    scene = facade_scene(rng, n_views=n_views, camera=camera)
    landmark_map = built(rng, scene)
    assert [k.drone_id for k in landmark_map.keyframes] == list(range(1, n_views + 1))
    for keyframe, body in zip(landmark_map.keyframes, scene.bodies, strict=True):
        truth = world_from_scene() @ body
        assert_pose_close(keyframe.world_from_body, truth, within_m=1e-6, within_rad=1e-7)
    points = world_from_scene().apply(scene.points_world[landmarks_of(scene, landmark_map)])
    np.testing.assert_allclose(landmark_map.points_world, points, atol=1e-5)
    assert len(points) > 150


def test_the_leader_is_the_origin_with_the_attitude_of_its_autopilot() -> None:
    rng = np.random.default_rng(1)
    scene = facade_scene(rng, n_views=3, noise_px=0.3)
    views = drone_views(rng, scene, [7, 3, 5], attitude_sigma_rad=0.02)
    landmark_map = reconstruct([views[2], views[0], views[1]], 7, [(3, 5, 4.0)], OPTIONS)
    assert isinstance(landmark_map, LandmarkMap)
    first = landmark_map.keyframes[0]
    assert first.drone_id == 7
    assert first.image_bytes == b"image 7"
    assert first.captured_at_ns == 1_000_000
    leader = Pose(LEADER_ATTITUDE, np.zeros(3))
    assert_pose_close(first.world_from_body, leader, within_m=1e-12, within_rad=1e-12)
    assert landmark_map.parent == b""
    assert landmark_map.detectors == ("akaze",)


def test_keyframes_and_landmarks_err_as_much_as_stated() -> None:
    rng = np.random.default_rng(2)
    poses, pose_sigma, points, point_sigma, noises = [], [], [], [], []
    for draw in range(16):
        n_views = 2 + draw % 2
        scene = facade_scene(rng, 100, relief_m=4.0, n_views=n_views, noise_px=0.6)
        error_m = OPTIONS.distance_sigma_m * float(rng.standard_normal())
        found = built(rng, scene, distance_error_m=error_m)
        uncertainty = map_uncertainty(found)
        i = n_views - 1
        truth = world_from_scene() @ scene.bodies[i]
        poses.append(truth.local(found.keyframes[i].world_from_body))
        pose_sigma.append(uncertainty.keyframe_covariance[6 * i :, 6 * i :])
        j = int(rng.integers(len(found.points_world)))
        place = world_from_scene().apply(scene.points_world[landmarks_of(scene, found)[j]])
        points.append(found.points_world[j] - place)
        point_sigma.append(uncertainty.marginal()[j])
        noises.append(found.pixel_noise_px)
    assert np.mean(noises) == pytest.approx(0.6, rel=0.1)
    # The pixel noise is estimated, and features are refused by it: not exactly chi-square.
    assert_consistent(poses, pose_sigma, slack=1.25)
    assert_consistent(points, point_sigma, slack=1.25)


@pytest.mark.parametrize("distance_m", [0.5, 2.0, 40.0])
def test_metres_come_from_the_known_distance(distance_m: float) -> None:
    rng = np.random.default_rng(3)
    scene = facade_scene(rng, noise_px=0.3, lever_arm_m=0.0)
    views = drone_views(rng, scene, [1, 2])
    landmark_map = reconstruct(views, 1, [(2, 1, distance_m)], OPTIONS)
    assert isinstance(landmark_map, LandmarkMap)
    a, b = (k.world_from_body.translation for k in landmark_map.keyframes)
    assert float(np.linalg.norm(a - b)) == pytest.approx(distance_m, abs=1e-3)
    depth = float(np.median(np.linalg.norm(landmark_map.points_world, axis=1)))
    truth = float(np.median(np.linalg.norm(scene.points_world, axis=1)))
    assert depth == pytest.approx(truth * distance_m / scene.baseline_m(0, 1), rel=0.02)


@pytest.mark.parametrize("lever_arm_m", [0.3, 2.0])
def test_a_lever_arm_is_metres_however_far_apart_the_drones_are(lever_arm_m: float) -> None:
    """Before the scale is known the baseline has length one; a lever arm is metres all along."""
    for seed in range(2):
        rng = np.random.default_rng(seed)
        scene = facade_scene(
            rng, relief_m=20.0, distance_m=80.0, baseline_m=20.0, lever_arm_m=lever_arm_m
        )
        found = built(rng, scene).keyframes[1].world_from_body
        truth = world_from_scene() @ scene.bodies[1]
        assert_pose_close(found, truth, within_m=1e-5, within_rad=1e-6)


def test_several_known_distances_are_better_than_one() -> None:
    rng = np.random.default_rng(4)
    scene = facade_scene(rng, n_views=3, noise_px=0.5, relief_m=4.0)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    pairs = [(1, 2, scene.baseline_m(0, 1)), (1, 3, scene.baseline_m(0, 2))]
    sigma = []
    for known in (pairs[:1], pairs):
        found = reconstruct(views, 1, known, OPTIONS)
        assert isinstance(found, LandmarkMap)
        assert len(found.distances) == len(known)
        sigma.append(np.trace(map_uncertainty(found).keyframe_covariance))
    assert sigma[1] < 0.95 * sigma[0]


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_known_distances_that_contradict_each_other_are_refused(factor: float) -> None:
    rng = np.random.default_rng(4)
    scene = facade_scene(rng, n_views=3, noise_px=0.5, relief_m=4.0)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    one, other = scene.baseline_m(0, 1), scene.baseline_m(0, 2)
    reason = refusal(views, 1, [(1, 2, one), (1, 3, factor * other)])
    assert "the known distances contradict each other" in reason
    assert "drones 1 and 2" in reason
    assert "drones 1 and 3" in reason or "between drones 3 and 1" in reason


@pytest.mark.parametrize("pair", [(1, 1, 2.0), (1, 2, 0.0), (1, 2, -2.0), (1, 2, float("nan"))])
def test_a_known_distance_that_is_none_is_refused(pair: tuple[int, int, float]) -> None:
    rng = np.random.default_rng(4)
    scene = facade_scene(rng, 100, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2])
    assert refusal(views, 1, [(1, 2, scene.baseline_m(0, 1)), pair]).endswith("is none")


def test_a_known_distance_to_a_stranger_is_ignored() -> None:
    rng = np.random.default_rng(4)
    scene = facade_scene(rng, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2])
    found = reconstruct(views, 1, [(1, 9, 100.0), (1, 2, scene.baseline_m(0, 1))], OPTIONS)
    assert isinstance(found, LandmarkMap)
    assert len(found.distances) == 1


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_wrong_matches_do_not_move_the_map(share: float) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scene = facade_scene(rng, 250, relief_m=3.0, noise_px=0.3, outliers=share)
        found = built(rng, scene)
        covariance = map_uncertainty(found).keyframe_covariance[6:, 6:]
        error = (world_from_scene() @ scene.bodies[1]).local(found.keyframes[1].world_from_body)
        # 99.99 % of chi-square with 6 degrees of freedom; one wrong landmark left in makes 200.
        assert error @ np.linalg.solve(covariance, error) < 27.9
        wrong = scene.wrong[landmarks_of(scene, found)].any(axis=1)
        assert wrong.sum() <= 2


def test_wrong_descriptors_do_not_move_the_map() -> None:
    """Matches between different places, not only displaced ones."""
    rng = np.random.default_rng(5)
    scene = facade_scene(rng, 250, relief_m=3.0, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2], attitude_sigma_rad=0.02)
    features = views[1].features[0]
    descriptors = features.descriptors.copy()
    mixed = rng.permutation(len(descriptors))[:60]
    descriptors[mixed] = descriptors[np.roll(mixed, 1)]
    views[1] = replace(views[1], features=(Features(features.pixels, descriptors),))
    found = reconstruct(views, 1, [(1, 2, scene.baseline_m(0, 1))], OPTIONS)
    assert isinstance(found, LandmarkMap)
    error = (world_from_scene() @ scene.bodies[1]).local(found.keyframes[1].world_from_body)
    covariance = map_uncertainty(found).keyframe_covariance[6:, 6:]
    assert error @ np.linalg.solve(covariance, error) < 27.9


def test_the_map_of_a_seed_is_one_map() -> None:
    rng = np.random.default_rng(6)
    scene = facade_scene(rng, n_views=3, noise_px=0.3, outliers=0.1)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    known = [(1, 2, scene.baseline_m(0, 1))]
    one, other = (reconstruct(views, 1, known, OPTIONS, seed=3) for _ in range(2))
    assert isinstance(one, LandmarkMap)
    assert isinstance(other, LandmarkMap)
    np.testing.assert_array_equal(one.points_world, other.points_world)
    np.testing.assert_array_equal(one.observed_px, other.observed_px)


def test_landmarks_that_the_leader_does_not_see_are_mapped_too() -> None:
    """A third drone shares some with the second one only: placed once it is registered."""
    rng = np.random.default_rng(7)
    scene = facade_scene(rng, n_views=3, noise_px=0.2, missed=0.2)
    found = built(rng, scene)
    both = scene.seen[:, 1] & scene.seen[:, 2] & ~scene.seen[:, 0]
    mapped = found.seen[:, 1] & found.seen[:, 2] & ~found.seen[:, 0]
    assert both.sum() > 20
    assert mapped.sum() > 0.8 * both.sum()


def test_a_drone_that_overlaps_nobody_is_left_out() -> None:
    rng = np.random.default_rng(7)
    scene = facade_scene(rng, n_views=3, noise_px=0.3, camera=RADIAL_TANGENTIAL_5)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    foreign = views[2].features[0]
    unknown = Features(foreign.pixels, descriptors_of(rng, len(foreign)))
    views[2] = replace(views[2], features=(unknown,))
    found = reconstruct(views, 1, [(1, 2, scene.baseline_m(0, 1))], OPTIONS)
    assert isinstance(found, LandmarkMap)
    assert [k.drone_id for k in found.keyframes] == [1, 2]
    assert found.observed_px.shape[1] == 2


def test_a_drone_whose_camera_sees_nothing_is_left_out() -> None:
    rng = np.random.default_rng(7)
    scene = facade_scene(rng, n_views=3, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    nothing = Features(np.zeros((0, 2)), np.zeros((0, 61), np.uint8))
    views[1] = replace(views[1], features=(nothing,))
    found = reconstruct(views, 1, [(1, 3, scene.baseline_m(0, 2))], OPTIONS)
    assert isinstance(found, LandmarkMap)
    assert [k.drone_id for k in found.keyframes] == [1, 3]


def test_features_where_the_lens_model_has_no_inverse_are_no_landmarks() -> None:
    """The corners of a strong barrel distortion: one of them must not poison all others."""
    barrel = Camera(640, 480, 320.0, 320.0, 319.5, 239.5, "radial-tangential", (-0.4, 0, 0, 0))
    rng = np.random.default_rng(8)
    scene = facade_scene(rng, 150, noise_px=0.2)
    ideal = np.hypot(*(scene.ideal[:, 0].T))
    central = scene.points_world[ideal < 0.6]
    scene = observe(rng, central, scene.bodies, scene.mountings, barrel, noise_px=0.2)
    views = drone_views(rng, scene, [1, 2], attitude_sigma_rad=0.02)
    corners = descriptors_of(rng, 5)
    where = rng.random((5, 2)) * 4.0
    views = [
        replace(
            v,
            features=(
                Features(
                    np.vstack([v.features[0].pixels, where]),
                    np.vstack([v.features[0].descriptors, corners]).astype(np.uint8),
                ),
            ),
        )
        for v in views
    ]
    assert np.all(np.isnan(barrel.ideal_from_pixels(where)))
    few = replace(OPTIONS, min_landmarks=30)
    found = reconstruct(views, 1, [(1, 2, scene.baseline_m(0, 1))], few)
    assert isinstance(found, LandmarkMap), found
    truth = world_from_scene() @ scene.bodies[1]
    assert_pose_close(found.keyframes[1].world_from_body, truth, within_m=0.1, within_rad=0.01)
    assert np.nanmin(found.observed_px) > 4.0


def test_two_detectors_make_one_map() -> None:
    rng = np.random.default_rng(9)
    scene = facade_scene(rng, 240, noise_px=0.3)
    half = []
    for parity in (0, 1):
        mine = (np.arange(240) % 2 == parity)[:, None, None]
        part = replace(scene, observed_px=np.where(mine, scene.observed_px, np.nan))
        half.append(drone_views(rng, part, [1, 2]))
    views = [
        replace(a, features=(a.features[0], b.features[0])) for a, b in zip(*half, strict=True)
    ]
    found = reconstruct(views, 1, [(1, 2, scene.baseline_m(0, 1))], MapOptions())
    assert isinstance(found, LandmarkMap)
    assert found.detectors == ("akaze", "sift")
    assert len(found.points_world) > 0.8 * scene.seen.all(axis=1).sum()


def diagonal_flat_scene(rng: np.random.Generator, baseline_m: float) -> Scene:
    """A wall without relief, seen by drones diagonally behind each other: two relative poses."""
    flat = facade_scene(rng, relief_m=0.0)
    second = Pose(np.eye(3), baseline_m * np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0))
    bodies = (Pose.identity(), second)
    return observe(rng, flat.points_world, bodies, flat.mountings, PINHOLE, noise_px=0.3)


def test_attitude_decides_between_planar_twins() -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scene = diagonal_flat_scene(rng, 4.0)
        found = built(rng, scene, attitude_sigma_rad=0.02)
        truth = world_from_scene() @ scene.bodies[1]
        found_pose = found.keyframes[1].world_from_body
        assert_pose_close(found_pose, truth, within_m=0.1, within_rad=0.01, least_m=1e-4)


@pytest.mark.parametrize("baseline_m", [4.0, 1.2])
def test_planar_twins_without_attitude_are_refused(baseline_m: float) -> None:
    """The shorter the baseline the less the twins are turned, and yet one is far off."""
    rng = np.random.default_rng(1)
    scene = diagonal_flat_scene(rng, baseline_m)
    views = drone_views(rng, scene, [1, 2], attitudes=False)
    reason = refusal(views, 1, [(1, 2, scene.baseline_m(0, 1))])
    assert "drones 1 and 2: two relative poses" in reason
    assert "a flat scene" in reason


def test_drones_that_know_no_north_make_the_leader_s_map() -> None:
    """Each says 0 however it stands; what they see says how they stand to each other."""
    rng = np.random.default_rng(6)
    scene = facade_scene(rng, n_views=3, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.005)
    turned = []
    for view, turn_deg in zip(views, (0.0, 150.0, -40.0), strict=True):
        assert view.ned_from_body is not None
        attitude = about_down(np.deg2rad(turn_deg)) @ view.ned_from_body
        turned.append(replace(view, ned_from_body=attitude))
    known = [(1, 2, scene.baseline_m(0, 1))]
    northless = [turned[0], *(replace(view, has_heading=False) for view in turned[1:])]
    made, as_known = (reconstruct(some, 1, known, OPTIONS) for some in (northless, views))
    assert isinstance(made, LandmarkMap)
    assert isinstance(as_known, LandmarkMap)
    assert len(made.keyframes) == len(as_known.keyframes) == 3
    for one, other in zip(made.keyframes, as_known.keyframes, strict=True):
        assert_pose_close(
            one.world_from_body, other.world_from_body, within_m=0.02, within_rad=1e-3
        )


def test_a_pose_that_only_tilts_wrongly_is_told_by_the_vertical() -> None:
    """Between twins that differ in the vertical, no north is needed to choose."""
    tilted = exp_so3(np.deg2rad([20.0, 0.0, 0.0]))
    level = RelativeAttitude(about_down(2.0), np.eye(3), has_heading=False)
    assert level.b_from_a is None
    assert level.off_rad(about_down(-1.0)) == pytest.approx(0.0, abs=1e-9)
    assert level.off_rad(about_down(0.7) @ tilted) == pytest.approx(np.deg2rad(20.0), abs=1e-9)


def hypothesis(rotation_deg: float, shift_deg: float, cost: float) -> RelativePose:
    shift = np.deg2rad(shift_deg)
    pose = Pose(
        exp_so3(np.deg2rad([0.0, rotation_deg, 0.0])),
        np.array([np.cos(shift), 0.0, np.sin(shift)]),
    )
    return RelativePose(pose, np.ones(100, dtype=bool), cost)


def test_the_choice_weighs_cost_and_attitude() -> None:
    right, twin = hypothesis(0.0, 0.0, 55.0), hypothesis(20.0, 50.0, 50.0)
    sigma = np.deg2rad(4.0)
    alike = RelativeAttitude(np.eye(3), np.eye(3))
    turned = RelativeAttitude(exp_so3(np.deg2rad([0.0, 20.0, 0.0])), np.eye(3))
    assert choose_hypothesis([twin, right], alike, sigma) is right
    assert choose_hypothesis([twin, right], turned, sigma) is twin
    assert isinstance(choose_hypothesis([twin, right], None, sigma), NoMap)
    clearly = hypothesis(20.0, 50.0, 20.0)
    assert choose_hypothesis([clearly, right], None, sigma) is clearly
    # Ten sigma of the attitudes outweigh any small advantage of cost.
    assert choose_hypothesis([hypothesis(40.0, 50.0, 20.0), right], alike, sigma) is right


def test_hypotheses_that_hardly_differ_are_no_reason_to_refuse() -> None:
    one, same = hypothesis(0.0, 0.0, 50.0), hypothesis(1.0, 5.0, 51.0)
    assert choose_hypothesis([one, same], None, 0.07) is one


def test_refusals_say_why() -> None:
    rng = np.random.default_rng(10)
    scene = facade_scene(rng, noise_px=0.3)
    known = [(1, 2, scene.baseline_m(0, 1))]
    views = drone_views(rng, scene, [1, 2], attitude_sigma_rad=0.02)
    assert refusal(views, 3, known) == "the leader, drone 3, has sent no image"
    assert refusal([], 3, known) == "the leader, drone 3, has sent no image"
    mute = [replace(views[0], ned_from_body=None), views[1]]
    assert refusal(mute, 1, known) == "the autopilot of the leader, drone 1, sends no attitude"
    assert "two drones" in refusal(views[:1], 1, known)
    assert refusal(views, 1, []) == (
        "no known distance between drones that see the same (drones [1, 2] do): "
        "the scale is unknown"
    )
    assert "scale is unknown" in refusal(views, 1, [(1, 3, 2.0)])


@pytest.mark.parametrize(
    ("n_common", "reason"), [(8, "(8 matches)"), (40, "40 matches agree, 60 needed")]
)
def test_too_few_matches_are_refused(n_common: int, reason: str) -> None:
    rng = np.random.default_rng(11)
    scene = facade_scene(rng, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2], attitude_sigma_rad=0.02)
    descriptors = views[0].features[0].descriptors.copy()
    common = {bytes(d[4:]) for d in views[1].features[0].descriptors}
    shared = [i for i, d in enumerate(descriptors) if bytes(d[4:]) in common]
    others = shared[n_common:]
    descriptors[others] = descriptors_of(rng, len(others))
    features = Features(views[0].features[0].pixels, descriptors)
    views[0] = replace(views[0], features=(features,))
    text = refusal(views, 1, [(1, 2, scene.baseline_m(0, 1))])
    assert "drones 1 and 2 see too little in common" in text
    assert reason in text


def test_drones_that_see_different_places_are_refused() -> None:
    rng = np.random.default_rng(12)
    views = [drone_views(rng, facade_scene(rng, noise_px=0.3), [1, 2])[i] for i in range(2)]
    assert "see too little in common (0 matches)" in refusal(views, 1, [(1, 2, 2.0)])


def test_a_baseline_too_short_for_any_depth_is_refused() -> None:
    rng = np.random.default_rng(13)
    scene = facade_scene(rng, 300, baseline_m=0.25, relief_m=4.0, noise_px=0.5, lever_arm_m=0.0)
    views = drone_views(rng, scene, [1, 2], attitude_sigma_rad=0.02)
    reason = refusal(views, 1, [(1, 2, scene.baseline_m(0, 1))])
    assert any(text in reason for text in ("too close together", "could be placed")), reason


@pytest.mark.parametrize("north_m", [0.0, 1000.0])
def test_how_vague_a_map_is_has_nothing_to_do_with_where_its_world_begins(north_m: float) -> None:
    """Far out all would pass, and none where little is known of where the world begins by now."""
    made = map_of(facade_scene(np.random.default_rng(15), 300, n_views=3, noise_px=0.5), 0.01)
    off = np.array([north_m, 0.0, 0.0])
    made = replace(
        made,
        keyframes=tuple(
            replace(
                k,
                world_from_body=Pose(
                    k.world_from_body.rotation, k.world_from_body.translation + off
                ),
            )
            for k in made.keyframes
        ),
        points_world=made.points_world + off,
        anchor_covariance=np.diag([3.0] * 3 + [1e-4] * 3) ** 2,
    )
    assert isinstance(accepted(made, MapOptions()), LandmarkMap)
    refused = accepted(made, MapOptions(max_depth_error=1e-3))
    assert isinstance(refused, NoMap)
    assert "too close together" in refused.reason


def test_drones_in_the_same_place_are_refused() -> None:
    rng = np.random.default_rng(14)
    scene = facade_scene(rng, 300, noise_px=0.3, lever_arm_m=0.0)
    turned = Pose(exp_so3(np.array([0.0, 0.02, 0.05])), np.zeros(3))
    bodies = (Pose.identity(), turned)
    scene = observe(rng, scene.points_world, bodies, scene.mountings, PINHOLE, noise_px=0.3)
    views = drone_views(rng, scene, [1, 2], attitude_sigma_rad=0.02)
    assert refusal(views, 1, [(1, 2, 1.0)])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"keyframe_quality": 0}, "keyframe_quality"),
        ({"calibration_px": -0.1}, "calibration_px"),
        ({"calibration_px": float("nan")}, "calibration_px"),
        ({"update_quality": 101}, "update_quality"),
        ({"min_landmarks": 10}, "min_landmarks"),
        ({"min_angle_deg": 0.0}, "min_angle_deg"),
        ({"max_depth_error": float("nan")}, "max_depth_error"),
    ],
)
def test_options_out_of_range_are_refused(changes: dict[str, float], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        replace(OPTIONS, **changes)  # type: ignore[arg-type]
