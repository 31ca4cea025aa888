import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.recording.folders import CAMERA, PERIOD_NS, START_NS, write_small
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3, matrix_from_euler
from vcl_companion.recording import KnownPair, read_recording
from vcl_companion.recording.sensor import NED_FROM_REFERENCE, ReferenceAxes

SHARED = Path(__file__).parents[2] / ".." / "shared" / "data"
TRUTH = "mav0/state_groundtruth_estimate0"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_small(tmp_path_factory.mktemp("template") / "small")


@pytest.fixture
def folder(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "small"))


def replace_row(path: Path, number: int, old: str, new: str) -> None:
    lines = path.read_text().split("\n")
    assert old in lines[number - 1]
    lines[number - 1] = lines[number - 1].replace(old, new, 1)
    path.write_text("\n".join(lines))


def failure(folder: Path) -> str:
    with pytest.raises(RecordingError) as caught:
        read_recording(folder)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_reads_what_is_there(folder: Path) -> None:
    recording = read_recording(folder)
    assert recording.name == "small"
    assert recording.leader == "mav0"
    assert recording.frame_rate_hz == 5.0
    assert recording.known_distances == (KnownPair("mav0", "mav1", None),)
    assert [drone.name for drone in recording.drones] == ["mav0", "mav1"]
    drone = recording.drone("mav1")
    assert [frame.at_ns for frame in drone.frames] == [START_NS + k * PERIOD_NS for k in range(3)]
    assert drone.frames[0].path.is_file()
    assert drone.truth is not None
    np.testing.assert_array_equal(drone.truth.positions_m, [[1.0, 0.0, -1.0]] * 3)
    assert drone.imu is not None
    np.testing.assert_array_equal(drone.imu.specific_forces_m_s2, np.full((3, 3), -9.81))


def test_truth_and_imu_and_description_may_be_absent(folder: Path) -> None:
    (folder / TRUTH / "data.csv").unlink()
    shutil.rmtree(folder / "mav0/imu0")
    (folder / "recording.toml").unlink()
    recording = read_recording(folder)
    assert recording.drone("mav0").truth is None
    assert recording.drone("mav0").imu is None
    assert recording.name == "small"  # the folder's
    assert recording.known_distances == ()


def test_drones_come_by_number_and_ten_follows_nine(folder: Path) -> None:
    for name in ("mav10", "mav9"):
        shutil.copytree(folder / "mav0", folder / name)
    assert [d.name for d in read_recording(folder).drones] == ["mav0", "mav1", "mav9", "mav10"]


def euroc_folder(folder: Path) -> None:
    """Make it a plain EuRoC folder: one vehicle, no recording.toml, CRLF, z-up truth."""
    shutil.rmtree(folder / "mav1")
    (folder / "recording.toml").unlink()
    sensor = folder / "mav0/cam0/sensor.yaml"
    sensor.write_text(sensor.read_text().replace("reference_axes: NED\n", ""))
    for table in folder.rglob("*.csv"):
        table.write_bytes(table.read_bytes().replace(b"\n", b"\r\n"))


def test_a_plain_euroc_folder_is_one_drone_with_z_up(folder: Path) -> None:
    euroc_folder(folder)
    truth_from_world = "0.5,0.5,0.5,0.5,1.0,2.0,3.0" + ",0" * 6
    (folder / TRUTH / "data.csv").write_text(
        f"#header\r\n{START_NS - 5_000_000},4.0,1.0,2.0,{truth_from_world}\r\n"
        f"{START_NS + 5_000_000},4.0,1.0,2.0,{truth_from_world}\r\n"
    )
    recording = read_recording(folder)
    (drone,) = recording.drones
    assert drone.sensor.reference_axes == "NWU"
    assert drone.truth is not None
    np.testing.assert_array_equal(drone.truth.positions_m[0], [4.0, -1.0, -2.0])
    assert drone.truth.velocities_m_s is not None
    np.testing.assert_array_equal(drone.truth.velocities_m_s[0], [1.0, -2.0, -3.0])
    # (1, 1, 1, 1) / 2 turns x to y: body x lies along west, which is -y in NED.
    pose = drone.truth.pose_at(START_NS)
    assert pose is not None
    np.testing.assert_allclose(pose.rotation[:, 0], [0.0, -1.0, 0.0], atol=1e-12)
    # The truth covers the first frame only.
    assert drone.truth.pose_at(drone.frames[1].at_ns) is None


