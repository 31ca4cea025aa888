"""``python -m sitl bench``: what is measured, checked and shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar

from sitl.bench.cases import grid
from sitl.bench.realtime import bench_realtime
from sitl.bench.robust import bench_robust
from sitl.bench.robust_report import show_robust
from sitl.bench.speed import PARTS, bench_speed
from sitl.bench.speed_report import show_costs, show_figures, show_where
from sitl.bench.steps import STEPS, bench_steps
from sitl.bench.steps_report import show_steps
from sitl.result_folder import result_folder
from vcl_companion.errors import ConfigError

What = Literal["steps", "robust", "speed", "realtime"]
Progress = Callable[[str, int, int], None]

_SEEDS = 200
_QUICK_SEEDS = 3
_QUICK_OUTLIERS = 0.3

_T = TypeVar("_T")
# What each leaves in its folder.
_OWN = ("steps.*", "robust", "robust.*", "speed.*", "realtime.*", "recording*", "flight")


@dataclass(frozen=True)
class BenchOptions:
    """What is asked for.

    Attributes:
        what: the times of each step, poses among wrong matches, the speed of frames
            and maps, or daemons in the time of their cameras.
        only: names of parts, or pieces of them; empty for everything.
        seeds: scenes per cell of ``robust``; None for the usual number.
        quick: seconds instead of minutes and hours, to see that it runs.
    """

    what: What
    only: tuple[str, ...] = ()
    seeds: int | None = None
    quick: bool = False


def run_bench(out: Path, options: BenchOptions, console: Console) -> None:
    """Measure, show and write the result into a folder.

    Raises:
        ConfigError: a name is nothing's, or the folder is another one's or cannot be written.
    """
    if options.what != "robust" and options.seeds is not None:
        raise ConfigError(f"--seeds is for bench robust; {options.what} has no scenes")
    if options.what == "realtime" and options.only:
        raise ConfigError("--only: realtime has no parts")
    with result_folder(out, _OWN):
        if options.what == "speed":
            _run_speed(out, options, console)
            return
        if options.what == "realtime":
            with _shown(console) as progress:
                daemons = bench_realtime(out, options.quick, _changes(progress))
            for name, figures in daemons.items():
                show_figures(console, figures, name)
            show_where(console, out / "realtime.md")
            return
        if options.what == "steps":
            steps = chosen(STEPS, [step.name for step in STEPS], options.only)
            with _shown(console) as progress:
                results = bench_steps(out, steps, options.quick, progress)
            show_steps(console, results, out)
            return
        cells = [c for c in grid() if not options.quick or c.outliers == _QUICK_OUTLIERS]
        cells = chosen(cells, [cell.name for cell in cells], options.only)
        seeds = options.seeds or (_QUICK_SEEDS if options.quick else _SEEDS)
        with _shown(console) as progress:
            rows = bench_robust(out, seeds, progress, cells)
        show_robust(console, rows, out)


def _run_speed(out: Path, options: BenchOptions, console: Console) -> None:
    parts = tuple(chosen(PARTS, PARTS, options.only))
    with _shown(console) as progress:
        result = bench_speed(out, parts, options.quick, progress)
    if result.figures:
        show_figures(console, result.figures)
    show_costs(console, result.tables)
    show_where(console, out / "speed.md")


def _changes(progress: Progress) -> Progress:
    """Pass on what is new, not every frame of it."""
    last = ""

    def show(part: str, done: int, total: int) -> None:
        nonlocal last
        if part != last:
            last = part
            progress(part, done, total)

    return show


def chosen(things: Sequence[_T], names: Sequence[str], only: Sequence[str]) -> list[_T]:
    """Return the things that any of some names means, in their order; all of them for no name.

    A name is taken apart at its hyphens, and means every thing whose own name has
    all of these pieces: ``planar-3px`` is eight cells.

    Raises:
        ConfigError: a name means nothing.
    """
    own = [set(name.split("-")) for name in names]
    taken = [False] * len(names)
    for name in only:
        fits = [set(name.split("-")) <= pieces for pieces in own]
        if not any(fits):
            known = ", ".join(names if len(names) < 20 else [*names[:2], "..."])
            raise ConfigError(f"--only {name} means nothing; there is {known}")
        taken = [old or new for old, new in zip(taken, fits, strict=True)]
    return [thing for thing, is_taken in zip(things, taken, strict=True) if is_taken or not only]


@contextmanager
def _shown(console: Console) -> Iterator[Progress]:
    """Show progress as a bar on a terminal, as a line per part elsewhere."""
    if not console.is_terminal:
        yield lambda part, done, total: console.print(
            f"{done}/{total} {part}", markup=False, highlight=False, soft_wrap=True
        )
        return
    columns = (
        TextColumn("{task.description:<44}"),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda part, done, total: bar.update(
            task, description=part, completed=done, total=total
        )
