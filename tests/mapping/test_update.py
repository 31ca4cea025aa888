"""A map that grows: in the same world, as good as it says, or refused with a reason."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.checks import assert_pose_close
from tests.mapping.rendered import panels, rendered_view
from tests.mapping.views import descriptors_of, drone_views, world_from_scene
from tests.scenes import PINHOLE, Scene, observe
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_euler
from vcl_companion.mapping.continuity import MAX_IMAGE_BYTES
from vcl_companion.mapping.drone_view import DroneView
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import MapOptions, NoMap
from vcl_companion.mapping.reconstruction import reconstruct
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.mapping.update import extend_map, extended
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD
from vcl_companion.vision.features import Detector, Features
from vcl_companion.wire.header import MAX_BLOB_BYTES
from vcl_companion.wire.map_codec import MAX_CELLS, MAX_KEYFRAMES, decode_map, encode_map

OPTIONS = MapOptions(detectors=("akaze",))
MOUNTING = Pose(BODY_FROM_CAM_FORWARD, np.array([0.1, 0.0, 0.05]))
PARENT = b"revision"
NOISE_PX = 0.4


def street(rng: np.random.Generator, n: int = 1100, length_m: float = 60.0) -> Array:
    """Return (N, 3) landmarks on a facade 12 m north of the first drone, with relief."""
    return np.stack(
        [
            12.0 + 4.0 * (rng.random(n) - 0.5),
            length_m * rng.random(n) - 12.0,
            16.0 * (rng.random(n) - 0.5),
        ],
        axis=1,
    )


def at(x: float, y: float, z: float = 0.0, yaw_deg: float = 0.0) -> Pose:
    return Pose(matrix_from_euler(0.02, -0.03, np.deg2rad(yaw_deg)), np.array([x, y, z]))


FIRST = (Pose.identity(), at(0.3, 2.0, -0.4, 3.0), at(-0.2, -2.0, 0.5, -4.0))
LATER = (at(-1.5, 5.0, 0.3, 2.0), at(-1.0, 7.5, -0.5, -3.0), at(-2.0, 3.5, 0.6, 4.0))


def flight(
    rng: np.random.Generator, bodies: tuple[Pose, ...], ids: list[int], noise_px: float = NOISE_PX
) -> tuple[Scene, list[DroneView]]:
    """Return what drones see of a street, one view for each pose; the first three make the map."""
    scene = observe(rng, street(rng), bodies, (MOUNTING,) * len(bodies), PINHOLE, noise_px=noise_px)
    views = drone_views(rng, scene, ids, attitude_sigma_rad=0.02)
    # No images: what is tested here is registration by features. Bytes tell the views apart.
    return scene, [replace(v, image_bytes=b"view %d" % k) for k, v in enumerate(views)]


def first_map(scene: Scene, views: list[DroneView]) -> LandmarkMap:
    known = [(1, 2, scene.baseline_m(0, 1))]
    found = reconstruct(views[:3], 1, known, OPTIONS)
    assert isinstance(found, LandmarkMap), found
    return found


def extension(
    old: LandmarkMap,
    views: list[DroneView],
    new: list[DroneView],
    options: MapOptions = OPTIONS,
) -> LandmarkMap | NoMap:
    """Extend a map whose keyframes' features are those of the views they were."""

    def features_of(image_bytes: bytes, camera: Camera, detector: Detector) -> Features:
        view = next(v for v in [*views, *new] if v.image_bytes == image_bytes)
        return view.features[options.detectors.index(detector)]

    return extended(old, PARENT, new, features_of, options)


def grown(
    old: LandmarkMap,
    views: list[DroneView],
    new: list[DroneView],
    options: MapOptions = OPTIONS,
) -> LandmarkMap:
    found = extension(old, views, new, options)
    assert isinstance(found, LandmarkMap), found
    return found


def sigma_m(landmark_map: LandmarkMap, i: int) -> float:
    covariance = map_uncertainty(landmark_map).keyframe_covariance
    return float(np.sqrt(np.trace(covariance[6 * i : 6 * i + 3, 6 * i : 6 * i + 3])))


