"""Maps of patches: sharper than detectors, extended by one drone alone, not by a wrong guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.mapping.coverage import coverage
from tests.mapping.rendered import CAMERA, panels, rendered_view
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.sharpening import sharpened
from vcl_companion.mapping.thinning import cells_of, thinned
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.update import extend_map
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD

MOUNTING = Pose(BODY_FROM_CAM_FORWARD, np.array([0.1, 0.0, 0.05]))
OPTIONS = MapOptions(detectors=("akaze",))
PARENT = b"revision"


def at(x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> Pose:
    return Pose(matrix_from_euler(0.02, -0.03, np.deg2rad(yaw_deg)), np.array([x, y, z]))


BODIES = [at(0.0, 0.0), at(0.2, 1.5, -0.3), at(-0.6, 2.5, 0.2, 3.0), at(-1.2, 4.0, -0.2, -2.0)]


@pytest.fixture(scope="module")
def views() -> list[DroneView]:
    scene = panels(np.random.default_rng(3))
    return [
        rendered_view(scene, 1 + (k == 1), k, body, MOUNTING, OPTIONS)
        for k, body in enumerate(BODIES)
    ]


def first_map(views: list[DroneView], options: MapOptions = OPTIONS) -> LandmarkMap:
    known = float(np.linalg.norm(BODIES[0].translation - BODIES[1].translation))
    found = reconstruct(views[:2], 1, [(1, 2, known)], options)
    assert isinstance(found, LandmarkMap), found
    return found


def turn_deg(landmark_map: LandmarkMap, k: int, truth: Pose) -> float:
    error = truth.local(landmark_map.keyframes[k].world_from_body)
    return float(np.rad2deg(np.linalg.norm(error[3:])))


def test_patches_are_sharper_than_the_detector(views: list[DroneView]) -> None:
    rough = first_map(views, replace(OPTIONS, patches=False))
    rng = np.random.default_rng(0)
    noisy = replace(
        rough, observed_px=rough.observed_px + rng.normal(0, 0.3, rough.observed_px.shape)
    )
    sharp = sharpened(noisy, OPTIONS)
    assert len(sharp.points_world) > 0.5 * len(rough.points_world)
    assert sharp.pixel_noise_px < 0.5 * 0.3
    assert turn_deg(sharp, 1, BODIES[1]) < 0.05
    error = BODIES[1].local(sharp.keyframes[1].world_from_body)
    covariance = map_uncertainty(sharp).keyframe_covariance[6:12, 6:12]
    # 99.99 % of chi-square with 6 degrees of freedom.
    assert error @ np.linalg.solve(covariance, error) < 27.9


def test_images_that_are_none_leave_nothing_to_sharpen(views: list[DroneView]) -> None:
    rough = first_map(views, replace(OPTIONS, patches=False))
    blind = replace(
        rough, keyframes=tuple(replace(k, image_bytes=b"none") for k in rough.keyframes)
    )
    assert len(sharpened(blind, OPTIONS).points_world) == 0


def test_one_drone_alone_extends_the_map_from_where_it_believes_to_be(
    views: list[DroneView],
) -> None:
    old = first_map(views)
    rng = np.random.default_rng(1)
    sigma = np.repeat([0.03, 0.003], 3)
    new = [
        replace(v, features=(), world_from_body=b.retracted(sigma * rng.standard_normal(6)))
        for v, b in zip(views[2:], BODIES[2:], strict=True)
    ]
    one = extend_map(old, PARENT, new[:1], OPTIONS)
    assert isinstance(one, LandmarkMap), one
    found = extend_map(one, PARENT, new[1:], OPTIONS)
    assert isinstance(found, LandmarkMap), found
    assert len(found.keyframes) == 4
    assert len(found.points_world) > 1.2 * len(old.points_world)
    covariance = map_uncertainty(found).keyframe_covariance
    for k, body in enumerate(BODIES[1:], start=1):
        error = body.local(found.keyframes[k].world_from_body)
        own = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
        assert error @ np.linalg.solve(own, error) < 27.9, (k, error)
        assert np.linalg.norm(error[:3]) < 0.05
    ahead = BODIES[3]
    before = coverage(old, CAMERA, MOUNTING, ahead)
    after = coverage(found, CAMERA, MOUNTING, ahead)
    assert after.share > before.share
    assert after.n_visible > before.n_visible


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_map_stays_where_more_than_its_observations_has_put_it(
    views: list[DroneView], seed: int
) -> None:
    """Keyframes that are gone have made it: by what is left alone it would move by centimetres."""
    old = extend_map(first_map(views), PARENT, views[2:3], OPTIONS)
    assert isinstance(old, LandmarkMap), old
    rng = np.random.default_rng(seed)
    left = old.observed_px + rng.normal(0.0, 0.4, old.observed_px.shape)
    known = replace(old, observed_px=left, pixel_noise_px=float(np.hypot(old.pixel_noise_px, 0.4)))
    new = [replace(views[3], features=(), world_from_body=BODIES[3])]
    found = extend_map(known, PARENT, new, OPTIONS)
    as_it_was = extend_map(old, PARENT, new, OPTIONS)
    assert isinstance(found, LandmarkMap), found
    assert isinstance(as_it_was, LandmarkMap), as_it_was
    assert len(found.points_world) > 0.9 * len(as_it_was.points_world)
    assert found.pixel_noise_px > 2.0 * as_it_was.pixel_noise_px
    for one, other in zip(found.keyframes[:3], as_it_was.keyframes[:3], strict=True):
        apart = one.world_from_body.translation - other.world_from_body.translation
        assert np.linalg.norm(apart) < 0.005


@pytest.mark.parametrize("wrong", [at(0.0, 0.0, 0.0, 60.0), at(3.0, 9.0), at(500.0, 0.0)])
def test_a_wrong_guess_is_found_out(views: list[DroneView], wrong: Pose) -> None:
    old = first_map(views)
    found = extend_map(old, PARENT, [replace(views[2], world_from_body=wrong)], OPTIONS)
    if isinstance(found, NoMap):
        return
    error = BODIES[2].local(found.keyframes[2].world_from_body)
    assert np.linalg.norm(error[:3]) < 0.05


def test_no_cell_is_crowded_and_long_tracks_stay(views: list[DroneView]) -> None:
    crowd = first_map(views, replace(OPTIONS, landmarks_per_cell=50))
    thin = thinned(crowd, 2)
    assert 0 < len(thin.points_world) < len(crowd.points_world)
    cells = np.stack([cells_of(thin.observed_px[:, i], CAMERA) for i in range(2)], axis=1)
    crowded = np.array([np.bincount(cells[cells[:, i] >= 0, i], minlength=192) for i in (0, 1)])
    # Each landmark that stays had room in one of the images at least.
    assert ((crowded[0, cells[:, 0]] <= 2) | (crowded[1, cells[:, 1]] <= 4)).mean() > 0.9
    np.testing.assert_array_equal(thinned(crowd, 2).points_world, thin.points_world)
    assert len(thinned(crowd, 10_000).points_world) == len(crowd.points_world)


def test_nothing_of_a_map_is_seen_from_behind_it(views: list[DroneView]) -> None:
    old = first_map(views)
    seen = coverage(old, CAMERA, MOUNTING, BODIES[0])
    assert seen.n_visible > 0.8 * len(old.points_world)
    assert 8.0 < seen.depth_m < 11.0
    for away in (at(0.0, 0.0, 0.0, 180.0), at(30.0, 0.0, 0.0, 180.0)):
        none = coverage(old, CAMERA, MOUNTING, away)
        assert (none.n_visible, none.share) == (0, 0.0)


def test_a_map_that_is_full_goes_on_from_its_newest_half() -> None:
    """Two drones along a street, thrice as far as they see: the map holds a part of it."""
    rng = np.random.default_rng(0)
    scene, n_rounds = panels(rng, 24), 18
    bodies = [
        at(0.3 * (-1) ** n * i, -18.0 + 1.5 * n + 2.4 * i, 0.2 * i)
        for n in range(n_rounds)
        for i in (0, 1)
    ]
    views = [
        rendered_view(scene, 1 + k % 2, k // 2, body, MOUNTING, OPTIONS)
        for k, body in enumerate(bodies)
    ]
    options = replace(OPTIONS, max_keyframes=12)
    known = float(np.linalg.norm(bodies[0].translation - bodies[1].translation))
    found = reconstruct(views[:2], 1, [(1, 2, known)], options)
    assert isinstance(found, LandmarkMap), found
    began = found.keyframes[0].world_from_body
    for n in range(1, n_rounds):
        shown = [
            replace(
                views[k],
                features=(),
                world_from_body=found.keyframes[k % 2 - 2].world_from_body
                @ (bodies[k - 2].inverse() @ bodies[k]).retracted(0.005 * rng.standard_normal(6)),
            )
            for k in (2 * n, 2 * n + 1)
        ]
        before, found = found, extend_map(found, PARENT, shown, options)
        assert isinstance(found, LandmarkMap), (n, found)
        # As many hold what was as are moved.
        moved = [was is not now for was, now in poses_of_both(before, found)]
        assert len(before.keyframes) <= 9 or 2 * sum(moved) <= len(moved)
    newest = [k.captured_at_ns for k in found.keyframes[-6:]]
    assert newest == [
        n_rounds - 3,
        n_rounds - 3,
        n_rounds - 2,
        n_rounds - 2,
        n_rounds - 1,
        n_rounds - 1,
    ]
    flown = found.keyframes[-2].world_from_body.translation - began.translation
    truth_m = np.linalg.norm(bodies[-2].translation - bodies[0].translation)
    assert abs(np.linalg.norm(flown) / truth_m - 1.0) < 0.002


def poses_of_both(a: LandmarkMap, b: LandmarkMap) -> list[tuple[Pose, Pose]]:
    """Return the poses of the keyframes that two maps have in common."""
    of_b = {(k.drone_id, k.captured_at_ns): k.world_from_body for k in b.keyframes}
    return [
        (k.world_from_body, of_b[name])
        for k in a.keyframes
        if (name := (k.drone_id, k.captured_at_ns)) in of_b
    ]
