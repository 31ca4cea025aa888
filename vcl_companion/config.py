"""The daemon's configuration: the Options of the packages below, read from one TOML file.

A section is a frozen dataclass and a key is one of its fields, so a default is
written once, beside the code that it tunes. What a field may hold is its
annotation; its bounds are its class's ``__post_init__``.
"""

from __future__ import annotations

import difflib
import json
import re
import tomllib
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from vcl_companion.cameras.source import CameraOptions
from vcl_companion.errors import ConfigError
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.peers import PeerOptions
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import Pipeline
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.options import MapOptions
from vcl_companion.swarm.group import SwarmOptions
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.swarm.transfer_options import TransferOptions
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.text_file import read_text
from vcl_companion.vision.features import Detector, FeatureOptions

_Section = TypeVar("_Section")
_Path = tuple[str | int, ...]
_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_SHOWN_CHARACTERS = 40
# What is larger, or above 0 and smaller, is of another unit: by how a key ends, whatever more
# its class says.
_LARGEST_OF = {
    "_deg": 360.0,
    "_m": 1e5,
    "_px": 1e4,
    "_hz": 1e4,
    "_s": 1e7,  # speeds, and bytes per second, as well
    "_bytes": 1e12,
}
_LARGEST, _LEAST = 1e6, 1e-9
_NAMES = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}


@dataclass(frozen=True)
class LogOptions:
    """What is written down.

    Attributes:
        level: least severity of the messages on standard error.
        flight_log: file that gets one JSON line per frame and event; empty: none.
        status_file: file that says every second how the service is, for ``vcl status``;
            empty: none.
    """

    level: Literal["debug", "info", "warning", "error"] = "info"
    flight_log: str = ""
    status_file: str = ""


@dataclass(frozen=True)
class Config:
    """Everything one daemon can be told.

    Attributes:
        system_id: this drone's MAVLink system id, 1..255.
        clock: ``system`` in flight; ``camera`` when a stream or a recording is the time.
        pipeline: ``default`` tracks the map's patches and looks for features only when
            lost; ``paper`` looks for features in every frame.
        scheduling: ``realtime``: frames of the default pipeline go before everything else
            on the machine, where it permits that; ``normal``: among others.
    """

    system_id: int = 1
    clock: Literal["system", "camera"] = "system"
    pipeline: Pipeline = "default"
    scheduling: Literal["realtime", "normal"] = "realtime"
    camera: CameraOptions = field(default_factory=CameraOptions)
    autopilot: AutopilotOptions = field(default_factory=AutopilotOptions)
    peers: PeerOptions = field(default_factory=PeerOptions)
    swarm: SwarmOptions = field(default_factory=SwarmOptions)
    transfer: TransferOptions = field(default_factory=TransferOptions)
    map: MapOptions = field(default_factory=MapOptions)
    update: UpdateOptions = field(default_factory=UpdateOptions)
    features: FeatureOptions = field(default_factory=FeatureOptions)
    localization: LocalizationOptions = field(default_factory=LocalizationOptions)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    filter: FilterOptions = field(default_factory=FilterOptions)
    inter: InterMavOptions = field(default_factory=InterMavOptions)
    log: LogOptions = field(default_factory=LogOptions)

    def __post_init__(self) -> None:
        if self.localization.detector not in self.map.detectors:
            raise ConfigError(
                f"localization.detector: {self.localization.detector} is not in map.detectors "
                f"{list(self.map.detectors)}"
            )
        fallback = self.localization.fallback_detector
        if fallback and fallback not in self.map.detectors:
            raise ConfigError(
                f"localization.fallback_detector: {fallback} is not in map.detectors "
                f"{list(self.map.detectors)}; empty for none"
            )
        if self.inter.detector not in self.map.detectors:
            raise ConfigError(
                f"inter.detector: {self.inter.detector} is not in map.detectors "
                f"{list(self.map.detectors)}"
            )
        if not 1 <= self.system_id <= 255:
            raise ConfigError(f"system_id: must be in 1..255, got {self.system_id}")
        members = self.swarm.members
        if members and self.system_id not in members:
            raise ConfigError(
                f"system_id: {self.system_id} is not in swarm.members {list(members)}"
            )
        others = [m for m in members if m != self.system_id]
        if others and not self.peers.to:
            raise ConfigError(
                f"peers.to: is empty, and swarm.members names {others}; their ADDRESS:PORT go there"
            )
        if self.peers.to and not others:
            raise ConfigError(
                "swarm.members: names no other drone, and peers.to has addresses of some"
            )

    def recognised_by(self) -> tuple[Detector, ...]:
        """Return the detectors by which maps are recognised, in the order in which they try."""
        own, fallback = self.localization.detector, self.localization.fallback_detector
        if self.pipeline == "paper" or not fallback or fallback == own:
            return (own,)
        return own, fallback


def load_config(path: Path) -> Config:
    """Read a configuration file.

    Raises:
        ConfigError: the file cannot be read or is no TOML; a key is unknown (the
            message names its path and the nearest valid key), or a value is of
            the wrong type or out of bounds. Always one line that names the file.
    """
    try:
        text = read_text(path)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from error
    return parse_config(text, str(path))


