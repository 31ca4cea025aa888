"""What an AirSim recording leaves out and its ``settings.json`` holds: starts and cameras.

Sources: AirSim docs/settings.md and AirLib AirSimSettings.hpp. A camera's
settings are those of ``Vehicles.<vehicle>.Cameras.<camera>`` over
``CameraDefaults`` over AirSim's own (256x144, 90 degrees); files before 2018
have ``CaptureSettings`` at the top level.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_euler
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD
from vcl_companion.text_file import read_text

_SCENE = 0  # ImageType of an ordinary picture
_DEFAULT_WIDTH_PX, _DEFAULT_HEIGHT_PX, _DEFAULT_FOV_DEG = 256.0, 144.0, 90.0
_MAX_IMAGE_PX = 1 << 16
_MAX_DISTANCE_M = 1e7
# The numbers that AirSim's cameras had before they had names, and the unnamed default.
_CAMERA_NAMES = {
    "": "front_center",
    "0": "front_center",
    "1": "front_right",
    "2": "front_left",
    "3": "bottom_center",
    "4": "back_center",
}

Table = Mapping[str, object]


@dataclass(frozen=True, eq=False)
class AirSimSettings:
    """A ``settings.json``.

    Attributes:
        path: the file, for messages.
        table: its content.
    """

    path: Path
    table: Table

    def vehicle_names(self) -> tuple[str, ...]:
        """Return the vehicles in the file's order; none when it leaves AirSim's default one."""
        return tuple(self._child(self.table, "Vehicles"))

    def start_ned_m(self, vehicle: str) -> Array:
        """Return (3,) where a vehicle's own coordinates begin, NED from Player Start, m."""
        settings = self._vehicle(vehicle)
        return np.array(
            [self._number(settings, key, f"vehicle {vehicle!r}", 0.0) for key in ("X", "Y", "Z")]
        )

    def camera(self, vehicle: str, name: str) -> tuple[Camera, Pose]:
        """Return a camera's intrinsics and body_from_cam.

        A camera whose place is not set is put at the body's origin, looking
        forward: AirSim keeps that default in the vehicle's blueprint, not in text.
        """
        layers = [self.table, self._child(self.table, "CameraDefaults"), {}]
        cameras = self._child(self._vehicle(vehicle), "Cameras")
        for key in cameras:
            if _CAMERA_NAMES.get(key, key) == _CAMERA_NAMES.get(name, name):
                layers[2] = self._child(cameras, key)
        where = f"camera {name!r} of {vehicle!r}"
        mount = {**_without_nan(layers[1]), **_without_nan(layers[2])}
        gimbal = {**self._child(layers[1], "Gimbal"), **self._child(layers[2], "Gimbal")}
        if self._number(gimbal, "Stabilization", where, 0.0) != 0.0:
            raise RecordingError(
                f"{self.path}: {where} hangs in a gimbal; record with Stabilization 0"
            )
        x, y, z = (self._number(mount, key, where, 0.0) for key in ("X", "Y", "Z"))
        roll, pitch, yaw = (
            math.radians(self._number(mount, key, where, 0.0)) for key in ("Roll", "Pitch", "Yaw")
        )
        rotation = matrix_from_euler(roll, pitch, yaw) @ BODY_FROM_CAM_FORWARD
        return self._intrinsics(layers, where), Pose(rotation, np.array([x, y, z]))

    def _intrinsics(self, layers: list[Table], where: str) -> Camera:
        capture: dict[str, object] = {}
        for layer in layers:
            entries = layer.get("CaptureSettings", [])
            if not isinstance(entries, list):
                raise RecordingError(f"{self.path}: CaptureSettings must be a list")
            for entry in entries:
                if isinstance(entry, dict) and entry.get("ImageType", _SCENE) == _SCENE:
                    capture = _without_nan(entry)  # replaces, as in AirSim; no merging
        if str(capture.get("ProjectionMode", "")).lower() == "orthographic":
            raise RecordingError(f"{self.path}: {where} is orthographic; record in perspective")
        width = self._number(capture, "Width", where, _DEFAULT_WIDTH_PX)
        height = self._number(capture, "Height", where, _DEFAULT_HEIGHT_PX)
        fov_deg = self._number(capture, "FOV_Degrees", where, _DEFAULT_FOV_DEG)
        if not all(1 <= size <= _MAX_IMAGE_PX and size == int(size) for size in (width, height)):
            raise RecordingError(f"{self.path}: {where}: {width:g} x {height:g} is no image size")
        if not 1.0 <= fov_deg <= 179.0:
            raise RecordingError(f"{self.path}: {where}: FOV_Degrees {fov_deg:g} is not 1 to 179")
        # The field of view spans the width from the left pixel's outer edge to the right one's.
        focal_px = 0.5 * width / math.tan(math.radians(0.5 * fov_deg))
        centre = (0.5 * (width - 1.0), 0.5 * (height - 1.0))
        return Camera(int(width), int(height), focal_px, focal_px, *centre)

    def _vehicle(self, name: str) -> Table:
        vehicles = self._child(self.table, "Vehicles")
        if vehicles and name not in vehicles:
            known = ", ".join(map(repr, vehicles))
            raise RecordingError(f"{self.path}: Vehicles has no {name!r} ({known})")
        return self._child(vehicles, name)

    def _child(self, table: Table, key: str) -> Table:
        value = table.get(key, {})
        if not isinstance(value, dict):
            raise RecordingError(f"{self.path}: {key!r} must be an object")
        return cast("Table", value)

    def _number(self, table: Table, key: str, where: str, default: float) -> float:
        value = table.get(key, default)
        if isinstance(value, int | float) and not isinstance(value, bool):
            if value != value:  # AirSim writes NaN for "not set"
                return default
            if abs(value) <= _MAX_DISTANCE_M:
                return float(value)
        raise RecordingError(f"{self.path}: {where}: {key} is not a usable number")


def read_airsim_settings(path: Path) -> AirSimSettings:
    """Read a ``settings.json``.

    Raises:
        RecordingError: absent, or not a JSON object.
    """
    try:
        table = json.loads(read_text(path))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    except json.JSONDecodeError as error:
        raise RecordingError(f"{path}, row {error.lineno}: not JSON ({error.msg})") from None
    except (ValueError, RecursionError):
        raise RecordingError(f"{path}: not JSON text") from None
    if not isinstance(table, dict):
        raise RecordingError(f"{path}: must hold one JSON object")
    return AirSimSettings(path, table)


def _without_nan(table: Table) -> dict[str, object]:
    """Leave out what is not set, so that it does not hide the layer below."""
    return {key: value for key, value in table.items() if value == value}
