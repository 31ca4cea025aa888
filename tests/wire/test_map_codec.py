"""The map's bytes: exact enough, stable, small, and safe to decode whoever sent them."""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.wire.golden import assert_golden
from tests.wire.samples import random_map, random_pose, scene_map, small_map, small_merged_map
from vcl_companion.errors import WireError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import Keyframe, KnownDistance, LandmarkMap
from vcl_companion.wire.frame_codec import decode_frame
from vcl_companion.wire.header import PROTOCOL_VERSION, BlobKind, VersionMismatchError
from vcl_companion.wire.map_codec import decode_map, encode_map, parent_of, revision_of

_HEAD = "<BBHHId8sB8sB"

_maps = st.builds(
    random_map,
    st.integers(0, 2**32).map(np.random.default_rng),
    st.integers(0, 40),
    st.integers(1, 5),
    st.sampled_from([0.0, 0.3, 1.0]),
)


def assert_maps_close(a: LandmarkMap, b: LandmarkMap) -> None:
    for mine, yours in zip(a.keyframes, b.keyframes, strict=True):
        for name in ("drone_id", "captured_at_ns", "camera", "image_bytes"):
            assert getattr(mine, name) == getattr(yours, name)
        for name in ("world_from_body", "body_from_cam"):
            poses: tuple[Pose, Pose] = (getattr(mine, name), getattr(yours, name))
            assert np.array_equal(poses[0].translation, poses[1].translation)
            assert np.abs(poses[0].rotation - poses[1].rotation).max() < 5e-9
    a, b = in_order(a), in_order(b)
    assert a.points_world.shape == b.points_world.shape
    near = (np.abs(a.points_world - b.points_world) <= 2.0**-13).all(axis=1)
    for i, keyframe in enumerate(a.keyframes):
        anchored = ~near & a.seen[:, i] & ~a.seen[:, :i].any(axis=1)
        points = a.points_world[anchored], b.points_world[anchored]
        assert_anchored_close(points[0], points[1], a.seen[anchored], keyframe, a.keyframes)
        near |= anchored
    assert near.all()
    assert np.array_equal(a.seen, b.seen)
    assert np.abs(a.observed_px - b.observed_px)[a.seen].max(initial=0.0) <= 2.0**-6
    for name in ("pixel_noise_px", "detectors", "distances", "parent", "world"):
        assert getattr(a, name) == getattr(b, name)
    for one, other in zip(a.joined, b.joined, strict=True):
        assert (one.revision, one.world) == (other.revision, other.world)
        apart = one.world_from_other.difference(other.world_from_other)
        assert np.abs(apart).max() < 1e-8
    assert np.array_equal(a.anchor_covariance, b.anchor_covariance)


def in_order(m: LandmarkMap) -> LandmarkMap:
    """The map with its landmarks in an order that follows from where they are, seen first."""
    steps = np.rint(32.0 * np.where(m.seen[..., None], m.observed_px, -2.0)).reshape(
        len(m.seen), 2 * len(m.keyframes)
    )
    order = np.lexsort((*np.rint(4096.0 * m.points_world.T), *steps.T))
    return replace(m, points_world=m.points_world[order], observed_px=m.observed_px[order])


def assert_anchored_close(
    a: Array, b: Array, seen: NDArray[np.bool_], anchor: Keyframe, keyframes: tuple[Keyframe, ...]
) -> None:
    """Half a step of 1/32 px in the anchor, and in whoever sees it from farthest away."""
    bodies = np.array([k.world_from_body.translation for k in keyframes])
    far_m = np.linalg.norm(bodies - anchor.world_from_body.translation, axis=1)
    baseline_m = np.where(seen, np.hypot(far_m, 1.0), 0.0).max(axis=1, initial=0.0)
    cam_from_world = (anchor.world_from_body @ anchor.body_from_cam).inverse()
    in_cam = [cam_from_world.apply(points) for points in (a, b)]
    pixels = [anchor.camera.project(points) for points in in_cam]
    assert np.abs(pixels[0] - pixels[1]).max(initial=0.0) <= 1 / 64 + 1e-4
    nearer = np.abs(1.0 / in_cam[0][:, 2] - 1.0 / in_cam[1][:, 2])
    assert (nearer * anchor.camera.fx_px * baseline_m).max(initial=0.0) <= 1 / 64 + 1e-4


