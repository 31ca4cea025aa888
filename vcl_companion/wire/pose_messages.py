"""Inter-MAV localization between drones (IV-E): what the target asks, what a host answers.

A peer's numbers are checked here, where they come in: what passes is a pose
within bounds and a covariance that can be fused with.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.wire.frame_codec import FrameAnswer, encode_frame_body, take_frame_body
from vcl_companion.wire.header import (
    HEADER_BYTES,
    MAX_BLOB_BYTES,
    BlobKind,
    decode_header,
    encode_header,
)
from vcl_companion.wire.map_codec import REVISION_BYTES
from vcl_companion.wire.messages import check_reason, check_request_id, fitting_reason
from vcl_companion.wire.pose_codec import MAX_COORDINATE_M, encode_rotation, take_rotation
from vcl_companion.wire.reader import Reader

# PoseRequest, after version and kind
# | 2  | 8 bytes | revision of the map that the target flies on            |
# | 10 |         | the target's frame: a frame answer from its offset 2 on |

# PoseProposal body
# | 0  | u32      | request id                                                        |
# | 4  | 8 bytes  | revision                                                          |
# | 12 | rotation | world_from_body                                                   |
# | 28 | 3 x i32  | position in the world, steps of 2^-16 m                           |
# | 40 | 21 x f32 | upper triangle of the covariance, row by row: a local             |
# |    |          | perturbation, x y z (m), then a rotation vector (rad), body axes  |
_PROPOSAL_HEAD = struct.Struct(f"<I{REVISION_BYTES}s")
_POSITION = struct.Struct("<3i")
_COVARIANCE = struct.Struct("<21f")
_STEPS_PER_M = 1 << 16

# PoseRefused body
# | 0 | u32  | request id                             |
# | 4 | rest | reason, printable UTF-8, 1 to 90 bytes |
_REFUSED = struct.Struct("<I")

_UPPER = np.triu_indices(6)
# No camera is surer than 0.1 mm and 1e-5 rad; this also covers the rounding of the pose.
_LEAST_SIGMA = np.array([1e-4] * 3 + [1e-5] * 3)
_MOST_SIGMA = np.array([1e3] * 3 + [10.0] * 3)
# Rounding 21 numbers to 24 bits takes at most 6 * 2^-24 of the diagonal away.
_WIDENED = 1.0 + 1e-5
_LEAST_EIGENVALUE = 1e-6  # of the correlations


@dataclass(frozen=True, eq=False)
class PoseRequest:
    """Asks a peer where we were when this frame was taken.

    Attributes:
        revision: of the map that the pose is wanted in, 8 bytes.
        frame: ours; its ``request_id`` is echoed in the answer.
    """

    revision: bytes
    frame: FrameAnswer

    def __post_init__(self) -> None:
        _check_revision(self.revision)


@dataclass(frozen=True)
class PoseProposal:
    """Where a host says that the target was; ``of`` makes one of any pose.

    Attributes:
        request_id: of the request.
        revision: of the map that this pose is in, 8 bytes.
        quaternion: unit quaternion w x y z, world_from_body.
        position_m: x y z in the world, m, in steps of 2^-16 m.
        covariance_upper: the 21 numbers of ``covariance``, each a 32-bit float.
    """

    request_id: int
    revision: bytes
    quaternion: tuple[float, ...]
    position_m: tuple[float, ...]
    covariance_upper: tuple[float, ...]

    def __post_init__(self) -> None:
        check_request_id(self.request_id)
        _check_revision(self.revision)
        if (len(self.quaternion), len(self.position_m), len(self.covariance_upper)) != (4, 3, 21):
            raise ValueError("a proposal has 4 + 3 + 21 numbers")
        if not abs(float(np.linalg.norm(self.quaternion)) - 1.0) < 1e-6:
            raise ValueError(f"no unit quaternion: {self.quaternion}")
        if not np.all(np.abs(self.position_m) <= MAX_COORDINATE_M):
            raise ValueError(f"a pose lies out of range: {self.position_m} m")
        _check_covariance(self.covariance)

    @classmethod
    def of(
        cls, request_id: int, revision: bytes, world_from_body: Pose, covariance: Array
    ) -> PoseProposal:
        """Make the message, rounded as it travels; the covariance never becomes smaller by it.

        Args:
            request_id: of the request.
            revision: of the map.
            world_from_body: the target's pose.
            covariance: (6, 6) local perturbation.

        Raises:
            ValueError: the pose is out of range, or the covariance is none that
                can be fused with.
        """
        if not np.abs(world_from_body.translation).max() <= MAX_COORDINATE_M:
            raise ValueError(f"a pose lies out of range: {world_from_body.translation} m")
        widened = 0.5 * (covariance + covariance.T) + np.diag(_LEAST_SIGMA**2)
        widened[np.diag_indices(6)] *= _WIDENED
        if not np.all(np.abs(widened) < 1e30):
            raise ValueError("a covariance out of range")
        steps = np.round(world_from_body.translation * _STEPS_PER_M)
        rotation = take_rotation(Reader(encode_rotation(world_from_body.quaternion()), "rotation"))
        return cls(
            request_id,
            revision,
            tuple(rotation.tolist()),
            tuple((steps / _STEPS_PER_M + 0.0).tolist()),
            tuple(widened[_UPPER].astype(np.float32).astype(np.float64).tolist()),
        )

    @property
    def world_from_body(self) -> Pose:
        """The target's pose."""
        return Pose.from_quaternion(np.array(self.quaternion), np.array(self.position_m))

    @property
    def covariance(self) -> Array:
        """(6, 6) of it, local perturbation."""
        out = np.empty((6, 6))
        out[_UPPER] = self.covariance_upper
        out.T[_UPPER] = self.covariance_upper
        return out


