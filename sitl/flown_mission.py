"""How well a drone flew its mission: its true path against the one that it was commanded.

Commands are places in the firmware's local frame, which is the ``world`` of our poses; the
leader's start carries them to the truth, as it does everything. Where the firmware's height is a
barometer's, that counts from where the drone stood.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sitl.mission import COMMANDED_FILE, LANDED
from sitl.page_style import Column
from sitl.processes import FlightError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording import Trajectory

MISSION_COLUMNS: tuple[Column, ...] = (
    ("ended", "mission", "{}", None),
    ("took_s", "took s", "{:.0f}", 1.0),
    ("way_m", "way m", "{:.0f}", 1.0),
    ("max_deviation_m", "off its way m", "{:.2f}", 1.0),
    ("rms_deviation_m", "rms m", "{:.2f}", 1.0),
    ("landed_off_m", "landed off m", "{:.2f}", 1.0),
)


@dataclass(frozen=True)
class FlownMission:
    """One drone's mission.

    Attributes:
        ended: ``landed``, or what went wrong.
        took_s: from the first command to the end.
        way_m: length of the commanded path as far as it was commanded.
        max_deviation_m: the farthest that the truth was from the part of the commanded path
            that it was on.
        rms_deviation_m: root mean square of the same.
        landed_off_m: horizontally, from where it was to land; None when it was not to yet.
    """

    ended: str
    took_s: float
    way_m: float
    max_deviation_m: float
    rms_deviation_m: float
    landed_off_m: float | None


def read_mission(
    folder: Path,
    truth: Trajectory | None,
    ref_from_world: Pose | None,
    *,
    has_own_height: bool = False,
) -> FlownMission | None:
    """Judge how a mission was flown; None where there was none, or it never began.

    Args:
        folder: the drone's.
        truth: of the flight.
        ref_from_world: by the leader's start.
        has_own_height: whether its height counts from elsewhere: then from where it stood.

    Raises:
        FlightError: the file is broken.
    """
    path = folder / COMMANDED_FILE
    if not path.exists() or truth is None or ref_from_world is None:
        return None
    try:
        lines = [line.split(",", 4) for line in path.read_text("utf-8").splitlines()[1:]]
        at_ns = np.array([int(line[0]) for line in lines], dtype=np.int64)
        places = np.array([[float(v) for v in line[1:4]] for line in lines]).reshape(-1, 3)
        what = [line[4] for line in lines]
    except (OSError, ValueError, IndexError) as broken:
        raise FlightError(f"{path}: {broken}") from broken
    if len(lines) < 3:
        return None
    corners = ref_from_world.apply(places)
    if has_own_height:
        stood = int(np.searchsorted(truth.at_ns, at_ns[0]).clip(max=len(truth.at_ns) - 1))
        corners[:, 2] += truth.positions_m[stood, 2] - corners[0, 2]
    ends_ns = min(int(at_ns[-1]), int(truth.at_ns[-1]))
    during = (truth.at_ns >= at_ns[0]) & (truth.at_ns <= ends_ns)
    true = truth.positions_m[during]
    # The part of the way that was commanded last before each instant.
    part = np.searchsorted(at_ns, truth.at_ns[during], side="right") - 1
    part = np.clip(part, 1, len(corners) - 1)
    off_m = _distances(true, corners[part - 1], corners[part])
    was_to_land = what[-1] == LANDED
    return FlownMission(
        what[-1],
        (ends_ns - int(at_ns[0])) * 1e-9,
        float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()),
        float(off_m.max()),
        float(np.sqrt(np.mean(off_m**2))),
        float(np.linalg.norm((true[-1] - corners[-1])[:2])) if was_to_land else None,
    )


def _distances(points: Array, starts: Array, ends: Array) -> Array:
    """Return (N,) how far points are from line segments, (N, 3) each."""
    along = ends - starts
    length2 = np.maximum(np.sum(along**2, axis=1), 1e-12)
    share = np.clip(np.sum((points - starts) * along, axis=1) / length2, 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - starts - share[:, None] * along, axis=1))
