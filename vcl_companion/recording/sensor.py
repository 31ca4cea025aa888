"""How a camera sits on its drone and what it sees: EuRoC's ``sensor.yaml``.

A camera's file holds ``T_BS`` (body_from_cam), ``resolution``, ``intrinsics``
[fu, fv, cu, cv], ``distortion_model``, ``distortion_coefficients``, ``rate_hz``
and the optional ``reference_axes`` of the recording's frame R.

``reference_axes`` speaks of R alone. The body is whatever ``T_BS`` and the
ground truth agree it is: FRD in recordings made here, x-up in EuRoC's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

import numpy as np
import yaml

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera, DistortionModel
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, orthonormalized
from vcl_companion.text_file import read_text

ReferenceAxes = Literal["NED", "ENU", "NWU"]

# A camera that looks along the body's x axis: forward = z, right = x, down = y of the image.
BODY_FROM_CAM_FORWARD: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
NED_FROM_REFERENCE: dict[ReferenceAxes, Array] = {
    "NED": np.eye(3),
    "ENU": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "NWU": np.diag([1.0, -1.0, -1.0]),
}
for _matrix in (BODY_FROM_CAM_FORWARD, *NED_FROM_REFERENCE.values()):
    _matrix.flags.writeable = False

# Kalibr's short names mean the same models.
_DISTORTION_MODELS: dict[str, DistortionModel] = {
    "none": "none",
    "radial-tangential": "radial-tangential",
    "radtan": "radial-tangential",
    "equidistant": "equidistant",
    "equi": "equidistant",
}
_MAX_FILE_BYTES = 1 << 16  # the YAML parser is slow, and these files have a page
_MAX_IMAGE_PX = 1 << 16
_MAX_LEVER_ARM_M = 1e3
_ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Sensor:
    """A calibrated camera on a body.

    Attributes:
        camera: intrinsics.
        body_from_cam: where the camera sits, ``T_BS``.
        rate_hz: nominal frame rate.
        reference_axes: the axes that the recording's files use for R; values in
            memory are NED whatever stands here.
    """

    camera: Camera
    body_from_cam: Pose
    rate_hz: float
    reference_axes: ReferenceAxes = "NED"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ValueError(f"rate_hz must be positive, got {self.rate_hz}")
        if self.reference_axes not in NED_FROM_REFERENCE:
            raise ValueError(f"reference_axes must be NED, ENU or NWU, got {self.reference_axes!r}")


def nominal_rate_hz(at_ns: Sequence[int]) -> float:
    """Return the frame rate of rising instants: of the median interval, six digits.

    1 Hz for a single frame; held to 0.001 .. 100000 Hz, whatever the intervals.
    """
    if len(at_ns) < 2:
        return 1.0
    interval_ns = float(np.median(np.diff(np.array(at_ns, dtype=np.int64))))
    return float(f"{min(max(1e9 / interval_ns, 1e-3), 1e5):.6g}")


def read_sensor(
    path: Path,
    default_axes: ReferenceAxes = "NED",
    *,
    rotation: Array | None = None,
    position_m: Array | None = None,
) -> Sensor:
    """Read a camera's ``sensor.yaml``.

    Args:
        path: the file.
        default_axes: what holds when the file does not say ``reference_axes``.
        rotation: (3, 3) body_from_cam that takes the place of that in ``T_BS``; then the file
            need not have it, and the camera sits at the body's origin unless it is said.
        position_m: (3,) the camera's place in the body, m, instead of that in ``T_BS``.

    Raises:
        RecordingError: it is absent or cannot be used; one line with file and key.
    """
    fields = read_fields(path)
    model = fields.get("camera_model", "pinhole")
    if model != "pinhole":
        raise RecordingError(f"{path}: camera_model {_shown(model)} is not supported (pinhole)")
    named = fields.get("distortion_model", "none")
    distortion_model = _DISTORTION_MODELS.get(named) if isinstance(named, str) else None
    if distortion_model is None:
        known = ", ".join(dict.fromkeys(_DISTORTION_MODELS.values()))
        raise RecordingError(f"{path}: distortion_model {_shown(named)} is not one of {known}")
    distortion = tuple(_numbers(path, fields, "distortion_coefficients", None, []))
    if distortion_model == "none" and not any(distortion):
        distortion = ()
    width, height = _numbers(path, fields, "resolution", 2)
    fx, fy, cx, cy = _numbers(path, fields, "intrinsics", 4)
    (rate_hz,) = _numbers(path, fields, "rate_hz", 1)
    for size in (width, height):
        if not (1 <= size <= _MAX_IMAGE_PX and size == int(size)):
            raise RecordingError(f"{path}: resolution {width:g} x {height:g} is not an image size")
    body_from_cam = read_extrinsics(path, fields)
    if rotation is not None:
        there = np.zeros(3) if body_from_cam is None else body_from_cam.translation
        body_from_cam = Pose(rotation, there)
    if body_from_cam is None:
        raise RecordingError(
            f"{path}: T_BS is missing; add the 4x4 matrix body_from_cam, or set "
            "[camera] mounting_deg in the configuration"
        )
    if position_m is not None:
        body_from_cam = Pose(body_from_cam.rotation, position_m)
    try:
        camera = Camera(int(width), int(height), fx, fy, cx, cy, distortion_model, distortion)
        axes = read_reference_axes(path, fields) or default_axes
        return Sensor(camera, body_from_cam, rate_hz, axes)
    except ValueError as error:
        raise RecordingError(f"{path}: {error}") from None


def check_lens(path: Path, camera: Camera) -> None:
    """Refuse what no lens is, as when images were scaled and their intrinsics were not.

    Args:
        path: the file that it was read from.
        camera: the intrinsics.

    Raises:
        RecordingError: one line with file and key.
    """
    last = np.array([camera.width_px - 1, camera.height_px - 1])
    centre = np.array([camera.cx_px, camera.cy_px])
    if not (np.all(centre >= 0.0) and np.all(centre <= last)):
        raise RecordingError(
            f"{path}: intrinsics: the principal point {camera.cx_px:g}, {camera.cy_px:g} lies "
            f"outside of {camera.width_px}x{camera.height_px} px; are they of another resolution?"
        )
    sides = np.array([[0.0, 0.5], [1.0, 0.5], [0.5, 0.0], [0.5, 1.0]]) * last
    if not np.isfinite(camera.ideal_from_pixels(sides)).all():
        raise RecordingError(
            f"{path}: distortion_coefficients: no ray reaches the middle of each side of the image"
        )


def write_sensor(path: Path, sensor: Sensor) -> None:
    """Write a camera's ``sensor.yaml``; ``read_sensor`` gives the same values back."""
    camera = sensor.camera
    rows = [", ".join(repr(float(x)) for x in row) for row in sensor.body_from_cam.matrix()]
    matrix = (",\n" + " " * 9).join(rows)
    intrinsics = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    path.write_text(
        "# camera frame: x right, y down, z forward (optical)\n"
        "sensor_type: camera\n"
        f"reference_axes: {sensor.reference_axes}\n"
        "# p_B = T_BS p_S: body_from_cam\n"
        f"T_BS:\n  cols: 4\n  rows: 4\n  data: [{matrix}]\n"
        f"rate_hz: {float(sensor.rate_hz)!r}\n"
        f"resolution: [{camera.width_px}, {camera.height_px}]\n"
        "camera_model: pinhole\n"
        f"intrinsics: [{', '.join(repr(float(x)) for x in intrinsics)}]"
        " # fu, fv, cu, cv; pixel centres at integers\n"
        f"distortion_model: {camera.distortion_model}\n"
        f"distortion_coefficients: [{', '.join(repr(float(x)) for x in camera.distortion)}]\n",
        encoding="utf-8",
    )


