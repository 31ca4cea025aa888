from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera, DistortionModel
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.recording.sensor import (
    BODY_FROM_CAM_FORWARD,
    NED_FROM_REFERENCE,
    ReferenceAxes,
    Sensor,
    check_lens,
    nominal_rate_hz,
    read_sensor,
    write_sensor,
)

# cam0/sensor.yaml as EuRoC's MH_01_easy has it.
EUROC = """\
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""

FINITE = st.floats(-1e3, 1e3)


@st.composite
def sensors(draw: st.DrawFn) -> Sensor:
    model: DistortionModel = draw(st.sampled_from(["none", "radial-tangential", "equidistant"]))
    count = {"none": [0], "radial-tangential": [4, 5], "equidistant": [4]}[model]
    coefficient = st.floats(-1.0, 1.0)
    distortion = draw(st.lists(coefficient, min_size=count[0], max_size=count[-1]))
    focal = st.floats(1e-3, 1e4)
    camera = Camera(
        draw(st.integers(1, 5000)),
        draw(st.integers(1, 5000)),
        draw(focal),
        draw(focal),
        draw(FINITE),
        draw(FINITE),
        model,
        tuple(distortion),
    )
    vector = np.array(draw(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3)))
    lever_arm = np.array(draw(st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3)))
    axes: ReferenceAxes = draw(st.sampled_from(["NED", "ENU", "NWU"]))
    return Sensor(camera, Pose(exp_so3(vector), lever_arm), draw(st.floats(0.01, 1e3)), axes)


@given(sensors())
def test_what_is_written_reads_back_the_same(
    tmp_path_factory: pytest.TempPathFactory, sensor: Sensor
) -> None:
    path = tmp_path_factory.mktemp("sensor") / "sensor.yaml"
    write_sensor(path, sensor)
    read = read_sensor(path)
    assert read.camera == sensor.camera
    assert read.rate_hz == sensor.rate_hz
    assert read.reference_axes == sensor.reference_axes
    np.testing.assert_allclose(
        read.body_from_cam.matrix(), sensor.body_from_cam.matrix(), rtol=0, atol=1e-15
    )


def test_a_genuine_euroc_file(tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(EUROC)
    sensor = read_sensor(path, default_axes="NWU")
    assert sensor.camera == Camera(
        *(752, 480, 458.654, 457.296, 367.215, 248.375, "radial-tangential"),
        (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    )
    assert sensor.rate_hz == 20.0
    assert sensor.reference_axes == "NWU"
    assert sensor.body_from_cam.rotation[2, 2] == pytest.approx(0.999660727178, abs=1e-9)
    assert sensor.body_from_cam.translation[1] == -0.064676986768


@pytest.mark.parametrize(
    "matrix",
    [
        "T_BS: [0,0,1,0.5, 1,0,0,0, 0,1,0,0, 0,0,0,1]",
        "T_BS:\n- [0,0,1,0.5]\n- [1,0,0,0]\n- [0,1,0,0]\n- [0,0,0,1]",
        "T_BS:\n  rows: 4\n  cols: 4\n  data: [0,0,1,5e-1, 1,0,0,0, 0,1,0,0, 0,0,0,1]",
    ],
)
def test_forms_of_the_extrinsics(tmp_path: Path, matrix: str) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(
        f"{matrix}\nrate_hz: 5\nresolution: [64, 48]\nintrinsics: [50, 50, 31.5, 23.5]\n"
    )
    sensor = read_sensor(path)
    np.testing.assert_array_equal(sensor.body_from_cam.rotation, BODY_FROM_CAM_FORWARD)
    np.testing.assert_array_equal(sensor.body_from_cam.translation, [0.5, 0.0, 0.0])
    assert sensor.camera.distortion_model == "none"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("resolution: [752, 480]\n", "", "resolution is missing"),
        ("[752, 480]", "[752]", "resolution needs 2 number(s), found 1"),
        ("[752, 480]", "[752.5, 480]", "not an image size"),
        ("[752, 480]", "[0, 480]", "not an image size"),
        ("458.654", "nan", "intrinsics holds 'nan', not a finite number"),
        ("458.654", "-458.654", "focal lengths must be positive"),
        ("radial-tangential", "fisheye62", "distortion_model 'fisheye62' is not one of none"),
        (", 1.76187114e-05]", "]", "takes 4 or 5 coefficients, got 3"),
        ("rate_hz: 20", "rate_hz: 0", "rate_hz must be positive"),
        ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.0, 2.0]", "must end with the row 0, 0, 0, 1"),
        ("0.0148655429818", "0.5", "T_BS holds no rotation"),
        ("-0.0216401454975", "1e9", "no metres"),
        ("camera_model: pinhole", "camera_model: omni", "camera_model 'omni' is not supported"),
        ("sensor_type: camera", "reference_axes: NEU", "reference_axes 'NEU' is not"),
        ("sensor_type: camera", "sensor_type: [", "not YAML"),
        ("sensor_type: camera", "T: &a [*a]", "not YAML"),
        ("T_BS:", "T_SB:", "T_BS is missing"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    assert old in EUROC
    path = tmp_path / "sensor.yaml"
    path.write_text(EUROC.replace(old, new))
    with pytest.raises(RecordingError) as caught:
        read_sensor(path)
    message = str(caught.value)
    assert says in message
    assert message.startswith(str(path))
    assert "\n" not in message


def test_a_mirroring_matrix_is_no_rotation(tmp_path: Path) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(
        "T_BS: [1,0,0,0, 0,1,0,0, 0,0,-1,0, 0,0,0,1]\n"
        "rate_hz: 5\nresolution: [64, 48]\nintrinsics: [50, 50, 31.5, 23.5]\n"
    )
    with pytest.raises(RecordingError, match=r"determinant -1\.000"):
        read_sensor(path)


def test_an_absent_file_says_what_is_needed(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"sensor\.yaml: missing; the calibration"):
        read_sensor(tmp_path / "sensor.yaml")


def test_the_nominal_rate_is_that_of_most_intervals() -> None:
    assert nominal_rate_hz([7]) == 1.0
    assert nominal_rate_hz([0, 50_000_000, 100_000_000, 900_000_000]) == 20.0
    assert nominal_rate_hz([0, 2**62]) == 1e-3
    assert nominal_rate_hz([0, 1]) == 1e5


def test_axes_are_rotations_with_the_right_down() -> None:
    up = {"ENU": [0.0, 0.0, 1.0], "NWU": [0.0, 0.0, 1.0], "NED": [0.0, 0.0, -1.0]}
    north = {"ENU": [0.0, 1.0, 0.0], "NWU": [1.0, 0.0, 0.0], "NED": [1.0, 0.0, 0.0]}
    for axes, matrix in NED_FROM_REFERENCE.items():
        assert np.linalg.det(matrix) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_array_equal(matrix @ up[axes], [0.0, 0.0, -1.0])
        np.testing.assert_array_equal(matrix @ north[axes], [1.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("367.215, 248.375", "752.0, 248.375", "another resolution"),
        ("367.215, 248.375", "367.215, -1.0", "another resolution"),
        ("[-0.28340811, 0.07395907,", "[-3.0, 0.0,", "no ray reaches"),
    ],
)
def test_what_no_lens_is_is_one_line(tmp_path: Path, old: str, new: str, says: str) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_text(EUROC)
    check_lens(path, read_sensor(path).camera)
    assert old in EUROC
    path.write_text(EUROC.replace(old, new))
    with pytest.raises(RecordingError, match=says) as raised:
        check_lens(path, read_sensor(path).camera)
    assert str(raised.value).startswith(f"{path}: ")
    assert "\n" not in str(raised.value)
