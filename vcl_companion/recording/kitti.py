"""Imports a KITTI odometry sequence as a recording of one drone.

A sequence holds ``calib.txt`` (projection matrices P0..P3 of the rectified
cameras, row-major 3x4), ``times.txt`` (seconds, one a line) and ``image_0``
(the left grey camera); the poses file holds one row-major 3x4 camera pose a
line, in the axes of the first camera (x right, y down, z forward).

World: NED-like at the first camera, x its view, y right, z down. Body: FRD at
the camera. Both come from the camera axes by BODY_FROM_CAM_FORWARD.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import orthonormalized
from vcl_companion.recording.description import Description
from vcl_companion.recording.images import check_image, image_size_px
from vcl_companion.recording.sensor import BODY_FROM_CAM_FORWARD, Sensor, nominal_rate_hz
from vcl_companion.recording.tables import Row, check_order, read_rows
from vcl_companion.recording.trajectory import Trajectory
from vcl_companion.recording.writer import RecordingWriter

_DRONE = "mav0"
# The published poses are printed with 7 digits.
_ROTATION_TOLERANCE = 1e-3
_MAX_FOCAL_PX = 1e6


def import_kitti(sequence_dir: Path, poses_file: Path | None, out: Path) -> None:
    """Write a KITTI odometry sequence in our layout.

    Args:
        sequence_dir: ``sequences/NN``.
        poses_file: ``poses/NN.txt``; None for sequences without ground truth.
        out: folder to make.

    Raises:
        RecordingError: something is missing or malformed; one line: file, row, what to do.
    """
    at_ns = _read_times(sequence_dir / "times.txt")
    folder = sequence_dir / "image_0"
    images = [folder / f"{k:06d}.png" for k in range(len(at_ns))]
    camera = _read_camera(sequence_dir / "calib.txt", image_size_px(images[0]))
    for k, image in enumerate(images):
        try:
            check_image(image, camera)
        except RecordingError as error:
            raise RecordingError(f"{sequence_dir / 'times.txt'}, row {k + 1}: {error}") from None
    truth = None if poses_file is None else _read_poses(poses_file, at_ns)
    rate_hz = nominal_rate_hz(at_ns)
    sensor = Sensor(camera, Pose(BODY_FROM_CAM_FORWARD, np.zeros(3)), rate_hz)
    name = f"kitti-{sequence_dir.resolve().name}"
    with RecordingWriter(out, Description(name, rate_hz, _DRONE)) as writer:
        writer.add_drone(_DRONE, sensor, truth)
        for instant, image in zip(at_ns, images, strict=True):
            writer.add_file(_DRONE, instant, image)


def _read_times(path: Path) -> list[int]:
    instants: list[int] = []
    previous: tuple[Row, int] | None = None
    for row in read_rows(path, "a KITTI sequence has one time a line, seconds", None):
        if len(row.cells) != 1:
            raise row.error(f"{len(row.cells)} columns, expected one time in seconds")
        at_ns = row.seconds_as_ns()
        check_order(row, at_ns, previous)
        previous = row, at_ns
        instants.append(at_ns)
    return instants


def _read_camera(path: Path, size_px: tuple[int, int]) -> Camera:
    """Return the left grey camera of ``calib.txt``, rectified and so without distortion."""
    for row in read_rows(path, "a KITTI sequence has the rows P0: to P3:", None):
        if row.cells[0] != "P0:":
            continue
        if len(row.cells) != 13:
            raise row.error(f"P0 has {len(row.cells) - 1} numbers, expected 12 of a 3x4 matrix")
        projection = np.array([row.value(k) for k in range(1, 13)]).reshape(3, 4)
        fx, fy, cx, cy = projection[0, 0], projection[1, 1], projection[0, 2], projection[1, 2]
        expected = np.array([[fx, 0, cx, 0], [0, fy, cy, 0], [0, 0, 1, 0]])
        if not np.array_equal(projection, expected):
            raise row.error("P0 is not that of a rectified camera at the origin")
        if not (0 < fx < _MAX_FOCAL_PX and 0 < fy < _MAX_FOCAL_PX and min(size_px) > 0):
            raise row.error(f"focal lengths {fx:g} and {fy:g} px are not those of a camera")
        return Camera(*size_px, float(fx), float(fy), float(cx), float(cy))
    raise RecordingError(f"{path}: no row 'P0:'; the left grey camera's projection is needed")


def _read_poses(path: Path, at_ns: list[int]) -> Trajectory:
    """Read first_from_cam per frame and return ned_from_body."""
    rows = read_rows(path, "give the sequence's poses/NN.txt, or none", None)
    if len(rows) != len(at_ns):
        raise RecordingError(
            f"{path}: {len(rows)} poses for {len(at_ns)} times; give the poses of this sequence"
        )
    # The world is to the first camera as the body is to its own.
    body_from_cam = Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
    cam_from_body = body_from_cam.inverse()
    poses = []
    for row in rows:
        if len(row.cells) != 12:
            raise row.error(f"{len(row.cells)} numbers, expected 12 of a 3x4 pose")
        matrix = np.array([row.value(k) for k in range(12)]).reshape(3, 4)
        rotation = matrix[:, :3]
        skewness = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if not skewness <= _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
            raise row.error("its left 3x3 is not a rotation")
        first_from_cam = Pose(orthonormalized(rotation), matrix[:, 3])
        poses.append(body_from_cam @ first_from_cam @ cam_from_body)
    return Trajectory.from_poses(at_ns, poses)
