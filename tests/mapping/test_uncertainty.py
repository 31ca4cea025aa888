"""The factored covariance is the inverse of the whole normal matrix, and it is honest."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent, nees
from tests.dense_bundle import normal_equations
from tests.mapping.views import map_of
from tests.scenes import CAMERAS, Scene, facade_scene
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping import misplacement
from vcl_companion.mapping.landmark_map import KnownDistance, LandmarkMap
from vcl_companion.mapping.lens_errors import lenses_px, n_lens_causes
from vcl_companion.mapping.misplacement import (
    ASIDE_DEG,
    ASIDE_NOISE_PX,
    LEAST_NOISE_PX,
    N_FIELDS,
    SMOOTH_PX,
)
from vcl_companion.mapping.tracks import ideal_of_pixels
from vcl_companion.mapping.uncertainty import map_uncertainty, views_of
from vcl_companion.vision.bundle import (
    BundleOptions,
    Distance,
    adjust,
)


def normal_matrix(landmark_map: LandmarkMap) -> tuple[Array, Array]:
    """Return the whole normal matrix, keyframes 1 to V-1 and every landmark, and (N, V) noise."""
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
    aside_px = ASIDE_NOISE_PX * (aside_deg / ASIDE_DEG) ** 1.5
    noise = np.sqrt(LEAST_NOISE_PX**2 + aside_px**2 + landmark_map.pixel_noise_px**2)
    views = views_of(landmark_map)
    scaled = replace(views, slopes=views.slopes / noise[..., None, None])
    system = normal_equations(scaled, None)
    n_poses, n_points = len(system.pose_block), len(system.point_block)
    size = n_poses + 3 * n_points
    whole = np.zeros((size, size))
    whole[:n_poses, :n_poses] = system.pose_block
    for j in range(n_points):
        own = slice(n_poses + 3 * j, n_poses + 3 * j + 3)
        whole[own, own] = system.point_block[j]
        whole[:n_poses, own] = system.cross[j]
        whole[own, :n_poses] = system.cross[j].T
    return whole[6:, 6:], noise


def fields_of(landmark_map: LandmarkMap) -> Array:
    """Return (N, V, 2, F) what observations err by in common, NaN where there is none."""
    out = np.full((*landmark_map.observed_px.shape, N_FIELDS), np.nan)
    out[landmark_map.seen] = misplacement.misplacement(landmark_map)[1]
    return out


def noise_of(landmark_map: LandmarkMap) -> Array:
    """Return (N, V) what each observation errs by for itself, NaN where there is none."""
    out = np.full(landmark_map.seen.shape, np.nan)
    out[landmark_map.seen] = misplacement.misplacement(landmark_map)[0]
    return out


def moved_by(landmark_map: LandmarkMap, errors_px: Array, whole: Array, noise: Array) -> Array:
    """Return (6V - 6,) how far keyframes are off when (N, V, 2) observations are, by one step."""
    cameras = [keyframe.camera for keyframe in landmark_map.keyframes]
    truth = views_of(landmark_map)
    ideal = ideal_of_pixels(landmark_map.observed_px + errors_px, cameras)
    scaled = replace(truth, ideal=ideal, slopes=truth.slopes / noise[..., None, None])
    system = normal_equations(scaled, None)
    size = len(system.pose_rhs)
    pull = np.concatenate([system.pose_rhs[6:], system.point_rhs.ravel()])
    return np.asarray(np.linalg.solve(whole, pull)[: size - 6])


@pytest.mark.parametrize(("n_views", "n_landmarks"), [(2, 25), (3, 25), (3, 600)])
def test_the_factored_covariance_is_the_dense_one(n_views: int, n_landmarks: int) -> None:
    scene = facade_scene(np.random.default_rng(0), n_landmarks, n_views=n_views, missed=0.1)
    landmark_map = map_of(scene)
    uncertainty = map_uncertainty(landmark_map)
    whole, noise = normal_matrix(landmark_map)
    np.testing.assert_allclose(noise_of(landmark_map)[landmark_map.seen], noise[landmark_map.seen])
    dense = np.asarray(np.linalg.inv(whole))
    n = 6 * (n_views - 1)
    scale = np.sqrt(np.diag(dense))
    small = 1e-3  # of a sigma, so that one step is enough
    fields = small * fields_of(landmark_map)
    moved = np.stack(
        [moved_by(landmark_map, fields[..., f], whole, noise) / small for f in range(N_FIELDS)], 1
    )
    at_rest = moved_by(landmark_map, 0.0 * fields[..., 0], whole, noise) / small
    moved -= at_rest[:, None]

    def assert_equal(found: Array, expected: Array, rows: slice, columns: slice) -> None:
        unit = np.outer(scale[rows], scale[columns])
        np.testing.assert_allclose(found / unit, expected / unit, atol=2e-4)

    poses = slice(0, n)
    keyframes = uncertainty.keyframe_covariance
    np.testing.assert_array_equal(keyframes[:6], 0.0)
    assert_equal(keyframes[6:, 6:], dense[poses, poses] + moved @ moved.T, poses, poses)
    for j, marginal in enumerate(uncertainty.marginal()):
        own = slice(n + 3 * j, n + 3 * j + 3)
        other = slice(n, n + 3)
        lever = uncertainty.landmark_lever[j][:, 6:]
        with_it = lever @ moved
        assert_equal(marginal, dense[own, own] + with_it @ with_it.T, own, own)
        shared = lever @ keyframes[6:, 6:]
        assert_equal(shared, dense[own, poses] + with_it @ moved.T, own, poses)
        if j > 0:
            first = uncertainty.landmark_lever[0][:, 6:]
            expected = dense[own, other] + with_it @ (first @ moved).T
            assert_equal(shared @ first.T, expected, own, other)


def test_what_all_landmarks_err_by_does_not_average_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a hundred times the landmarks noise leaves a tenth."""
    few, many = (
        map_of(facade_scene(np.random.default_rng(2), n, relief_m=4.0, n_views=4), 1e-5, 0.05)
        for n in (100, 10_000)
    )

    def left() -> float:
        few_sigma, many_sigma = (
            np.sqrt(np.diag(map_uncertainty(m).keyframe_covariance)[6:]) for m in (few, many)
        )
        return float(np.median(many_sigma / few_sigma))

    with_it = left()
    monkeypatch.setattr(misplacement, "SMOOTH_PX", 0.0)
    assert left() == pytest.approx(0.1, abs=0.03)
    assert with_it > 1.5 * left()


