"""A mounting by angles is the rotation that scipy makes of them, and wins over the file's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vcl_companion.cameras.mounting import (
    mounted_rotation,
    mounting_of,
    mounting_text,
    read_calibration,
)
from vcl_companion.cameras.source import CameraOptions
from vcl_companion.errors import ConfigError, RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.sensor import Sensor, write_sensor

DEGREES = st.floats(-180.0, 180.0)
# Optical axes of a camera in the housing's: right, down, forward.
HOUSING_FROM_CAM = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])


@given(st.tuples(DEGREES, DEGREES, DEGREES))
def test_angles_are_yaw_then_pitch_then_roll(angles: tuple[float, float, float]) -> None:
    roll, pitch, yaw = angles
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True) * HOUSING_FROM_CAM
    np.testing.assert_allclose(mounted_rotation(angles), expected.as_matrix(), atol=1e-12)
    again = mounted_rotation(mounting_of(mounted_rotation(angles)))
    np.testing.assert_allclose(again, expected.as_matrix(), atol=1e-5)


@pytest.mark.parametrize(
    ("angles", "forward", "top", "text"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 0, -1), "looks forward, image's top up"),
        ((0, -90, 0), (0, 0, 1), (1, 0, 0), "looks down, image's top forward"),
        ((0, 0, 90), (0, 1, 0), (0, 0, -1), "looks right, image's top up"),
        ((0, 0, 180), (-1, 0, 0), (0, 0, -1), "looks back, image's top up"),
        ((180, 0, 0), (1, 0, 0), (0, 0, 1), "looks forward, image's top down"),
        ((90, 0, 0), (1, 0, 0), (0, 1, 0), "looks forward, image's top right"),
        ((0, 90, 0), (0, 0, -1), (-1, 0, 0), "looks up, image's top back"),
    ],
)
def test_a_camera_looks_where_its_angles_say(
    angles: tuple[float, ...], forward: tuple[int, ...], top: tuple[int, ...], text: str
) -> None:
    body_from_cam = mounted_rotation(angles)
    np.testing.assert_allclose(body_from_cam @ (0, 0, 1), forward, atol=1e-12)
    np.testing.assert_allclose(body_from_cam @ (0, -1, 0), top, atol=1e-12)
    assert mounting_text(body_from_cam).endswith(text)


def calibration(folder: Path, *, with_matrix: bool) -> CameraOptions:
    path = folder / "camera.yaml"
    matrix = Pose(mounted_rotation((10, 20, 30)), np.array([0.1, 0.2, 0.3]))
    write_sensor(path, Sensor(Camera(64, 48, 50.0, 50.0, 31.5, 23.5), matrix, 20.0))
    if not with_matrix:
        lines = path.read_text().splitlines()
        start = lines.index("T_BS:")
        path.write_text("\n".join(lines[:start] + lines[start + 7 :]) + "\n")
    return CameraOptions(calibration=str(path))


def test_the_configuration_wins_each_half_for_itself(tmp_path: Path) -> None:
    options = calibration(tmp_path, with_matrix=True)
    turned = replace(options, mounting_deg=(0.0, -90.0, 0.0))
    moved = replace(options, position_m=(0.0, 0.0, 0.5))
    both = replace(turned, position_m=(0.0, 0.0, 0.5))
    for one, angles, position in (
        (options, (10, 20, 30), (0.1, 0.2, 0.3)),
        (turned, (0, -90, 0), (0.1, 0.2, 0.3)),
        (moved, (10, 20, 30), (0.0, 0.0, 0.5)),
        (both, (0, -90, 0), (0.0, 0.0, 0.5)),
    ):
        sits = read_calibration(one).body_from_cam
        np.testing.assert_allclose(sits.rotation, mounted_rotation(angles), atol=1e-12)
        np.testing.assert_allclose(sits.translation, position)


def test_a_file_without_a_matrix_needs_the_angles(tmp_path: Path) -> None:
    options = calibration(tmp_path, with_matrix=False)
    with pytest.raises(RecordingError, match=r"camera\.yaml: T_BS is missing; .*mounting_deg"):
        read_calibration(replace(options, position_m=(0.0, 0.0, 0.5)))
    sits = read_calibration(replace(options, mounting_deg=(0.0, 0.0, 90.0))).body_from_cam
    np.testing.assert_allclose(sits.rotation, mounted_rotation((0, 0, 90)))
    np.testing.assert_allclose(sits.translation, 0.0)


def test_images_that_no_map_takes_are_refused_at_the_start(tmp_path: Path) -> None:
    options = calibration(tmp_path, with_matrix=True)
    large = Camera(2592, 1944, 2000.0, 2000.0, 1295.5, 971.5)
    write_sensor(Path(options.calibration), Sensor(large, Pose.identity(), 20.0))
    with pytest.raises(RecordingError, match=r"camera\.yaml: no map takes .* 2592x1944 px, "):
        read_calibration(options)


@pytest.mark.parametrize("name", ["mounting_deg", "position_m"])
@pytest.mark.parametrize("value", [(0.0, 400.0, 0.0), (0.0, 0.0, float("nan"))])
def test_what_is_no_mounting_is_refused(name: str, value: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match=f"^{name}: must be in "):
        CameraOptions(**{name: value})  # type: ignore[arg-type]
