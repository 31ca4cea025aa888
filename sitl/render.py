"""A scenario becomes a recording."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np

from sitl.renderer import Renderer
from sitl.scenario import DroneInScenario, Scenario
from sitl.town import build_town
from sitl.trajectories import FlightPath
from vcl_companion.recording import (
    Description,
    ImageOptions,
    KnownPair,
    RecordingWriter,
    Trajectory,
)

TRUTH_SIGMA_M = 0.001
"""How well a distance is known between two that a scenario places, 1 sigma: exactly, which no
adjustment could take in."""

Progress = Callable[[int, int], None]  # frames done, frames in all


def render_scenario(scenario: Scenario, out_dir: Path, progress: Progress | None = None) -> None:
    """Render all frames of a scenario and write them as a recording with its ground truth.

    On one machine the same scenario gives the same recording, byte for byte.

    Args:
        scenario: what to render.
        out_dir: the recording's folder; must be new or empty.
        progress: told after every frame.

    Raises:
        RecordingError: the folder cannot be written, or holds something already.
    """
    pair = (KnownPair(*scenario.known_distance),) if scenario.known_distance else ()
    description = Description(
        scenario.name, scenario.frame_rate_hz, scenario.leader, pair, TRUTH_SIGMA_M, 0.0
    )
    images = ImageOptions(scenario.image.format, scenario.image.jpg_quality)
    with RecordingWriter(out_dir, description, images) as writer:
        sensors = {drone.name: scenario.sensor(drone) for drone in scenario.drone}
        paths = {drone.name: drone.path() for drone in scenario.drone}
        for drone in scenario.drone:
            truth = _truth(scenario, drone, paths[drone.name])
            writer.add_drone(drone.name, sensors[drone.name], truth)
        world = build_town(scenario.world)
        renderers = {
            drone.name: Renderer(
                world, scenario.camera.camera(), scenario.image.imaging(drone.gain)
            )
            for drone in scenario.drone
        }
        n_total = scenario.n_frames * len(scenario.drone)
        for k in range(scenario.n_frames):
            for i, drone in enumerate(scenario.drone):
                at_ns = scenario.frame_at_ns(drone, k)
                motion = paths[drone.name].at(scenario.flight_s(at_ns))
                rng = np.random.default_rng([scenario.seed, i, k])
                world_from_cam = motion.ned_from_body @ sensors[drone.name].body_from_cam
                writer.add_frame(
                    drone.name, at_ns, renderers[drone.name].render(world_from_cam, rng)
                )
                if progress is not None:
                    progress(k * len(scenario.drone) + i + 1, n_total)


def _truth(scenario: Scenario, drone: DroneInScenario, path: FlightPath) -> Trajectory:
    """Return a drone's exact motion at its frames and, evenly, between them."""
    per_frame = max(1, round(scenario.truth_rate_hz / scenario.frame_rate_hz))
    frames = [scenario.frame_at_ns(drone, k) for k in range(scenario.n_frames)]
    instants = [
        start + (end - start) * step // per_frame
        for start, end in pairwise(frames)
        for step in range(per_frame)
    ]
    instants.append(frames[-1])
    motions = [path.at(scenario.flight_s(at_ns)) for at_ns in instants]
    return Trajectory(
        np.array(instants, dtype=np.int64),
        np.array([motion.ned_from_body.translation for motion in motions]),
        np.array([motion.ned_from_body.quaternion() for motion in motions]),
        np.array([motion.velocity_m_s for motion in motions]),
    )
