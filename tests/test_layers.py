"""The layering rule of CONTRIBUTING.md against the imports of the code.

Read from the syntax tree, so that imports inside functions, under
``TYPE_CHECKING`` and on platforms other than this one count as well.
"""

import ast
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "vcl_companion"

# From the ground up. What stands on one shelf does not see its neighbours.
SHELVES = (
    ("errors", "clock", "options", "compiled", "text_file"),
    ("geometry",),
    ("vision",),
    ("mapping",),
    ("localization",),
    ("wire",),
    ("swarm",),
    ("recording",),
    ("cameras", "links"),
    ("config", "one_line"),
    ("daemon", "ground"),
    ("cli",),
    ("__main__",),
)
HEIGHT = {room: height for height, shelf in enumerate(SHELVES) for room in shelf}

# Foreign modules that only some files may import; a trailing slash is a folder.
CONFINED = {
    "pymavlink": (
        f"{PACKAGE}/links/decoding.py",
        f"{PACKAGE}/links/mavlink.py",
        f"{PACKAGE}/links/own_messages.py",
        f"{PACKAGE}/links/signing.py",
        "sitl/autopilots/",
        "tests/",
    ),
    "depthai": (f"{PACKAGE}/cameras/oak.py", "tests/cameras/"),
    "mavsdk": (f"{PACKAGE}/ground/", "sitl/", "tests/"),
    # 27 MB in each daemon; what it would be needed for is in scipy.special.
    "scipy.stats": ("sitl/", "tests/"),
}
OUTSIDE = ("sitl", "tests")

# No socket, no clock, no file, no logger, no global randomness: what varies is an argument.
PURE = ("geometry", "vision", "mapping", "localization", "wire", "swarm")
WORLDLY = frozenset(
    ("asyncio", "datetime", "logging", "os", "pathlib", "random", "selectors", "socket", "time")
)


def imported_modules(source: str, file: str) -> Iterator[tuple[int, str]]:
    """Yield line and dotted name of everything that ``source`` imports.

    ``from a import b`` is both ``a`` and ``a.b``: b may be a module. A literal
    given to ``import_module`` or ``__import__`` counts too.
    """
    package = PurePosixPath(file).parent.parts
    for node in ast.walk(ast.parse(source, file)):
        match node:
            case ast.Import(names=names):
                yield from ((node.lineno, name.name) for name in names)
            case ast.ImportFrom(module=module, names=names, level=level):
                base = package[: len(package) - level + 1] if level else ()
                start = ".".join((*base, module) if module else base)
                yield node.lineno, start
                yield from ((node.lineno, f"{start}.{name.name}") for name in names)
            case ast.Call(
                func=ast.Name(id="__import__" | "import_module")
                | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(name)), *_],
            ):
                yield node.lineno, name


def violations(source: str, file: str) -> list[str]:
    """Return what the module ``source``, at ``file`` below the root, imports against the rule."""
    found = [
        f"{file}:{line}: {name}: {why}"
        for line, name in imported_modules(source, file)
        if (why := objection(file, name))
    ]
    return list(dict.fromkeys(found))


def objection(file: str, name: str) -> str | None:
    """Return why ``file`` must not import ``name``, None when it may."""
    ours = file.startswith(f"{PACKAGE}/")
    top, *inner = name.split(".")
    for module, where in CONFINED.items():
        if f"{name}.".startswith(f"{module}.") and not file.startswith(where):
            return f"only in {', '.join(where)}"
    if top in OUTSIDE and ours:
        return f"the package does not know {top}"
    if top == "tests" and not file.startswith("tests/"):
        return "only tests import tests"
    room = file.removeprefix(f"{PACKAGE}/").split("/")[0].removesuffix(".py")
    if ours and room in PURE and top in WORLDLY:
        return f"{room} knows no clock, file, socket or logger"
    if top != PACKAGE or not inner:
        return None
    if file.startswith("sitl/") and inner[0] == "cli":
        return "sitl starts daemons as processes, it does not import cli"
    if not ours:
        return None
    if inner[0] not in HEIGHT:
        return None if inner[0].startswith("__") or room == "__init__" else "stands on no shelf"
    if room not in HEIGHT:
        return f"{room} stands on no shelf"
    if inner[0] != room and HEIGHT[inner[0]] >= HEIGHT[room]:
        return f"{room} is not above {inner[0]}"
    return None


def modules() -> list[str]:
    return sorted(
        path.relative_to(ROOT).as_posix()
        for folder in (PACKAGE, *OUTSIDE)
        for path in (ROOT / folder).rglob("*.py")
    )


