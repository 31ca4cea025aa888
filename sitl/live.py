"""A live flight: a model flies as its firmware commands, and its cameras see what is rendered.

Time stands still while images are rendered: the daemons have as much of the machine as in a
recorded flight at the same speed, and more meanwhile. What was seen is left as a recording that
may be flown again.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.daemon_config import check_settings
from sitl.fly import Progress, flown, reported
from sitl.out_folder import RECORDING_FOLDER, prepare_folder
from sitl.pacing import Instant
from sitl.plan import FlightPlan, FlyOptions, plan_flight
from sitl.render import TRUTH_SIGMA_M
from sitl.renderer import Renderer
from sitl.scenario import Scenario
from sitl.swarm import Swarm
from sitl.town import build_town
from vcl_companion.daemon.map_store import SAVED_FILE
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording import (
    Description,
    Drone,
    FrameFile,
    ImageOptions,
    KnownPair,
    Recording,
    RecordingWriter,
    Trajectory,
    read_recording,
    write_sensor,
)


def fly_live(
    scenario: Scenario,
    out: Path,
    options: FlyOptions,
    progress: Progress,
    map_of: Path | None = None,
) -> dict[str, Any]:
    """Fly the missions of a scenario, and return what report.json says.

    Args:
        scenario: the town, the cameras, the missions.
        out: for all that is left of it.
        options: how it is flown.
        progress: told of it.
        map_of: output folder of an earlier flight; the drones begin with its last map.

    Raises:
        VclError: the scenario or an option cannot be used.
        FlightError: a process ended or hung; all others have been ended too.
        KeyboardInterrupt: likewise, on Ctrl-C.
    """
    plan = plan_live(scenario, out, options)
    check_settings(plan)
    stored = None if map_of is None else _last_map(map_of)
    prepare_folder(out, plan, records=True)
    for planned in plan.drones:
        run = out / "run" / planned.name
        write_sensor(run / "sensor.yaml", planned.drone.sensor)
        if stored is not None:
            (run / "maps" / SAVED_FILE).write_bytes(stored)
    progress("building the town", 0, 0)
    recording = plan.recording
    description = Description(
        recording.name, recording.frame_rate_hz, plan.leader, recording.known_distances,
        recording.distance_sigma_m, recording.calibration_px,
    )  # fmt: skip
    images = ImageOptions(scenario.image.format, scenario.image.jpg_quality)
    with RecordingWriter(recording.path, description, images) as writer:
        shots = LiveShots(scenario, plan, writer)
        conduct = flown(plan, out, shots, progress)
        shots.leave_truth()
    return reported(_as_flown(plan), out, conduct, progress)


def _last_map(flight: Path) -> bytes:
    """Return the last map of a flight that came from far enough to leave a report.

    Raises:
        ConfigError: there is none.
    """
    try:
        said = json.loads((flight / "report.json").read_text("utf-8"))
        leader, revision = str(said["options"]["leader"]), str(said["map"]["revision"])
        return (flight / "run" / leader / "maps" / f"{revision}.vclmap").read_bytes()
    except OSError as error:
        raise ConfigError(f"--map {flight}: {error.filename}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"--map {flight}: its report.json tells of no map") from error


def plan_live(scenario: Scenario, out: Path, options: FlyOptions) -> FlightPlan:
    """Decide who flies; the recording of it is yet to be made.

    Raises:
        ConfigError: an option does not fit the scenario, or that has flights and no missions.
    """
    if options.firmware is None:
        raise ConfigError("a live flight takes a real --autopilot: the stand-in does not fly")
    missions = {}
    drones = []
    for drone in scenario.drone:
        if drone.mission is None:
            raise ConfigError(
                f"{scenario.name}: {drone.name} has no mission; render it, and fly the recording"
            )
        missions[drone.name] = drone.mission
        at_ns = [scenario.frame_at_ns(drone, k) for k in range(scenario.n_frames)]
        stands = Trajectory.from_poses(at_ns[:1], [drone.mission.ned_from_body])
        frames = tuple(FrameFile(t, out) for t in at_ns)  # those that are to come
        drones.append(Drone(drone.name, scenario.sensor(drone), frames, stands))
    names = {drone.name for drone in drones if not options.drones or drone.name in options.drones}
    pair = scenario.known_distance
    known = (KnownPair(*pair),) if pair and set(pair) <= names else ()
    recording = Recording(
        out / RECORDING_FOLDER, scenario.name, scenario.frame_rate_hz, scenario.leader, known,
        tuple(drones), TRUTH_SIGMA_M, calibration_px=0.0,
    )  # fmt: skip
    plan = plan_flight(recording, options)
    flying = tuple(replace(p, mission=missions[p.name]) for p in plan.drones)
    return replace(plan, drones=flying)


class LiveShots:
    """Renders what each drone sees from where its firmware truly is.

    Args:
        scenario: the world and the cameras.
        plan: who flies.
        writer: keeps the images, and in the end the truth.

    Attributes:
        held_s: how long rendering has taken altogether, wall clock.
    """

    def __init__(self, scenario: Scenario, plan: FlightPlan, writer: RecordingWriter) -> None:
        self.held_s = 0.0
        self._plan = plan
        self._writer = writer
        self._seed = scenario.seed
        world = build_town(scenario.world)
        gains = {drone.name: drone.gain for drone in scenario.drone}
        self._renderers = [
            Renderer(
                world, planned.drone.sensor.camera, scenario.image.imaging(gains[planned.name])
            )
            for planned in plan.drones
        ]
        self._truth: list[tuple[list[int], list[Pose]]] = [([], []) for _ in plan.drones]
        for planned in plan.drones:
            writer.add_drone(planned.name, planned.drone.sensor)

    async def taken(self, moment: Instant, swarm: Swarm) -> dict[int, bytes]:
        """Return the encoded images of the drones that take one at a moment, by drone."""
        for n, drone in enumerate(swarm.drones):
            at_ns, poses = self._truth[n]
            at_ns.append(moment.at_ns)
            poses.append(_pose(drone.stand_in.state["pose"]))
        began_s = time.monotonic()
        images = await asyncio.gather(
            *(asyncio.to_thread(self._rendered, due.drone, due.sequence) for due in moment.frames)
        )
        self.held_s += time.monotonic() - began_s
        return {
            due.drone: self._writer.add_frame(
                self._plan.drones[due.drone].name, moment.at_ns, image
            )
            for due, image in zip(moment.frames, images, strict=True)
        }

    def is_over(self, swarm: Swarm) -> bool:
        """Return whether all missions are over, well or not."""
        return all(drone.stand_in.state.get("is_over", False) for drone in swarm.drones)

    def leave_truth(self) -> None:
        """Write down where each drone truly was."""
        for planned, (at_ns, poses) in zip(self._plan.drones, self._truth, strict=True):
            self._writer.set_truth(planned.name, Trajectory.from_poses(at_ns, poses))

    def _rendered(self, drone: int, sequence: int) -> NDArray[np.uint8]:
        rng = np.random.default_rng([self._seed, drone, sequence])
        body_from_cam = self._plan.drones[drone].drone.sensor.body_from_cam
        return self._renderers[drone].render(self._truth[drone][1][-1] @ body_from_cam, rng)


def _pose(values: Sequence[float]) -> Pose:
    return Pose.from_quaternion(np.array(values[3:]), np.array(values[:3]))


def _as_flown(plan: FlightPlan) -> FlightPlan:
    """Return a plan with the recording that its flight has become."""
    recording = read_recording(plan.recording.path)
    drones = tuple(replace(p, drone=recording.drone(p.name)) for p in plan.drones)
    return replace(plan, recording=recording, drones=drones)