def assert_right(
    found: LandmarkMap, scene: Scene, views: list[DroneView], within_m: float = 0.15
) -> None:
    """Assert that every keyframe is where its view was, within what the map says of itself."""
    covariance = map_uncertainty(found).keyframe_covariance
    for i, keyframe in enumerate(found.keyframes[1:], start=1):
        name = (keyframe.drone_id, keyframe.captured_at_ns)
        k = next(n for n, v in enumerate(views) if (v.drone_id, v.captured_at_ns) == name)
        truth = world_from_scene() @ scene.bodies[k]
        error = truth.local(keyframe.world_from_body)
        own = covariance[6 * i : 6 * i + 6, 6 * i : 6 * i + 6]
        # 99.99 % of chi-square with 6 degrees of freedom.
        assert error @ np.linalg.solve(own, error) < 27.9, (i, error)
        assert_pose_close(keyframe.world_from_body, truth, within_m=within_m, within_rad=0.01)


def test_new_views_carry_the_map_along_the_street() -> None:
    rng = np.random.default_rng(0)
    scene, views = flight(rng, FIRST + LATER, [1, 2, 3, 1, 2, 3])
    old = first_map(scene, views)
    found = grown(old, views, views[3:])
    assert found.parent == PARENT
    assert found.distances == old.distances
    assert [k.drone_id for k in found.keyframes] == [1, 2, 3, 1, 2, 3]
    assert len(found.points_world) > 1.2 * len(old.points_world)
    assert found.pixel_noise_px == pytest.approx(NOISE_PX, rel=0.1)
    assert_right(found, scene, views)
    first = found.keyframes[0].world_from_body
    assert_pose_close(first, old.keyframes[0].world_from_body, within_m=1e-12, within_rad=1e-12)
    data = encode_map(found)
    assert encode_map(decode_map(data)) == data


def test_without_noise_the_extended_map_is_exact() -> None:
    rng = np.random.default_rng(1)
    scene, views = flight(rng, FIRST + LATER, [1, 2, 3, 1, 2, 3], noise_px=0.0)
    found = grown(first_map(scene, views), views, views[3:])
    for keyframe, body in zip(found.keyframes, scene.bodies, strict=True):
        truth = world_from_scene() @ body
        assert_pose_close(keyframe.world_from_body, truth, within_m=1e-4, within_rad=1e-5)


def test_old_landmarks_stay_where_they_were_within_their_sigma() -> None:
    rng = np.random.default_rng(2)
    scene, views = flight(rng, FIRST + LATER, [1, 2, 3, 1, 2, 3])
    old = first_map(scene, views)
    found = grown(old, views, views[3:])
    # The same landmark by its pixel in the first keyframe.
    gap = np.linalg.norm(old.observed_px[:, None, 0] - found.observed_px[None, :, 0], axis=2)
    gap[~np.isfinite(gap)] = np.inf
    j, place = np.flatnonzero(gap.min(axis=1) == 0.0), gap.argmin(axis=1)
    assert len(j) > 0.9 * np.isfinite(old.observed_px[:, 0, 0]).sum()
    moved = found.points_world[place[j]] - old.points_world[j]
    covariance = map_uncertainty(old).marginal()[j]
    squared = np.einsum("ni,ni->n", moved, np.linalg.solve(covariance, moved[..., None])[..., 0])
    assert np.quantile(squared, 0.9) < 16.3
    assert np.linalg.norm(moved, axis=1).max() > 1e-4


def test_a_flight_along_the_street_keeps_its_scale() -> None:
    """Twelve metres sideways in three updates; the error grows by no more than it says."""
    rng = np.random.default_rng(3)
    side_by_side = ((0.0, 0.0, 2.0), (2.0, 0.4, -2.0), (-2.0, -0.4, 1.0))
    later = tuple(
        at(-0.5 * n, 3.5 * n + y, z, yaw_deg) for n in (1, 2, 3) for y, z, yaw_deg in side_by_side
    )
    bodies = FIRST + later
    scene, views = flight(rng, bodies, [1, 2, 3] * 4)
    found = first_map(scene, views)
    for n in (3, 6, 9):
        found = grown(found, views, views[n : n + 3])
    assert len(found.keyframes) == 12
    assert_right(found, scene, views)


