"""Small recordings on disk for the tests of this package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.recording import (
    BODY_FROM_CAM_FORWARD,
    Description,
    ImageOptions,
    InertialSamples,
    KnownPair,
    RecordingWriter,
    Sensor,
    Trajectory,
)

CAMERA = Camera(48, 32, 40.0, 41.0, 23.5, 15.5)
FORWARD = Pose(BODY_FROM_CAM_FORWARD, np.zeros(3))
START_NS = 1_721_300_000_000_000_000
PERIOD_NS = 200_000_000


def grey_image(rng: np.random.Generator, camera: Camera = CAMERA) -> NDArray[np.uint8]:
    return rng.integers(0, 256, (camera.height_px, camera.width_px), dtype=np.uint8)


def random_trajectory(
    rng: np.random.Generator, at_ns: list[int], *, velocities: bool = True
) -> Trajectory:
    poses = [Pose(exp_so3(rng.normal(0, 1.0, 3)), rng.normal(0, 5.0, 3)) for _ in at_ns]
    made = Trajectory.from_poses(at_ns, poses)
    speeds = rng.normal(0, 1.0, (len(at_ns), 3)) if velocities else None
    return Trajectory(made.at_ns, made.positions_m, made.quaternions, speeds)


def write_small(path: Path, n_drones: int = 2, n_frames: int = 3) -> Path:
    """Write drones that stand at (k, 0, -1) m and look north; png images."""
    rng = np.random.default_rng(5)
    pairs = (KnownPair("mav0", "mav1"),) if n_drones > 1 else ()
    description = Description("small", 5.0, "mav0", pairs)
    with RecordingWriter(path, description, ImageOptions("png")) as writer:
        for k in range(n_drones):
            at_ns = [START_NS + i * PERIOD_NS for i in range(n_frames)]
            pose = Pose(np.eye(3), np.array([k, 0.0, -1.0]))
            truth = Trajectory.from_poses(at_ns, [pose] * n_frames)
            imu = InertialSamples(
                np.array(at_ns), np.zeros((n_frames, 3)), np.full((n_frames, 3), -9.81)
            )
            writer.add_drone(f"mav{k}", Sensor(CAMERA, FORWARD, 5.0), truth, imu)
            for instant in at_ns:
                writer.add_frame(f"mav{k}", instant, grey_image(rng))
    return path
