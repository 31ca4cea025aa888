"""Poses over time as TUM text: ``timestamp_s tx ty tz qx qy qz qw``, one row each.

The form that evaluation tools read. Every number has nine decimals; instants
are written from integers, since a float of epoch seconds loses the nanoseconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from vcl_companion.errors import RecordingError
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.tables import MOST_BYTES, split_rows
from vcl_companion.recording.trajectory import QUATERNION_TOLERANCE
from vcl_companion.text_file import read_text

_NS_PER_S = 1_000_000_000


def tum_line(at_ns: int, pose: Pose) -> str:
    """Return one row, without the line's end; ``at_ns`` must not be negative."""
    if at_ns < 0:
        raise ValueError(f"TUM rows hold instants from 0 on, got {at_ns} ns")
    seconds, nanoseconds = divmod(int(at_ns), _NS_PER_S)
    w, x, y, z = pose.quaternion()
    numbers = (*pose.translation, x, y, z, w)
    return " ".join([f"{seconds}.{nanoseconds:09d}", *(f"{number:.9f}" for number in numbers)])


def write_tum(path: Path, stamped_poses: Iterable[tuple[int, Pose]]) -> None:
    """Write (at_ns, pose) rows; none gives an empty file.

    A ``Trajectory`` gives its rows by ``stamped_poses()``.
    """
    text = "".join(tum_line(at_ns, pose) + "\n" for at_ns, pose in stamped_poses)
    path.write_text(text, encoding="utf-8")


def read_tum(path: Path) -> list[tuple[int, Pose]]:
    """Read (at_ns, pose) rows in the file's order; an empty file has none.

    Raises:
        RecordingError: a row is malformed; one line that names it.
    """
    try:
        text = read_text(path, MOST_BYTES)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError:
        raise RecordingError(f"{path}: not a text file") from None
    stamped_poses = []
    for row in split_rows(path, text, separator=None):
        if len(row.cells) != 8:
            raise row.error(f"{len(row.cells)} columns, expected timestamp tx ty tz qx qy qz qw")
        x, y, z, qx, qy, qz, qw = (row.value(column) for column in range(1, 8))
        quaternion = np.array([qw, qx, qy, qz])
        if abs(np.linalg.norm(quaternion) - 1.0) > QUATERNION_TOLERANCE:
            raise row.error("the quaternion has not unit length")
        pose = Pose.from_quaternion(quaternion, np.array([x, y, z]))
        stamped_poses.append((row.seconds_as_ns(), pose))
    return stamped_poses
