"""Writes a recording image by image; the folder appears when it is complete."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import RecordingError
from vcl_companion.recording.description import Description, format_description
from vcl_companion.recording.images import check_image
from vcl_companion.recording.recording import (
    CAMERA_FOLDER,
    DESCRIPTION_FILE,
    IMU_FOLDER,
    TRUTH_FOLDER,
)
from vcl_companion.recording.sensor import NED_FROM_REFERENCE, ReferenceAxes, Sensor, write_sensor
from vcl_companion.recording.trajectory import InertialSamples, Trajectory

ImageFormat = Literal["jpg", "png"]

_TRUTH_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)
_VELOCITY_HEADER = ",v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1]"
_BIAS_HEADER = (
    ",b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],b_w_RS_S_z [rad s^-1],"
    "b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)
_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)


@dataclass(frozen=True)
class ImageOptions:
    """How images are kept.

    Attributes:
        image_format: ``jpg`` (small) or ``png`` (exact).
        jpg_quality: 1 to 100.
    """

    image_format: ImageFormat = "jpg"
    jpg_quality: int = 92

    def __post_init__(self) -> None:
        if self.image_format not in ("jpg", "png") or not 1 <= self.jpg_quality <= 100:
            raise ValueError(f"images are jpg of quality 1..100 or png, got {self}")


@dataclass(eq=False)
class _OpenDrone:
    sensor: Sensor
    rows: list[tuple[int, str]] = field(default_factory=list)
    truth: Trajectory | None = None
    imu: InertialSamples | None = None


class RecordingWriter:
    """A recording being made; a context manager.

    Images go to disk as they come, into a folder beside the final one; the
    tables follow and the folder gets its name on a clean exit, so a reader sees
    all of the recording or nothing. An exception inside discards it.

        with RecordingWriter(path, Description(name="yard")) as writer:
            writer.add_drone("mav0", sensor, truth=trajectory)
            writer.add_frame("mav0", at_ns, image)
    """

    def __init__(
        self,
        path: Path,
        description: Description | None = None,
        images: ImageOptions | None = None,
    ) -> None:
        self._path = path.absolute()
        self._description = description or Description()
        self._images = images or ImageOptions()
        self._drones: dict[str, _OpenDrone] = {}
        self._partial = self._path.parent / f".{path.name}.{os.getpid()}.partial"

    def __enter__(self) -> Self:
        with self._disk():
            if self._path.exists() and (not self._path.is_dir() or any(self._path.iterdir())):
                raise RecordingError(f"{self._path}: already there; give a new or empty folder")
            self._partial.mkdir(parents=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                with self._disk():
                    self._finish()
        finally:
            shutil.rmtree(self._partial, ignore_errors=True)

    def add_drone(
        self,
        name: str,
        sensor: Sensor,
        truth: Trajectory | None = None,
        imu: InertialSamples | None = None,
    ) -> None:
        """Announce a drone before its first frame.

        Args:
            name: ``mavN``.
            sensor: its camera; ``reference_axes`` says which axes the truth is written in.
            truth: ned_from_body; may be given later (``set_truth``).
            imu: samples in body axes.
        """
        if not re.fullmatch(r"mav[0-9]{1,6}", name) or name in self._drones:
            raise ValueError(f"drone names are mav0, mav1, ..., each once; got {name!r}")
        with self._disk():
            (self._partial / name / CAMERA_FOLDER / "data").mkdir(parents=True)
        self._drones[name] = _OpenDrone(sensor, truth=truth, imu=imu)

    def set_truth(self, name: str, truth: Trajectory) -> None:
        """Give a drone's ground truth when it is known only after its frames."""
        self._drones[name].truth = truth

    def add_frame(self, name: str, at_ns: int, image: NDArray[np.uint8]) -> bytes:
        """Encode and keep one image; return its encoded form.

        Args:
            name: of a drone that was added.
            at_ns: later than the drone's frame before, ns.
            image: (H, W) uint8 of the camera's size.
        """
        drone = self._drones[name]
        camera = drone.sensor.camera
        if image.dtype != np.uint8 or image.shape != (camera.height_px, camera.width_px):
            raise ValueError(f"{name}: image {image.dtype}{image.shape} is not grey of its camera")
        options = self._images
        flags = [cv2.IMWRITE_JPEG_QUALITY, options.jpg_quality]
        target = self._target(name, at_ns, "." + options.image_format)
        encoded_well, encoded = cv2.imencode(
            target.suffix, image, flags if options.image_format == "jpg" else []
        )
        if not encoded_well:
            raise ValueError(f"{name}: OpenCV cannot encode {target.name}")
        data = encoded.tobytes()
        with self._disk():
            target.write_bytes(data)
        drone.rows.append((at_ns, target.name))
        return data

    def add_file(self, name: str, at_ns: int, source: Path) -> None:
        """Keep a JPEG or PNG file as it is (importers).

        Raises:
            RecordingError: the file is missing, damaged or not of the camera's size.
        """
        drone = self._drones[name]
        check_image(source, drone.sensor.camera)
        with self._disk():
            with source.open("rb") as file:
                suffix = ".png" if file.read(1) == b"\x89" else ".jpg"
            target = self._target(name, at_ns, suffix)
            shutil.copyfile(source, target)
        drone.rows.append((at_ns, target.name))

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """Turn a full or read-only disk into one line."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise RecordingError(f"{self._path}: cannot be written ({reason})") from None

    def _target(self, name: str, at_ns: int, suffix: str) -> Path:
        rows = self._drones[name].rows
        if not 0 <= at_ns < 2**63 or (rows and at_ns <= rows[-1][0]):
            raise ValueError(f"{name}: frame at {at_ns} ns does not follow the one before")
        return self._partial / name / CAMERA_FOLDER / "data" / f"{at_ns}{suffix}"

    def _finish(self) -> None:
        empty = [name for name, drone in self._drones.items() if not drone.rows]
        if empty or not self._drones:
            raise ValueError(f"nothing recorded by {', '.join(empty) or 'any drone'}")
        for name, drone in self._drones.items():
            folder = self._partial / name
            write_sensor(folder / CAMERA_FOLDER / "sensor.yaml", drone.sensor)
            rows = [f"{at_ns},{file_name}" for at_ns, file_name in drone.rows]
            _write_table(folder / CAMERA_FOLDER / "data.csv", "#timestamp [ns],filename", rows)
            if drone.truth is not None:
                (folder / TRUTH_FOLDER).mkdir()
                _write_truth(
                    folder / TRUTH_FOLDER / "data.csv", drone.truth, drone.sensor.reference_axes
                )
            if drone.imu is not None:
                (folder / IMU_FOLDER).mkdir()
                values = np.hstack([drone.imu.angular_rates_rad_s, drone.imu.specific_forces_m_s2])
                _write_table(
                    folder / IMU_FOLDER / "data.csv",
                    _IMU_HEADER,
                    [_line(k, row) for k, row in zip(drone.imu.at_ns, values, strict=True)],
                )
        text = format_description(self._description)
        (self._partial / DESCRIPTION_FILE).write_text(text, encoding="utf-8")
        self._partial.replace(self._path)


def _write_truth(path: Path, truth: Trajectory, axes: ReferenceAxes) -> None:
    """Write poses in the reference frame's axes; biases, which nobody knows, as EuRoC's zeros."""
    written = truth.turned(NED_FROM_REFERENCE[axes].T)
    columns = [written.positions_m, written.quaternions]
    header = _TRUTH_HEADER
    if written.velocities_m_s is not None:
        header += _VELOCITY_HEADER + _BIAS_HEADER
        columns += [written.velocities_m_s, np.zeros((len(written), 6))]
    rows = [_line(k, v) for k, v in zip(written.at_ns, np.hstack(columns), strict=True)]
    _write_table(path, header, rows)


def _line(at_ns: np.int64, values: NDArray[np.float64]) -> str:
    # repr is the shortest text that reads back as the same number; + 0.0 drops the sign of -0.
    return ",".join([str(int(at_ns)), *(repr(float(value) + 0.0) for value in values)])


def _write_table(path: Path, header: str, rows: list[str]) -> None:
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