def test_a_drone_that_joins_late_is_registered_by_its_own_parallax() -> None:
    """Its last view sees the map; the others see what only that one shares with them."""
    rng = np.random.default_rng(4)
    own = tuple(at(-1.0, y, 0.3 * n, 2.0 * n) for n, y in enumerate((34.0, 26.0, 18.0, 9.0)))
    scene, views = flight(rng, FIRST + own, [1, 2, 3, 4, 4, 4, 4])
    old = first_map(scene, views)
    assert isinstance(extension(old, views, views[3:4]), NoMap)
    found = grown(old, views, views[3:])
    assert [k.drone_id for k in found.keyframes] == [1, 2, 3, 4, 4, 4, 4]
    assert_right(found, scene, views)


def shared_little(
    rng: np.random.Generator, views: list[DroneView], n_common: int
) -> list[DroneView]:
    """Let each late view see only so many of the map's landmarks, of twice as many altogether."""
    late = {name(d) for v in views[3:] for d in v.features[0].descriptors}
    mapped = sorted(late & {name(d) for v in views[:3] for d in v.features[0].descriptors})
    common = {mapped[k] for k in rng.permutation(len(mapped))[: 3 * n_common]}
    strangers = {key: bytes(descriptors_of(rng, 1)[0, 4:]) for key in mapped if key not in common}
    out = list(views[:3])
    for view in views[3:]:
        features = view.features[0]
        names = [name(d) for d in features.descriptors]
        shared = [i for i, key in enumerate(names) if key in common]
        gone = rng.permutation(shared)[n_common:]
        descriptors = features.descriptors.copy()
        for i, key in enumerate(names):
            if key in strangers:
                descriptors[i, 4:] = np.frombuffer(strangers[key], np.uint8)
        kept = Features(
            np.delete(features.pixels, gone, axis=0), np.delete(descriptors, gone, axis=0)
        )
        out.append(replace(view, features=(kept,)))
    return out


def name(descriptor: NDArray[np.generic]) -> bytes:
    """Return the part of a descriptor that is the same in every image."""
    return bytes(descriptor[4:])


def test_views_none_of_which_can_be_registered_alone_join_together() -> None:
    rng = np.random.default_rng(5)
    own = tuple(at(-2.0 + 0.4 * n, 1.5 * n - 2.0, 0.5 * n - 1.0, 2.0 * n) for n in range(4))
    scene, views = flight(rng, FIRST + own, [1, 2, 3, 4, 4, 4, 4])
    views = shared_little(rng, views, 16)
    old = first_map(scene, views)
    for n in range(3, 7):
        alone = extension(old, views, [views[n]])
        assert isinstance(alone, NoMap)
        assert "drone 4" in alone.reason
    found = grown(old, views, views[3:])
    assert [k.drone_id for k in found.keyframes] == [1, 2, 3, 4, 4, 4, 4]
    assert_right(found, scene, views)
    apart = replace(OPTIONS, max_depth_error=1e-4)
    assert isinstance(extension(old, views, views[3:], apart), NoMap)


def test_a_view_is_not_registered_on_landmarks_of_hardly_any_parallax() -> None:
    """The trap: many landmarks agree on a pose metres off; their depth is what they do not know."""
    rng = np.random.default_rng(6)
    near = (Pose.identity(), at(0.0, 0.5, 0.0), at(0.05, -0.4, 0.1))
    far = (at(4.0, 7.0, 0.0, -50.0),)
    loose = replace(OPTIONS, min_angle_deg=0.3, max_depth_error=0.45)
    scene, views = flight(rng, near + far, [1, 2, 3, 4], noise_px=0.8)
    old = reconstruct(views[:3], 1, [(1, 2, scene.baseline_m(0, 1))], loose)
    assert isinstance(old, LandmarkMap), old
    found = extension(old, views, views[3:], loose)
    if isinstance(found, LandmarkMap):
        truth = world_from_scene() @ scene.bodies[3]
        error = truth.local(found.keyframes[3].world_from_body)
        covariance = map_uncertainty(found).keyframe_covariance[18:, 18:]
        assert error @ np.linalg.solve(covariance, error) < 27.9
    # Whoever wants landmarks known to a tenth of their distance gets no pose by these.
    strict = replace(loose, max_depth_error=0.02)
    assert isinstance(extension(old, views, views[3:], strict), NoMap)


