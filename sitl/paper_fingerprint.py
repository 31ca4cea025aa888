"""What a recording or a flight was made of, so that nothing is made twice, and nothing stale kept.

Code counts by its text: every module of ours that is imported, directly or by
way of others, from where the work starts. A changed picture or page therefore
does not have anything flown again; a changed daemon does.
"""

from __future__ import annotations

import ast
import hashlib
import json
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from sitl.plan import FlyOptions
from sitl.scenario import Scenario

_ROOT = Path(__file__).resolve().parents[1]
_OURS = ("sitl", "vcl_companion")
_RENDERING = ("sitl.render",)
_FLYING = ("sitl.swarm", "sitl.pacing", "sitl.out_folder", "sitl.leash", "vcl_companion.cli")
_STAND_INS = "sitl/autopilots"
# The harness's own loop, without the reports that it imports.
_LOOP = "sitl/fly.py"
_LIBRARIES = ("numpy", "scipy", "numba", "opencv-python-headless", "pymavlink")

Fingerprint = Mapping[str, Any]


def of_recording(scenario: Scenario) -> Fingerprint:
    """Return what a recording is rendered from."""
    told = json.dumps(msgspec.to_builtins(scenario), sort_keys=True)
    return {"scenario": _digest([told.encode()]), "renderer": _renderer()}


def of_flight(recording: Fingerprint, options: FlyOptions) -> Fingerprint:
    """Return what a flight results from."""
    return {
        "recording": dict(recording),
        "settings": [[".".join(s.path), s.value] for s in options.settings],
        "speed": "max" if math.isinf(options.speed) else options.speed,
        "seed": options.seed,
        "code": _flying(),
        "libraries": {"python": platform.python_version()} | {n: version(n) for n in _LIBRARIES},
    }


def differences(before: Fingerprint, now: Fingerprint) -> list[str]:
    """Return the names of what is not as it was."""
    keys = [*now, *(key for key in before if key not in now)]
    return [key for key in keys if before.get(key) != now.get(key)]


def written(path: Path) -> Fingerprint | None:
    """Return a fingerprint from its file; None when there is none that can be read."""
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return value if isinstance(value, dict) else None


def write(path: Path, fingerprint: Fingerprint) -> None:
    """Write a fingerprint at once, so that half of one never counts."""
    half = path.with_name(path.name + ".half")
    half.write_text(json.dumps(fingerprint, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    half.replace(path)


@cache
def _renderer() -> str:
    return _digest_of_files(imported_files(_RENDERING))


@cache
def _flying() -> str:
    stand_ins = [p.relative_to(_ROOT).as_posix() for p in (_ROOT / _STAND_INS).glob("*.py")]
    modules = [*_FLYING, *(_module_of(path) for path in stand_ins)]
    return _digest_of_files({*imported_files(modules), _LOOP})


def imported_files(modules: Sequence[str]) -> set[str]:
    """Return the files of our modules and of all modules of ours that these import.

    Read from the text, so that imports inside functions count as well.
    """
    found: set[str] = set()
    waiting = [file for module in modules for file in _files_of(module)]
    while waiting:
        file = waiting.pop()
        if file in found:
            continue
        found.add(file)
        waiting += [path for name in _imports(file) for path in _files_of(name)]
    return found


def _imports(file: str) -> Iterator[str]:
    package = PurePosixPath(file).parent.parts
    for node in ast.walk(ast.parse((_ROOT / file).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parents = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*parents, *([node.module] if node.module else [])])
            # ``from a import b``: b may be a module.
            yield base
            yield from (f"{base}.{alias.name}" for alias in node.names)


def _files_of(module: str) -> list[str]:
    """Return the file of a module of ours and those of the packages around it."""
    parts = module.split(".")
    if parts[0] not in _OURS:
        return []
    candidates = ["/".join([*parts[:n], "__init__.py"]) for n in range(1, len(parts) + 1)]
    candidates.append("/".join(parts) + ".py")
    return [path for path in candidates if (_ROOT / path).is_file()]


def _module_of(file: str) -> str:
    return file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _digest_of_files(files: set[str]) -> str:
    return _digest([name.encode() + b"\0" + (_ROOT / name).read_bytes() for name in sorted(files)])


def _digest(parts: Sequence[bytes]) -> str:
    whole = hashlib.sha256()
    for part in parts:
        whole.update(len(part).to_bytes(8, "big") + part)
    return whole.hexdigest()[:16]
