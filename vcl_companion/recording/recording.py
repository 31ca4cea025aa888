"""A flight of N drones on disk: EuRoC's ASL layout per drone, read and checked at once.

Which axes the reference frame R of a drone's files has, first rule that speaks:

1. ``reference_axes`` in ``state_groundtruth_estimate0/sensor.yaml``;
2. ``reference_axes`` in ``cam0/sensor.yaml``;
3. NED when the folder has a ``recording.toml`` (a recording of our own making);
4. NWU, z up, otherwise: a plain EuRoC folder.

Ground truth is turned into NED here, once; everything behind is NED.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.description import KnownPair, read_description
from vcl_companion.recording.images import check_image
from vcl_companion.recording.sensor import (
    NED_FROM_REFERENCE,
    ReferenceAxes,
    Sensor,
    check_lens,
    read_extrinsics,
    read_fields,
    read_reference_axes,
    read_sensor,
)
from vcl_companion.recording.tables import Row, check_order, read_rows, read_samples
from vcl_companion.recording.trajectory import (
    QUATERNION_TOLERANCE,
    InertialSamples,
    Trajectory,
)

__all__ = [
    "Drone",
    "FrameFile",
    "InertialSamples",
    "KnownPair",
    "Recording",
    "Trajectory",
    "read_recording",
]

_DRONE_NAME = re.compile(r"mav([0-9]{1,6})")
CAMERA_FOLDER = "cam0"
IMU_FOLDER = "imu0"
TRUTH_FOLDER = "state_groundtruth_estimate0"
DESCRIPTION_FILE = "recording.toml"


@dataclass(frozen=True)
class FrameFile:
    """One image of a drone: when it was taken and where it lies."""

    at_ns: int
    path: Path


@dataclass(frozen=True, eq=False)
class Drone:
    """What one drone recorded.

    Attributes:
        name: ``mavN``.
        sensor: its camera.
        frames: at least one, in time order.
        truth: ned_from_body over time; may not cover all frames. None when not recorded.
        imu: inertial samples; None when not recorded.
    """

    name: str
    sensor: Sensor
    frames: tuple[FrameFile, ...]
    truth: Trajectory | None = None
    imu: InertialSamples | None = None


@dataclass(frozen=True, eq=False)
class Recording:
    """One flight.

    Attributes:
        path: its folder.
        name: for people.
        frame_rate_hz: nominal rate; that of the first drone's camera unless it says otherwise.
        leader: name of a drone; the first unless it says otherwise.
        known_distances: pairs of its drones whose distance at the start is known.
        drones: at least one, by rising number.
        distance_sigma_m: how well these, or the truth, are known; None where it is silent.
        calibration_px: what its cameras may be off their calibration; None where it is silent.
    """

    path: Path
    name: str
    frame_rate_hz: float
    leader: str
    known_distances: tuple[KnownPair, ...]
    drones: tuple[Drone, ...]
    distance_sigma_m: float | None = None
    calibration_px: float | None = None

    def drone(self, name: str) -> Drone:
        """Return the drone of that name; KeyError when there is none."""
        for drone in self.drones:
            if drone.name == name:
                return drone
        raise KeyError(name)


def read_recording(path: Path) -> Recording:
    """Read a recording and check all of it but the images' content.

    Images are checked by their headers (present, whole, of the camera's size)
    and decoded when they are played (``load_image``).

    Raises:
        RecordingError: something is broken; one line: which file, which row, what to do.
    """
    try:
        return _read_folder(path)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise RecordingError(f"{error.filename or path}: cannot be read ({reason})") from None


def _read_folder(path: Path) -> Recording:
    if not path.is_dir():
        raise RecordingError(f"{path}: no such folder; give the folder that holds mav0")
    numbered = sorted(
        (int(match[1]), folder.name, folder)
        for folder in path.iterdir()
        if (match := _DRONE_NAME.fullmatch(folder.name)) and folder.is_dir()
    )
    if not numbered:
        hint = "; give the folder above it" if (path / CAMERA_FOLDER).is_dir() else ""
        raise RecordingError(f"{path}: no mav0, mav1, ... folder in it{hint}")
    description_path = path / DESCRIPTION_FILE
    description = read_description(description_path)
    default_axes: ReferenceAxes = "NED" if description_path.exists() else "NWU"
    names = [name for _, name, _ in numbered]
    mentioned = [name for pair in description.known_distances for name in (pair.a, pair.b)]
    for name in [description.leader or names[0], *mentioned]:
        if name not in names:
            raise RecordingError(f"{description_path}: no drone {name!r} ({', '.join(names)})")
    drones = tuple(_read_drone(folder, default_axes) for _, _, folder in numbered)
    return Recording(
        path=path,
        name=description.name or path.resolve().name,
        frame_rate_hz=description.frame_rate_hz or drones[0].sensor.rate_hz,
        leader=description.leader or names[0],
        known_distances=description.known_distances,
        drones=drones,
        distance_sigma_m=description.distance_sigma_m,
        calibration_px=description.calibration_px,
    )


def _read_drone(folder: Path, default_axes: ReferenceAxes) -> Drone:
    path = folder / CAMERA_FOLDER / "sensor.yaml"
    sensor = read_sensor(path, default_axes)
    check_lens(path, sensor.camera)
    truth_fields_path = folder / TRUTH_FOLDER / "sensor.yaml"
    body_from_truth = Pose.identity()
    if truth_fields_path.exists():
        fields = read_fields(truth_fields_path)
        axes = read_reference_axes(truth_fields_path, fields)
        sensor = replace(sensor, reference_axes=axes or sensor.reference_axes)
        body_from_truth = read_extrinsics(truth_fields_path, fields) or body_from_truth
    truth_path = folder / TRUTH_FOLDER / "data.csv"
    imu_path = folder / IMU_FOLDER / "data.csv"
    return Drone(
        name=folder.name,
        sensor=sensor,
        frames=_read_frames(folder / CAMERA_FOLDER, sensor.camera),
        truth=_read_truth(truth_path, sensor.reference_axes, body_from_truth)
        if truth_path.exists()
        else None,
        imu=_read_imu(imu_path) if imu_path.exists() else None,
    )


def _read_frames(folder: Path, camera: Camera) -> tuple[FrameFile, ...]:
    frames = []
    previous: tuple[Row, int] | None = None
    for row in read_rows(folder / "data.csv", "a row per image is needed: timestamp_ns,filename"):
        if len(row.cells) != 2:
            raise row.error(f"{len(row.cells)} columns, expected timestamp_ns,filename")
        at_ns = row.timestamp_ns()
        check_order(row, at_ns, previous)
        previous = row, at_ns
        name = row.cells[1]
        if not name.isprintable() or "/" in name or name in ("", ".", ".."):
            raise row.error(f"{name[:80]!r} is not the name of a file in {folder / 'data'}")
        image_path = folder / "data" / name
        try:
            check_image(image_path, camera)
        except RecordingError as error:
            raise row.error(str(error)) from None
        frames.append(FrameFile(at_ns, image_path))
    return tuple(frames)


def _read_truth(path: Path, axes: ReferenceAxes, body_from_truth: Pose) -> Trajectory:
    """Read poses of the truth's own sensor in R and give those of the body in NED."""
    samples = read_samples(
        path, (8, 11, 17), "write the ground truth, or delete the file to fly without"
    )
    norms = np.linalg.norm(samples.values[:, 3:7], axis=1)
    for row, norm in zip(samples.rows, norms, strict=True):
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise row.error(f"quaternion of length {norm:.4g} is not a rotation")
    lever_arm = body_from_truth.translation.any()
    recorded = Trajectory(
        samples.at_ns,
        samples.values[:, :3],
        samples.values[:, 3:7],
        # With a lever arm the body's velocity is another than the sensor's.
        samples.values[:, 7:10] if samples.values.shape[1] >= 10 and not lever_arm else None,
    )
    if not np.array_equal(body_from_truth.matrix(), np.eye(4)):
        truth_from_body = body_from_truth.inverse()
        moved = [pose @ truth_from_body for _, pose in recorded.stamped_poses()]
        recorded = replace(
            recorded,
            positions_m=np.array([pose.translation for pose in moved]),
            quaternions=np.array([pose.quaternion() for pose in moved]),
        )
    return recorded.turned(NED_FROM_REFERENCE[axes])


def _read_imu(path: Path) -> InertialSamples:
    samples = read_samples(path, (7,), "write the samples, or delete the file to fly without")
    fields_path = path.parent / "sensor.yaml"
    body_from_imu = None
    if fields_path.exists():
        body_from_imu = read_extrinsics(fields_path, read_fields(fields_path))
    turn = (body_from_imu or Pose.identity()).rotation.T
    return InertialSamples(
        samples.at_ns, samples.values[:, :3] @ turn, samples.values[:, 3:] @ turn
    )