@dataclass(frozen=True)
class PoseRefused:
    """Why a host proposes nothing.

    Attributes:
        request_id: of the request.
        reason: one printable line of at most 90 bytes; ``because`` makes any text one.
    """

    request_id: int
    reason: str

    def __post_init__(self) -> None:
        check_request_id(self.request_id)
        check_reason(self.reason)

    @classmethod
    def because(cls, request_id: int, reason: str) -> PoseRefused:
        """Make the message of any text."""
        return cls(request_id, fitting_reason(reason))


def encode_pose_request(request: PoseRequest) -> bytes:
    """Return the blob of a request.

    Raises:
        ValueError: the image or the camera is larger than peers accept.
    """
    header = encode_header(BlobKind.POSE_REQUEST)
    return header + request.revision + encode_frame_body(request.frame)


def decode_pose_request(data: bytes) -> PoseRequest:
    """Return the request of a blob; the image stays encoded.

    Raises:
        WireError: the bytes are not a pose request, or one out of bounds.
    """
    if len(data) > MAX_BLOB_BYTES:
        raise WireError(f"a pose request of {len(data)} bytes, at most {MAX_BLOB_BYTES}")
    kind = decode_header(data)
    if kind != BlobKind.POSE_REQUEST:
        raise WireError(f"not a pose request: blob kind {kind}")
    reader = Reader(data, "pose request", HEADER_BYTES)
    request = PoseRequest(reader.take(REVISION_BYTES), take_frame_body(reader))
    reader.finish()
    return request


def encode_pose_proposal(message: PoseProposal) -> bytes:
    """Return the body of a proposal."""
    return b"".join(
        [
            _PROPOSAL_HEAD.pack(message.request_id, message.revision),
            encode_rotation(np.array(message.quaternion)),
            _POSITION.pack(*(round(value * _STEPS_PER_M) for value in message.position_m)),
            _COVARIANCE.pack(*message.covariance_upper),
        ]
    )


def decode_pose_proposal(body: bytes) -> PoseProposal:
    """Return the proposal of a body, or raise WireError."""
    reader = Reader(body, "pose proposal")
    request_id, revision = reader.unpack(_PROPOSAL_HEAD)
    quaternion = take_rotation(reader)
    position_m = tuple(steps / _STEPS_PER_M for steps in reader.unpack(_POSITION))
    covariance = reader.unpack(_COVARIANCE)
    reader.finish()
    try:
        return PoseProposal(
            request_id, revision, tuple(quaternion.tolist()), position_m, covariance
        )
    except ValueError as error:
        raise WireError(f"pose proposal: {error}") from None


def encode_pose_refused(message: PoseRefused) -> bytes:
    """Return the body of a refusal."""
    return _REFUSED.pack(message.request_id) + message.reason.encode("utf-8")


def decode_pose_refused(body: bytes) -> PoseRefused:
    """Return the refusal of a body, or raise WireError."""
    (request_id,) = Reader(body, "pose refused").unpack(_REFUSED)
    try:
        return PoseRefused(request_id, body[_REFUSED.size :].decode("utf-8"))
    except ValueError as error:  # UnicodeDecodeError is one
        raise WireError(f"pose refused: {error}") from None


def _check_revision(revision: bytes) -> None:
    if len(revision) != REVISION_BYTES:
        raise ValueError(f"a revision has {REVISION_BYTES} bytes: {revision!r}")


def _check_covariance(covariance: Array) -> None:
    """Raise ValueError unless it is finite, positive definite and within bounds."""
    if not np.all(np.isfinite(covariance)):
        raise ValueError("a covariance is not finite")
    variance = np.diag(covariance)
    if not np.all((variance >= (0.999 * _LEAST_SIGMA) ** 2) & (variance <= _MOST_SIGMA**2)):
        raise ValueError(f"a covariance out of range: variances {variance.tolist()}")
    sigma = np.sqrt(variance)
    if not np.linalg.eigvalsh(covariance / np.outer(sigma, sigma))[0] > _LEAST_EIGENVALUE:
        raise ValueError("a covariance is not positive definite")
