"""How the camera sits on the body: by angles that people know, or by the calibration's matrix.

The camera's housing has axes like the body's, forward along the optical axis, right and down
along the image's. Its angles in the body are the aerospace ones, yaw about down first, then
pitch about its right, then roll about its forward, as an autopilot tells its attitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vcl_companion.cameras.source import CameraOptions
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.rotation import Array, euler_from_matrix, matrix_from_euler
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD, Sensor, check_lens, read_sensor
from vcl_companion.wire.pose_codec import check_camera

_SIDES = (("forward", "back"), ("right", "left"), ("down", "up"))


def mounted_rotation(mounting_deg: Sequence[float]) -> Array:
    """Return body_from_cam (3, 3) of a housing's roll, pitch and yaw in the body, degrees."""
    roll, pitch, yaw = np.deg2rad(mounting_deg).tolist()
    return np.asarray(matrix_from_euler(roll, pitch, yaw) @ BODY_FROM_CAM_FORWARD)


def mounting_of(body_from_cam: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw, degrees, of the housing of a (3, 3) body_from_cam."""
    roll, pitch, yaw = np.rad2deg(euler_from_matrix(body_from_cam @ BODY_FROM_CAM_FORWARD.T))
    return float(roll), float(pitch), float(yaw)


def read_calibration(options: CameraOptions) -> Sensor:
    """Read the calibration file; what the options say of the mounting wins over its ``T_BS``.

    Raises:
        RecordingError: it cannot be used, its images are larger than maps take, or nobody says
            how the camera sits.
    """
    mounting, position_m = options.mounting_deg, options.position_m
    path = Path(options.calibration)
    sensor = read_sensor(
        path,
        rotation=None if mounting is None else mounted_rotation(mounting),
        position_m=None if position_m is None else np.array(position_m),
    )
    check_lens(path, sensor.camera)
    try:
        check_camera(sensor.camera)
    except ValueError as error:
        raise RecordingError(f"{path}: no map takes its images: {error}") from error
    return sensor


def mounting_text(body_from_cam: Array) -> str:
    """Say for people how a camera with a (3, 3) body_from_cam sits."""
    roll, pitch, yaw = (round(angle) + 0 for angle in mounting_of(body_from_cam))
    forward, top = _nearest_side(body_from_cam[:, 2]), _nearest_side(-body_from_cam[:, 1])
    return f"mounting_deg [{roll}, {pitch}, {yaw}]: looks {forward}, image's top {top}"


def _nearest_side(direction_body: Array) -> str:
    """Return the side of the body that a (3,) direction points to, as far as one is nearest."""
    axis = int(np.argmax(np.abs(direction_body)))
    return _SIDES[axis][int(direction_body[axis] < 0.0)]