@pytest.mark.parametrize("file", modules())
def test_imports_only_from_lower_shelves(file: str) -> None:
    assert violations((ROOT / file).read_text(encoding="utf-8"), file) == []


def test_every_room_of_the_package_stands_on_a_shelf() -> None:
    rooms = {
        path.stem
        for path in (ROOT / PACKAGE).iterdir()
        if (path / "__init__.py").exists() or path.suffix == ".py"
    }
    assert rooms - {"__init__"} <= HEIGHT.keys()


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("vcl_companion/vision/a.py", "import vcl_companion.mapping"),
        ("vcl_companion/vision/a.py", "import vcl_companion.mapping.landmark_map as m"),
        ("vcl_companion/vision/a.py", "from vcl_companion import mapping"),
        ("vcl_companion/vision/a.py", "from vcl_companion.mapping import landmark_map"),
        ("vcl_companion/vision/a.py", "from ..mapping import landmark_map"),
        ("vcl_companion/vision/a.py", "from .. import mapping"),
        ("vcl_companion/vision/__init__.py", "from ..mapping import landmark_map"),
        ("vcl_companion/vision/a/b.py", "from ...mapping import landmark_map"),
        ("vcl_companion/vision/a.py", "def f():\n    import vcl_companion.cli"),
        ("vcl_companion/vision/a.py", "import importlib\nimportlib.import_module('sitl.fly')"),
        ("vcl_companion/geometry/a.py", "if TYPE_CHECKING:\n    import vcl_companion.vision.b"),
        ("vcl_companion/cameras/a.py", "from vcl_companion.links import transport"),
        ("vcl_companion/links/a.py", "from vcl_companion.cameras.source import Frame"),
        ("vcl_companion/daemon/a.py", "import vcl_companion.ground"),
        ("vcl_companion/errors.py", "import vcl_companion.clock"),
        ("vcl_companion/wire/a.py", "from time import monotonic"),
        ("vcl_companion/swarm/a.py", "import os.path"),
        ("vcl_companion/config.py", "import vcl_companion.daemon.health"),
        ("vcl_companion/new/a.py", "import vcl_companion.errors"),
        ("vcl_companion/daemon/a.py", "import vcl_companion.new"),
        ("vcl_companion/daemon/a.py", "import sitl"),
        ("vcl_companion/daemon/a.py", "from tests.scenes import scene"),
        ("vcl_companion/links/peers.py", "from pymavlink.dialects.v20 import common"),
        ("vcl_companion/links/mavlink.py", "import mavsdk"),
        ("vcl_companion/cameras/v4l2.py", "import depthai as dai"),
        ("vcl_companion/vision/a.py", "from scipy import stats"),
        ("vcl_companion/daemon/a.py", "from scipy.stats import chi2"),
        ("sitl/fly.py", "from vcl_companion.cli import main"),
        ("sitl/fly.py", "from vcl_companion import cli"),
        ("sitl/fly.py", "import pymavlink"),
        ("sitl/fly.py", "import tests.checks"),
    ],
)
def test_the_check_finds_a_violation(file: str, source: str) -> None:
    assert len(violations(source, file)) >= 1


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("vcl_companion/vision/a.py", "from vcl_companion.geometry.pose import Pose"),
        ("vcl_companion/vision/a.py", "from vcl_companion.vision.b import c\nfrom . import b"),
        ("vcl_companion/vision/a.py", "from vcl_companion import geometry, errors"),
        ("vcl_companion/cli/__init__.py", "from vcl_companion.daemon.assemble import run_daemon"),
        ("vcl_companion/links/mavlink.py", "from pymavlink.dialects.v20 import common"),
        ("vcl_companion/cameras/oak.py", "def f():\n    import depthai"),
        ("sitl/fly.py", "import mavsdk, vcl_companion.daemon.health"),
        ("sitl/autopilots/stand_in.py", "import pymavlink"),
        ("tests/sitl/test_a.py", "import sitl, mavsdk, pymavlink, vcl_companion.cli, tests.scenes"),
        ("vcl_companion/vision/a.py", "import mavsdk_like, sitl_other, timeit"),
        ("vcl_companion/recording/a.py", "import pathlib"),
        ("vcl_companion/vision/a.py", "from scipy import special"),
        ("sitl/a.py", "from scipy.stats import chi2"),
    ],
)
def test_the_check_lets_through_what_is_allowed(file: str, source: str) -> None:
    assert violations(source, file) == []
