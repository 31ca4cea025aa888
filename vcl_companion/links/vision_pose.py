"""What an autopilot is told of our pose, in the form in which its firmware reads it right.

* ArduPilot (GCS_Common.cpp, ``handle_common_vision_position_estimate_data``) makes one number of
  three variances, ``posErr = sqrt(c0 + c6 + c11)``, and takes it for the standard deviation of
  each axis (AP_NavEKF3_PosVelFusion.cpp). True variances would tell it of up to sqrt(3) times
  more than there is: they are scaled, so that it reads the position's worst direction. The
  attitude's, ``angErr = sqrt(c15 + c18 + c20)``, it takes for at least 5 degrees.
* PX4 (mavlink_receiver.cpp, ``handle_message_vision_position_estimate``) takes six variances for
  what they are.

All read where we were at an instant, but their own clock tells it them: what they are told of is
uncertain along the way by as much as that instant is.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.pose import Pose, euler_pose_covariance
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.worst_sigma import worst_sigma

# MAV_AUTOPILOT
_ARDUPILOT, _PX4 = 3, 12
# Rounding leaves a zero variance a little negative; more than this is an error.
_NEGATIVE_VARIANCE = -1e-9
_MAX_FLOAT32 = 3.4e38


class Firmware(enum.Enum):
    """Whose software an autopilot runs."""

    ARDUPILOT = "ardupilot"
    PX4 = "px4"
    OTHER = "other"


def firmware_of(autopilot: int) -> Firmware:
    """Return the firmware that a HEARTBEAT's MAV_AUTOPILOT stands for."""
    return {_ARDUPILOT: Firmware.ARDUPILOT, _PX4: Firmware.PX4}.get(autopilot, Firmware.OTHER)


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Where we were at an instant, and how we moved.

    Attributes:
        local_from_body: the pose, NED-like, in the frame that the autopilot knows.
        covariance: (6, 6) local perturbation (``geometry/pose.py``), m and rad.
        velocity_local_m_s: (3,) along the axes of that frame.
        velocity_covariance: (3, 3) of it, m^2/s^2.
        at_ns: the instant, our clock.
        n_resets: real jumps of that frame so far.
    """

    local_from_body: Pose
    covariance: Array
    velocity_local_m_s: Array
    velocity_covariance: Array
    at_ns: int
    n_resets: int

    def __post_init__(self) -> None:
        for name, shape in (
            ("covariance", (6, 6)),
            ("velocity_local_m_s", (3,)),
            ("velocity_covariance", (3, 3)),
        ):
            if getattr(self, name).shape != shape:
                raise ValueError(f"PoseEstimate.{name} is {shape}")


def covariance_for(firmware: Firmware, estimate: PoseEstimate, time_error_s: float) -> Array | str:
    """Return the covariance that makes a firmware read the true one, or why there is none.

    Args:
        firmware: who reads it.
        estimate: what it is of.
        time_error_s: how well the autopilot knows the instant, 1 sigma.

    Returns:
        (6, 6) of x y z along the local axes and roll pitch yaw, m and rad, without negative
        variances; or a reason why nothing may be sent: an autopilot takes partial NaN or a
        negative variance as an internal error.
    """
    pose, speed = estimate.local_from_body, estimate.velocity_local_m_s
    with np.errstate(all="ignore"):
        covariance = euler_pose_covariance(pose, estimate.covariance)
        covariance[:3, :3] += time_error_s**2 * np.outer(speed, speed)
    numbers = np.concatenate([covariance.ravel(), pose.translation, pose.rotation.ravel(), speed])
    if not np.all(np.abs(numbers) < _MAX_FLOAT32):
        return "not finite"
    variances = np.diag(covariance)
    if variances.min() < _NEGATIVE_VARIANCE * max(1.0, float(variances.max())):
        return "negative variance"
    np.fill_diagonal(covariance, np.maximum(variances, 0.0))
    return _as_ardupilot_reads(covariance) if firmware is Firmware.ARDUPILOT else covariance


def _as_ardupilot_reads(covariance: Array) -> Array:
    """Scale the position so that the sum of its variances is that of the worst direction."""
    position = covariance[:3, :3]
    total = float(np.trace(position))
    if total <= 0.0:
        return covariance
    scale = np.repeat([worst_sigma(position) / np.sqrt(total), 1.0], 3)
    return np.asarray(covariance * np.outer(scale, scale))
