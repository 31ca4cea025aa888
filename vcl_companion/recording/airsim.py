"""Imports an AirSim recording: ``airsim_rec.txt``, ``images/`` and a ``settings.json``.

Rows are tab-separated under a header (AirSim docs/modify_recording_data.md,
PawnSimApi::getRecordFileLine): TimeStamp in ms, POS_X..Z, Q_W..Z, ImageFile;
since 1.4 a VehicleName before them, the rows of all vehicles interleaved. A
vehicle's positions are NED from its own start, which is in settings.json; its
attitude turns FRD to NED. ImageFile lists one file per recorded camera and
image type, by ';', named ``img_[<vehicle>_]<camera>_<type>_<time>.png``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.airsim_settings import AirSimSettings, read_airsim_settings
from vcl_companion.recording.description import Description, KnownPair
from vcl_companion.recording.images import check_image
from vcl_companion.recording.sensor import Sensor, nominal_rate_hz
from vcl_companion.recording.tables import Row, check_order, read_rows
from vcl_companion.recording.trajectory import QUATERNION_TOLERANCE, Trajectory
from vcl_companion.recording.writer import RecordingWriter

_TABLE_FILE = "airsim_rec.txt"
_SETTINGS_FILE = "settings.json"
_NS_PER_MS = 1_000_000
_POSE_COLUMNS = ("POS_X", "POS_Y", "POS_Z", "Q_W", "Q_X", "Q_Y", "Q_Z")
_COLUMNS = ("TimeStamp", *_POSE_COLUMNS, "ImageFile")
_IMAGE_NAME = re.compile(r"img_(?P<camera>.*)_(?P<type>[0-9]+)_[0-9]+\.(png|jpe?g)", re.IGNORECASE)
_SCENE_TYPE = "0"


@dataclass(eq=False)
class _Vehicle:
    """The rows of one vehicle, gathered; positions still from its own start."""

    rows: list[Row] = field(default_factory=list)
    at_ns: list[int] = field(default_factory=list)
    start_from_body: list[Pose] = field(default_factory=list)
    images: list[Path] = field(default_factory=list)
    camera_name: str = ""


def import_airsim(source: Path, out: Path) -> None:
    """Write an AirSim recording in our layout.

    Vehicles become mav0, mav1, ... in the order of settings.json; the first
    leads and its distance to the second is the known one. Of several images in
    a row the first ordinary picture (type 0) is taken.

    Args:
        source: the folder of ``airsim_rec.txt``; ``settings.json`` lies there or above.
        out: folder to make.

    Raises:
        RecordingError: something is missing or malformed; one line: file, row, what to do.
    """
    settings = read_airsim_settings(_settings_path(source))
    vehicles = _read_vehicles(source / _TABLE_FILE, settings)
    order = [name for name in settings.vehicle_names() if name in vehicles] or list(vehicles)
    imported = {}
    for k, name in enumerate(order):
        imported[f"mav{k}"] = vehicles[name], *_sensor_and_truth(name, vehicles[name], settings)
    drones = list(imported)
    description = Description(
        name=source.resolve().name,
        frame_rate_hz=imported[drones[0]][1].rate_hz,
        leader=drones[0],
        known_distances=(KnownPair(drones[0], drones[1]),) if len(drones) > 1 else (),
    )
    with RecordingWriter(out, description) as writer:
        for drone, (vehicle, sensor, truth) in imported.items():
            writer.add_drone(drone, sensor, truth)
            for at_ns, image in zip(vehicle.at_ns, vehicle.images, strict=True):
                writer.add_file(drone, at_ns, image)


def _settings_path(source: Path) -> Path:
    for folder in (source, source.resolve().parent):
        if (folder / _SETTINGS_FILE).is_file():
            return folder / _SETTINGS_FILE
    raise RecordingError(
        f"{source / _SETTINGS_FILE}: missing; copy AirSim's settings.json there, "
        "it has the camera and the start of each vehicle"
    )


def _read_vehicles(path: Path, settings: AirSimSettings) -> dict[str, _Vehicle]:
    header, *rows = read_rows(path, "give the folder of an AirSim recording", "\t")
    column_of = {name: k for k, name in enumerate(header.cells)}
    absent = [name for name in _COLUMNS if name not in column_of]
    if absent:
        raise header.error(f"no column {', '.join(absent)}; the header of an AirSim recording")
    if not rows:
        raise RecordingError(f"{path}: no rows under its header; nothing was recorded")
    vehicles: dict[str, _Vehicle] = {}
    for row in rows:
        if len(row.cells) != len(header.cells):
            raise row.error(f"{len(row.cells)} columns where the header has {len(header.cells)}")
        if "VehicleName" in column_of:
            name = row.cells[column_of["VehicleName"]]
        else:
            name = _only_vehicle(settings)
        if settings.vehicle_names() and name not in settings.vehicle_names():
            raise row.error(f"vehicle {name[:40]!r} is not in the Vehicles of {settings.path}")
        _add_row(vehicles.setdefault(name, _Vehicle()), row, column_of, name)
    if len(vehicles) > 1 and not settings.vehicle_names():
        raise RecordingError(
            f"{settings.path}: no Vehicles; the starts of {', '.join(map(repr, vehicles))} "
            "are needed (X, Y, Z)"
        )
    return vehicles


def _only_vehicle(settings: AirSimSettings) -> str:
    """Return which vehicle a table without VehicleName is about."""
    names = settings.vehicle_names()
    if len(names) > 1:
        raise RecordingError(
            f"{settings.path}: {len(names)} Vehicles, but the recording names none; "
            "leave only the recorded one"
        )
    return names[0] if names else ""


def _add_row(vehicle: _Vehicle, row: Row, column_of: Mapping[str, int], name: str) -> None:
    cell = row.cells[column_of["TimeStamp"]]
    if not (cell.isascii() and cell.isdigit() and len(cell) <= 13):
        raise row.error(f"{cell[:40]!r} is not a TimeStamp in whole milliseconds")
    at_ns = int(cell) * _NS_PER_MS
    previous = (vehicle.rows[-1], vehicle.at_ns[-1]) if vehicle.rows else None
    check_order(row, at_ns, previous)
    numbers = np.array([row.value(column_of[column]) for column in _POSE_COLUMNS])
    if abs(np.linalg.norm(numbers[3:]) - 1.0) > QUATERNION_TOLERANCE:
        raise row.error("Q_W..Q_Z has not unit length, it is no rotation")
    camera_name, image = _scene_image(row, row.cells[column_of["ImageFile"]], name)
    if vehicle.rows and camera_name != vehicle.camera_name:
        raise row.error(f"camera {camera_name!r} after {vehicle.camera_name!r}; keep one camera")
    vehicle.camera_name = camera_name
    vehicle.rows.append(row)
    vehicle.at_ns.append(at_ns)
    vehicle.start_from_body.append(Pose.from_quaternion(numbers[3:], numbers[:3]))
    vehicle.images.append(row.path.parent / "images" / image)


def _scene_image(row: Row, cell: str, vehicle: str) -> tuple[str, str]:
    """Return (camera, file name) of a row's first ordinary picture."""
    names = [name.strip() for name in cell.split(";") if name.strip()]
    for name in names:
        if "/" in name or "\\" in name or not name.isprintable():
            raise row.error(f"{name[:80]!r} is not the name of a file in images/")
        match = _IMAGE_NAME.fullmatch(name)
        if match and match["type"] == _SCENE_TYPE:
            return match["camera"].removeprefix(vehicle).removeprefix("_"), name
    if len(names) == 1 and not _IMAGE_NAME.fullmatch(names[0]):
        return "", names[0]  # renamed files: one a row leaves no doubt
    raise row.error("no PNG of ImageType 0 in ImageFile; record a scene camera with Compress true")


def _sensor_and_truth(
    name: str, vehicle: _Vehicle, settings: AirSimSettings
) -> tuple[Sensor, Trajectory]:
    camera, body_from_cam = settings.camera(name, vehicle.camera_name)
    for row, image in zip(vehicle.rows, vehicle.images, strict=True):
        try:
            check_image(image, camera)
        except RecordingError as error:
            raise row.error(f"{error} (calibration: {settings.path})") from None
    rate_hz = nominal_rate_hz(vehicle.at_ns)
    # Only the origin differs: every vehicle's axes are north, east, down.
    ned_from_start = Pose(np.eye(3), settings.start_ned_m(name))
    poses = [ned_from_start @ pose for pose in vehicle.start_from_body]
    return Sensor(camera, body_from_cam, rate_hz), Trajectory.from_poses(vehicle.at_ns, poses)