def test_a_view_that_does_not_fit_is_left_out() -> None:
    rng = np.random.default_rng(7)
    scene, views = flight(rng, FIRST + LATER, [1, 2, 3, 1, 2, 3])
    foreign = views[4].features[0]
    unknown = Features(foreign.pixels, descriptors_of(rng, len(foreign)))
    views[4] = replace(views[4], features=(unknown,))
    old = first_map(scene, views)
    found = grown(old, views, views[3:])
    assert [k.captured_at_ns for k in found.keyframes[3:]] == [1_000_003, 1_000_005]
    assert_right(found, scene, views)
    alone = extension(old, views, [views[4]])
    assert isinstance(alone, NoMap)
    assert alone.reason.startswith("no new view fits the map: drone 2: ")


def test_a_view_turned_against_its_autopilot_is_left_out() -> None:
    rng = np.random.default_rng(8)
    scene, views = flight(rng, FIRST + LATER[:1], [1, 2, 3, 1])
    assert views[3].ned_from_body is not None
    upset = exp_so3(np.deg2rad([30.0, 0.0, 0.0])) @ views[3].ned_from_body
    old = first_map(scene, views)
    refused = extension(old, views, [replace(views[3], ned_from_body=upset)])
    assert isinstance(refused, NoMap)
    assert "disagrees with its autopilot's attitude" in refused.reason


def test_no_view_or_a_known_one_is_no_update() -> None:
    rng = np.random.default_rng(9)
    scene, views = flight(rng, FIRST, [1, 2, 3])
    old = first_map(scene, views)
    for new in ([], views[:1]):
        refused = extension(old, views, new)
        assert isinstance(refused, NoMap)
        assert "does not have already" in refused.reason


def test_an_old_map_that_is_not_where_it_says_is_not_bent_to_fit() -> None:
    """New views, right, on an old map out of shape: it would have to move by more than it can."""
    rng = np.random.default_rng(10)
    scene, views = flight(rng, FIRST + LATER, [1, 2, 3, 1, 2, 3])
    old = first_map(scene, views)
    y = old.points_world @ world_from_scene().rotation[:, 1]
    away = 0.02 * (y[:, None] ** 2) * world_from_scene().rotation[:, 0]
    refused = extension(replace(old, points_world=old.points_world + away), views, views[3:])
    assert isinstance(refused, NoMap)
    assert "old landmarks" in refused.reason


def test_the_number_of_keyframes_and_landmarks_is_bounded() -> None:
    rng = np.random.default_rng(11)
    later = tuple(at(-1.0, 1.5 * n, 0.3, 1.0) for n in range(1, 6))
    scene, views = flight(rng, FIRST + later, [1, 2, 3, 1, 2, 3, 1, 2])
    options = replace(OPTIONS, max_keyframes=5, max_landmarks=200)
    found = grown(first_map(scene, views), views, views[3:5], options)
    found = grown(found, views, views[5:8], options)
    assert len(found.keyframes) == 5
    assert len(found.points_world) == 200
    names = [k.captured_at_ns - 1_000_000 for k in found.keyframes]
    assert names == [0, 4, 5, 6, 7]
    # The leader's first still fixes the frame; the known distance went with the other drone's.
    assert not found.anchor_covariance.any()
    (distance,) = found.distances
    assert distance.keyframe_a == 0
    truth_m = scene.baseline_m(0, names[distance.keyframe_b])
    assert abs(distance.distance_m - truth_m) < 4.0 * distance.sigma_m
    assert_right(found, scene, views)


