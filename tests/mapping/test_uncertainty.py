"""The factored covariance is the inverse of the whole normal matrix, and it is honest."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent, nees
from tests.mapping.views import map_of
from tests.scenes import CAMERAS, Scene, facade_scene
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import KnownDistance, LandmarkMap
from vcl_companion.mapping.uncertainty import (
    ASIDE_DEG,
    ASIDE_NOISE_PX,
    REPEATED_NOISE_PX,
    SHARED_NOISE_PX,
    map_uncertainty,
    shared_noise_px,
    views_of,
)
from vcl_companion.vision.bundle import BundleOptions, Distance, adjust, normal_equations


def dense_covariance(landmark_map: LandmarkMap, looks_before: Array | float = 0.0) -> Array:
    """Invert the whole normal matrix: keyframes 1 to V-1, then every landmark.

    Args:
        landmark_map: the map.
        looks_before: (N, V) how many rounds before had seen a landmark.
    """
    aside_deg = np.zeros(landmark_map.seen.shape)
    for j, k in np.argwhere(landmark_map.seen):
        sights = [
            landmark_map.points_world[j] - (frame.world_from_body @ frame.body_from_cam).translation
            for frame in landmark_map.keyframes
        ]
        units = [sight / np.linalg.norm(sight) for sight in sights]
        mean = np.sum([u for u, sees in zip(units, landmark_map.seen[j], strict=True) if sees], 0)
        turned = np.linalg.norm(np.cross(units[k], mean)), units[k] @ mean
        aside_deg[j, k] = np.rad2deg(np.arctan2(*turned))
    repeated = REPEATED_NOISE_PX * np.sqrt(np.asarray(looks_before)) * np.ones(aside_deg.shape)
    aside_px = ASIDE_NOISE_PX * (aside_deg / ASIDE_DEG) ** 1.5
    parts = (SHARED_NOISE_PX, aside_px, landmark_map.pixel_noise_px)
    noise = np.sqrt(repeated**2 + sum(np.square(part) for part in parts))[..., None, None]
    views = views_of(landmark_map)
    system = normal_equations(replace(views, slopes=views.slopes / noise), None)
    n_poses, n_points = len(system.pose_block), len(system.point_block)
    size = n_poses + 3 * n_points
    whole = np.zeros((size, size))
    whole[:n_poses, :n_poses] = system.pose_block
    for j in range(n_points):
        own = slice(n_poses + 3 * j, n_poses + 3 * j + 3)
        whole[own, own] = system.point_block[j]
        whole[:n_poses, own] = system.cross[j]
        whole[own, :n_poses] = system.cross[j].T
    return np.asarray(np.linalg.inv(whole[6:, 6:]))


@pytest.mark.parametrize(("n_views", "n_landmarks"), [(2, 25), (3, 25), (3, 600)])
def test_the_factored_covariance_is_the_dense_inverse(n_views: int, n_landmarks: int) -> None:
    scene = facade_scene(np.random.default_rng(0), n_landmarks, n_views=n_views, missed=0.1)
    landmark_map = map_of(scene)
    uncertainty = map_uncertainty(landmark_map)
    dense = dense_covariance(landmark_map)
    n = 6 * (n_views - 1)
    scale = np.sqrt(np.diag(dense))

    def assert_equal(factored: Array, rows: slice, columns: slice) -> None:
        unit = np.outer(scale[rows], scale[columns])
        np.testing.assert_allclose(factored / unit, dense[rows, columns] / unit, atol=1e-6)

    poses = slice(0, n)
    keyframes = uncertainty.keyframe_covariance
    np.testing.assert_array_equal(keyframes[:6], 0.0)
    assert_equal(keyframes[6:, 6:], poses, poses)
    for j, marginal in enumerate(uncertainty.marginal()):
        own = slice(n + 3 * j, n + 3 * j + 3)
        other = slice(n, n + 3)
        assert_equal(marginal, own, own)
        shared = uncertainty.landmark_lever[j] @ keyframes
        assert_equal(shared[:, 6:], own, poses)
        if j > 0:
            assert_equal(shared @ uncertainty.landmark_lever[0].T, own, other)


def test_a_further_round_tells_the_less_of_what_was_seen_before() -> None:
    """Each drone has a clock of its own; rounds are told apart all the same."""
    scene = facade_scene(np.random.default_rng(4), 60, relief_m=4.0, n_views=5)
    taken = [(1, 5), (2, 900_000), (1, 6), (3, 70), (2, 900_001)]
    made = map_of(scene)
    observed_px = made.observed_px.copy()
    observed_px[:20, :2] = np.nan  # these came with the second round
    observed_px[20:30, 2:4] = np.nan  # and these were seen again by one drone only
    keyframes = tuple(
        replace(k, drone_id=drone, captured_at_ns=at_ns)
        for k, (drone, at_ns) in zip(made.keyframes, taken, strict=True)
    )
    later = replace(made, keyframes=keyframes, observed_px=observed_px)
    looks_before = np.zeros((60, 5))
    looks_before[20:, 2:] = 1.0
    dense = dense_covariance(later, looks_before)
    n = 6 * 4
    unit = np.outer(*[np.sqrt(np.diag(dense)[:n])] * 2)
    found = map_uncertainty(later).keyframe_covariance[6:, 6:]
    np.testing.assert_allclose(found / unit, dense[:n, :n] / unit, atol=1e-6)


def noisy_map(rng: np.random.Generator, scene: Scene, sigma_m: float) -> LandmarkMap:
    """Measure a scene again, its known distance too, and adjust from the truth."""
    truth = map_of(scene, sigma_m)
    again = truth.observed_px + scene.noise_px * rng.standard_normal(truth.observed_px.shape)
    measured = scene.baseline_m(0, 1) + sigma_m * float(rng.standard_normal())
    noisy = replace(
        truth,
        observed_px=again,
        pixel_noise_px=scene.noise_px,
        distances=(KnownDistance(0, 1, measured, sigma_m),),
    )
    views = views_of(noisy)
    # Plain least squares: this test is about the covariance, not about outliers. The known
    # distance weighs in units of its sigma, the pixels in units of theirs.
    weighted = replace(
        views,
        slopes=views.slopes / scene.noise_px,
        distances=(Distance(0, 1, measured, sigma_m),),
    )
    adjusted, _ = adjust(weighted, BundleOptions(cauchy_px=100.0))
    keyframes = tuple(
        replace(k, world_from_body=body)
        for k, body in zip(noisy.keyframes, adjusted.bodies, strict=True)
    )
    return replace(noisy, keyframes=keyframes, points_world=adjusted.points)


def test_keyframes_and_landmarks_err_as_much_as_stated() -> None:
    rng = np.random.default_rng(7)
    scene = replace(facade_scene(rng, 60, relief_m=4.0, n_views=3), noise_px=0.6)
    # The rest is what is allowed for errors that neighbours share; this scene has none.
    claimed_px = float(np.sqrt(0.6**2 - SHARED_NOISE_PX**2))
    truth = map_of(scene)
    poses, pose_sigma, points, point_sigma = [], [], [], []
    for _ in range(60):
        found = noisy_map(rng, scene, 0.02)
        uncertainty = map_uncertainty(replace(found, pixel_noise_px=claimed_px))
        poses.append(
            np.concatenate(
                [
                    t.world_from_body.local(k.world_from_body)
                    for t, k in zip(truth.keyframes[1:], found.keyframes[1:], strict=True)
                ]
            )
        )
        pose_sigma.append(uncertainty.keyframe_covariance[6:, 6:])
        j = int(rng.integers(len(found.points_world)))
        points.append(found.points_world[j] - truth.points_world[j])
        point_sigma.append(uncertainty.marginal()[j])
    assert_consistent(poses, pose_sigma)
    assert_consistent(points, point_sigma)
    # The shared part matters: without it a landmark would seem far better known than it is.
    exact = replace(truth, pixel_noise_px=claimed_px)
    alone = nees(points, map_uncertainty(exact).landmark_covariance.mean(axis=0))
    assert float(alone.mean()) > 2.0 * float(nees(points, point_sigma).mean())


def test_whatever_the_first_keyframe_is_off_by_everything_is() -> None:
    scene = facade_scene(np.random.default_rng(3), 60, relief_m=4.0, n_views=3, noise_px=0.3)
    truth = map_of(scene)
    sigma = np.array([0.3, 0.2, 0.4, 0.02, 0.03, 0.05])
    exact, moved = (
        map_uncertainty(replace(truth, anchor_covariance=scale * np.diag(sigma**2)))
        for scale in (0.0, 1.0)
    )
    first = truth.keyframes[0].world_from_body
    step = 1e-6
    for i, keyframe in enumerate(truth.keyframes):
        relative = first.inverse() @ keyframe.world_from_body
        columns = [
            keyframe.world_from_body.local(first.retracted(step * e) @ relative) / step
            for e in np.eye(6)
        ]
        alike = np.stack(columns, axis=1)
        block = np.s_[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        added = moved.keyframe_covariance[block] - exact.keyframe_covariance[block]
        np.testing.assert_allclose(added, alike @ np.diag(sigma**2) @ alike.T, atol=1e-6)
    for j in (0, 17, 40):
        point = first.inverse().apply(truth.points_world[j])
        columns = [
            (first.retracted(step * e).apply(point) - truth.points_world[j]) / step
            for e in np.eye(6)
        ]
        alike = np.stack(columns, axis=1)
        added = moved.marginal()[j] - exact.marginal()[j]
        np.testing.assert_allclose(added, alike @ np.diag(sigma**2) @ alike.T, atol=1e-5, rtol=1e-3)


def test_a_better_known_distance_is_a_better_scale() -> None:
    scene = facade_scene(np.random.default_rng(0), 100, relief_m=4.0, noise_px=0.3)
    direction = np.concatenate([scene.bodies[1].rotation.T @ scene.bodies[1].translation, [0] * 3])
    direction /= np.linalg.norm(direction)
    for sigma_m in (0.1, 0.01):
        covariance = map_uncertainty(map_of(scene, sigma_m)).keyframe_covariance[6:, 6:]
        along_m = float(np.sqrt(direction @ covariance @ direction))
        assert along_m == pytest.approx(sigma_m, rel=0.01)


def test_a_map_is_never_taken_for_surer_than_detectors_are() -> None:
    good = map_of(facade_scene(np.random.default_rng(0), 40, n_views=3))
    as_much_px = float(np.sqrt(np.mean(np.square(shared_noise_px(good)[good.seen]))))
    floor, silent, loud = (
        map_uncertainty(replace(good, pixel_noise_px=noise_px)).keyframe_covariance[6:, 6:]
        for noise_px in (1e-12, 1e-300, as_much_px)
    )
    np.testing.assert_allclose(silent, floor, rtol=1e-9)
    assert np.trace(loud) == pytest.approx(2.0 * np.trace(floor), rel=0.1)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.distortion_model)
def test_every_camera_model_gives_a_covariance(camera: Camera) -> None:
    scene = facade_scene(np.random.default_rng(0), 40, n_views=3, camera=camera)
    marginal = map_uncertainty(map_of(scene)).marginal()
    assert np.all(np.linalg.eigvalsh(marginal) > 0)


def test_on_its_way_it_takes_little_more_memory_than_in_the_end() -> None:
    landmark_map = map_of(facade_scene(np.random.default_rng(0), 6000, n_views=4))
    tracemalloc.start()
    try:
        uncertainty = map_uncertainty(landmark_map)
        kept, most = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        marginal = uncertainty.marginal()
        more, most_more = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept > uncertainty.landmark_lever.nbytes
    assert most < 1.5 * kept
    assert more - kept > 0.9 * marginal.nbytes
    assert most_more - kept < 3.0 * marginal.nbytes


def degenerate_maps() -> dict[str, LandmarkMap]:
    scene = facade_scene(np.random.default_rng(0), 40, n_views=3)
    good = map_of(scene)
    seen_once = good.observed_px.copy()
    seen_once[5, 1:] = np.nan
    unseen = good.observed_px.copy()
    unseen[5] = np.nan
    alone = good.observed_px.copy()
    alone[:, 2] = np.nan
    shared = np.isfinite(alone[..., 0]).sum(axis=1) >= 2
    behind = good.points_world * [-1.0, 1.0, 1.0]
    inside = good.points_world.copy()
    cam = good.keyframes[0].world_from_body @ good.keyframes[0].body_from_cam
    inside[3] = cam.translation
    same = tuple(replace(k, world_from_body=Pose.identity()) for k in good.keyframes)
    one = np.broadcast_to(good.points_world[:1], good.points_world.shape)
    empty = replace(good, points_world=np.zeros((0, 3)), observed_px=np.zeros((0, 3, 2)))
    single = replace(
        good, keyframes=good.keyframes[:1], observed_px=good.observed_px[:, :1], distances=()
    )
    tiny = (KnownDistance(0, 1, 2.0, 1e-300),)
    wide = Camera(640, 480, 1e-200, 1e-200, 319.5, 239.5)
    return {
        "no distance": replace(good, distances=()),
        "exact distance": replace(good, distances=(KnownDistance(0, 1, 2.0, 0.0),)),
        "distance known to 1e-300 m": replace(good, distances=tiny),
        "a landmark seen once": replace(good, observed_px=seen_once),
        "a landmark unseen": replace(good, observed_px=unseen),
        "a keyframe that shares nothing": replace(
            good, points_world=good.points_world[shared], observed_px=alone[shared]
        ),
        "landmarks behind all keyframes": replace(good, points_world=behind),
        "a landmark in a camera's centre": replace(good, points_world=inside),
        "keyframes all in one place": replace(good, keyframes=same),
        "landmarks all in one place": replace(good, points_world=one),
        "landmarks at infinity": replace(good, points_world=good.points_world * 1e9),
        "no landmarks": empty,
        "one keyframe": single,
        "endless noise": replace(good, pixel_noise_px=1e300),
        "an absurd lens": replace(
            good, keyframes=tuple(replace(k, camera=wide) for k in good.keyframes)
        ),
    }


@pytest.mark.parametrize("name", degenerate_maps())
def test_a_map_that_its_observations_do_not_fix_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"do not fix it|claims to know a distance exactly"):
        map_uncertainty(degenerate_maps()[name])


def test_a_map_without_lever_arms_or_turns_is_fixed_too() -> None:
    """Parallel cameras in the body's centre: symmetric, not degenerate."""
    scene = facade_scene(np.random.default_rng(0), 40, turn_deg=0.0, lever_arm_m=0.0)
    assert np.all(np.linalg.eigvalsh(map_uncertainty(map_of(scene)).marginal()) > 0)
