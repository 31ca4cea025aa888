"""A flight's trajectories as files: ``estimate.tum``, ``covariance.csv``, ``truth.tum``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sitl.evaluation import Estimates, upper_from_covariance
from sitl.recording_axes import axes_from_ned
from sitl.result import FlightResult
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.tum import write_tum


def write_trajectories(result: FlightResult, out: Path) -> None:
    """Write every drone's estimates, their covariances and, where there is one, the truth.

    Poses go out in the axes of the recording's own files, carried there from
    ``world`` by the leader's start; without a truth to do so they stay in
    ``world``. Covariances go out as they were sent, in the axes of ``world``.
    """
    for drone in result.drones:
        turned = Pose(axes_from_ned(drone.axes), np.zeros(3))
        carry = Pose.identity()
        if result.ref_from_world is not None:
            carry = turned @ result.ref_from_world
        at_ns = drone.estimates.at_ns.tolist()
        poses = (carry @ pose for pose in drone.estimates.world_from_body)
        write_tum(out / drone.name / "estimate.tum", zip(at_ns, poses, strict=True))
        _write_covariances(out / drone.name / "covariance.csv", drone.estimates)
        known = [
            (at_ns, turned @ pose)
            for at_ns, pose in zip(drone.frames_at_ns.tolist(), drone.truth, strict=True)
            if pose is not None
        ]
        if known:
            write_tum(out / drone.name / "truth.tum", known)


def _write_covariances(path: Path, estimates: Estimates) -> None:
    lines = [",".join(["timestamp [ns]", *(f"c{n}" for n in range(21))])]
    values = upper_from_covariance(estimates.covariances)
    for at_ns, row in zip(estimates.at_ns.tolist(), values, strict=True):
        lines.append(",".join([str(at_ns), *(repr(float(value)) for value in row)]))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