@pytest.mark.parametrize(
    ("toml", "camera", "truth", "expected"),
    [
        (False, None, None, "NWU"),
        (True, None, None, "NED"),
        (True, "ENU", None, "ENU"),
        (False, "NED", None, "NED"),
        (True, "NED", "NWU", "NWU"),
        (False, "NWU", "ENU", "ENU"),
    ],
)
def test_which_axes_hold(
    folder: Path,
    toml: bool,
    camera: ReferenceAxes | None,
    truth: ReferenceAxes | None,
    expected: ReferenceAxes,
) -> None:
    euroc_folder(folder)
    if toml:
        (folder / "recording.toml").write_text("")
    if camera:
        with (folder / "mav0/cam0/sensor.yaml").open("a") as file:
            file.write(f"reference_axes: {camera}\n")
    if truth:
        (folder / TRUTH / "sensor.yaml").write_text(f"reference_axes: {truth}\n")
    (drone,) = read_recording(folder).drones
    assert drone.sensor.reference_axes == expected
    assert drone.truth is not None
    np.testing.assert_array_equal(
        drone.truth.positions_m[0], NED_FROM_REFERENCE[expected] @ [0.0, 0.0, -1.0]
    )


def test_truth_of_a_marker_beside_the_body_is_carried_over(folder: Path) -> None:
    body_from_marker = Pose(exp_so3(np.array([0.1, -0.4, 1.2])), np.array([0.2, -0.1, 0.05]))
    ned_from_body = Pose(matrix_from_euler(0.1, 0.2, 2.0), np.array([3.0, 4.0, -5.0]))
    marker = ned_from_body @ body_from_marker
    numbers = [*marker.translation, *marker.quaternion(), 1.0, 0.0, 0.0, *[0.0] * 6]
    (folder / TRUTH / "data.csv").write_text(
        f"{START_NS},{','.join(map(repr, map(float, numbers)))}\n"
    )
    matrix = ", ".join(map(repr, map(float, body_from_marker.matrix().ravel())))
    (folder / TRUTH / "sensor.yaml").write_text(f"T_BS:\n  data: [{matrix}]\n")
    truth = read_recording(folder).drone("mav0").truth
    assert truth is not None
    np.testing.assert_allclose(truth.pose(0).matrix(), ned_from_body.matrix(), atol=1e-12)
    assert truth.velocities_m_s is None  # the marker's is not the body's


CAM = "mav0/cam0/data.csv"


@pytest.mark.parametrize(
    ("table", "row", "old", "new", "says"),
    [
        (
            CAM,
            3,
            ".png",
            ".jpg",
            f"row 3: image {{folder}}/mav0/cam0/data/{START_NS + PERIOD_NS}.jpg is missing",
        ),
        (
            CAM,
            3,
            f"{START_NS + PERIOD_NS},",
            f"{START_NS},",
            "row 3: timestamp 1721300000000000000 is that of row 2 again",
        ),
        (
            CAM,
            3,
            f"{START_NS + PERIOD_NS},",
            f"{START_NS - 1},",
            "row 3: timestamp 1721299999999999999 is earlier than row 2",
        ),
        (CAM, 2, f"{START_NS},", "nan,", "row 2: 'nan' is not a timestamp in whole nanoseconds"),
        (CAM, 2, f"{START_NS},", "1.7213e18,", "row 2: '1.7213e18' is not a timestamp"),
        (
            CAM,
            2,
            f"{START_NS},",
            "9223372036854775808,",
            "row 2: '9223372036854775808' is not a timestamp",
        ),
        (CAM, 4, ",", ";", "row 4: 1 columns, expected timestamp_ns,filename"),
        (CAM, 4, ".png", ".png,0", "row 4: 3 columns"),
        (CAM, 2, f",{START_NS}", ",../data/", "row 2: '../data/.png' is not the name of a file"),
        (CAM, 2, f",{START_NS}.png", ",", "row 2: '' is not the name of a file"),
        (CAM, 2, f",{START_NS}.png", ",\0.png", "row 2: '\\x00.png' is not the name of a file"),
        (CAM, 2, f",{START_NS}.png", "," + "x" * 300, "row 2: image "),
        (CAM, 1, "#timestamp [ns]", "timestamp", "row 1: 'timestamp' is not a timestamp"),
        (f"{TRUTH}/data.csv", 3, "-1.0", "nan", "row 3: column 4: 'nan' is not a usable number"),
        (f"{TRUTH}/data.csv", 3, "-1.0", "inf", "row 3: column 4: 'inf' is not a usable number"),
        (f"{TRUTH}/data.csv", 3, "-1.0", "1_0", "row 3: column 4: '1_0' is not a number"),
        (
            f"{TRUTH}/data.csv",
            4,
            "-1.0,1.0",
            "-1.0,2.0",
            "row 4: quaternion of length 2 is not a rotation",
        ),
        (
            f"{TRUTH}/data.csv",
            4,
            "-1.0,1.0",
            "-1.0,0.0",
            "row 4: quaternion of length 0 is not a rotation",
        ),
        (f"{TRUTH}/data.csv", 4, "-1.0,", "", "row 4: 7 columns where row 2 has 8"),
        (f"{TRUTH}/data.csv", 2, "-1.0,", "", "row 2: 7 columns, expected 8 or 11 or 17"),
        (f"{TRUTH}/data.csv", 3, f"{START_NS + PERIOD_NS}", f"{START_NS}", "row 3: timestamp"),
        ("mav0/imu0/data.csv", 3, "-9.81", "g", "row 3: column 5: 'g' is not a number"),
    ],
)
def test_a_broken_row_is_one_line_with_file_and_row(
    folder: Path, table: str, row: int, old: str, new: str, says: str
) -> None:
    replace_row(folder / table, row, old, new)
    message = failure(folder)
    assert message.startswith(f"{folder / table}, ")
    assert says.format(folder=folder) in message


