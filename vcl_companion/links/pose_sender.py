"""Poses to one autopilot, each in the message and with the covariance that its firmware reads."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable

from vcl_companion.clock import Clock
from vcl_companion.geometry.rotation import euler_from_matrix, quaternion_from_matrix
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.fusion import FusionMonitor
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    FRAME_LOCAL_FRD,
    FRAME_LOCAL_NED,
    ODOMETRY_ID,
    VISION_POSITION_ESTIMATE_ID,
)
from vcl_companion.links.vision_pose import Firmware, PoseEstimate, covariance_for

# How far back estimators fuse: EKF2_DELAY_MAX; VISO_DELAY_MS goes up to 0.25.
_REMEMBERS_S = 0.2
# Poses were sent for as long as the last one is no older; how often, the last ten say.
_POSES_LAST_S, _POSES_COUNTED = 1.0, 10
# 0 is what an autopilot that has heard of none takes for known.
_RESETS = 255


class PoseSender:
    """Sends poses; in the event loop's thread.

    Args:
        options: how the autopilot is told.
        codec: encodes.
        write: sends bytes.
        clock: ours.
        tally: counts what is not sent.
        fusion: told of what is.

    Attributes:
        options: as above; ``max_pose_age_s`` and ``time_error_s`` may be changed.
        firmware: whose reading the covariance is conditioned for.
        is_paused: whether poses are held back, as the ground has commanded.
    """

    def __init__(
        self,
        options: AutopilotOptions,
        codec: Codec,
        write: Callable[[bytes], None],
        clock: Clock,
        tally: LinkTally,
        fusion: FusionMonitor,
    ) -> None:
        self.options = options
        self._codec = codec
        self._write = write
        self._clock = clock
        self._tally = tally
        self._fusion = fusion
        self.firmware = Firmware.OTHER
        self.is_paused = False
        self._sent_at_s: deque[float] = deque(maxlen=_POSES_COUNTED)
        self._first_reset: int | None = None

    @property
    def message_id(self) -> int:
        """In which message poses are sent."""
        by_vision = self.options.message == "vision_position_estimate"
        return VISION_POSITION_ESTIMATE_ID if by_vision else ODOMETRY_ID

    @property
    def has_sent(self) -> bool:
        """Whether a pose has ever been sent."""
        return self._first_reset is not None

    @property
    def interval_s(self) -> float | None:
        """From one pose that was sent to the next, s; None when none goes out now."""
        now_s = asyncio.get_running_loop().time()
        sent = self._sent_at_s
        if len(sent) < 2 or now_s - sent[-1] > _POSES_LAST_S:
            return None
        return (sent[-1] - sent[0]) / (len(sent) - 1)

    def send(self, estimate: PoseEstimate, *, is_of_frame: bool = True) -> str | None:
        """Send where we were, as the autopilot's firmware wants to be told.

        Args:
            estimate: where.
            is_of_frame: whether a frame gave it; what lies between tells nothing of whether the
                autopilot follows us.

        Returns:
            None when it was sent; else why not: the ground has paused it, it is too old, or the
            covariance is not finite or has a negative variance.
        """
        if self.is_paused:
            return "paused by the ground"
        age_s = (self._clock.now_ns() - estimate.at_ns) * 1e-9
        if age_s > self.options.max_pose_age_s:
            self._tally.refuse("pose not sent: too old")
            return f"its pose was {age_s:.1f} s old"
        # It takes what is older than it remembers for the oldest that it does.
        time_error_s = math.hypot(self.options.time_error_s, max(0.0, age_s - _REMEMBERS_S))
        covariance = covariance_for(self.firmware, estimate, time_error_s)
        if isinstance(covariance, str):
            self._tally.refuse(f"pose not sent: {covariance}")
            return f"the pose's covariance is not one: {covariance}"
        pose = estimate.local_from_body
        x_m, y_m, z_m = pose.translation.tolist()
        usec, reset_counter = estimate.at_ns // 1000, self._reset_counter(estimate.n_resets)
        if self.message_id == VISION_POSITION_ESTIMATE_ID:
            angles = euler_from_matrix(pose.rotation)
            frame = self._codec.vision_position_estimate(
                usec, (x_m, y_m, z_m), angles, covariance, reset_counter
            )
        else:
            turn = pose.rotation.T
            # ArduPilot drops what is not FRD; PX4 takes FRD for turned, and NED as it is.
            is_px4 = self.firmware is Firmware.PX4
            frame = self._codec.odometry(
                usec,
                FRAME_LOCAL_NED if is_px4 else FRAME_LOCAL_FRD,
                (x_m, y_m, z_m),
                tuple(quaternion_from_matrix(pose.rotation).tolist()),
                tuple((turn @ estimate.velocity_local_m_s).tolist()),
                covariance,
                turn @ estimate.velocity_covariance @ turn.T,
                reset_counter,
            )
        self._write(frame)
        self._sent_at_s.append(asyncio.get_running_loop().time())
        if not is_of_frame:
            self._fusion.sent_between(estimate.at_ns)
            return None
        sigma_m = worst_sigma(covariance[:3, :3])
        self._fusion.sent(estimate.at_ns, pose.translation, sigma_m, estimate.n_resets)
        return None

    def _reset_counter(self, n_resets: int) -> int:
        """Return a counter that is not the autopilot's own first one, nor our last run's.

        An ArduPilot that has heard of no reset begins at its origin. Its first pose then, 2.7 m
        from there, is a step to it, and not a beginning: it believed to fly at 75 m/s.
        """
        if self._first_reset is None:
            self._first_reset = self._clock.now_ns() // 1_000_000_000
        return 1 + (self._first_reset + n_resets) % _RESETS
