"""A third drone that shares much with one other, and hardly a landmark with both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.checks import assert_consistent
from tests.mapping.views import drone_views, world_from_scene
from tests.scenes import Scene, facade_scene
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.baseline import with_length
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.update import extended
from vcl_companion.vision.features import Detector, Features, joined_features
from vcl_companion.vision.resection import NotFound

OPTIONS = MapOptions(detectors=("akaze",))
LENGTH = MapOptions(max_error_px=1.0, max_depth_error=0.1)
N_SEEN = 150
CAMERA = Camera(640, 480, 320.0, 320.0, 319.5, 239.5)


def chained(rng: np.random.Generator, n_common: int, outliers: float = 0.0) -> Scene:
    """Return a scene of which the second drone sees the first half and the third the other."""
    scene = facade_scene(
        rng, 2 * N_SEEN - n_common, n_views=3, noise_px=0.3, outliers=outliers, turn_deg=2.0
    )
    observed = scene.observed_px.copy()
    observed[N_SEEN:, 1] = np.nan
    observed[: N_SEEN - n_common, 2] = np.nan
    return replace(scene, observed_px=observed)


def first_map(rng: np.random.Generator, scene: Scene) -> LandmarkMap:
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    made = reconstruct(views, 1, [(1, 2, scene.baseline_m(0, 1))], OPTIONS)
    assert isinstance(made, LandmarkMap), made
    return made


def test_a_drone_chained_to_another_by_few_landmarks_errs_as_much_as_stated() -> None:
    off, told = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        scene = chained(rng, 14, outliers=0.05)
        made = first_map(rng, scene)
        assert [k.drone_id for k in made.keyframes] == [1, 2, 3]
        third = made.keyframes[2].world_from_body
        off.append(third.local(world_from_scene() @ scene.bodies[2]))
        told.append(map_uncertainty(made).keyframe_covariance[12:18, 12:18])
    assert_consistent(np.array(off), np.array(told))


def test_a_drone_that_shares_too_few_landmarks_with_two_others_is_left_out() -> None:
    rng = np.random.default_rng(0)
    made = first_map(rng, chained(rng, 4))
    assert [k.drone_id for k in made.keyframes] == [1, 2]


@pytest.mark.parametrize("n_wrong", [0, 8])
def test_the_length_is_that_of_most_landmarks(n_wrong: int) -> None:
    rng = np.random.default_rng(1)
    scene = facade_scene(rng, 20, noise_px=0.2)
    a, b = scene.worlds_from_cams
    b_from_a = b.inverse() @ a
    length = float(np.linalg.norm(b_from_a.translation))
    points = a.inverse().apply(scene.points_world)
    points[:n_wrong] *= rng.uniform(1.5, 3.0, (n_wrong, 1))
    both = scene.seen.all(axis=1)
    found = with_length(
        Pose(b_from_a.rotation, b_from_a.translation / length),
        points[both],
        scene.ideal[both, 1],
        scene.camera,
        LENGTH,
    )
    assert not isinstance(found, NotFound)
    pose, agree = found
    assert np.linalg.norm(pose.translation) == pytest.approx(length, rel=0.01)
    np.testing.assert_allclose(pose.rotation, b_from_a.rotation)
    np.testing.assert_array_equal(agree, np.flatnonzero(both) >= n_wrong)


@pytest.mark.parametrize("n_right", [0, 19])
def test_wrong_matches_on_lines_that_the_image_cuts_short_tell_no_length(n_right: int) -> None:
    # A camera that leaves behind nearly all that is mapped, over ground of which one spot looks
    # like another: a landmark is matched with what lies on its line inside the image.
    rng = np.random.default_rng(4)
    aside, length = Pose(np.eye(3), np.array([1.0, 0.0, 0.0])), 12.0
    points = rng.uniform([-5.0, -4.0, 8.0], [8.0, 4.0, 9.0], (150, 3))
    points[:n_right, 0] = rng.uniform(-8.0, -5.0, n_right)
    room = CAMERA.width_px / 2 / CAMERA.focal_px - points[:, 0] / points[:, 2]
    shift = rng.uniform(0.0, np.maximum(room, 0.02))
    shift[:n_right] = length / points[:n_right, 2]
    seen = points[:, :2] / points[:, 2:]
    seen[:, 0] += shift
    found = with_length(aside, points, seen, CAMERA, MapOptions())
    if n_right:
        assert not isinstance(found, NotFound)
        assert np.linalg.norm(found[0].translation) == pytest.approx(length, rel=0.01)
        assert found[1][:n_right].all()
    else:
        assert isinstance(found, NotFound)
        assert "agree on how long" in found.reason


def test_landmarks_that_contradict_each_other_give_no_length() -> None:
    rng = np.random.default_rng(2)
    aside = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    points = rng.uniform([-3.0, -2.0, 4.0], [3.0, 2.0, 40.0], (20, 3))
    found = with_length(aside, points, rng.uniform(-1, 1, (20, 2)), CAMERA, LENGTH)
    assert isinstance(found, NotFound)
    assert "agree on how long" in found.reason
    few = with_length(aside, points[:5], np.zeros((5, 2)), CAMERA, LENGTH)
    assert isinstance(few, NotFound)
    assert "6 needed" in few.reason


def test_a_length_that_landmarks_know_too_vaguely_is_none() -> None:
    rng = np.random.default_rng(3)
    aside = Pose(np.eye(3), np.array([1.0, 0.0, 0.0]))
    points = rng.uniform([-3.0, -2.0, 30.0], [3.0, 2.0, 40.0], (8, 3))
    seen = (points + aside.translation)[:, :2] / points[:, 2:] + rng.normal(0.0, 0.01, (8, 2))
    found = with_length(
        aside, points, seen, CAMERA, replace(LENGTH, max_error_px=3.0, max_depth_error=0.05)
    )
    assert isinstance(found, NotFound)
    assert "% only" in found.reason
    assert not isinstance(
        with_length(
            aside, points, seen, CAMERA, replace(LENGTH, max_error_px=3.0, max_depth_error=0.5)
        ),
        NotFound,
    )


def extended_by(scene: Scene, views: list[DroneView]) -> LandmarkMap:
    """Return the first two drones' map, extended by the other views where they fit it."""
    old = reconstruct(views[:2], 1, [(1, 2, scene.baseline_m(0, 1))], OPTIONS)
    assert isinstance(old, LandmarkMap), old

    def features_of(image_bytes: bytes, _: Camera, detector: Detector) -> Features:
        assert detector == "akaze"
        return next(v.features[0] for v in views if v.image_bytes == image_bytes)

    made = extended(old, b"revision", views[2:], features_of, OPTIONS)
    return made if isinstance(made, LandmarkMap) else old