def read_fields(path: Path) -> dict[str, object]:
    """Read the top level of any ``sensor.yaml``; every scalar stays text.

    Text, because YAML 1.1 takes ``1e-5`` for a string and ``no`` for a number,
    and its tags can raise anything; what a field means is decided by its reader.
    """
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise RecordingError(f"{path}: too large for a sensor.yaml")
        fields = yaml.load(read_text(path, _MAX_FILE_BYTES), Loader=yaml.BaseLoader)
    except FileNotFoundError:
        raise RecordingError(f"{path}: missing; the calibration of this sensor is needed") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    except yaml.MarkedYAMLError as error:
        row = f", row {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise RecordingError(f"{path}{row}: not YAML ({error.problem or error.context})") from None
    except (yaml.YAMLError, ValueError, RecursionError):
        raise RecordingError(f"{path}: not YAML text") from None
    if not isinstance(fields, dict):
        raise RecordingError(f"{path}: no 'key: value' lines in it")
    return cast("dict[str, object]", fields)


def read_extrinsics(path: Path, fields: dict[str, object]) -> Pose | None:
    """Return ``T_BS`` (body_from_sensor) of a sensor's fields; None when it is not there.

    A mapping with ``data``, 16 numbers in a row, or four rows of four.
    """
    value = fields.get("T_BS")
    if value is None:
        return None
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and [len(x) for x in value if isinstance(x, list)] == [4] * 4:
        value = [number for row in value for number in row]
    matrix = np.array(_numbers(path, {"T_BS": value}, "T_BS", 16)).reshape(4, 4)
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if np.abs(matrix).max() > _MAX_LEVER_ARM_M:
        raise RecordingError(f"{path}: T_BS has numbers that are no rotation and no metres")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 1e-9:
        raise RecordingError(f"{path}: T_BS must end with the row 0, 0, 0, 1")
    skewness = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if skewness > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise RecordingError(
            f"{path}: T_BS holds no rotation (off by {skewness:.2g}, determinant "
            f"{np.linalg.det(rotation):.3f}); its upper left 3x3 must be orthonormal, right-handed"
        )
    # Only what was rounded in print is touched, so that exact files stay exact.
    return Pose(rotation if skewness < 1e-12 else orthonormalized(rotation), translation)


