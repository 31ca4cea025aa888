"""Which real autopilot software flies in the stand-in's place: a user's own binary."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vcl_companion.errors import ConfigError

Kind = Literal["ardupilot", "px4"]

# What of a build is named, and its program from there.
_BUILT: dict[Kind, tuple[str, str]] = {
    "ardupilot": ("build/sitl/bin/arducopter", ""),
    "px4": ("build/px4_sitl_default", "bin/px4"),
}
_BAROMETER, _VISION = 0.0, 3.0
_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")


@dataclass(frozen=True)
class FirmwareBinary:
    """A firmware that was built for simulation.

    Attributes:
        kind: whose.
        path: its program.
        parameters: name and value of those that are set before it starts.
    """

    kind: Kind
    path: Path
    parameters: tuple[tuple[str, float], ...] = ()

    def has_own_height(self, *, flies_itself: bool) -> bool:
        """Return whether its height counts from where it was switched on, by a barometer.

        Args:
            flies_itself: whether it does, in a live flight; in a recorded one it is moved.
        """
        usual = _BAROMETER if flies_itself else _VISION
        reference = dict(self.parameters).get("EKF2_HGT_REF", usual)
        return self.kind == "px4" and reference != _VISION

    @property
    def holds_at_rest(self) -> bool:
        """Whether it says that it holds its position for constant while it stands and fuses too."""
        return self.kind == "px4"

    def __str__(self) -> str:
        return f"{self.kind}={self.path}"


def parse_firmware(text: str, parameters: Sequence[str] = ()) -> FirmwareBinary:
    """Return what ``ardupilot=/path/to/arducopter`` says, and ``NAME=VALUE`` of parameters.

    ``px4=`` takes the folder of a build.

    Raises:
        ConfigError: it has another form, or there is no such program.
    """
    name, equals, path_text = text.partition("=")
    for kind, (_, program) in _BUILT.items():
        if equals and name.strip() == kind:
            path = Path(path_text.strip()).expanduser() / program
            if path.is_dir() or not os.access(path, os.X_OK):
                raise ConfigError(f"--autopilot {text}: {path} is no program")
            return FirmwareBinary(kind, path.resolve(), tuple(map(_parameter, parameters)))
    kinds = " or ".join(f"{kind}=/path/to/{built}" for kind, (built, _) in _BUILT.items())
    raise ConfigError(f"--autopilot {text}: expected {kinds}")


def _parameter(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        if _NAME.fullmatch(name.strip()):
            return name.strip(), float(value)
    except ValueError:
        pass
    raise ConfigError(f"--parameter {text}: expected NAME=NUMBER, like VISO_DELAY_MS=20")
