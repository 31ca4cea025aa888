"""Numbers of a scenario that nothing can be rendered by, found before anything is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from vcl_companion.errors import ConfigError

# What a number is, by how its key ends, and from where to where it goes: a wrong unit or a slip of
# the pen is beyond. What depends on others is looked at by the thing itself.
_RANGES: Mapping[str, tuple[float, float]] = {
    "seed": (0, 2**32 - 1),
    "count": (0, 1000),
    "bays": (0, 100),
    "columns": (0, 100),
    "floors": (0, 100),
    "supersampling": (1, 8),
    "start_at_ns": (0, 2**62),
    "texels_per_m": (0.1, 1000),
    "strength": (0, 100),
    "gain": (0.01, 100),
    "focal_px": (1, 100_000),
    "blur_px": (0, 50),
    "size_m": (0.01, 1000),
    "width_m": (0.01, 1000),
    "depth_m": (0.01, 1000),
    "height_m": (0.001, 1000),
    "length_x_m": (0.01, 10_000),
    "length_y_m": (0.01, 10_000),
    "half_m": (1, 10_000),
    "every_m": (0.1, 10_000),
    "_m": (-100_000, 100_000),
    "_deg": (-36_000, 36_000),
    "_s": (-36_000, 36_000),
    "_hz": (0.001, 10_000),
}
_ANY = (-1_000_000.0, 1_000_000.0)


def refuse_absurd(value: object, path: Path, where: str = "", key: str = "") -> None:
    """Raise ConfigError at the first number that is out of range, naming it and the range.

    Args:
        value: a table of the scenario, or what stands in it.
        path: the file, for the message.
        where: of the value in the file.
        key: the last name in that.
    """
    if isinstance(value, dict):
        for name, item in value.items():
            refuse_absurd(item, path, f"{where}.{name}".lstrip("."), str(name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            refuse_absurd(item, path, f"{where}[{i}]", key)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        least, most = next((r for end, r in _RANGES.items() if key.endswith(end)), _ANY)
        if not (math.isfinite(value) and least <= value <= most):
            raise ConfigError(f"{path}: {where}: is {value!r}, and goes from {least:g} to {most:g}")
