"""Which real autopilot software flies in the stand-in's place: a user's own binary."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from vcl_companion.errors import ConfigError

Kind = Literal["ardupilot"]

_NAME = re.compile(r"[A-Z][A-Z0-9_]{0,15}")


@dataclass(frozen=True)
class FirmwareBinary:
    """A firmware that was built for simulation.

    Attributes:
        kind: whose.
        path: ArduPilot: ``build/sitl/bin/arducopter``.
        parameters: name and value of those that are set before it starts.
    """

    kind: Kind
    path: Path
    parameters: tuple[tuple[str, float], ...] = ()

    def __str__(self) -> str:
        return f"{self.kind}={self.path}"


def parse_firmware(text: str, parameters: Sequence[str] = ()) -> FirmwareBinary:
    """Return what ``ardupilot=/path/to/arducopter`` says, and ``NAME=VALUE`` of parameters.

    Raises:
        ConfigError: it has another form, or there is no such program.
    """
    name, equals, path_text = text.partition("=")
    for kind in get_args(Kind):
        if equals and name.strip() == kind:
            path = Path(path_text.strip()).expanduser()
            if path.is_dir() or not os.access(path, os.X_OK):
                raise ConfigError(f"--autopilot {text}: {path} is no program")
            return FirmwareBinary(kind, path.resolve(), tuple(map(_parameter, parameters)))
    kinds = ", ".join(f"{kind}=/path/to/its/program" for kind in get_args(Kind))
    raise ConfigError(f"--autopilot {text}: expected {kinds}")


def _parameter(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        if _NAME.fullmatch(name.strip()):
            return name.strip(), float(value)
    except ValueError:
        pass
    raise ConfigError(f"--parameter {text}: expected NAME=NUMBER, like VISO_DELAY_MS=20")
