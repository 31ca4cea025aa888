import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.recording.folders import grey_image
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler
from vcl_companion.recording import KnownPair, load_image, read_recording
from vcl_companion.recording.airsim import import_airsim

WIDTH_PX, HEIGHT_PX = 64, 36
SIZE = Camera(WIDTH_PX, HEIGHT_PX, 32.0, 32.0, 31.5, 17.5)
CAPTURE = {"CaptureSettings": [{"ImageType": 0, "Width": 64, "Height": 36, "FOV_Degrees": 90}]}
POSE = "POS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z"
OLD_HEADER = f"TimeStamp\t{POSE}\tImageFile"
NEW_HEADER = f"VehicleName\t{OLD_HEADER}"
START_MS = 1_539_453_811_633


def write_settings(source: Path, **more: object) -> None:
    settings = {"SettingsVersion": 1.2, "SimMode": "Multirotor", "CameraDefaults": CAPTURE, **more}
    (source / "settings.json").write_text(json.dumps(settings))


def write_image(source: Path, name: str) -> NDArray[np.uint8]:
    (source / "images").mkdir(exist_ok=True, parents=True)
    image = grey_image(np.random.default_rng(len(name) + sum(name.encode())), SIZE)
    assert cv2.imwrite(str(source / "images" / name), image)
    return image


@pytest.fixture
def old_source(tmp_path: Path) -> Path:
    """One vehicle, no VehicleName; a depth image beside each picture; a row as AirSim prints it."""
    source = tmp_path / "2018-10-13-19-03-31"
    rows = [OLD_HEADER]
    for k in range(3):
        name = f"img__0_{1539184758841717600 + k}.png"
        write_image(source, name)
        at_ms = START_MS + 100 * k
        rows.append(
            f"{at_ms}\t{k}.5\t0.000000\t-0.141340\t0.694659\t0.000000\t0.000000\t-0.719339\t"
            f"img__1_{1539184758841717600 + k}.pfm;{name}"
        )
    (source / "airsim_rec.txt").write_bytes(("\n".join(rows) + "\n").encode())
    write_settings(source)
    return source


@pytest.fixture
def new_source(tmp_path: Path) -> Path:
    """Three vehicles interleaved, settings.json in the folder above as AirSim keeps it."""
    source = tmp_path / "2021-03-04-05-06-07"
    rows = [NEW_HEADER]
    for k in range(4):
        for number, vehicle in enumerate(("Drone_2", "Drone_1")):
            name = f"img_{vehicle}_front_center_0_{1600000000000000000 + 10 * k + number}.png"
            write_image(source, name)
            # Both stand 2 m above their start and turn right by 90 degrees.
            pose = f"{k}\t0\t-2\t0.7071068\t0\t0\t0.7071068"
            rows.append(f"{vehicle}\t{START_MS + 50 * k + number}\t{pose}\t{name}")
    (source / "airsim_rec.txt").write_bytes(("\r\n".join(rows) + "\r\n").encode())
    mount = {"X": 0.3, "Y": 0.0, "Z": 0.1, "Pitch": -10.0, "Roll": 0.0, "Yaw": 5.0}
    write_settings(
        source.parent,
        Vehicles={
            "Drone_1": {"VehicleType": "SimpleFlight", "X": 4, "Y": -2, "Z": -1},
            "Idle": {"X": 100},
            "Drone_2": {"X": 0, "Y": 3.5, "Cameras": {"0": mount}},
        },
    )
    return source


