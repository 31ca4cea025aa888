"""The configuration file of one daemon of a flight, as TOML text."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sitl.plan import FlightPlan, PlannedDrone, Setting
from vcl_companion.config import parse_config
from vcl_companion.errors import ConfigError
from vcl_companion.recording.recording import CAMERA_FOLDER, Recording

_FLAT_OUT_WAIT_S = 30.0
# Autopilots in simulation have the cameras' clock. What is left are the steps in which their
# estimators take poses in: anywhere within 10 ms (ArduPilot's EKF3).
_TRUE_TIME_ERROR_S = 0.003
# What the harness tells each daemon so that they find each other, it, and their own files.
_OWN_TO_EACH = frozenset({
    ("system_id",), ("camera", "source"), ("autopilot", "link"), ("peers", "listen"),
    ("peers", "to"), ("log", "flight_log"), ("log", "status_file"), ("map", "directory"),
})  # fmt: skip
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def daemon_config(
    plan: FlightPlan,
    planned: PlannedDrone,
    out: Path,
    camera_port: int,
    autopilot_port: int,
    peer_port: int,
    other_peer_ports: Sequence[int],
) -> dict[str, Any]:
    """Return one daemon's configuration: where everything is, and nothing of the truth."""
    run = out / "run" / planned.name
    calibration = plan.recording.path.resolve() / planned.name / CAMERA_FOLDER / "sensor.yaml"
    if planned.mission is not None:  # the recording is made as it flies
        calibration = run / "sensor.yaml"
    wiring = {
        "system_id": planned.system_id,
        "clock": "camera",
        "camera": {
            "source": f"stream:127.0.0.1:{camera_port}",
            "calibration": str(calibration),
        },
        "autopilot": {
            "link": f"udp:127.0.0.1:{autopilot_port}",
            "time_error_s": _TRUE_TIME_ERROR_S,
        },
        "peers": {
            "listen": f"127.0.0.1:{peer_port}",
            "to": [f"127.0.0.1:{port}" for port in other_peer_ports],
            "key_file": str(key_path(out).resolve()),
            "timestamp_file": str(run / "signing.json"),
        },
        "swarm": {
            "members": [drone.system_id for drone in plan.drones],
            "leader": plan.system_id(plan.leader),
            "known_distances": [list(distance) for distance in plan.known_distances],
        },
        "log": {
            "flight_log": str(run / "flight.jsonl"),
            "status_file": str(run / "status.json"),
        },
        "map": {
            "directory": str(run / "maps"),
            **exactness(plan.recording, plan.are_distances_recorded),
        },
    }
    if math.isinf(plan.options.speed):
        # The recording's time stands still meanwhile; the outcome must not hang on the machine.
        wiring["inter"] = {"wait_s": _FLAT_OUT_WAIT_S}
        # Frames as fast as they can be looked at would leave peers and links no time at all.
        wiring["scheduling"] = "normal"
    return with_settings(wiring, plan.options.settings)


def exactness(recording: Recording, are_distances_recorded: bool) -> dict[str, Any]:
    """Return the settings of a daemon's maps that say how exact what it is told is.

    Args:
        recording: may say so of its distances and its cameras.
        are_distances_recorded: whether it is the recording's distances that are known.
    """
    told = {}
    if are_distances_recorded and recording.distance_sigma_m is not None:
        told["distance_sigma_m"] = recording.distance_sigma_m
    if recording.calibration_px is not None:
        told["calibration_px"] = recording.calibration_px
    return told


def check_settings(plan: FlightPlan) -> None:
    """Refuse what no daemon would start with, before anything is written for one.

    Raises:
        ConfigError: a setting, or a known distance, is no valid configuration, or a setting
            is another with each daemon.
    """
    for setting in plan.options.settings:
        if setting.path in _OWN_TO_EACH:
            raise ConfigError(f"--set {'.'.join(setting.path)}: each daemon is given its own")
    for planned in plan.drones:
        others = range(2, 1 + len(plan.drones))
        config = daemon_config(plan, planned, Path("out"), 1, 1, 1, others)
        parse_config(toml_text(config), "--set" if plan.options.settings else planned.name)


def key_path(out: Path) -> Path:
    """Return where a flight's key is: the drones sign with it, and it ends with the flight."""
    return out / "run" / "swarm.key"


def with_settings(config: Mapping[str, Any], settings: Sequence[Setting]) -> dict[str, Any]:
    """Return a configuration with settings put in; a later one wins.

    Raises:
        ConfigError: a setting makes a section of what is a key.
    """
    out: dict[str, Any] = {
        key: with_settings(value, ()) if isinstance(value, Mapping) else value
        for key, value in config.items()
    }
    for setting in settings:
        table = out
        for part in setting.path[:-1]:
            inner = table.setdefault(part, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"--set {'.'.join(setting.path)}: {part} is no section")
            table = inner
        table[setting.path[-1]] = setting.value
    return out


def toml_text(config: Mapping[str, Any]) -> str:
    """Return a configuration as TOML: the keys of each table first, then its sections."""
    return "\n".join(_lines(config, ())) + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    out = [f"{_key(k)} = {_value(v)}" for k, v in table.items() if not isinstance(v, Mapping)]
    for key, value in table.items():
        if isinstance(value, Mapping):
            inner = (*path, key)
            out += ["", f"[{'.'.join(map(_key, inner))}]", *_lines(value, inner)]
    return out


def _key(key: str) -> str:
    return key if _BARE_KEY.fullmatch(key) else _string(key)


def _value(value: object) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case int() | float():
            return repr(value)
        case str():
            return _string(value)
        case list() | tuple():
            return f"[{', '.join(map(_value, value))}]"
        case Mapping():
            pairs = ", ".join(f"{_key(str(k))} = {_value(v)}" for k, v in value.items())
            return f"{{{pairs}}}"
    raise ConfigError(f"a daemon has no setting of the kind {type(value).__name__}")


def _string(text: str) -> str:
    # A TOML basic string is a JSON string, but for DEL, which TOML wants escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
