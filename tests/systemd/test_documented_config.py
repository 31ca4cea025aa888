import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from vcl_companion.config import Config, load_config, setting_paths

FILE = Path(__file__).parents[2] / "systemd" / "vcl-companion.toml"
UNITS = {"_hz": "Hz", "_s": "s", "_ms": "ms", "_m": "m", "_px": "px", "_deg": "degrees"}
UNITS |= {"_bytes": "bytes", "_rad": "rad", "_bits": "bits"}
UNITS |= {"_m_s": "m/s", "_m_s2": "m/s²", "_deg_s": "degrees/s", "_bytes_per_s": "bytes/s"}


def written(value: Any) -> Any:
    """Return a setting as TOML gives it back."""
    return json.loads(json.dumps(value, default=str))


def default_of(path: tuple[str, ...]) -> Any:
    value: Any = Config()
    for name in path:
        value = getattr(value, name)
    return value


def section_and_key_of_lines(lines: list[str]) -> dict[tuple[str, ...], int]:
    """Return the line number of every ``key =`` under its ``[section]``, commented out or not."""
    found: dict[tuple[str, ...], int] = {}
    section: tuple[str, ...] = ()
    for number, line in enumerate(lines):
        if header := re.fullmatch(r"\[([\w.]+)\]", line):
            section = tuple(header[1].split("."))
        elif key := re.match(r"(?:# ?)?(\w+) = ?", line):
            found.setdefault((*section, key[1]), number)
    return found


LINES = FILE.read_text(encoding="utf-8").splitlines()
NUMBERS = section_and_key_of_lines(LINES)
SETTINGS = list(setting_paths())


def test_it_loads_as_exactly_the_defaults() -> None:
    assert load_config(FILE) == Config()


@pytest.mark.parametrize("path", SETTINGS, ids=".".join)
def test_every_setting_is_there_with_its_default(path: tuple[str, ...]) -> None:
    default = default_of(path)
    if default is None:  # TOML has no null: the key stands there commented out
        assert path in NUMBERS, f"add `# {path[-1]} =` under [{'.'.join(path[:-1])}]"
        assert LINES[NUMBERS[path]].startswith("#")
        return
    value: Any = tomllib.loads("\n".join(LINES))
    for name in path:
        assert name in value, f"add `{path[-1]} = {json.dumps(default)}` under {path[:-1]}"
        value = value[name]
    assert value == written(default)


@pytest.mark.parametrize("path", SETTINGS, ids=".".join)
def test_every_setting_is_explained_with_its_unit(path: tuple[str, ...]) -> None:
    number = NUMBERS[path]
    comment = ""
    while LINES[number - 1].startswith("#"):
        number -= 1
        comment = LINES[number] + "\n" + comment
    assert len(comment) > 20, f"{'.'.join(path)} has no comment above it"
    endings = [ending for ending in UNITS if path[-1].endswith(ending)]
    if endings:
        unit = UNITS[max(endings, key=len)]
        assert re.search(rf"(?<![\w/]){re.escape(unit)}(?![\w/])", comment), f"say the unit, {unit}"
