from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.recording.folders import grey_image
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.recording import load_image, read_recording
from vcl_companion.recording.kitti import import_kitti

CAMERA = Camera(62, 19, 36.0, 36.0, 30.4, 9.3)
CALIB = (
    "P0: 3.600000e+01 0.000000e+00 3.040000e+01 0.000000e+00 0.000000e+00 3.600000e+01"
    " 9.300000e+00 0.000000e+00 0.000000e+00 0.000000e+00 1.000000e+00 0.000000e+00\n"
    "P1: 3.600000e+01 0.000000e+00 3.040000e+01 -1.930000e+01 0.000000e+00 3.600000e+01"
    " 9.300000e+00 0.000000e+00 0.000000e+00 0.000000e+00 1.000000e+00 0.000000e+00\n"
)
# The first times of sequence 00, as its file prints them.
TIMES = ("0.000000e+00", "1.037359e-01", "2.073570e-01", "3.109951e-01")


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    """A car that drives 2 m ahead a frame, 0.1 m up and 0.3 m to the right, turning right."""
    folder = tmp_path / "sequences" / "07"
    (folder / "image_0").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    (folder / "calib.txt").write_text(CALIB)
    (folder / "times.txt").write_text("\n".join(TIMES) + "\n")
    rng = np.random.default_rng(3)
    poses = []
    for k in range(len(TIMES)):
        image = grey_image(rng, CAMERA)
        cv2.imwrite(str(folder / "image_0" / f"{k:06d}.png"), image)
        # Camera axes: y is down, so a turn to the right is positive about y.
        turn = exp_so3(np.array([0.0, 0.1 * k, 0.0]))
        matrix = np.column_stack([turn, [0.3 * k, -0.1 * k, 2.0 * k]])
        poses.append(" ".join(f"{number:.6e}" for number in matrix.ravel()))
    (tmp_path / "poses" / "07.txt").write_text("\n".join(poses) + "\n")
    return folder


def test_a_sequence_becomes_one_drone_in_ned(sequence: Path, tmp_path: Path) -> None:
    import_kitti(sequence, tmp_path / "poses/07.txt", tmp_path / "out")
    recording = read_recording(tmp_path / "out")
    (drone,) = recording.drones
    assert recording.name == "kitti-07"
    assert drone.sensor.camera == CAMERA
    assert recording.frame_rate_hz == pytest.approx(9.65, abs=0.01)
    assert [frame.at_ns for frame in drone.frames] == [0, 103_735_900, 207_357_000, 310_995_100]
    assert drone.truth is not None
    # North is the first view, east its right, down is down.
    np.testing.assert_allclose(drone.truth.positions_m[3], [6.0, 0.9, -0.3], atol=1e-9)
    np.testing.assert_allclose(
        drone.truth.pose(3).rotation, exp_so3(np.array([0.0, 0.0, 0.3])), atol=2e-6
    )
    # The recording says of a point what KITTI's own matrices say of it.
    first_from_cam = np.loadtxt(tmp_path / "poses/07.txt")[3].reshape(3, 4)
    point_cam = np.array([1.0, -0.5, 7.0])
    in_ned = (drone.truth.pose(3) @ drone.sensor.body_from_cam).apply(point_cam)
    x, y, z = first_from_cam @ [*point_cam, 1.0]
    np.testing.assert_allclose(in_ned, [z, x, y], atol=1e-5)
    source = sequence / "image_0/000002.png"
    np.testing.assert_array_equal(
        load_image(drone.frames[2].path, CAMERA), load_image(source, CAMERA)
    )


def test_without_poses_there_is_no_truth(sequence: Path, tmp_path: Path) -> None:
    import_kitti(sequence, None, tmp_path / "out")
    assert read_recording(tmp_path / "out").drones[0].truth is None


@pytest.mark.parametrize(
    ("path", "old", "new", "says"),
    [
        ("calib.txt", "P0:", "Q0:", "calib.txt: no row 'P0:'"),
        ("calib.txt", "3.600000e+01", "nan", "calib.txt, row 1: column 2: 'nan'"),
        ("calib.txt", "3.600000e+01", "-3.6e+01", "row 1: focal lengths -36 and 36"),
        ("calib.txt", "1.000000e+00 0.000000e+00", "1.000000e+00", "P0 has 11 numbers"),
        ("calib.txt", "P0: 3.600000e+01 0.0", "P0: 3.600000e+01 2.0", "not that of a rectified"),
        (
            "times.txt",
            "2.073570e-01",
            "1.0e-01",
            "times.txt, row 3: timestamp 100000000 is earlier",
        ),
        ("times.txt", "2.073570e-01", "-2", "times.txt, row 3: '-2' is not a timestamp"),
        ("times.txt", "2.073570e-01", "1 2", "times.txt, row 3: 2 columns"),
        ("times.txt", "3.109951e-01", "0.3\n0.4", "times.txt, row 5: image "),
        ("../../poses/07.txt", "e+00\n", "e+00 0\n", "07.txt, row 1: 13 numbers, expected 12"),
        ("../../poses/07.txt", "1.000000e+00", "9.000000e-01", "row 1: its left 3x3 is not a rot"),
        ("../../poses/07.txt", "1.000000e+00", "inf", "row 1: column 1: 'inf'"),
        ("../../poses/07.txt", "\n", " ", "07.txt: 3 poses for 4 times"),
    ],
)
def test_a_broken_sequence_is_one_line(
    sequence: Path, tmp_path: Path, path: str, old: str, new: str, says: str
) -> None:
    broken = sequence / path
    text = broken.read_text()
    assert old in text
    broken.write_text(text.replace(old, new, 1))
    with pytest.raises(RecordingError) as caught:
        import_kitti(sequence, tmp_path / "poses/07.txt", tmp_path / "out")
    message = str(caught.value)
    assert says in message
    assert "\n" not in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["calib.txt", "times.txt", "image_0/000000.png"])
def test_an_absent_file_is_named(sequence: Path, tmp_path: Path, name: str) -> None:
    (sequence / name).unlink()
    with pytest.raises(RecordingError, match=f"{name}.* missing; "):
        import_kitti(sequence, tmp_path / "poses/07.txt", tmp_path / "out")
