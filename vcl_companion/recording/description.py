"""``recording.toml``: what a recording says of itself; every key is optional."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from vcl_companion.errors import RecordingError
from vcl_companion.text_file import read_text

_KEYS = (
    "name",
    "frame_rate_hz",
    "leader",
    "known_distance",
    "distance_sigma_m",
    "calibration_px",
)
# Those that are numbers: which will do, and how to say so.
_NUMBERS: dict[str, tuple[Callable[[float], bool], str]] = {
    "frame_rate_hz": (lambda hz: 0.0 < hz < 1e6, "be a positive number below 1e6"),
    "distance_sigma_m": (lambda m: 0.0 < m < 1e6, "be above 0 and below 1e6 metres"),
    "calibration_px": (lambda px: 0.0 <= px <= 10.0, "lie in 0..10"),
}
_PAIR_FORM = 'known_distance must be ["mav0", "mav1"], ["mav0", "mav1", metres] or a list of such'


@dataclass(frozen=True)
class KnownPair:
    """Two drones whose distance at the start is known (assumption 2 of the method).

    Attributes:
        a, b: the drones' names.
        distance_m: between the bodies; None: the harness takes it from the truth.
    """

    a: str
    b: str
    distance_m: float | None = None

    def __post_init__(self) -> None:
        if self.a == self.b:
            raise ValueError(f"known_distance names {self.a!r} twice")
        if self.distance_m is not None and not 0.0 < self.distance_m < 1e6:
            raise ValueError("known_distance must be above 0 and below 1e6 metres")


@dataclass(frozen=True)
class Description:
    """The keys of ``recording.toml``; None where it is silent.

    Attributes:
        name: for people.
        frame_rate_hz: nominal.
        leader: name of a drone.
        known_distances: pairs of its drones whose distance at the start is known.
        distance_sigma_m: how well these are known, or the truth that they are taken from, as
            ``map.distance_sigma_m``.
        calibration_px: what the cameras may be off their calibration, as ``map.calibration_px``;
            0 where they are exact, as rendered ones are.
    """

    name: str | None = None
    frame_rate_hz: float | None = None
    leader: str | None = None
    known_distances: tuple[KnownPair, ...] = ()
    distance_sigma_m: float | None = None
    calibration_px: float | None = None


def read_description(path: Path) -> Description:
    """Read ``recording.toml``; an absent file says nothing.

    Raises:
        RecordingError: it is not TOML, or a key is unknown or of the wrong type.
    """
    try:
        table = tomllib.loads(read_text(path))
    except FileNotFoundError:
        return Description()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from None
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(f"{path}: not TOML ({' '.join(str(error).split())})") from None
    except (ValueError, RecursionError):
        raise RecordingError(f"{path}: not TOML text") from None
    for key in table:
        if key not in _KEYS:
            nearest = difflib.get_close_matches(key, _KEYS, n=1, cutoff=0.0)[0]
            raise RecordingError(f"{path}: unknown key {key!r}; the nearest is {nearest!r}")
    for key in ("name", "leader"):
        if key in table and not (isinstance(table[key], str) and table[key].strip()):
            raise RecordingError(f"{path}: {key} must be a text that is not empty")
    for key, (is_right, form) in _NUMBERS.items():
        if key in table and not (_is_number(table[key]) and is_right(table[key])):
            raise RecordingError(f"{path}: {key} must {form}")
    numbers = {key: float(table[key]) for key in _NUMBERS if key in table}
    return Description(
        name=table.get("name"),
        frame_rate_hz=numbers.get("frame_rate_hz"),
        leader=table.get("leader"),
        known_distances=_known_pairs(path, table.get("known_distance", [])),
        distance_sigma_m=numbers.get("distance_sigma_m"),
        calibration_px=numbers.get("calibration_px"),
    )


def format_description(description: Description) -> str:
    """Return the text of a ``recording.toml``."""
    lines = []
    if description.name is not None:
        lines.append(f"name = {_toml_string(description.name)}")
    if description.frame_rate_hz is not None:
        lines.append(f"frame_rate_hz = {float(description.frame_rate_hz)!r}")
    if description.leader is not None:
        lines.append(f"leader = {_toml_string(description.leader)}")
    pairs = []
    for pair in description.known_distances:
        cells = [_toml_string(pair.a), _toml_string(pair.b)]
        if pair.distance_m is not None:
            cells.append(repr(float(pair.distance_m)))
        pairs.append(f"[{', '.join(cells)}]")
    if len(pairs) == 1:
        lines.append(f"known_distance = {pairs[0]}")
    elif pairs:
        lines.append(f"known_distance = [{', '.join(pairs)}]")
    if description.distance_sigma_m is not None:
        lines.append(f"distance_sigma_m = {float(description.distance_sigma_m)!r}")
    if description.calibration_px is not None:
        lines.append(f"calibration_px = {float(description.calibration_px)!r}")
    return "".join(line + "\n" for line in lines)


def _known_pairs(path: Path, value: object) -> tuple[KnownPair, ...]:
    if not isinstance(value, list):
        raise RecordingError(f"{path}: {_PAIR_FORM}")
    entries = value if all(isinstance(entry, list) for entry in value) else [value]
    pairs = []
    for entry in entries:
        if len(entry) not in (2, 3) or not all(isinstance(name, str) for name in entry[:2]):
            raise RecordingError(f"{path}: {_PAIR_FORM}")
        distance = entry[2] if len(entry) == 3 else None
        if distance is not None and not _is_number(distance):
            raise RecordingError(f"{path}: {_PAIR_FORM}")
        try:
            pairs.append(KnownPair(entry[0], entry[1], distance))
        except ValueError as error:
            raise RecordingError(f"{path}: {error}") from None
    return tuple(pairs)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _toml_string(text: str) -> str:
    """Quote a basic TOML string: backslash, quote and control characters escaped."""
    out = []
    for character in text:
        if character in '"\\':
            out.append("\\" + character)
        elif ord(character) < 0x20 or ord(character) == 0x7F:
            out.append(f"\\u{ord(character):04x}")
        else:
            out.append(character)
    return '"' + "".join(out) + '"'
