"""What targets ask and hosts answer: never surer than it was, and nothing that cannot be fused."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.checks import assert_pose_close
from tests.wire.golden import assert_golden
from tests.wire.samples import random_pose, small_frame, small_proposal
from tests.wire.test_frame_codec import assert_frames_close
from vcl_companion.errors import WireError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.wire.frame_codec import encode_frame
from vcl_companion.wire.header import PROTOCOL_VERSION, BlobKind, VersionMismatchError
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRequest,
    decode_pose_proposal,
    decode_pose_request,
    encode_pose_proposal,
    encode_pose_request,
)

REQUEST = PoseRequest(bytes(range(8)), small_frame())
HONEST = np.diag([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]) ** 2


def test_golden_bytes_of_a_request() -> None:
    data = encode_pose_request(REQUEST)
    assert_golden("pose_request", data)
    decoded = decode_pose_request(data)
    assert decoded.revision == REQUEST.revision
    assert_frames_close(decoded.frame, REQUEST.frame)
    assert encode_pose_request(decoded) == data


@given(st.integers(0, 2**32), st.floats(-4.0, 1.5))
def test_a_proposal_is_the_pose_and_never_surer_than_it_was(seed: int, decade: float) -> None:
    rng = np.random.default_rng(seed)
    pose = random_pose(rng)
    root = rng.normal(0.0, 1.0, (6, 6)) * (10.0**decade * np.array([1, 1, 1, 0.01, 0.01, 0.01]))
    covariance = root.T @ root
    said = PoseProposal.of(1, bytes(8), pose, covariance)
    assert decode_pose_proposal(encode_pose_proposal(said)) == said
    assert_pose_close(said.world_from_body, pose, within_m=2e-5, within_rad=1e-8)
    sigma = np.sqrt(np.diag(said.covariance))
    more = (said.covariance - covariance) / np.outer(sigma, sigma)
    assert np.linalg.eigvalsh(more)[0] > 0.0
    # ... and hardly less: 1e-5 and the floor of 0.1 mm and 1e-5 rad.
    least = np.array([1e-8] * 3 + [1e-10] * 3)
    assert np.all(np.diag(said.covariance) <= (np.diag(covariance) + least) * 1.00002)


@pytest.mark.parametrize(
    "covariance",
    [
        np.full((6, 6), np.nan),
        np.diag([np.inf] * 6),
        -HONEST,
        HONEST * 1e12,
        HONEST - 2 * np.diag([0, 0.04, 0, 0, 0, 0]),
        np.full((6, 6), 1.0) - 0.1 * np.eye(6),
    ],
)
def test_what_cannot_be_fused_cannot_be_proposed(covariance: Array) -> None:
    with pytest.raises(ValueError, match="covariance"):
        PoseProposal.of(1, bytes(8), Pose.identity(), covariance)


def test_poses_out_of_range_cannot_be_proposed() -> None:
    far = Pose(np.eye(3), np.array([4e4, 0.0, 0.0]))
    with pytest.raises(ValueError, match="out of range"):
        PoseProposal.of(1, bytes(8), far, HONEST)
    with pytest.raises(ValueError, match="revision"):
        PoseProposal.of(1, b"short", Pose.identity(), HONEST)
    with pytest.raises(ValueError, match="quaternion"):
        replace(small_proposal(), quaternion=(1.0, 0.1, 0.0, 0.0))
    with pytest.raises(ValueError, match="numbers"):
        replace(small_proposal(), covariance_upper=(1.0,))
    with pytest.raises(ValueError, match="revision"):
        PoseRequest(b"", small_frame())


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [
        (0, float("nan"), "not finite"),
        (6, float("inf"), "not finite"),
        (0, -0.01, "out of range"),
        (0, 0.0, "out of range"),
        (0, 1e-12, "out of range"),
        (20, 1e3, "out of range"),
        (1, 0.5, "positive definite"),
    ],
)
def test_a_lying_peer_s_covariance_is_a_wire_error(at: int, value: float, reason: str) -> None:
    """Nothing that would take all the weight, none of it, or break the arithmetic."""
    body = bytearray(encode_pose_proposal(small_proposal()))
    struct.pack_into("<f", body, 40 + 4 * at, value)
    with pytest.raises(WireError, match=reason):
        decode_pose_proposal(bytes(body))


@given(st.data())
@settings(max_examples=150)
def test_mutated_requests_are_a_request_with_exactly_these_bytes_or_a_wire_error(
    data: st.DataObject,
) -> None:
    mutated = bytearray(encode_pose_request(REQUEST))
    for _ in range(data.draw(st.integers(1, 3))):
        mutated[data.draw(st.integers(0, len(mutated) - 1))] = data.draw(st.integers(0, 255))
    try:
        decoded = decode_pose_request(bytes(mutated))
    except WireError:
        return
    assert encode_pose_request(decoded) == bytes(mutated)


@given(st.binary(max_size=200), st.booleans())
def test_any_bytes_are_a_wire_error(body: bytes, with_header: bool) -> None:
    header = bytes([PROTOCOL_VERSION, BlobKind.POSE_REQUEST]) if with_header else b""
    with pytest.raises(WireError):
        decode_pose_request(header + body)


def test_another_blob_is_no_request() -> None:
    with pytest.raises(WireError, match="blob kind 65"):
        decode_pose_request(encode_frame(small_frame()))
    with pytest.raises(WireError, match="bytes too many"):
        decode_pose_request(encode_pose_request(REQUEST) + b"\0")
    with pytest.raises(VersionMismatchError):
        decode_pose_request(bytes([PROTOCOL_VERSION + 1]) + encode_pose_request(REQUEST)[1:])