def test_the_old_form_is_one_drone(old_source: Path, tmp_path: Path) -> None:
    import_airsim(old_source, tmp_path / "out")
    recording = read_recording(tmp_path / "out")
    (drone,) = recording.drones
    assert recording.name == old_source.name
    assert recording.frame_rate_hz == 10.0
    assert recording.known_distances == ()
    assert [frame.at_ns for frame in drone.frames] == [
        (START_MS + 100 * k) * 1_000_000 for k in range(3)
    ]
    assert drone.truth is not None
    np.testing.assert_array_equal(drone.truth.positions_m[2], [2.5, 0.0, -0.14134])
    yaw = -2 * np.arctan2(0.719339, 0.694659)
    np.testing.assert_allclose(
        drone.truth.pose(0).rotation, matrix_from_euler(0, 0, yaw), atol=1e-6
    )
    # 90 degrees over 64 px: the focal length is half the width, the centre between two pixels.
    assert drone.sensor.camera.fx_px == pytest.approx(32.0, abs=1e-12)
    assert (drone.sensor.camera.cx_px, drone.sensor.camera.cy_px) == (31.5, 17.5)
    # What the camera sees ahead is ahead of the body, what it sees below is below.
    np.testing.assert_allclose(
        drone.sensor.body_from_cam.apply(np.array([[1.0, 2.0, 3.0]])), [[3.0, 1.0, 2.0]]
    )
    image = write_image(old_source, "img__0_1539184758841717600.png")
    np.testing.assert_array_equal(load_image(drone.frames[0].path, drone.sensor.camera), image)


def test_the_new_form_is_one_swarm_in_one_frame(new_source: Path, tmp_path: Path) -> None:
    import_airsim(new_source, tmp_path / "out")
    recording = read_recording(tmp_path / "out")
    first, second = recording.drones  # Drone_1, Drone_2: the order of settings.json
    assert recording.leader == "mav0"
    assert recording.known_distances == (KnownPair("mav0", "mav1"),)
    assert first.truth is not None
    assert second.truth is not None
    np.testing.assert_array_equal(first.truth.positions_m[1], [5.0, -2.0, -3.0])
    np.testing.assert_array_equal(second.truth.positions_m[1], [1.0, 3.5, -2.0])
    assert first.frames[1].at_ns == (START_MS + 51) * 1_000_000
    assert second.frames[1].at_ns == (START_MS + 50) * 1_000_000
    np.testing.assert_allclose(first.truth.pose(0).rotation[:, 0], [0.0, 1.0, 0.0], atol=1e-12)
    assert first.sensor.body_from_cam.translation.tolist() == [0.0, 0.0, 0.0]
    # Drone_2's camera is set by its number; it looks 10 degrees down and 5 to the right.
    tilt, turn = np.radians([10.0, 5.0])
    ahead = [np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)]
    mounted: Pose = second.sensor.body_from_cam
    np.testing.assert_allclose(mounted.rotation[:, 2], ahead, atol=1e-12)
    assert mounted.translation.tolist() == [0.3, 0.0, 0.1]


def test_a_cameras_own_capture_settings_win_and_replace(new_source: Path, tmp_path: Path) -> None:
    own = {"CaptureSettings": [{"ImageType": 0, "Width": 64, "Height": 36, "FOV_Degrees": 60}]}
    write_settings(
        new_source,  # beside the recording: wins over the one above
        CameraDefaults={"CaptureSettings": [{"Width": 640, "Height": 480}]},
        Vehicles={
            "Drone_1": {"Cameras": {"front_center": own}},
            "Drone_2": {"Cameras": {"0": own}},
        },
    )
    import_airsim(new_source, tmp_path / "out")
    camera = read_recording(tmp_path / "out").drones[0].sensor.camera
    assert camera.fx_px == pytest.approx(32.0 / np.tan(np.radians(30.0)), abs=1e-9)


