"""Our frames as peers get them: with attitude and calibration, the same for the same request."""

from __future__ import annotations

import asyncio
from concurrent.futures import Executor
from dataclasses import dataclass

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.companion import ATTITUDE_WAIT_S
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.geometry.rotation import quaternion_from_matrix
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.mapping.drone_view import encode_image
from vcl_companion.recording.sensor import Sensor
from vcl_companion.wire.frame_codec import FrameAnswer, encode_frame

# Only a coordinator asks; while the swarm does not agree who that is there may be two.
_MAX_ASKERS = 4


@dataclass(frozen=True)
class WantedFrame:
    """What a peer asked for, in our time."""

    request_id: int
    at_ns: int


@dataclass(frozen=True)
class _Given:
    """The last answer to a peer."""

    request_id: int
    blob: bytes


class FrameAnswers:
    """Makes answers of our frames; the last one to a peer is kept for when it asks again.

    Args:
        system_id: this drone.
        frames: our own.
        autopilot: for the attitude that goes with a frame.
        sensor: of our camera.
        clock: time base of frames.
        executor: runs the encoding.
        keyframe_quality: of the images, 1 to 100.
    """

    def __init__(
        self,
        system_id: int,
        frames: FrameHistory,
        autopilot: AutopilotLink,
        sensor: Sensor,
        clock: Clock,
        executor: Executor,
        keyframe_quality: int,
    ) -> None:
        self._system_id = system_id
        self._frames = frames
        self._autopilot = autopilot
        self._sensor = sensor
        self._clock = clock
        self._executor = executor
        self._keyframe_quality = keyframe_quality
        self._given: dict[int, _Given] = {}

    async def blob_for(self, peer: int, wanted: WantedFrame) -> bytes | None:
        """Return the encoded answer to a request, or None when there is no frame of that instant.

        Asked again, the very same bytes: an answer on its way is not begun anew.

        Raises:
            ValueError: the frame is larger than peers accept.
        """
        given = self._given.get(peer)
        if given is not None and given.request_id == wanted.request_id:
            return given.blob
        frame = self._frames.nearest(wanted.at_ns)
        if frame is None:
            return None
        blob = encode_frame(await self.describe(frame, wanted.request_id))
        self._given.pop(peer, None)
        self._given[peer] = _Given(wanted.request_id, blob)
        if len(self._given) > _MAX_ASKERS:
            del self._given[next(iter(self._given))]
        return blob

    async def describe(self, frame: Frame, request_id: int) -> FrameAnswer:
        """Make the answer that shows one of our frames.

        Raises:
            ValueError: the frame is over an hour old, or cannot be encoded.
        """
        attitude = await self._autopilot.attitude_at(frame.captured_at_ns, ATTITUDE_WAIT_S)
        loop = asyncio.get_running_loop()
        image_bytes = await loop.run_in_executor(
            self._executor, encode_image, frame.image, self._keyframe_quality
        )
        return FrameAnswer(
            drone_id=self._system_id,
            request_id=request_id,
            captured_at_ns=frame.captured_at_ns,
            frame_age_s=max(self._clock.now_ns() - frame.captured_at_ns, 0) * 1e-9,
            ned_from_body=None
            if attitude is None
            else quaternion_from_matrix(attitude.ned_from_body),
            body_from_cam=self._sensor.body_from_cam,
            camera=self._sensor.camera,
            image_bytes=image_bytes,
        )