def late(rng: np.random.Generator, n_common: int, outliers: float) -> tuple[Scene, LandmarkMap]:
    """Return a scene, and the first two drones' map of it extended by the third's view."""
    scene = chained(rng, n_common, outliers)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    return scene, extended_by(scene, views)


def test_a_late_drone_is_chained_to_a_keyframe_and_errs_as_much_as_stated() -> None:
    off, told = [], []
    for seed in range(12):
        scene, made = late(np.random.default_rng(seed), 14, 0.05)
        assert [k.drone_id for k in made.keyframes] == [1, 2, 3]
        off.append(made.keyframes[2].world_from_body.local(world_from_scene() @ scene.bodies[2]))
        told.append(map_uncertainty(made).keyframe_covariance[12:18, 12:18])
    assert_consistent(np.array(off), np.array(told))


def test_landmarks_that_have_their_like_elsewhere_in_the_image_are_found_on_their_lines() -> None:
    rng = np.random.default_rng(5)
    scene = chained(rng, 20)
    views = drone_views(rng, scene, [1, 2, 3], attitude_sigma_rad=0.02)
    (own,) = views[2].features
    # Each landmark of the map has another corner of the third image that resembles it.
    mapped = {bytes(d[4:]) for d in views[1].features[0].descriptors}
    known = [i for i, d in enumerate(own.descriptors) if bytes(d[4:]) in mapped]
    assert len(known) > 15
    like = Features(rng.uniform((0, 0), (640, 480), (len(known), 2)), own.descriptors[known])
    views[2] = replace(views[2], features=(joined_features([own, like]),))
    made = extended_by(scene, views)
    assert [k.drone_id for k in made.keyframes] == [1, 2, 3]
    off = made.keyframes[2].world_from_body.local(world_from_scene() @ scene.bodies[2])
    told = map_uncertainty(made).keyframe_covariance[12:18, 12:18]
    assert_consistent(off[None], told[None])


def test_a_drone_is_chained_to_one_that_has_just_joined() -> None:
    rng = np.random.default_rng(6)
    n_common = 14
    scene = facade_scene(rng, 2 * N_SEEN - n_common, n_views=4, noise_px=0.3, turn_deg=2.0)
    observed = scene.observed_px.copy()
    # The third sees all of the map, and as much besides; the fourth that, and hardly the map.
    observed[N_SEEN:, :2] = np.nan
    observed[: N_SEEN - n_common, 3] = np.nan
    scene = replace(scene, observed_px=observed)
    views = drone_views(rng, scene, [1, 2, 3, 4], attitude_sigma_rad=0.02)
    made = extended_by(scene, views)
    assert [k.drone_id for k in made.keyframes] == [1, 2, 3, 4]
    off = made.keyframes[3].world_from_body.local(world_from_scene() @ scene.bodies[3])
    told = map_uncertainty(made).keyframe_covariance[18:24, 18:24]
    assert_consistent(off[None], told[None])


def test_a_late_drone_that_shares_hardly_a_landmark_is_left_out() -> None:
    _, made = late(np.random.default_rng(0), 4, 0.0)
    assert [k.drone_id for k in made.keyframes] == [1, 2]
