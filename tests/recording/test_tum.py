from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recording.folders import random_trajectory
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.tum import read_tum, tum_line, write_tum


def test_the_line() -> None:
    pose = Pose.from_quaternion(np.array([0.5, 0.5, -0.5, 0.5]), np.array([1.0, -2.5, 0.0]))
    assert tum_line(1_721_300_000_000_000_001, pose) == (
        "1721300000.000000001 1.000000000 -2.500000000 0.000000000 "
        "0.500000000 -0.500000000 0.500000000 0.500000000"
    )
    with pytest.raises(ValueError, match="from 0 on"):
        tum_line(-1, pose)


@given(
    st.lists(st.integers(0, 2**62), min_size=1, max_size=4, unique=True).map(sorted),
    st.integers(0, 2**32 - 1),
)
def test_rows_read_back_to_the_last_decimal(
    tmp_path_factory: pytest.TempPathFactory, at_ns: list[int], seed: int
) -> None:
    trajectory = random_trajectory(np.random.default_rng(seed), at_ns)
    path = tmp_path_factory.mktemp("tum") / "truth.tum"
    write_tum(path, trajectory.stamped_poses())
    read = read_tum(path)
    assert [instant for instant, _ in read] == at_ns
    for k, (_, pose) in enumerate(read):
        np.testing.assert_allclose(pose.translation, trajectory.positions_m[k], atol=5.01e-10)
        np.testing.assert_allclose(pose.rotation, trajectory.pose(k).rotation, atol=5e-9)


def test_no_pose_is_an_empty_file(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", [])
    assert (tmp_path / "a.tum").read_bytes() == b""
    assert read_tum(tmp_path / "a.tum") == []


def test_other_tools_times(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    path.write_text("# comment\n1.5 0 0 0 0 0 0 1\n1.7213e+09 1 2 3 0 0 0 1\n")
    assert [at_ns for at_ns, _ in read_tum(path)] == [1_500_000_000, 1_721_300_000_000_000_000]


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1.0 0 0 0 0 0 0", "7 columns"),
        ("x 0 0 0 0 0 0 1", "'x' is not a timestamp in seconds"),
        ("-1 0 0 0 0 0 0 1", "'-1' is not a timestamp in seconds"),
        ("nan 0 0 0 0 0 0 1", "'nan' is not a timestamp in seconds"),
        ("1e999999999 0 0 0 0 0 0 1", "is not a timestamp in seconds"),
        ("1.0 0 0 nan 0 0 0 1", "column 4: 'nan'"),
        ("1.0 0 0 0 0 0 0 0.5", "unit length"),
    ],
)
def test_a_broken_row(tmp_path: Path, row: str, says: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"0.5 0 0 0 0 0 0 1\n{row}\n")
    with pytest.raises(RecordingError) as caught:
        read_tum(path)
    assert str(caught.value).startswith(f"{path}, row 2: ")
    assert says in str(caught.value)
