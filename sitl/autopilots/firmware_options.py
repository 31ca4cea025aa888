"""What the process of a real firmware is told: one configuration file, whosever firmware it is.

``binary`` (a program built for simulation), ``system_id``, ``boot_offset_ns`` (it is started when
recording time is this), ``parameters`` (name to value, set before it starts; may be absent),
``speed`` (of the recording; 0 or absent: as fast as it goes), ``out``, ``run`` (where it runs), and
either ``attitude`` {``file``} (a trajectory: its motion), or, where it is to fly by itself,
``mission`` and ``begins_ns`` (recording time when that is to begin).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from sitl.autopilots.attitude_source import read_table
from sitl.autopilots.motion import RecordedMotion
from sitl.mission import Mission
from vcl_companion.errors import ConfigError


@dataclass(frozen=True)
class Orders:
    """What the pilot of one that flies by itself is to do, and when.

    Attributes:
        mission: what.
        begins_ns: recording time.
    """

    mission: Mission
    begins_ns: int


@dataclass(frozen=True)
class FirmwareOptions:
    """The configuration file, read.

    Attributes:
        binary: the firmware.
        system_id: the vehicle's.
        boot_offset_ns: recording time at its start.
        flies: what its sensors feel, or what it is to do by itself.
        parameters: set before it starts.
        speed: seconds of the recording per second; 0: as fast as it goes.
        out: directory for what is written.
        run: directory of its own.
    """

    binary: Path
    system_id: int
    boot_offset_ns: int
    flies: RecordedMotion | Orders
    parameters: Mapping[str, float]
    speed: float
    out: Path
    run: Path

    def over(self, parameters: Mapping[str, float]) -> FirmwareOptions:
        """Return the same with parameters that are set where it does not name them itself."""
        return replace(self, parameters={**parameters, **self.parameters})


def read_options(path: Path) -> FirmwareOptions:
    """Read the configuration file.

    Raises:
        ConfigError: it, the binary or the truth is wrong, in one line.
    """
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        flies = _flies(config)
        binary = Path(config["binary"])
        parameters = {str(k): float(v) for k, v in config.get("parameters", {}).items()}
        options = FirmwareOptions(
            binary,
            int(config["system_id"]),
            int(config["boot_offset_ns"]),
            flies,
            parameters,
            float(config.get("speed", 0.0)),
            Path(config["out"]),
            Path(config["run"]),
        )
    except KeyError as error:
        raise ConfigError(f"{path}: key {error} is missing") from error
    except (OSError, ValueError, TypeError, msgspec.ValidationError) as error:
        raise ConfigError(f"{path}: {error}") from error
    if not os.access(binary, os.X_OK) or binary.is_dir():
        raise ConfigError(f"{binary}: is no program; it takes a firmware built for simulation")
    return options


def _flies(config: Mapping[str, Any]) -> RecordedMotion | Orders:
    if "mission" in config:
        return Orders(msgspec.convert(config["mission"], Mission), int(config["begins_ns"]))
    at_ns, rows = read_table(Path(config["attitude"]["file"]), 8)
    return RecordedMotion(at_ns, rows[:, :3], rows[:, 3:])
