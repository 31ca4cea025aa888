"""What an autopilot's parameters were before ``vcl check --fix`` set them, in a file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from vcl_companion.daemon.whole_file import write_whole
from vcl_companion.errors import ConfigError


def write_before(path: Path, before: Mapping[str, float]) -> None:
    """Keep what parameters were before they were set, for ``--restore``.

    What is kept already is what they were at first, and stays.

    Raises:
        ConfigError: it cannot be written.
    """
    try:
        kept = read_before(path) if path.exists() else {}
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps({**before, **kept}, indent=1).encode() + b"\n")
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}: nothing is changed") from error


def forget_before(path: Path) -> None:
    """Remove what was kept: it has been put back.

    Raises:
        ConfigError: it cannot be removed.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}: remove it by hand") from error


def read_before(path: Path) -> dict[str, float]:
    """Return what parameters were.

    Raises:
        ConfigError: there is no such file, or it is something else.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        before = {str(name): float(value) for name, value in values.items()}
        if not before or not all(map(math.isfinite, before.values())):
            raise ValueError
        return before
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}: nothing to restore") from error
    except (ValueError, AttributeError, TypeError) as error:
        raise ConfigError(f"{path}: holds no parameters") from error
