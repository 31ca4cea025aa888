"""Reading what processes write, while they write it too."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def whole_lines(path: Path) -> list[str]:
    """Return what is whole: a file that is being written may end within a line."""
    *whole, _ = path.read_text().split("\n")
    return whole


def json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the records of a log."""
    return [json.loads(line) for line in whole_lines(path)]
