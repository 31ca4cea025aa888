"""The map's bytes: exact enough, stable, small, and safe to decode whoever sent them."""

from __future__ import annotations

import dataclasses
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.wire.golden import assert_golden
from tests.wire.samples import random_map, random_pose, small_map
from vcl_companion.errors import WireError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.mapping.landmark_map import KnownDistance, LandmarkMap
from vcl_companion.wire.frame_codec import decode_frame
from vcl_companion.wire.header import PROTOCOL_VERSION, BlobKind, VersionMismatchError
from vcl_companion.wire.map_codec import decode_map, encode_map, parent_of, revision_of

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
    assert a.points_world.shape == b.points_world.shape
    assert np.abs(a.points_world - b.points_world).max(initial=0.0) <= 2.0**-13
    assert np.array_equal(a.seen, b.seen)
    assert np.abs(a.observed_px - b.observed_px)[a.seen].max(initial=0.0) <= 2.0**-6
    for name in ("pixel_noise_px", "detectors", "distances", "parent"):
        assert getattr(a, name) == getattr(b, name)
    assert np.array_equal(a.anchor_covariance, b.anchor_covariance)


def test_golden_bytes() -> None:
    data = encode_map(small_map())
    assert_golden("map", data)
    assert_maps_close(decode_map(data), small_map())
    assert revision_of(data).hex() == "ff15c6f69aafc847"


@given(_maps)
@settings(max_examples=60)
def test_round_trip_keeps_the_map_and_the_bytes(landmark_map: LandmarkMap) -> None:
    data = encode_map(landmark_map)
    decoded = decode_map(data)
    assert_maps_close(landmark_map, decoded)
    assert encode_map(decoded) == data
    assert len(revision_of(data)) == 8


@given(_maps, st.data())
@settings(max_examples=150)
def test_mutated_maps_are_a_map_with_exactly_these_bytes_or_a_wire_error(
    landmark_map: LandmarkMap, data: st.DataObject
) -> None:
    mutated = bytearray(encode_map(landmark_map))
    for _ in range(data.draw(st.integers(1, 3))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        decoded = decode_map(bytes(mutated))
    except WireError:
        return
    assert encode_map(decoded) == bytes(mutated)


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


def test_a_thousand_landmarks_in_two_keyframes_take_less_than_18_kb_without_images() -> None:
    rng = np.random.default_rng(1)
    m = random_map(rng, 1000, 2, seen_share=1.0)
    images = sum(len(keyframe.image_bytes) for keyframe in m.keyframes)
    assert 12_000 < len(encode_map(m)) - images < 18_000


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
        head = struct.pack("<BBHHId8s", 1, 0, n_keyframes, n_distances, n_landmarks, 0.5, bytes(8))
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
    at = len(bytes([PROTOCOL_VERSION, BlobKind.MAP])) + struct.calcsize("<BBHHId8s")
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
    at = len(bytes([PROTOCOL_VERSION, BlobKind.MAP])) + struct.calcsize("<BBHHId8s") + 8
    negative = data[:at] + struct.pack("<d", -0.0) + data[at + 8 :]
    assert encode_map(decode_map(negative)) == negative != data


@given(st.one_of(st.just(b""), st.binary(min_size=8, max_size=8)))
def test_the_parent_is_read_without_the_rest(parent: bytes) -> None:
    data = encode_map(replace(small_map(), parent=parent))
    assert parent_of(data) == parent_of(data[:40]) == decode_map(data).parent == parent


@given(st.binary(max_size=60), st.sampled_from([b"", b"\x01", b"\x01\x42"]))
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