def test_keyframes_err_as_much_as_stated_where_observations_err_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(5)
    truth = map_of(facade_scene(rng, 800, relief_m=4.0, n_views=4), noise_px=0.05)
    errors, sigmas = [], []
    fields = fields_of(truth)
    for _ in range(60):
        alike = fields @ rng.standard_normal(N_FIELDS)
        own = noise_of(truth)[..., None] * rng.standard_normal(truth.observed_px.shape)
        found = adjusted(replace(truth, observed_px=truth.observed_px + alike + own))
        errors.append(
            np.concatenate(
                [
                    t.world_from_body.local(k.world_from_body)
                    for t, k in zip(truth.keyframes[1:], found.keyframes[1:], strict=True)
                ]
            )
        )
        sigmas.append(map_uncertainty(found).keyframe_covariance[6:, 6:])
    assert_consistent(errors, sigmas)
    monkeypatch.setattr(misplacement, "SMOOTH_PX", 0.0)
    alone = map_uncertainty(truth).keyframe_covariance[6:, 6:]
    assert float(nees(errors, alone).mean()) > 1.5 * float(nees(errors, sigmas).mean())


def test_keyframes_err_as_much_as_stated_where_lenses_are_off() -> None:
    """Two drones' lenses, each off by something of its own in both of its keyframes."""
    rng = np.random.default_rng(6)
    made = map_of(facade_scene(rng, 800, relief_m=4.0, n_views=4), noise_px=0.05)
    keyframes = tuple(replace(k, drone_id=1 + i % 2) for i, k in enumerate(made.keyframes))
    truth = replace(made, keyframes=keyframes)
    assert n_lens_causes(truth) == 14
    by_lenses = np.full((*truth.observed_px.shape, 14), np.nan)
    by_lenses[truth.seen] = lenses_px(truth, 0.3)
    fields = fields_of(truth)
    errors, sigmas = [], []
    for _ in range(60):
        alike = fields @ rng.standard_normal(N_FIELDS) + by_lenses @ rng.standard_normal(14)
        own = noise_of(truth)[..., None] * rng.standard_normal(truth.observed_px.shape)
        found = adjusted(replace(truth, observed_px=truth.observed_px + alike + own))
        moved = [
            t.world_from_body.local(k.world_from_body)
            for t, k in zip(truth.keyframes[1:], found.keyframes[1:], strict=True)
        ]
        errors.append(np.concatenate(moved))
        sigmas.append(map_uncertainty(found, 0.3).keyframe_covariance[6:, 6:])
    assert_consistent(errors, sigmas)
    exact = map_uncertainty(truth).keyframe_covariance[6:, 6:]
    assert float(nees(errors, exact).mean()) > 3.0 * float(nees(errors, sigmas).mean())


