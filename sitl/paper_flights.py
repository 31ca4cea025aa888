"""The experiments' flights: each is flown once, and anew when something it results from changed.

A flight's fingerprint lies in its ``run`` folder and is written when the flight
is over; the next flight into the folder clears it first. So an interrupted
flight has none and is flown again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sitl import paper_fingerprint
from sitl.fly import Progress, fly
from sitl.gathered import gather
from sitl.paper_estimates import SourceEstimates, by_source
from sitl.paper_experiments import Experiment, Pipeline
from sitl.paper_recordings import Rendered
from sitl.plan import FlyOptions, plan_flight
from sitl.result import DroneResult, FlightResult
from vcl_companion.recording import read_recording

_FINGERPRINT = Path("run") / "fingerprint.json"


@dataclass(frozen=True, eq=False)
class PaperFlight:
    """One flight of an experiment.

    Attributes:
        experiment: which.
        pipeline: how it was localized.
        fused: with fusion or without.
        folder: the flight's output.
        result: its outcome.
        report: its ``report.json``.
        estimates: of each drone whose log has them: what it knew before fusing.
        reused: whether it was flown by an earlier run.
        why: why it was flown again; empty when it was not there before.
    """

    experiment: Experiment
    pipeline: Pipeline
    fused: bool
    folder: Path
    result: FlightResult
    report: Mapping[str, Any]
    estimates: Mapping[str, SourceEstimates] = field(default_factory=dict)
    reused: bool = False
    why: str = ""

    @property
    def variant(self) -> str:
        """``fused`` or ``unfused``."""
        return variant_name(self.fused)

    def drone(self, name: str) -> DroneResult:
        """Return a drone's part of the flight."""
        return next(drone for drone in self.result.drones if drone.name == name)


def variant_name(fused: bool) -> str:
    """Return what a flight with fusion, or one without, is called."""
    return "fused" if fused else "unfused"


def flown(
    experiment: Experiment,
    pipeline: Pipeline,
    fused: bool,
    recording: Rendered,
    folder: Path,
    options: FlyOptions,
    progress: Progress,
) -> PaperFlight:
    """Return a flight, flown unless it is there.

    Args:
        experiment: which.
        pipeline: how it is localized.
        fused: with fusion or without.
        recording: what is flown.
        folder: the flight's own output folder.
        options: how it is flown, with all settings.
        progress: told what is being done.

    Raises:
        VclError: recording or options cannot be used, or the folder is somebody else's.
        FlightError: a process ended or hung.
        KeyboardInterrupt: on Ctrl-C; the flight does not count then.
    """
    now = paper_fingerprint.of_flight(recording.fingerprint, options)
    before = paper_fingerprint.written(folder / _FINGERPRINT)
    reused = before == now and (folder / "report.json").is_file()
    if not reused:
        fly(recording.path, folder, options, progress)
        paper_fingerprint.write(folder / _FINGERPRINT, now)
    progress("comparing with the truth", 0, 0)
    result = gather(plan_flight(read_recording(recording.path), options), folder)
    read = {drone.name: by_source(result, drone) for drone in result.drones}
    why = ""
    if not reused and before is not None:
        why = f"{' and '.join(paper_fingerprint.differences(before, now))} changed"
    return PaperFlight(
        experiment=experiment,
        pipeline=pipeline,
        fused=fused,
        folder=folder,
        result=result,
        report=json.loads((folder / "report.json").read_text(encoding="utf-8")),
        estimates={name: estimates for name, estimates in read.items() if estimates is not None},
        reused=reused,
        why=why,
    )