def read_reference_axes(path: Path, fields: dict[str, object]) -> ReferenceAxes | None:
    """Return the key ``reference_axes`` of a sensor's fields; None when it is not there."""
    value = fields.get("reference_axes")
    if value is None:
        return None
    if not isinstance(value, str) or value.upper() not in NED_FROM_REFERENCE:
        raise RecordingError(f"{path}: reference_axes {_shown(value)} is not NED, ENU or NWU")
    return cast("ReferenceAxes", value.upper())


def _numbers(
    path: Path,
    fields: dict[str, object],
    key: str,
    count: int | None,
    default: list[object] | None = None,
) -> list[float]:
    """Return the finite numbers under a key; ``count`` of them, or any number when None."""
    value = fields.get(key, default)
    if value is None:
        raise RecordingError(f"{path}: {key} is missing")
    items = value if isinstance(value, list) else [value]
    if count is not None and len(items) != count:
        raise RecordingError(f"{path}: {key} needs {count} number(s), found {len(items)}")
    numbers = []
    for item in items:
        try:
            number = float(item) if isinstance(item, str | int | float) else np.nan
        except (ValueError, OverflowError):
            number = np.nan
        if not np.isfinite(number):
            raise RecordingError(f"{path}: {key} holds {_shown(item)}, not a finite number")
        numbers.append(number)
    return numbers


def _shown(value: object) -> str:
    """Return what was found, short; a list or mapping only by its kind (it may be vast)."""
    return repr(value[:40]) if isinstance(value, str) else f"a {type(value).__name__}"