def test_broken_images(folder: Path) -> None:
    image = folder / f"mav1/cam0/data/{START_NS + PERIOD_NS}.png"
    whole = image.read_bytes()
    prefix = f"{folder / 'mav1/cam0/data.csv'}, row 3: image {image} "
    cv2.imwrite(str(image), np.zeros((CAMERA.height_px, CAMERA.width_px + 1), dtype=np.uint8))
    assert failure(folder) == prefix + "is 49x32, its calibration says 48x32"
    image.write_bytes(whole[:-20])
    assert failure(folder) == prefix + "is cut off at its end; copy it again"
    for content in (b"", b"not an image", whole[:20]):
        image.write_bytes(content)
        assert failure(folder) == prefix + "is not a JPEG or PNG file"
    image.unlink()
    image.mkdir()
    assert failure(folder).startswith(prefix + "cannot be read")


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("mav1/cam0/sensor.yaml", "missing; the calibration of this sensor is needed"),
        ("mav1/cam0/data.csv", "missing; a row per image is needed"),
    ],
)
def test_an_absent_file_is_named(folder: Path, path: str, says: str) -> None:
    (folder / path).unlink()
    assert failure(folder).startswith(f"{folder / path}: {says}")


def test_tables_without_rows(folder: Path) -> None:
    (folder / CAM).write_text("#timestamp [ns],filename\n\n")
    assert failure(folder).startswith(f"{folder / CAM}: no rows")
    (folder / CAM).write_bytes(b"\xff\xfe\x00")
    assert failure(folder) == f"{folder / CAM}: not a text file"


def test_a_wrong_folder_says_which_is_right(folder: Path, tmp_path: Path) -> None:
    assert "no such folder" in failure(tmp_path / "absent")
    assert "give the folder above it" in failure(folder / "mav0")
    (tmp_path / "empty").mkdir()
    assert failure(tmp_path / "empty").endswith("no mav0, mav1, ... folder in it")


@pytest.mark.parametrize(
    ("name", "n_frames"),
    [
        ("yard", (70, 70, 70)),
        ("fountain-P11", (6, 5)),
        ("Herz-Jesus-P8", (4, 4)),
        ("castle-P19", (10, 9)),
    ],
)
@pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is not here")
def test_the_shared_recordings(name: str, n_frames: tuple[int, ...]) -> None:
    recording = read_recording(SHARED / name)
    assert recording.name == name
    assert recording.leader == "mav0"
    assert recording.frame_rate_hz == 5.0
    assert recording.known_distances == (KnownPair("mav0", "mav1", None),)
    assert tuple(len(drone.frames) for drone in recording.drones) == n_frames
    for drone in recording.drones:
        assert drone.truth is not None
        assert all(drone.truth.pose_at(frame.at_ns) is not None for frame in drone.frames)
    if name == "yard":  # its README states the distance
        first, second = (drone.truth.pose(0) for drone in recording.drones[:2] if drone.truth)
        distance_m = float(np.linalg.norm(first.translation - second.translation))
        assert distance_m == pytest.approx(2.596, abs=5e-4)
