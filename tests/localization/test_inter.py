"""One drone seen from another: the pose, its covariance, and when there is no proposal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_pose_close, nees
from tests.localization.maps import Descriptors, index_of_scene, seen_from
from tests.mapping.views import descriptors_of
from tests.scenes import facade_scene, perturbed
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, about_down, exp_so3, matrix_from_euler
from vcl_companion.localization.inter import NoProposal, Proposal, localize_inter
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.localization.pair_evidence import InterOptions, Observer
from vcl_companion.mapping.lens_errors import N_LENS, lens_px
from vcl_companion.vision.features import Features

HOST = Pose(matrix_from_euler(0.02, -0.03, 0.05), np.array([1.0, 0.8, -0.3]))
TARGET = Pose(matrix_from_euler(-0.03, 0.02, -0.08), np.array([0.4, 2.9, -0.9]))
OPTIONS = InterOptions()
SURE = np.eye(6) * 1e-12

Scene = tuple[MapIndex, Descriptors]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture
def relief(rng: np.random.Generator) -> Scene:
    return index_of_scene(rng, facade_scene(rng, 300, relief_m=4.0, n_views=3))


def observer(scene: Scene, features: Features, pose: Pose | None) -> Observer:
    first = scene[0].landmark_map.keyframes[0]
    attitude = None if pose is None else pose.rotation
    return Observer(features, first.camera, first.body_from_cam, attitude)


def proposed(
    rng: np.random.Generator,
    scene: Scene,
    *,
    target: Pose = TARGET,
    host_estimate: Pose = HOST,
    host_covariance: np.ndarray[tuple[int, int], np.dtype[np.float64]] = SURE,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    options: InterOptions = OPTIONS,
) -> Proposal | NoProposal:
    seen = [
        seen_from(rng, scene[0].landmark_map, scene[1], pose, noise_px=noise_px, outliers=outliers)
        for pose in (HOST, target)
    ]
    return localize_inter(
        observer(scene, seen[0], HOST),
        host_estimate,
        host_covariance,
        observer(scene, seen[1], target),
        scene[0],
        options,
    )


def test_without_noise_the_target_is_where_it_is(rng: np.random.Generator, relief: Scene) -> None:
    found = proposed(rng, relief)
    assert isinstance(found, Proposal), found
    assert_pose_close(found.world_from_body, TARGET, within_m=1e-4, within_rad=1e-5)
    assert found.n_common >= 100
    assert found.n_matches >= found.n_common


def test_noise_and_wrong_matches_move_it_as_much_as_stated(relief: Scene) -> None:
    errors, covariances = [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        target = perturbed(rng, TARGET, 0.3, 0.03)
        found = proposed(rng, relief, target=target, noise_px=0.5, outliers=0.2)
        assert isinstance(found, Proposal), found
        errors.append(target.local(found.world_from_body))
        covariances.append(found.covariance)
    position_m = np.linalg.norm(np.array(errors)[:, :3], axis=1)
    assert 1e-4 < np.median(position_m) < 0.1
    # Never too sure of itself; the floors for real detectors make it less sure than it could be.
    values = nees(errors, np.array(covariances))
    assert np.mean(values) < 7.0
    assert np.mean(values) > 0.5


def test_the_target_s_lens_is_off_as_much_as_stated(relief: Scene) -> None:
    exact, descriptors = relief
    told = replace(exact, uncertainty=replace(exact.uncertainty, calibration_px=4.0))
    camera = exact.landmark_map.keyframes[0].camera
    unaware: list[float] = []
    aware: list[float] = []
    for seed in range(15):
        rng = np.random.default_rng(seed)
        of_host, of_target = (
            seen_from(rng, exact.landmark_map, descriptors, pose, noise_px=0.5)
            for pose in (HOST, TARGET)
        )
        off_px = lens_px(camera, of_target.pixels, 4.0) @ rng.standard_normal(N_LENS)
        shifted = replace(of_target, pixels=of_target.pixels + off_px)
        for index, squared in ((exact, unaware), (told, aware)):
            scene = index, descriptors
            found = localize_inter(
                observer(scene, of_host, HOST), HOST, SURE,
                observer(scene, shifted, None), index, OPTIONS,
            )  # fmt: skip
            assert isinstance(found, Proposal), found
            squared.append(nees(TARGET.local(found.world_from_body), found.covariance)[0])
    assert np.median(unaware) > 20.0
    assert 0.5 < np.median(aware) < 10.0


def test_the_host_s_error_reaches_the_target_through_the_lever(
    rng: np.random.Generator, relief: Scene
) -> None:
    """What is proposed is off by the host's error, and says so (eqs. 8 and 9)."""
    covariance = np.diag([0.02, 0.03, 0.01, 0.001, 0.001, 0.002]) ** 2
    errors, covariances = [], []
    for _ in range(30):
        off = rng.multivariate_normal(np.zeros(6), covariance)
        found = proposed(rng, relief, host_estimate=HOST.retracted(off), host_covariance=covariance)
        if isinstance(found, NoProposal):
            continue  # the map and a host far off share too few landmarks
        errors.append(TARGET.local(found.world_from_body))
        covariances.append(found.covariance)
    assert len(errors) >= 25
    # Where the common landmarks fix the target by themselves, the host's error hardly matters.
    assert np.mean(nees(errors, np.array(covariances))) < 7.0
    assert np.median(np.linalg.norm(np.array(errors)[:, :3], axis=1)) < 0.03


