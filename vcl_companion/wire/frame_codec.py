"""One drone's frame with all a peer needs to use it.

It answers a frame request, and is passed on by who asked.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.seen_landmarks import SeenLandmarks
from vcl_companion.wire.header import (
    HEADER_BYTES,
    MAX_BLOB_BYTES,
    BlobKind,
    decode_header,
    encode_header,
)
from vcl_companion.wire.messages import check_age, check_request_id
from vcl_companion.wire.pose_codec import (
    encode_camera,
    encode_image,
    encode_pose,
    encode_rotation,
    take_camera,
    take_image,
    take_pose,
    take_rotation,
)
from vcl_companion.wire.reader import Reader
from vcl_companion.wire.seen_codec import encode_seen, take_seen

# After version and kind
# | 2  | u8  | drone (system id), not 0                                       |
# | 3  | u32 | request id                                                     |
# | 7  | u64 | captured at, ns, the sender's own clock, below 2^63            |
# | 15 | f64 | age of the frame when it was sent, s                           |
# | 23 | u8  | a sum: 1 an attitude follows, 2 the drone's own pose, 4 the    |
# |    |     | attitude's heading is by no north that others know, 8 where    |
# |    |     | the image shows a map's landmarks; 8 only with 2               |
# | 24 | rotation ned_from_body if so, pose world_from_body if so, pose body_from_cam, camera, |
# |    | image: see pose_codec; what the image shows if so: see seen_codec                     |
_HEAD = struct.Struct("<BIQdB")
_HAS_ATTITUDE, _HAS_POSE, _HAS_NO_HEADING, _HAS_SEEN = 1, 2, 4, 8


@dataclass(frozen=True, eq=False)
class FrameAnswer:
    """One frame of one drone.

    Attributes:
        drone_id: system id of the drone that took it.
        request_id: of the request that it answers, or goes with.
        captured_at_ns: mid-exposure, on that drone's own clock.
        frame_age_s: how old the frame was when it was sent.
        ned_from_body: (4,) unit quaternion w x y z from its autopilot at that
            instant, or None if it had none.
        body_from_cam: its camera's mounting.
        camera: its camera's intrinsics.
        image_bytes: the encoded image, see ``mapping/keyframe_image.py``.
        world_from_body: where that drone believes that it was, on the map that it
            flew on; None when it does not know.
        has_heading: whether the attitude's heading is by the world's north, as far as
            that drone knows; else only its roll and pitch tell others anything.
        seen: where the image, before it was encoded, shows landmarks of a map, seen from that
            pose; None where that is not told.
    """

    drone_id: int
    request_id: int
    captured_at_ns: int
    frame_age_s: float
    ned_from_body: Array | None
    body_from_cam: Pose
    camera: Camera
    image_bytes: bytes
    world_from_body: Pose | None = None
    has_heading: bool = True
    seen: SeenLandmarks | None = None

    def __post_init__(self) -> None:
        if not 1 <= self.drone_id <= 255 or not 0 <= self.captured_at_ns < 1 << 63:
            raise ValueError(f"a frame of drone {self.drone_id} at {self.captured_at_ns} ns")
        check_request_id(self.request_id)
        check_age(self.frame_age_s)
        if self.seen is not None and self.world_from_body is None:
            raise ValueError("a frame that shows landmarks is of a drone that knows where it was")
        if self.ned_from_body is None:
            return
        quaternion = np.array(self.ned_from_body, dtype=np.float64)
        if quaternion.shape != (4,) or not math.isclose(
            float(np.linalg.norm(quaternion)), 1.0, abs_tol=1e-6
        ):
            raise ValueError(f"FrameAnswer.ned_from_body is no unit quaternion: {quaternion}")
        quaternion.flags.writeable = False
        object.__setattr__(self, "ned_from_body", quaternion)


def encode_frame(frame: FrameAnswer, kind: BlobKind = BlobKind.FRAME_ANSWER) -> bytes:
    """Return the bytes of a frame, answered or passed on; its attitude is rounded to 1e-9 rad.

    Raises:
        ValueError: the image or the camera is larger than peers accept.
    """
    return encode_header(kind) + encode_frame_body(frame)


def encode_frame_body(frame: FrameAnswer) -> bytes:
    """Return what follows version and kind; a pose request holds the same.

    Raises:
        ValueError: see ``encode_frame``.
    """
    attitude = b"" if frame.ned_from_body is None else encode_rotation(frame.ned_from_body)
    pose = b"" if frame.world_from_body is None else encode_pose(frame.world_from_body)
    seen = b"" if frame.seen is None else encode_seen(frame.seen)
    return b"".join(
        [
            _HEAD.pack(
                frame.drone_id,
                frame.request_id,
                frame.captured_at_ns,
                frame.frame_age_s,
                _HAS_ATTITUDE * bool(attitude)
                + _HAS_POSE * bool(pose)
                + _HAS_NO_HEADING * (not frame.has_heading)
                + _HAS_SEEN * bool(seen),
            ),
            attitude,
            pose,
            encode_pose(frame.body_from_cam),
            encode_camera(frame.camera),
            encode_image(frame.image_bytes),
            seen,
        ]
    )


def decode_frame(data: bytes, kind: BlobKind = BlobKind.FRAME_ANSWER) -> FrameAnswer:
    """Return the frame of encoded bytes; the image stays encoded.

    Raises:
        WireError: the bytes are not a frame of this kind, or one out of bounds.
    """
    if len(data) > MAX_BLOB_BYTES:
        raise WireError(f"a frame answer of {len(data)} bytes, at most {MAX_BLOB_BYTES}")
    found = decode_header(data)
    if found != kind:
        raise WireError(f"not a {kind.name.lower().replace('_', ' ')}: blob kind {found}")
    reader = Reader(data, "frame answer", HEADER_BYTES)
    frame = take_frame_body(reader)
    reader.finish()
    return frame


def take_frame_body(reader: Reader) -> FrameAnswer:
    """Return the frame that comes next, or raise WireError."""
    drone_id, request_id, captured_at_ns, age_s, has = reader.unpack(_HEAD)
    if has > _HAS_ATTITUDE + _HAS_POSE + _HAS_NO_HEADING + _HAS_SEEN:
        raise WireError(f"frame answer: unknown contents {has}")
    attitude = take_rotation(reader) if has & _HAS_ATTITUDE else None
    world_from_body = take_pose(reader) if has & _HAS_POSE else None
    body_from_cam, camera = take_pose(reader), take_camera(reader)
    image_bytes = take_image(reader)
    seen = take_seen(reader) if has & _HAS_SEEN else None
    try:
        return FrameAnswer(
            drone_id,
            request_id,
            captured_at_ns,
            age_s,
            attitude,
            body_from_cam,
            camera,
            image_bytes,
            world_from_body,
            not has & _HAS_NO_HEADING,
            seen,
        )
    except ValueError as error:
        raise WireError(f"frame answer: {error}") from None