def test_a_map_goes_on_when_its_beginning_is_too_far_behind() -> None:
    """Frame and scale pass to what is left, as well known as that is by then."""
    rng = np.random.default_rng(13)
    later = tuple(at(-1.0, 2.7 * n, 0.3 * (-1) ** n, 1.0) for n in range(1, 16))
    ids = [1, 2, 3] + [1 + n % 3 for n in range(15)]
    scene, views = flight(rng, FIRST + later, ids)
    options = replace(OPTIONS, max_keyframes=6)
    found = first_map(scene, views)
    sigmas = []
    for k in range(3, 18, 3):
        found = grown(found, views, views[k : k + 3], options)
        sigmas.append(sigma_m(found, 0))
    names = [k.captured_at_ns - 1_000_000 for k in found.keyframes]
    assert names[0] > 5
    assert names[-3:] == [15, 16, 17]
    assert sigmas[0] == 0.0
    assert 0.0 < sigmas[-2] < sigmas[-1] < 0.2
    (distance,) = found.distances
    truth_m = scene.baseline_m(names[0], names[distance.keyframe_b])
    assert 1e-3 * truth_m < distance.sigma_m < 0.02 * truth_m
    assert abs(distance.distance_m - truth_m) < 4.0 * distance.sigma_m
    assert_right(found, scene, views, within_m=0.5)
    truth = world_from_scene() @ scene.bodies[names[0]]
    error = truth.local(found.keyframes[0].world_from_body)
    assert error @ np.linalg.solve(found.anchor_covariance, error) < 27.9


def test_the_update_of_a_seed_is_one_update() -> None:
    rng = np.random.default_rng(12)
    scene, views = flight(rng, FIRST + LATER, [1, 2, 3, 1, 2, 3])
    old = first_map(scene, views)
    one, other = (grown(old, views, views[3:]) for _ in range(2))
    np.testing.assert_array_equal(one.points_world, other.points_world)
    np.testing.assert_array_equal(one.observed_px, other.observed_px)


@pytest.mark.parametrize("detectors", [("akaze", "sift"), ("orb",)])
def test_rendered_views_extend_a_map_whatever_it_is_made_of(
    detectors: tuple[Detector, ...],
) -> None:
    """Descriptors of old landmarks come from the keyframe images, whichever detector is set."""
    options = MapOptions(detectors=detectors)
    scene = panels(np.random.default_rng(13))
    bodies = [at(0.0, 0.0), at(0.2, 1.5, -0.3), at(-1.0, 3.0, 0.2), at(-0.8, 4.5, -0.2)]
    views = [
        rendered_view(scene, 1 + k % 2, k // 2, body, MOUNTING, options)
        for k, body in enumerate(bodies)
    ]
    known = float(np.linalg.norm(bodies[0].translation - bodies[1].translation))
    old = reconstruct(views[:2], 1, [(1, 2, known)], options)
    assert isinstance(old, LandmarkMap), old
    old = decode_map(encode_map(old))
    found = extend_map(old, PARENT, views[2:], options)
    assert isinstance(found, LandmarkMap), found
    assert found.detectors == detectors
    assert len(found.points_world) > 1.2 * len(old.points_world)
    for keyframe, body in zip(found.keyframes, bodies, strict=True):
        assert_pose_close(keyframe.world_from_body, body, within_m=0.1, within_rad=0.01)
    data = encode_map(found)
    assert encode_map(decode_map(data)) == data


def test_an_encoded_map_of_the_largest_size_passes_as_one_blob() -> None:
    """Pixels of 16 000 landmarks take two bytes and a bit each way, in four images on average."""
    table = 16_000 * (3 * 5 + 4 * 2 * 3) + 64 * 16_000 // 8
    assert MAX_IMAGE_BYTES + table < MAX_BLOB_BYTES
    assert MAX_CELLS >= 16_000 * 64
    assert MapOptions.max_keyframes <= MAX_KEYFRAMES
