"""``python -m sitl consistency``: one recording after the other, from many instants of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sitl.consistency.chain import Chain
from sitl.consistency.report import Beginning, recording_report, write_consistency
from sitl.result_folder import result_folder
from vcl_companion.errors import ConfigError, RecordingError
from vcl_companion.recording import Recording, read_recording
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.vision.warm_up import warm_up

Told = Callable[[str], None]

# Of a flight every second frame is looked at; photographs metres apart are few.
_STEP, _FEW = 2, 20
# What begins later than this has hardly anything to be extended by.
_LATEST_SHARE = 0.8


@dataclass(frozen=True)
class ConsistencyOptions:
    """How many maps are made.

    Attributes:
        starts: instants of each recording that maps begin at, at most.
        extensions: of each of these, at most.
        novelty_deg: how newly a map looks before it is extended; the more often it is, the more
            of its error is what its extensions have in common, and the less is told.
        seed: of the errors of attitudes and predictions.
        alone_s: for how long drones then go on by their own frames alone.
    """

    starts: int = 8
    extensions: int = 5
    novelty_deg: float = UpdateOptions().novelty_deg
    seed: int = 0
    alone_s: float = 3.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.alone_s <= 600.0:
            raise ConfigError(f"--alone must lie in 0..600 seconds, got {self.alone_s}")
        if not 0.0 < self.novelty_deg <= 90.0:
            raise ConfigError(f"--novelty must lie in 0..90 degrees, got {self.novelty_deg}")


def consistency(
    recordings: Sequence[Path], out: Path, options: ConsistencyOptions, told: Told
) -> dict[str, Any]:
    """Make the maps, judge the poses on them, and write what came of it into a folder.

    Raises:
        RecordingError: a recording cannot be used.
        ConfigError: the folder is another one's, or cannot be written.
    """
    read = [_usable(path) for path in recordings]
    names = [recording.name for recording in read]
    if len(set(names)) < len(names):
        raise ConfigError(f"two recordings of one name: {', '.join(sorted(names))}")
    with result_folder(out, ("consistency.*",)):
        report = write_consistency(out, {})
        warm_up()
        found = {}
        for recording in read:
            found[recording.name] = recording_report(_beginnings(recording, options, told))
            report = write_consistency(out, found)
    return report


def _usable(path: Path) -> Recording:
    """Read a recording; refuse one that poses cannot be judged in."""
    recording = read_recording(path)
    if not recording.known_distances:
        raise RecordingError(
            f"{path}: no known distance, so that maps have no scale; say "
            'known_distance = ["mav0", "mav1"] in its recording.toml'
        )
    if len(recording.drone(recording.leader).frames) < 2:
        raise RecordingError(f"{path}: one frame of the leader's: nothing to look for on its map")
    for drone in recording.drones:
        if drone.truth is None:
            raise RecordingError(f"{path}: {drone.name} has no ground truth to be judged by")
    return recording


def _beginnings(recording: Recording, options: ConsistencyOptions, told: Told) -> list[Beginning]:
    n = len(recording.drone(recording.leader).frames)
    step = 1 if n <= _FEW else _STEP
    latest = max(int(_LATEST_SHARE * n) - step, 0)
    out = []
    for begins in np.unique(np.linspace(0, latest, options.starts).astype(int)).tolist():
        told(f"{recording.name}: maps from frame {begins} on")
        chain = Chain(recording, begins, options.seed, options.novelty_deg)
        looks = tuple(chain.looks(step, options.extensions))
        out.append(Beginning(begins, looks, chain.ended, tuple(chain.alone(options.alone_s))))
    return out