def test_a_camera_that_stays_where_it_is_errs_in_nothing_more() -> None:
    still = map_of(facade_scene(np.random.default_rng(3), 50, n_views=3))
    first = still.keyframes[0]
    turned = tuple(
        replace(k, world_from_body=replace(k.world_from_body, translation=np.zeros(3)))
        for k in still.keyframes
    )
    same = tuple(
        replace(k, body_from_cam=Pose(first.body_from_cam.rotation, np.zeros(3))) for k in turned
    )
    fields = misplacement.misplacement(replace(still, keyframes=same))[1]
    assert len(fields) == still.seen.sum()
    np.testing.assert_allclose(fields, 0.0, atol=1e-12)
    moving = fields_of(still)[still.seen]
    assert 0.0 < np.abs(moving).max() < SMOOTH_PX


def noisy_map(rng: np.random.Generator, scene: Scene, sigma_m: float) -> LandmarkMap:
    """Measure a scene again, its known distance too, and adjust from the truth."""
    truth = map_of(scene, sigma_m)
    again = truth.observed_px + scene.noise_px * rng.standard_normal(truth.observed_px.shape)
    measured = scene.baseline_m(0, 1) + sigma_m * float(rng.standard_normal())
    return adjusted(
        replace(
            truth,
            observed_px=again,
            pixel_noise_px=scene.noise_px,
            distances=(KnownDistance(0, 1, measured, sigma_m),),
        )
    )


def adjusted(noisy: LandmarkMap) -> LandmarkMap:
    """Adjust a map from where it is."""
    views, (known,) = views_of(noisy), noisy.distances
    # Plain least squares: this test is about the covariance, not about outliers. The known
    # distance weighs in units of its sigma, the pixels in units of theirs.
    weighted = replace(
        views,
        slopes=views.slopes / noise_of(noisy)[..., None, None],
        distances=(Distance(0, 1, known.distance_m, known.sigma_m),),
    )
    moved, _ = adjust(weighted, BundleOptions(cauchy_px=100.0))
    keyframes = tuple(
        replace(k, world_from_body=body)
        for k, body in zip(noisy.keyframes, moved.bodies, strict=True)
    )
    return replace(noisy, keyframes=keyframes, points_world=moved.points)


def test_keyframes_and_landmarks_err_as_much_as_stated() -> None:
    rng = np.random.default_rng(7)
    scene = replace(facade_scene(rng, 60, relief_m=4.0, n_views=3), noise_px=0.6)
    truth = map_of(scene)
    poses, pose_sigma, points, point_sigma = [], [], [], []
    for _ in range(60):
        found = noisy_map(rng, scene, 0.02)
        uncertainty = map_uncertainty(found)
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
    alone = nees(
        points, map_uncertainty(replace(truth, pixel_noise_px=0.6)).landmark_covariance.mean(axis=0)
    )
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


def test_a_map_is_never_taken_for_surer_than_patches_are() -> None:
    good = map_of(facade_scene(np.random.default_rng(0), 40, n_views=3))
    claims = [replace(good, pixel_noise_px=claimed_px) for claimed_px in (1e-12, 1e-300)]
    floor, silent = (map_uncertainty(m).keyframe_covariance[6:, 6:] for m in claims)
    np.testing.assert_allclose(silent, floor, rtol=1e-9)
    assert noise_of(claims[1])[good.seen].min() >= LEAST_NOISE_PX


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
