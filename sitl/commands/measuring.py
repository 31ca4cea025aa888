"""What takes long: ``paper``, ``bench``, ``torture``, ``scale``, ``consistency``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

import click

from sitl.commands.options import FOLDER, PIPELINES, speed, start_timeout_option


def _one_thread() -> None:
    """Let numpy have one thread, as all that it is compared with; this counts before its import."""
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


@click.command()
@click.option("--out", required=True, metavar="DIR", type=FOLDER, help="Results; made if absent.")
@click.option(
    "--only",
    multiple=True,
    metavar="NAME",
    help="rotate, sparse, forward_back, forward_back_near, forward_back_noisy or urban "
    "(repeatable); otherwise all.",
)
@click.option(
    "--speed",
    metavar="X|max",
    callback=speed,
    help="Seconds of the recording per second, or max: as fast as all daemons and their maps keep "
    "up; otherwise the paper's pipeline at max, the default one so that each of three drones has "
    "a processor and a half of this machine, at most in real time.",
)
@click.option(
    "--recordings",
    metavar="DIR",
    type=FOLDER,
    help="Where rendered scenarios are kept for other runs too; otherwise DIR/recordings.",
)
@click.option(
    "--seconds",
    type=float,
    metavar="S",
    help="Render and fly only the first S seconds: to try it out; nothing is judged then.",
)
@start_timeout_option(60.0)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="More of the daemons' configuration in every flight (repeatable).",
)
@click.option(
    "--pipeline",
    "pipelines",
    multiple=True,
    type=click.Choice(PIPELINES),
    help="Only flown so (repeatable); otherwise both, side by side.",
)
def paper(
    out: Path,
    only: tuple[str, ...],
    speed: float | None,
    recordings: Path | None,
    seconds: float | None,
    start_timeout: float,
    settings: tuple[str, ...],
    pipelines: tuple[str, ...],
) -> None:
    """Fly the paper's experiments and lay them beside its figures: paper.html, paper.json.

    Renders each scenario once and flies it by both pipelines, with and without fusion
    where the paper compares: about an hour. What is finished and still fits is not made again,
    so the same command goes on after an interruption. Exit status: 0, whatever was
    measured; 2 for input that cannot be used, 1 when a flight broke off.
    """
    from rich.console import Console

    from sitl.paper import PaperOptions, make_paper
    from sitl.paper_experiments import pipelines_named
    from sitl.plan import parse_setting
    from sitl.terminal import progress_shown, show_goals

    options = PaperOptions(
        only=only,
        speed=speed,
        settings=tuple(map(parse_setting, settings)),
        seconds=seconds,
        recordings=recordings,
        start_timeout_s=start_timeout,
    )
    console = Console()
    try:
        with progress_shown(console) as progress:
            result = make_paper(
                out,
                options,
                progress,
                lambda text: console.out(text, highlight=False),
                pipelines=pipelines_named(pipelines),
            )
    except KeyboardInterrupt:
        click.echo("sitl: what is finished is kept; the same command goes on from here", err=True)
        raise
    show_goals(console, result.goals, out)
    if result.failures:
        click.get_current_context().exit(1)


@click.command()
@click.argument(
    "what",
    metavar="[steps|robust|speed|realtime]",
    default="steps",
    type=click.Choice(["steps", "robust", "speed", "realtime"]),
)
@click.option(
    "--only",
    multiple=True,
    metavar="NAME",
    help="A step, cell or part, or a piece of a name (repeatable).",
)
@click.option(
    "--seeds", type=click.IntRange(min=1), help="Scenes in each cell of robust; 200 by default."
)
@click.option("--quick", is_flag=True, help="Seconds: see that it runs, not how well.")
@click.option("--out", default=Path("out/bench"), show_default=True, metavar="DIR", type=FOLDER)
def bench(
    what: Literal["steps", "robust", "speed", "realtime"],
    only: tuple[str, ...],
    seeds: int | None,
    quick: bool,
    out: Path,
) -> None:
    """Measure each step, or how well poses are found, beside OpenCV, SciPy and poselib.

    steps: the time of each step and whether its answer is right, in minutes.
    robust: poses among wrong matches, cell by cell, in hours; what is finished is
    kept in the output folder and not run again.
    speed: a frame beside the paper's, relocalization, cold start, map extension, and how
    costs grow with the map and the image, in minutes.
    realtime: three daemons at 30 Hz: dropped frames, latency, memory, load, in minutes.
    """
    _one_thread()
    from rich.console import Console

    from sitl.bench.command import BenchOptions, run_bench

    run_bench(out, BenchOptions(what, only, seeds, quick), Console())


@click.command()
@click.option(
    "--payloads", default=600_000, show_default=True, type=click.IntRange(min=1), metavar="N"
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option(
    "--processes",
    type=click.IntRange(min=1),
    help="That share the work; otherwise one per core.",
)
@click.option(
    "--session",
    default=20_000,
    show_default=True,
    type=click.IntRange(min=1),
    metavar="N",
    help="Payloads that one drone lives through before another begins; they are numbered by it.",
)
@click.option(
    "--only",
    type=click.IntRange(min=0),
    metavar="INDEX",
    help="Go through this payload's session up to it, and tell whether it fails.",
)
@click.option("--out", default=Path("out/torture"), show_default=True, metavar="DIR", type=FOLDER)
def torture(
    payloads: int, seed: int, processes: int | None, session: int, only: int | None, out: Path
) -> None:
    """Feed mutated payloads of hostile peers to all that a peer's bytes pass in a daemon.

    From MAVLink frames to maps in use and poses fused, with the daemon's own parts. Nothing
    but a WireError may be raised, and memory may not grow. Exit status: 0, 1 when
    something failed, 2 for input that cannot be used.
    """
    _one_thread()
    from rich.console import Console

    from sitl.torture.command import run_torture
    from sitl.torture.report import TortureOptions

    options = TortureOptions(payloads, seed, processes or 0, session)
    if not run_torture(out, options, only, Console()):
        click.get_current_context().exit(1)


@click.command()
@click.option(
    "--drones",
    default="2,5,10,30,100",
    show_default=True,
    metavar="N,N,...",
    help="How many, in one run after the other.",
)
@click.option(
    "--loss",
    default=0.1,
    show_default=True,
    metavar="P",
    help="Share of the datagrams that each receiver loses.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option("--out", default=Path("out/scale"), show_default=True, metavar="DIR", type=FOLDER)
def scale(drones: str, loss: float, seed: int, out: Path) -> None:
    """Measure how a drone's bytes and processor time grow with the number of drones.

    All drones live in one process over one lossy channel, by counted time: at rest, and while
    a first map and its update are handed out. Minutes for 100. Leaves scale.md, scale.json and
    scale.svg in the output folder. Exit status: 0, 2 for input that cannot be used.
    """
    _one_thread()
    from rich.console import Console

    from sitl.scale.command import ScaleOptions, parse_drones, run_scale

    run_scale(out, ScaleOptions(parse_drones(drones), loss, seed), Console())


@click.command()
@click.argument("recordings", nargs=-1, required=True, metavar="RECORDING...", type=FOLDER)
@click.option(
    "--starts",
    default=8,
    show_default=True,
    type=click.IntRange(min=1),
    metavar="N",
    help="Instants of each recording that maps are begun at, at most.",
)
@click.option(
    "--extensions",
    default=5,
    show_default=True,
    type=click.IntRange(min=0),
    metavar="N",
    help="Of each map, at most.",
)
@click.option(
    "--novelty",
    default=5.0,
    show_default=True,
    type=click.FloatRange(min=0.0, max=90.0, min_open=True),
    metavar="DEG",
    help="How newly a map looks before it is extended: 5 as in flight, fewer for more often.",
)
@click.option(
    "--alone",
    default=3.0,
    show_default=True,
    type=click.FloatRange(min=0.0, max=600.0),
    metavar="SECONDS",
    help="For how long drones then go on by their own frames alone.",
)
@click.option("--seed", default=0, show_default=True, type=click.IntRange(min=0))
@click.option(
    "--out", default=Path("out/consistency"), show_default=True, metavar="DIR", type=FOLDER
)
def consistency(
    recordings: tuple[Path, ...],
    starts: int,
    extensions: int,
    novelty: float,
    alone: float,
    seed: int,
    out: Path,
) -> None:
    """Measure whether maps and poses err as much as they say, by many maps of each RECORDING.

    A flight is one draw of its map's error. Here maps are begun at many instants of a
    recording and extended from there, and frames are followed on them, without daemons and as
    fast as can be: a minute for ten maps. Leaves consistency.md and consistency.json in the
    output folder. Exit status: 0, whatever was measured; 2 for input that cannot be used.
    """
    _one_thread()
    from rich.console import Console

    from sitl.consistency.command import ConsistencyOptions
    from sitl.consistency.command import consistency as measured
    from sitl.consistency.report import show_consistency

    console = Console()
    options = ConsistencyOptions(starts, extensions, novelty, seed, alone)
    report = measured(recordings, out, options, lambda text: console.out(text, highlight=False))
    show_consistency(console, report, out)