def test_golden_bytes() -> None:
    data = encode_map(small_map())
    assert_golden("map", data)
    assert_maps_close(decode_map(data), small_map())
    assert revision_of(data).hex() == "092642ae70439d85"


@given(_maps)
@settings(max_examples=60)
def test_round_trip_keeps_the_map_and_the_bytes(landmark_map: LandmarkMap) -> None:
    data = encode_map(landmark_map)
    decoded = decode_map(data)
    assert_maps_close(landmark_map, decoded)
    assert encode_map(decoded) == data
    assert len(revision_of(data)) == 8


def test_a_sighting_is_predicted_by_the_pose_that_is_told() -> None:
    """By the one before it is rounded, one sighting of this map came back a step off."""
    landmark_map = random_map(np.random.default_rng(78925), 21, 3, 1.0)
    assert_maps_close(landmark_map, decode_map(encode_map(landmark_map)))


_scenes = st.builds(
    scene_map,
    st.integers(0, 2**32).map(np.random.default_rng),
    st.integers(0, 40),
    st.integers(1, 5),
)


@given(st.one_of(_maps, _scenes), st.data())
@settings(max_examples=250)
def test_mutated_maps_are_a_map_with_exactly_these_bytes_or_a_wire_error(
    landmark_map: LandmarkMap, data: st.DataObject
) -> None:
    mutated = bytearray(encode_map(landmark_map))
    for _ in range(data.draw(st.integers(1, 3))):
        # From the end on: half of them should be in what is left of the landmarks there.
        mutated[-1 - data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        decoded = decode_map(bytes(mutated))
    except WireError:
        return
    assert encode_map(decoded) == bytes(mutated)


def test_a_landmark_that_lies_nowhere_is_a_wire_error() -> None:
    """Its pixel with this byte is one that the lens shows nothing at."""
    mutated = bytearray(encode_map(random_map(np.random.default_rng(33), 33, 1, 1.0)))
    mutated[-471] = 0
    with pytest.raises(WireError, match="a landmark lies nowhere"):
        decode_map(bytes(mutated))


@given(st.binary(max_size=300), st.booleans())
def test_any_bytes_are_a_wire_error_or_a_map(body: bytes, with_header: bool) -> None:
    header = bytes([PROTOCOL_VERSION, BlobKind.MAP]) if with_header else b""
    with pytest.raises(WireError):
        decode_map(header + body)


@given(st.data())
@settings(max_examples=60)
def test_a_cut_or_lengthened_map_is_a_wire_error(data: st.DataObject) -> None:
    whole = encode_map(small_map())
    cut = data.draw(st.integers(0, len(whole) - 1))
    for broken in (whole[:cut], whole + bytes(1 + cut % 5)):
        with pytest.raises(WireError):
            decode_map(broken)


@given(st.integers(0, 2**32))
@settings(max_examples=200)
def test_rotations_keep_their_bytes_near_every_tie(seed: int) -> None:
    """Quaternions with equal, zero and opposite parts: where a sign or an order could flip."""
    rng = np.random.default_rng(seed)
    quaternion = rng.choice([-1.0, 0.0, 1.0, 0.5, 1.0 - 1e-10, 1e-10], 4)
    if np.abs(quaternion).max() < 0.5:
        return
    pose = Pose.from_quaternion(quaternion, rng.uniform(-1, 1, 3))
    m = small_map()
    keyframe = replace(m.keyframes[0], world_from_body=pose)
    data = encode_map(replace(m, keyframes=(keyframe, m.keyframes[1])))
    decoded = decode_map(data)
    assert encode_map(decoded) == data
    assert np.abs(decoded.keyframes[0].world_from_body.rotation - pose.rotation).max() < 5e-9


def test_a_thousand_landmarks_in_three_keyframes_take_7_kb_without_images() -> None:
    m = scene_map(np.random.default_rng(1), 1000, 3)
    images = sum(len(keyframe.image_bytes) for keyframe in m.keyframes)
    assert 4_000 < len(encode_map(m)) - images < 7_500


@given(st.integers(0, 2**32).map(np.random.default_rng), st.integers(0, 60), st.integers(1, 6))
@settings(max_examples=40)
def test_a_map_of_a_scene_keeps_what_its_images_tell(
    rng: np.random.Generator, n_landmarks: int, n_keyframes: int
) -> None:
    m = scene_map(rng, n_landmarks, n_keyframes)
    data = encode_map(m)
    decoded = decode_map(data)
    assert_maps_close(m, decoded)
    assert encode_map(decoded) == data
    before, after = in_order(m), in_order(decoded)
    for i, keyframe in enumerate(m.keyframes):
        cam_from_world = keyframe.world_from_body.inverse()
        there = [
            keyframe.camera.project(cam_from_world.apply(it.points_world[it.seen[:, i]]))
            for it in (before, after)
        ]
        assert np.abs(there[0] - there[1]).max(initial=0.0) < 0.05


def test_golden_bytes_of_a_scene() -> None:
    data = encode_map(scene_map(np.random.default_rng(2), 12, 3))
    assert_golden("map_scene", data)
    assert encode_map(decode_map(data)) == data


def test_the_order_of_landmarks_is_told_by_where_they_are_seen() -> None:
    rng = np.random.default_rng(4)
    m = scene_map(rng, 80, 4)
    shuffled = rng.permutation(80)
    other = replace(m, points_world=m.points_world[shuffled], observed_px=m.observed_px[shuffled])
    assert encode_map(other) == encode_map(m)


def test_another_version_and_another_kind_are_recognised() -> None:
    data = encode_map(small_map())
    with pytest.raises(VersionMismatchError):
        decode_map(bytes([PROTOCOL_VERSION + 1]) + data[1:])
    with pytest.raises(WireError, match="not a frame answer"):
        decode_frame(data)


def test_hostile_counts_are_refused_before_any_work() -> None:
    header = bytes([PROTOCOL_VERSION, BlobKind.MAP])
    for n_keyframes, n_distances, n_landmarks in (
        (0, 0, 10),
        (65_535, 0, 10),
        (1, 65_535, 10),
        (1, 0, 2**32 - 1),
        (256, 0, 32_768),
    ):
        head = struct.pack(
            _HEAD, 1, 0, n_keyframes, n_distances, n_landmarks, 0.5, bytes(8), 0, bytes(8), 0
        )
        with pytest.raises(WireError, match=r"keyframes|distances|too many"):
            decode_map(header + head)


def _with_camera(m: LandmarkMap, camera: Camera) -> LandmarkMap:
    return replace(m, keyframes=(replace(m.keyframes[0], camera=camera), *m.keyframes[1:]))


def test_maps_out_of_bounds_are_not_encoded() -> None:
    m = small_map()
    points = m.points_world.copy()
    points[0, 0] = 40_000.0
    half_seen = m.observed_px.copy()
    half_seen[1, 1] = (3.0, np.nan)
    outside = m.observed_px.copy()
    outside[0, 0] = (642.0, 10.0)
    far = replace(m.keyframes[0], world_from_body=random_pose(np.random.default_rng(0), 1e7))
    cases = {
        "landmark lies further": replace(m, points_world=points),
        "only one of its two": replace(m, observed_px=half_seen),
        "outside of its image": replace(m, observed_px=outside),
        "detectors must be some of": replace(m, detectors=("surf",)),
        "parent revision": replace(m, parent=b"123"),
        "not a known distance": replace(m, distances=(KnownDistance(0, 1, float("nan"), 0.1),)),
        "out of range": replace(m, keyframes=(far, m.keyframes[1])),
        "image side": _with_camera(m, Camera(9000, 480, 400.0, 400.0, 320.0, 240.0)),
        "in all": _with_camera(m, Camera(2100, 2000, 900.0, 900.0, 1050.0, 1000.0)),
        "focal lengths": _with_camera(m, Camera(640, 480, 1e300, 400.0, 320.0, 240.0)),
    }
    for reason, broken in cases.items():
        with pytest.raises(ValueError, match=reason):
            encode_map(broken)


def test_a_name_of_nothing_but_zeros_is_none() -> None:
    """It would stand for none where there are always eight bytes, as in a state."""
    m = small_merged_map()
    data = encode_map(m)
    for name in (m.parent, m.world, m.joined[0].revision, m.joined[0].world):
        assert data.count(name) == 1
        with pytest.raises(WireError):
            decode_map(data.replace(name, bytes(8)))


def test_the_codec_carries_every_field_of_a_map() -> None:
    """A field added to the map must not silently stay at home."""
    names = {field.name for field in dataclasses.fields(LandmarkMap)}
    assert names == {
        "keyframes",
        "points_world",
        "observed_px",
        "pixel_noise_px",
        "detectors",
        "distances",
        "parent",
        "anchor_covariance",
        "world",
        "joined",
    }


def anchored_map() -> LandmarkMap:
    """The small map, its first keyframe known to 1 to 6 cm and tenths of a degree."""
    sigma = np.array([0.01, 0.02, 0.06, 0.001, 0.002, 0.003])
    alike = np.where(np.eye(6) > 0, 1.0, 0.25)
    return replace(small_map(), anchor_covariance=sigma[:, None] * alike * sigma)


def test_golden_bytes_of_a_map_that_began_elsewhere() -> None:
    data = encode_map(anchored_map())
    assert_golden("map_anchored", data)
    assert len(data) == len(encode_map(small_map())) + 21 * 8
    decoded = decode_map(data)
    assert_maps_close(decoded, anchored_map())
    assert encode_map(decoded) == data


def test_what_is_no_covariance_of_the_first_keyframe_is_refused() -> None:
    data = encode_map(anchored_map())
    at = len(bytes([PROTOCOL_VERSION, BlobKind.MAP])) + struct.calcsize(_HEAD)
    signalling = struct.unpack("<d", bytes.fromhex("010000000000f47f"))[0]  # warns when added
    for numbers in (
        [0.0] * 21, [float("nan")] * 21, [signalling] * 21, [-1.0] * 21, [1.0] + [9.0] * 20,
    ):  # fmt: skip
        broken = data[:at] + struct.pack("<21d", *numbers) + data[at + 21 * 8 :]
        with pytest.raises(WireError, match="covariance of its first keyframe"):
            decode_map(broken)
    with pytest.raises(WireError, match="unknown detectors"):
        decode_map(data[:2] + bytes([8]) + data[3:])
    with pytest.raises(ValueError, match="anchor_covariance must be a covariance"):
        replace(small_map(), anchor_covariance=-np.eye(6))


def test_a_negative_zero_in_the_covariance_stays_one() -> None:
    covariance = np.diag([1e-4] * 6)
    data = encode_map(replace(small_map(), anchor_covariance=covariance))
    at = len(bytes([PROTOCOL_VERSION, BlobKind.MAP])) + struct.calcsize(_HEAD) + 8
    negative = data[:at] + struct.pack("<d", -0.0) + data[at + 8 :]
    assert encode_map(decode_map(negative)) == negative != data


@given(st.one_of(st.just(b""), st.binary(min_size=8, max_size=8).filter(any)))
def test_the_parent_is_read_without_the_rest(parent: bytes) -> None:
    data = encode_map(replace(small_map(), parent=parent))
    assert parent_of(data) == parent_of(data[:40]) == decode_map(data).parent == parent


@given(st.binary(max_size=60), st.sampled_from([b"", b"\x03", b"\x03\x42"]))
def test_of_any_bytes_a_parent_or_a_wire_error(body: bytes, head: bytes) -> None:
    try:
        parent = parent_of(head + body)
    except WireError:
        return
    assert len(parent) in (0, 8)


def test_an_observation_left_of_or_above_its_image_is_not_taken_for_none() -> None:
    for pixel in ((-1.5, 10.0), (10.0, -1.5), (-1.5, -1.5)):
        observed_px = small_map().observed_px.copy()
        observed_px[0, 0] = pixel
        with pytest.raises(ValueError, match="outside of its image"):
            encode_map(replace(small_map(), observed_px=observed_px))


def test_golden_bytes_of_a_map_that_others_were_merged_into() -> None:
    data = encode_map(small_merged_map())
    assert_golden("map_merged", data)
    assert len(data) == len(encode_map(small_map())) + 2 * 64
    decoded = decode_map(data)
    assert_maps_close(decoded, small_merged_map())
    assert encode_map(decoded) == data
    assert decoded.world_of(b"whatever") == b"of first"
    assert small_map().world_of(b"revision") == b"revision"


def test_what_cannot_be_said_of_where_a_map_comes_from_is_refused() -> None:
    """Bytes that an honest map never has, each told apart from a map's that is."""
    whole = encode_map(small_merged_map())
    first = 2 + struct.calcsize(_HEAD) + struct.calcsize("<2H2d")
    scale = first + 16 + 40
    zeros = bytes(8)
    cases = {
        "parent revision or world": (28, b"\x07"),
        "malformed parent": (28, b"\x00"),
        "joined maps, at most 16": (37, b"\x11"),
        "at a scale of": (scale, struct.pack("<d", 10.01)),
        "at a scale of 0": (scale, struct.pack("<d", 0.0)),
        "at a scale of nan": (scale, struct.pack("<d", float("nan"))),
        "at a scale of -1": (scale, struct.pack("<d", -1.0)),
        "rotation is not normalised": (first + 16, bytes(16)),
        "pose lies out of range": (first + 32, struct.pack("<d", float("inf"))),
        "first map is its own": (3, b"\0" + whole[4:20] + zeros),
        "none of a first map": (28, b"\0" + zeros),
    }
    for reason, (at, wrong) in cases.items():
        with pytest.raises(WireError, match=reason):
            decode_map(whole[:at] + wrong + whole[at + len(wrong) :])


@given(st.data())
@settings(max_examples=150)
def test_mutated_joined_maps_are_exactly_these_bytes_or_a_wire_error(data: st.DataObject) -> None:
    whole = encode_map(small_merged_map())
    end = 2 + struct.calcsize(_HEAD) + struct.calcsize("<2H2d") + 2 * 64
    at = data.draw(st.integers(28, end - 1))
    mutated = whole[:at] + data.draw(st.binary(min_size=1, max_size=9)) + whole[at + 1 :]
    try:
        decoded = decode_map(mutated)
    except WireError:
        return
    assert encode_map(decoded) == mutated


def test_maps_that_say_nonsense_of_their_line_are_not_made() -> None:
    merged = small_merged_map()
    many = merged.joined[:1] * 17
    for broken, reason in (
        ({"parent": b""}, "world is none"),
        ({"world": b"123"}, "world is none"),
        ({"world": b""}, "cannot have been merged"),
        ({"joined": many}, "17 maps"),
    ):
        with pytest.raises(ValueError, match=reason):
            replace(merged, **broken)
    with pytest.raises(ValueError, match="revision must have 8 bytes"):
        replace(merged.joined[0], revision=b"short")
