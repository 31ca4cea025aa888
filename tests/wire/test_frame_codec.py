"""The frame answer's bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.wire.golden import assert_golden
from tests.wire.samples import CAMERAS, random_pose, small_frame
from vcl_companion.errors import WireError
from vcl_companion.mapping.seen_landmarks import MAX_SEEN, SeenLandmarks
from vcl_companion.wire.frame_codec import FrameAnswer, decode_frame, encode_frame
from vcl_companion.wire.header import PROTOCOL_VERSION, BlobKind, VersionMismatchError
from vcl_companion.wire.map_codec import MAX_LANDMARKS


@st.composite
def _seen(draw: st.DrawFn) -> SeenLandmarks:
    n_flags = draw(st.integers(1, 3000))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    n = min(draw(st.integers(1, MAX_SEEN)), n_flags)
    landmarks = np.sort(rng.choice(n_flags, n, replace=False))
    aside = np.clip(rng.normal(0.0, draw(st.sampled_from([0.1, 2.0])), (n, 2)), -4.0, 4.0)
    return SeenLandmarks(rng.bytes(8), landmarks, aside)


@st.composite
def _frames(draw: st.DrawFn) -> FrameAnswer:
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    knows = draw(st.booleans())
    return FrameAnswer(
        drone_id=draw(st.integers(1, 255)),
        request_id=draw(st.integers(0, 2**32 - 1)),
        captured_at_ns=draw(st.integers(0, 2**63 - 1)),
        frame_age_s=draw(st.floats(0.0, 3600.0)),
        ned_from_body=random_pose(rng).quaternion() if draw(st.booleans()) else None,
        body_from_cam=random_pose(rng, 0.5),
        camera=draw(st.sampled_from(CAMERAS)),
        image_bytes=draw(st.binary(min_size=1, max_size=400)),
        world_from_body=random_pose(rng, 30.0) if knows else None,
        has_heading=draw(st.booleans()),
        seen=draw(_seen()) if knows and draw(st.booleans()) else None,
    )


def assert_frames_close(a: FrameAnswer, b: FrameAnswer) -> None:
    for name in (
        "drone_id",
        "request_id",
        "captured_at_ns",
        "frame_age_s",
        "camera",
        "has_heading",
    ):
        assert getattr(a, name) == getattr(b, name)
    assert a.image_bytes == b.image_bytes
    assert np.array_equal(a.body_from_cam.translation, b.body_from_cam.translation)
    assert np.abs(a.body_from_cam.rotation - b.body_from_cam.rotation).max() < 5e-9
    assert (a.ned_from_body is None) == (b.ned_from_body is None)
    assert (a.world_from_body is None) == (b.world_from_body is None)
    assert (a.seen is None) == (b.seen is None)
    if a.seen is not None and b.seen is not None:
        assert a.seen.revision == b.seen.revision
        assert np.array_equal(a.seen.landmarks, b.seen.landmarks)
        assert np.abs(a.seen.aside_px - b.seen.aside_px).max() <= 1 / 64
    if a.world_from_body is not None and b.world_from_body is not None:
        assert np.array_equal(a.world_from_body.translation, b.world_from_body.translation)
        assert np.abs(a.world_from_body.rotation - b.world_from_body.rotation).max() < 5e-9
    if a.ned_from_body is not None and b.ned_from_body is not None:
        assert abs(abs(float(a.ned_from_body @ b.ned_from_body)) - 1.0) < 1e-12


def test_golden_bytes() -> None:
    data = encode_frame(small_frame())
    assert_golden("frame_answer", data)
    assert_frames_close(decode_frame(data), small_frame())
    without = encode_frame(replace(small_frame(), ned_from_body=None))
    assert_golden("frame_answer_no_attitude", without)
    assert decode_frame(without).ned_from_body is None
    here = replace(small_frame(), world_from_body=small_frame().body_from_cam)
    assert_golden("frame_answer_with_pose", encode_frame(here))
    assert_frames_close(decode_frame(encode_frame(here)), here)
    seen = SeenLandmarks(
        b"revision", np.array([0, 1, 5, 9]), np.array([[0, 0], [0.5, -1 / 32], [-4, 4], [2, 1]])
    )
    shows = replace(here, seen=seen)
    assert_golden("frame_answer_with_seen", encode_frame(shows))
    assert_frames_close(decode_frame(encode_frame(shows)), shows)
    northless = replace(small_frame(), has_heading=False)
    assert_golden("frame_answer_no_heading", encode_frame(northless))
    assert_frames_close(decode_frame(encode_frame(northless)), northless)


def test_a_frame_passed_on_is_the_same_but_for_its_kind() -> None:
    passed = encode_frame(small_frame(), BlobKind.PASSED_FRAME)
    assert_golden("passed_frame", passed)
    assert passed[2:] == encode_frame(small_frame())[2:]
    assert_frames_close(decode_frame(passed, BlobKind.PASSED_FRAME), small_frame())
    with pytest.raises(WireError, match="not a frame answer: blob kind 69"):
        decode_frame(passed)
    with pytest.raises(WireError, match="not a passed frame: blob kind 65"):
        decode_frame(encode_frame(small_frame()), BlobKind.PASSED_FRAME)


@given(_frames())
def test_round_trip_keeps_the_frame_and_the_bytes(frame: FrameAnswer) -> None:
    data = encode_frame(frame)
    decoded = decode_frame(data)
    assert_frames_close(frame, decoded)
    assert encode_frame(decoded) == data


@given(_frames(), st.data())
@settings(max_examples=150)
def test_mutated_frames_are_a_frame_with_exactly_these_bytes_or_a_wire_error(
    frame: FrameAnswer, data: st.DataObject
) -> None:
    mutated = bytearray(encode_frame(frame))
    for _ in range(data.draw(st.integers(1, 3))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        decoded = decode_frame(bytes(mutated))
    except WireError:
        return
    assert encode_frame(decoded) == bytes(mutated)


@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_are_a_wire_error(body: bytes, with_header: bool) -> None:
    header = bytes([PROTOCOL_VERSION, BlobKind.FRAME_ANSWER]) if with_header else b""
    with pytest.raises(WireError):
        decode_frame(header + body)


def test_another_version_is_recognised() -> None:
    data = encode_frame(small_frame())
    with pytest.raises(VersionMismatchError):
        decode_frame(bytes([PROTOCOL_VERSION + 1]) + data[1:])


def test_frames_out_of_bounds_are_refused() -> None:
    frame = small_frame()
    with pytest.raises(ValueError, match="unit quaternion"):
        replace(frame, ned_from_body=np.array([1.0, 0.0, 0.0, 0.1]))
    with pytest.raises(ValueError, match="unit quaternion"):
        replace(frame, ned_from_body=np.eye(3))
    with pytest.raises(ValueError, match="age"):
        replace(frame, frame_age_s=float("inf"))
    with pytest.raises(ValueError, match="drone 0"):
        replace(frame, drone_id=0)
    seen = SeenLandmarks(b"revision", np.array([3]), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="knows where it was"):
        replace(frame, seen=seen)
    here = replace(frame, world_from_body=frame.body_from_cam)
    for bad in (
        SeenLandmarks(b"revision", np.zeros(0, dtype=np.int64), np.zeros((0, 2))),
        SeenLandmarks(b"revision", np.array([MAX_LANDMARKS]), np.zeros((1, 2))),
        SeenLandmarks(b"short", np.array([3]), np.zeros((1, 2))),
    ):
        with pytest.raises(ValueError, match="some are seen"):
            encode_frame(replace(here, seen=bad))
    for image in (b"", bytes(1024 * 1024 + 1)):
        with pytest.raises(ValueError, match="an image of"):
            encode_frame(replace(frame, image_bytes=image))