def test_without_common_landmarks_there_is_no_scale(
    rng: np.random.Generator, relief: Scene
) -> None:
    """The map knows nothing of what both see: a relative pose, but no metres."""
    index, descriptors = relief
    elsewhere = descriptors_of(rng, len(descriptors))
    seen = [seen_from(rng, index.landmark_map, elsewhere, pose) for pose in (HOST, TARGET)]
    found = localize_inter(
        observer(relief, seen[0], HOST), HOST, SURE, observer(relief, seen[1], TARGET), index,
        OPTIONS,
    )  # fmt: skip
    assert isinstance(found, NoProposal)
    assert "needed for the scale" in found.reason


def test_images_of_different_things_have_no_relative_pose(
    rng: np.random.Generator, relief: Scene
) -> None:
    index, descriptors = relief
    here = seen_from(rng, index.landmark_map, descriptors, HOST)
    there = seen_from(rng, index.landmark_map, descriptors_of(rng, len(descriptors)), TARGET)
    found = localize_inter(
        observer(relief, here, HOST), HOST, SURE, observer(relief, there, TARGET), index, OPTIONS
    )
    assert isinstance(found, NoProposal)
    assert "too little in common" in found.reason


def test_attitude_chooses_between_planar_twins(rng: np.random.Generator) -> None:
    flat = index_of_scene(rng, facade_scene(rng, 300, relief_m=0.0, n_views=3))
    target = replace(TARGET, translation=np.array([0.4, 3.4, -0.9]))
    found = proposed(rng, flat, target=target, noise_px=0.3)
    assert isinstance(found, Proposal), found
    off = target.local(found.world_from_body)
    assert np.linalg.norm(off[3:]) < np.deg2rad(1.0)
    assert np.linalg.norm(off[:3]) < 0.3


