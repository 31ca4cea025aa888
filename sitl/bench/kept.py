"""Finished parts of ``bench robust`` on disk, and what they hold true for.

A part is one contender in one cell. It is run again when the code behind it,
the version of a library behind it, or the number of scenes differs; layout and
comments of the code do not count.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import platform
from collections.abc import Iterable
from pathlib import Path

from sitl.bench.cases import Task
from sitl.bench.trial import Score

Stamp = dict[str, str]

_RIVALS = ("sitl.bench.cases", "sitl.bench.trial", "vcl_companion.geometry.pose")
_OURS: dict[Task, str] = {
    "relative": "vcl_companion.vision.relative_pose",
    "resection": "vcl_companion.vision.absolute_pose",
}
# A change there changes what our search finds, not what a rival does.
_NOT_OF_RIVALS = "vcl_companion.vision."


def stamp_of(contender: str, task: Task, settings: object) -> Stamp:
    """Return what a part depends on.

    Args:
        contender: whose part it is; ``ours`` and ``best`` depend on our vision.
        task: of which only that part matters that does it.
        settings: anything else, by its representation.
    """
    own = contender in ("ours", "best")
    code = sources_behind(_RIVALS, _NOT_OF_RIVALS)
    if own:
        code += sources_behind([_OURS[task]])
    code.append(Path(__file__).with_name("contenders.py"))
    digest = hashlib.sha256()
    for file in sorted(set(code)):
        digest.update(ast.dump(ast.parse(file.read_text(encoding="utf-8"))).encode())
    libraries = ["numpy", "opencv-python-headless"]
    libraries += ["numba", "scipy"] if own else ["poselib"] if "poselib" in contender else []
    stamp = {name: _version(name) for name in libraries}
    return {
        "code": digest.hexdigest(),
        "settings": repr(settings),
        "python": platform.python_version(),
        **stamp,
    }


def sources_behind(modules: Iterable[str], without: str = "") -> list[Path]:
    """Return the files of some modules and of what they import of ours, directly or not.

    Args:
        modules: full names.
        without: modules whose name begins so are left out; empty for none.
    """
    waiting, files = list(modules), {}
    while waiting:
        name = waiting.pop()
        if name in files or (without and name.startswith(without)):
            continue
        spec = importlib.util.find_spec(name)
        if spec is None or spec.origin is None:
            continue
        files[name] = Path(spec.origin)
        for node in ast.walk(ast.parse(files[name].read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vcl_companion"):
                waiting.append(node.module or "")
    return list(files.values())


def read_part(file: Path, stamp: Stamp, scenes: int) -> list[Score] | None:
    """Return the scores of a finished part, None when there is none or it is out of date."""
    try:
        kept = json.loads(file.read_text(encoding="utf-8"))
        if kept["stamp"] != stamp or len(kept["scores"]) != scenes:
            return None
        return [Score(*score) for score in kept["scores"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_part(file: Path, stamp: Stamp, scores: list[Score]) -> None:
    """Keep a finished part; a reader sees all of it or nothing."""
    file.parent.mkdir(parents=True, exist_ok=True)
    rows = [[s.first, s.among, s.answers, s.turn_deg, s.offset, s.milliseconds] for s in scores]
    text = json.dumps({"stamp": stamp, "scores": rows}) + "\n"
    fresh = file.with_suffix(".part")
    fresh.write_text(text, encoding="utf-8")
    os.replace(fresh, file)


def _version(library: str) -> str:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return "absent"
