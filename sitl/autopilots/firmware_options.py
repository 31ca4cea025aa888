"""What the process of a real firmware is told: one configuration file, whosever firmware it is.

``binary`` (a program built for simulation), ``system_id``, ``boot_offset_ns`` (it is started when
recording time is this), ``attitude`` {``file``} (a trajectory: its motion), ``parameters`` (name
to value, set before it starts; may be absent), ``speed`` (of the recording; 0 or absent: as fast
as it goes), ``out``, ``run`` (where it runs).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sitl.autopilots.attitude_source import read_table
from sitl.autopilots.motion import RecordedMotion
from vcl_companion.errors import ConfigError


@dataclass(frozen=True)
class FirmwareOptions:
    """The configuration file, read.

    Attributes:
        binary: the firmware.
        system_id: the vehicle's.
        boot_offset_ns: recording time at its start.
        motion: what its sensors feel.
        parameters: set before it starts.
        speed: seconds of the recording per second; 0: as fast as it goes.
        out: directory for what is written.
        run: directory of its own.
    """

    binary: Path
    system_id: int
    boot_offset_ns: int
    motion: RecordedMotion
    parameters: Mapping[str, float]
    speed: float
    out: Path
    run: Path


def read_options(path: Path, parameters: Mapping[str, float]) -> FirmwareOptions:
    """Read the configuration file.

    Args:
        path: the file.
        parameters: set besides those that it names.

    Raises:
        ConfigError: it, the binary or the truth is wrong, in one line.
    """
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        at_ns, rows = read_table(Path(config["attitude"]["file"]), 8)
        binary = Path(config["binary"])
        more = {str(k): float(v) for k, v in config.get("parameters", {}).items()}
        options = FirmwareOptions(
            binary,
            int(config["system_id"]),
            int(config["boot_offset_ns"]),
            RecordedMotion(at_ns, rows[:, :3], rows[:, 3:]),
            {**parameters, **more},
            float(config.get("speed", 0.0)),
            Path(config["out"]),
            Path(config["run"]),
        )
    except KeyError as error:
        raise ConfigError(f"{path}: key {error} is missing") from error
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{path}: {error}") from error
    if not os.access(binary, os.X_OK) or binary.is_dir():
        raise ConfigError(f"{binary}: is no program; it takes a firmware built for simulation")
    return options