def parse_config(text: str, file: str) -> Config:
    """Return the configuration that TOML ``text`` says; ``file`` only names it in messages.

    Raises:
        ConfigError: see ``load_config``.
    """
    try:
        return _section(Config, tomllib.loads(text), ())
    except ConfigError as error:
        raise ConfigError(f"{file}: {_one_line(str(error))}") from error
    except RecursionError as error:
        raise ConfigError(f"{file}: nested too deeply") from error
    except ValueError as error:  # TOMLDecodeError, and integers of thousands of digits
        raise ConfigError(f"{file}: {_one_line(str(error))}") from error


def setting_paths(options: type = Config) -> Iterator[tuple[str, ...]]:
    """Yield the path of every setting below an Options class, in the order it is declared."""
    hints = typing.get_type_hints(options)
    for item in fields(options):
        inner = hints[item.name]
        if is_dataclass(inner) and isinstance(inner, type):
            yield from ((item.name, *path) for path in setting_paths(inner))
        else:
            yield (item.name,)


def _section(cls: type[_Section], table: Mapping[str, object], path: _Path) -> _Section:
    """Make the dataclass ``cls`` of a TOML table; ``path`` is where the table stands."""
    hints = typing.get_type_hints(cls)
    for key in table:
        if key not in hints:
            nearest = _dotted(_nearest(path, key))
            raise ConfigError(
                f"{_dotted((*path, key))}: unknown key; the nearest valid key is {nearest}"
            )
    values = {key: _value(hints[key], value, (*path, key)) for key, value in table.items()}
    try:
        return cls(**values)
    except (ConfigError, ValueError, OverflowError) as error:
        where = f"[{_dotted(path)}] " if path else ""
        raise ConfigError(f"{where}{error}") from error


def _value(expected: Any, value: object, path: _Path) -> Any:
    """Return ``value`` as the annotation ``expected`` wants it."""
    origin, arguments = typing.get_origin(expected), typing.get_args(expected)
    if origin in (types.UnionType, typing.Union):  # X | None: TOML has no null, so it is an X
        (expected,) = (argument for argument in arguments if argument is not types.NoneType)
        return _value(expected, value, path)
    if origin is Literal:
        # Compared with the type as well: 1 == True.
        if not any(value == choice and type(value) is type(choice) for choice in arguments):
            raise _mistyped("one of " + ", ".join(json.dumps(a) for a in arguments), value, path)
        return value
    if origin is tuple:
        return _tuple(arguments, value, path)
    if is_dataclass(expected) and isinstance(expected, type):
        if not isinstance(value, dict):
            raise _mistyped("a table", value, path)
        return _section(expected, value, path)
    if expected is Path and isinstance(value, str):
        return Path(value)
    largest = _largest(path)
    if expected is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not abs(value) <= largest:  # nor nan, nor an integer that is no float
            raise _mistyped(f"a finite number up to {largest:.0f}", value, path)
        if 0 < abs(value) < _LEAST:
            raise _mistyped(f"0 or a number from {_LEAST:g} on", value, path)
        return float(value)
    if expected is int and type(value) is int and not abs(value) <= largest:
        raise _mistyped(f"an integer up to {largest:.0f}", value, path)
    if expected in (bool, int, str) and type(value) is expected:
        return value
    raise _mistyped(_NAMES.get(expected, "a string"), value, path)


def _largest(path: _Path) -> float:
    key = next((part for part in reversed(path) if isinstance(part, str)), "")
    return next((most for unit, most in _LARGEST_OF.items() if key.endswith(unit)), _LARGEST)


def _tuple(arguments: tuple[Any, ...], value: object, path: _Path) -> tuple[Any, ...]:
    """Return a TOML array as ``tuple[X, ...]`` or ``tuple[X, Y, Z]``."""
    if not isinstance(value, list):
        raise _mistyped("an array", value, path)
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(arguments) != len(value):
        raise _mistyped(f"an array of {len(arguments)}", value, path)
    pairs = enumerate(zip(arguments, value, strict=True))
    return tuple(_value(item, got, (*path, i)) for i, (item, got) in pairs)


def _mistyped(expected: str, value: object, path: _Path) -> ConfigError:
    match value:
        case bool():
            got = str(value).lower()
        case int() if abs(value) >= 2**64:
            got = "a huge integer"
        case dict():
            got = "a table"
        case list():
            got = f"an array of {len(value)}"
        case str() if len(value) > _SHOWN_CHARACTERS:
            got = f"{value[:_SHOWN_CHARACTERS]!r}..."
        case str() | int() | float():
            got = repr(value)
        case _:
            got = "a date or time"
    return ConfigError(f"{_dotted(path)}: expected {expected}, got {got}")


def _nearest(table: _Path, key: str) -> _Path:
    """Return the valid path most like ``key``: in its table if one resembles it, else anywhere."""
    known = {path[:n] for path in setting_paths() for n in range(1, len(path) + 1)}
    elsewhere = {path[-1]: path for path in sorted(known)}
    beside = {path[-1]: path for path in sorted(known) if path[:-1] == table}
    for candidates, likeness in ((beside, 0.6), (elsewhere, 0.8), (beside, 0.0), (elsewhere, 0.0)):
        if found := difflib.get_close_matches(key, candidates, n=1, cutoff=likeness):
            return candidates[found[0]]
    raise AssertionError("a likeness of 0 matches something")


def _dotted(path: _Path) -> str:
    """Return a path as TOML writes it, an element of an array by its index."""
    text = ""
    for part in path:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += "." * bool(text) + (part if _BARE_KEY.fullmatch(part) else json.dumps(part))
    return text


def _one_line(text: str) -> str:
    return " ".join(text.split())