def test_without_a_common_north_only_roll_and_pitch_are_weighed(
    rng: np.random.Generator, relief: Scene
) -> None:
    seen = [
        seen_from(rng, relief[0].landmark_map, relief[1], pose, noise_px=0.3)
        for pose in (HOST, TARGET)
    ]
    host, target = (observer(relief, seen[i], pose) for i, pose in enumerate((HOST, TARGET)))
    assert target.ned_from_body is not None

    def place(turn_deg: float, has_heading: bool) -> Proposal | NoProposal:
        assert target.ned_from_body is not None
        other_north = about_down(np.deg2rad(turn_deg)) @ target.ned_from_body
        northless = replace(target, ned_from_body=other_north, has_heading=has_heading)
        return localize_inter(host, HOST, SURE, northless, relief[0], OPTIONS)

    known, alone = place(0.0, True), place(0.0, False)
    assert isinstance(known, Proposal)
    assert isinstance(alone, Proposal)
    for turn_deg in (150.0, -60.0):
        found = place(turn_deg, False)
        assert isinstance(found, Proposal), found
        assert_pose_close(
            found.world_from_body, alone.world_from_body, within_m=1e-6, within_rad=1e-7
        )
        np.testing.assert_allclose(found.covariance, alone.covariance, rtol=1e-6)
    assert_pose_close(alone.world_from_body, TARGET, within_m=0.1, within_rad=np.deg2rad(1.0))
    # What the heading told makes it surer.
    assert np.linalg.det(alone.covariance) >= np.linalg.det(known.covariance)


def nees_of_changed(
    scene: Scene, n: int, changed: Callable[[np.random.Generator, Features], Features]
) -> Array:
    """Return (n,) how far proposals are off, where what the target saw is changed somehow."""
    errors, covariances = [], []
    for seed in range(n):
        rng = np.random.default_rng(seed)
        here, there = (
            seen_from(rng, scene[0].landmark_map, scene[1], pose, noise_px=0.3)
            for pose in (HOST, TARGET)
        )
        target = observer(scene, changed(rng, there), None)
        found = localize_inter(observer(scene, here, HOST), HOST, SURE, target, scene[0], OPTIONS)
        assert isinstance(found, Proposal), found
        errors.append(TARGET.local(found.world_from_body))
        covariances.append(found.covariance)
    return nees(errors, np.array(covariances))


def test_a_match_whose_word_nobody_checks_is_not_taken(rng: np.random.Generator) -> None:
    """All but one match lie close together; that one lies far off, wrong along its line."""
    scene = index_of_scene(rng, facade_scene(rng, 600, relief_m=1.0, n_views=3))

    def narrow(_: np.random.Generator, there: Features) -> Features:
        x, y = there.pixels.T
        alone = int(np.argmax(x))
        kept = (np.abs(x - 200.0) < 60.0) & (np.abs(y - 240.0) < 90.0)
        kept[alone] = True
        pixels = there.pixels.copy()
        pixels[alone, 0] -= 4.0
        return Features(pixels[kept], there.descriptors[kept])

    assert np.max(nees_of_changed(scene, 12, narrow)) < 4.0


def test_wrong_matches_that_lie_together_are_told_as_a_wide_error(rng: np.random.Generator) -> None:
    """Far away, a step up and a nod down look alike; a shadow that moved decides between them."""
    scene = index_of_scene(rng, facade_scene(rng, 600, relief_m=0.5, n_views=3))

    def moved(rng: np.random.Generator, there: Features) -> Features:
        pixels = there.pixels.copy()
        corner = rng.uniform((60.0, 40.0), (460.0, 320.0))
        inside = ((pixels > corner) & (pixels < corner + 120.0)).all(axis=1)
        pixels[inside, 1] += rng.choice([-1.2, 1.2])
        return Features(pixels, there.descriptors)

    assert np.max(nees_of_changed(scene, 16, moved)) < 8.0


def test_a_proposal_too_vague_is_not_made(rng: np.random.Generator, relief: Scene) -> None:
    found = proposed(rng, relief, noise_px=0.5, options=InterOptions(max_sigma_m=1e-3))
    assert isinstance(found, NoProposal)
    assert "too uncertain" in found.reason


def test_nothing_seen_is_no_proposal(relief: Scene) -> None:
    none = Features(np.zeros((0, 2)), np.zeros((0, 61), np.uint8))
    blind = observer(relief, none, None)
    found = localize_inter(blind, HOST, SURE, blind, relief[0], OPTIONS)
    assert isinstance(found, NoProposal)
    turned = replace(blind, ned_from_body=exp_so3(np.array([0.1, 0.0, 0.0])))
    assert isinstance(localize_inter(turned, HOST, SURE, blind, relief[0], OPTIONS), NoProposal)