def failure(source: Path, out: Path) -> str:
    with pytest.raises(RecordingError) as caught:
        import_airsim(source, out)
    assert not out.exists()
    message = str(caught.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("row", "old", "new", "says"),
    [
        (1, "Q_W", "QW", "row 1: no column Q_W"),
        (4, str(START_MS + 50), f"{START_MS}.5", "not a TimeStamp in whole milliseconds"),
        (4, str(START_MS + 50), str(START_MS), "is that of row 2 again"),
        (4, "\t-2\t", "\tnan\t", "row 4: column 5: 'nan' is not a usable number"),
        (4, "\t-2\t", "\t", "row 4: 9 columns where the header has 10"),
        (4, "0.7071068\t0", "0.2\t0", "row 4: Q_W..Q_Z has not unit length"),
        (4, "Drone_2\t", "Drone_3\t", "row 4: vehicle 'Drone_3' is not in the Vehicles of"),
        (4, "_0_16", "_5_16", "row 4: no PNG of ImageType 0"),
        (4, "front_center_0", "bottom_0", "row 4: camera 'bottom' after 'front_center'"),
        (4, "img_", "../img_", "is not the name of a file in images/"),
        (4, "010.png", "999.png", "row 4: image "),
    ],
)
def test_a_broken_row(
    new_source: Path, tmp_path: Path, row: int, old: str, new: str, says: str
) -> None:
    path = new_source / "airsim_rec.txt"
    lines = path.read_text().split("\n")
    assert old in lines[row - 1]
    lines[row - 1] = lines[row - 1].replace(old, new, 1)
    path.write_text("\n".join(lines))
    message = failure(new_source, tmp_path / "out")
    assert message.startswith(str(path))
    assert says in message


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ("", "row 1: not JSON"),
        ("[]", "must hold one JSON object"),
        ('{"Vehicles": {"Drone_1": {}}}', "vehicle 'Drone_2' is not in the Vehicles of"),
        ("{}", "no Vehicles; the starts of 'Drone_2', 'Drone_1' are needed"),
        ('{"Vehicles": []}', "'Vehicles' must be an object"),
        ('{"Vehicles": {"Drone_1": {"X": "1"}, "Drone_2": {}}}', "X is not a usable number"),
        ('{"Vehicles": {"Drone_1": {"X": 1e400}, "Drone_2": {}}}', "X is not a usable number"),
        ('{"Vehicles": {"Drone_1": {}, "Drone_2": {}}}', "is 64x36, its calibration says 256x144"),
    ],
)
def test_broken_settings(new_source: Path, tmp_path: Path, settings: str, says: str) -> None:
    capture = f', "CameraDefaults": {json.dumps(CAPTURE)}}}'
    text = settings[:-1] + capture if '"1"' in settings or "1e400" in settings else settings
    (new_source / "settings.json").write_text(text)
    assert says in failure(new_source, tmp_path / "out")


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ({"Gimbal": {"Stabilization": 1}}, "hangs in a gimbal"),
        ({"CaptureSettings": [{"ProjectionMode": "orthographic"}]}, "is orthographic"),
        ({"CaptureSettings": [{"FOV_Degrees": 180}]}, "FOV_Degrees 180 is not 1 to 179"),
        ({"CaptureSettings": [{"Width": 0}]}, "0 x 144 is no image size"),
        ({"CaptureSettings": {}}, "CaptureSettings must be a list"),
        ({"Pitch": "down"}, "Pitch is not a usable number"),
    ],
)
def test_cameras_that_cannot_be_used(
    old_source: Path, tmp_path: Path, camera: object, says: str
) -> None:
    write_settings(old_source, Vehicles={"Drone": {"Cameras": {"front_center": camera}}})
    assert says in failure(old_source, tmp_path / "out")


def test_what_is_missing_is_named(old_source: Path, tmp_path: Path) -> None:
    write_settings(old_source, Vehicles={"A": {}, "B": {}})
    assert "leave only the recorded one" in failure(old_source, tmp_path / "out")
    write_settings(old_source)
    (old_source / "airsim_rec.txt").write_text(OLD_HEADER + "\n")
    assert "nothing was recorded" in failure(old_source, tmp_path / "out")
    (old_source / "airsim_rec.txt").unlink()
    assert "airsim_rec.txt: missing" in failure(old_source, tmp_path / "out")
    (old_source / "settings.json").unlink()
    assert "settings.json: missing; copy AirSim's" in failure(old_source, tmp_path / "out")


def test_a_place_that_is_not_set_is_not_a_number_in_airsim(
    old_source: Path, tmp_path: Path
) -> None:
    nan = float("nan")
    camera = {"X": 0.25, "Y": nan, "Z": nan, "Pitch": nan, "Roll": nan, "Yaw": nan}
    write_settings(old_source, Vehicles={"Drone": {"X": nan, "Cameras": {"0": camera}}})
    import_airsim(old_source, tmp_path / "out")
    (drone,) = read_recording(tmp_path / "out").drones
    assert drone.sensor.body_from_cam.translation.tolist() == [0.25, 0.0, 0.0]
    np.testing.assert_array_equal(drone.sensor.body_from_cam.rotation[:, 2], [1.0, 0.0, 0.0])
