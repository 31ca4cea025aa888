"""The command ``python -m sitl``: render scenes, import recordings, fly them, measure."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any, Literal

import click

from vcl_companion.errors import VclError

_DEMO = Path(__file__).parent / "recordings" / "demo"
_FOLDER = click.Path(path_type=Path)
_PIPELINES = ("default", "paper")


def _speed(_: click.Context, param: click.Parameter, value: str | None) -> float | None:
    """Return ``max`` as infinity, else a positive number; None when it was not given."""
    if value is None:
        return None
    try:
        speed = math.inf if value == "max" else float(value)
    except ValueError:
        speed = math.nan
    if not speed > 0.0:
        raise click.BadParameter(f"{value!r} is neither a positive number nor max", param=param)
    return speed


_parameters = click.option(
    "--parameter",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="Of the real --autopilot, set before it starts (repeatable).",
)
_speed_option = click.option(
    "--speed",
    default="1",
    show_default=True,
    metavar="X|max",
    callback=_speed,
    help="Seconds of the flight per second, or max: as fast as all daemons keep up.",
)
_drones = click.option(
    "--drones", default="", metavar="mav0,mav1", help="Only these fly; otherwise all of them."
)
_settings = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="More of the daemons' configuration, the value in TOML's notation (repeatable).",
)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


class _Commands(click.Group):
    """A group whose failures are one line: 2 for bad input, 1 for a flight that broke off."""

    def invoke(self, ctx: click.Context) -> Any:
        from sitl.processes import FlightError

        try:
            return super().invoke(ctx)
        except VclError as error:
            click.echo(f"sitl: {' '.join(str(error).split())}", err=True)
            ctx.exit(1 if isinstance(error, FlightError) else 2)
        except KeyboardInterrupt:
            click.echo("sitl: interrupted", err=True)
            ctx.exit(130)


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Fly a swarm in software: real daemons, stand-in autopilots, recorded or rendered images."""


@main.command()
@click.argument("recording", metavar="[RECORDING]", default="demo", type=_FOLDER)
@click.option("--out", required=True, metavar="DIR", type=_FOLDER, help="Results; made if absent.")
@click.option(
    "--autopilot",
    metavar="ardupilot=FILE|px4=FOLDER",
    help="A real firmware built for simulation, in the stand-in's place.",
)
@_parameters
@_speed_option
@_drones
@click.option(
    "--known-distance",
    "distances",
    multiple=True,
    metavar="mav0:mav1=1.63",
    help="Metres between two drones at the start (repeatable), instead of the recording's.",
)
@click.option(
    "--attitude",
    metavar="DIR",
    type=_FOLDER,
    help="Send the attitude streams of an earlier flight again: its --out.",
)
@click.option(
    "--seed",
    default=0,
    show_default=True,
    help="Of the noise of the attitude made from the truth, and of the network.",
)
@click.option(
    "--start-timeout",
    default=30.0,
    show_default=True,
    metavar="S",
    help="How long the daemons have to come up, and again to make the first map.",
)
@_settings
@click.option(
    "--pipeline",
    type=click.Choice(_PIPELINES),
    help="How daemons find their poses; the same as --set pipeline=...; default if not given.",
)
@click.option("--loss", default=0.0, metavar="P", help="Share of the peers' datagrams lost.")
@click.option(
    "--burst", type=float, metavar="N", help="Mean number of datagrams lost in a row, with --loss."
)
@click.option("--delay", default=0.0, metavar="S", help="Seconds that each is on its way.")
@click.option("--jitter", default=0.0, metavar="S", help="Up to so many seconds more.")
@click.option("--reorder", default=0.0, metavar="P", help="Share held back for 50 ms.")
@click.option("--duplicate", default=0.0, metavar="P", help="Share that arrives twice.")
@click.option("--corrupt", default=0.0, metavar="P", help="Share that arrives with wrong bytes.")
@click.option("--rate", type=float, metavar="BIT/S", help="Of each drone's transmitter.")
@click.option("--shared", is_flag=True, help="All drones together have that --rate.")
@click.option(
    "--addressed",
    is_flag=True,
    help="What is for several goes to each by itself; else all hear what one sends.",
)
@click.option(
    "--queue",
    default=0.5,
    show_default=True,
    metavar="S",
    help="A datagram that would wait for longer for its transmission is dropped, with --rate.",
)
@click.option(
    "--partition",
    "partitions",
    multiple=True,
    metavar="10-40:mav0|mav1,mav2",
    help="Groups that do not hear each other, between two seconds of the recording (repeatable).",
)
@click.option(
    "--late",
    "late",
    multiple=True,
    metavar="mav2=8",
    help="Start a drone's daemon only at that second of the recording (repeatable).",
)
@click.option(
    "--kill",
    "kills",
    multiple=True,
    metavar="mav0=12-20",
    help="Kill a drone's daemon (SIGKILL) at a second, and start it again at another (repeatable).",
)
def fly(
    recording: Path,
    out: Path,
    autopilot: str | None,
    parameters: tuple[str, ...],
    speed: float,
    drones: str,
    distances: tuple[str, ...],
    attitude: Path | None,
    seed: int,
    start_timeout: float,
    settings: tuple[str, ...],
    pipeline: str | None,
    loss: float,
    burst: float | None,
    delay: float,
    jitter: float,
    reorder: float,
    duplicate: float,
    corrupt: float,
    rate: float | None,
    shared: bool,
    addressed: bool,
    queue: float,
    partitions: tuple[str, ...],
    late: tuple[str, ...],
    kills: tuple[str, ...],
) -> None:
    """Fly RECORDING (a folder; the embedded demo by default) and report how it went.

    One real daemon and one stand-in autopilot per drone, over real sockets; with --autopilot
    the real firmware, in simulation, whose sensors feel the recording's true motion.
    What the drones say to each other may go over a bad radio: --loss to --partition,
    in seconds of the wall clock whatever the --speed, but for --partition.
    Leaves estimates, truth, report.json and report.html in the output folder.
    Exit status: 0, 2 for input that cannot be used, 1 when a process ended.
    """
    from rich.console import Console

    from sitl.absences import parse_kill, parse_late
    from sitl.firmware import parse_firmware
    from sitl.fly import fly as fly_recording
    from sitl.network import NetworkOptions
    from sitl.partitions import parse_partition
    from sitl.plan import FlyOptions, parse_known_distance, parse_setting, pipeline_setting
    from sitl.terminal import progress_shown, show_report

    options = FlyOptions(
        speed=speed,
        attitude=attitude,
        known_distances=tuple(map(parse_known_distance, distances)),
        drones=_names(drones),
        start_timeout_s=start_timeout,
        settings=(
            *map(parse_setting, settings),
            *([pipeline_setting(pipeline)] if pipeline else []),
        ),
        seed=seed,
        network=NetworkOptions(
            loss=loss,
            burst=burst,
            delay_s=delay,
            jitter_s=jitter,
            reorder=reorder,
            duplicate=duplicate,
            corrupt=corrupt,
            rate_bits_per_s=rate,
            shared=shared,
            addressed=addressed,
            queue_s=queue,
            partitions=tuple(map(parse_partition, partitions)),
        ),
        absences=(*map(parse_late, late), *map(parse_kill, kills)),
        firmware=parse_firmware(autopilot, parameters) if autopilot else None,
    )
    embedded = str(recording) == "demo" and not recording.exists()
    console = Console()
    with progress_shown(console) as progress:
        report = fly_recording(_DEMO if embedded else recording, out, options, progress)
    show_report(console, report, out)


@main.command()
@click.argument("scenario")
@click.option("--out", required=True, metavar="DIR", type=_FOLDER, help="Results; made if absent.")
@click.option(
    "--autopilot",
    metavar="ardupilot=FILE|px4=FOLDER",
    required=True,
    help="A real firmware built for simulation.",
)
@_parameters
@_speed_option
@_drones
@click.option(
    "--map",
    "map_of",
    metavar="DIR",
    type=_FOLDER,
    help="Begin with the last map of an earlier flight: its --out. One drone alone needs one.",
)
@click.option(
    "--start-timeout",
    default=60.0,
    show_default=True,
    metavar="S",
    help="How long the daemons have to come up, and again to make the first map.",
)
@_settings
def live(
    scenario: str,
    out: Path,
    autopilot: str,
    parameters: tuple[str, ...],
    speed: float,
    drones: str,
    map_of: Path | None,
    start_timeout: float,
    settings: tuple[str, ...],
) -> None:
    """Fly the missions of SCENARIO without GPS (a TOML file, or the name of an embedded one).

    A model of a quad flies as the firmware commands, what its camera sees is rendered, and its
    estimator has nothing but our poses. Leaves what a flight leaves, and DIR/recording, to be
    flown again. Exit status: 0, 2 for input that cannot be used, 1 when a process ended.
    """
    from rich.console import Console

    from sitl.firmware import parse_firmware
    from sitl.live import fly_live
    from sitl.plan import FlyOptions, parse_setting
    from sitl.scenario import load_scenario
    from sitl.terminal import progress_shown, show_report

    options = FlyOptions(
        speed=speed,
        drones=_names(drones),
        start_timeout_s=start_timeout,
        settings=tuple(map(parse_setting, settings)),
        firmware=parse_firmware(autopilot, parameters),
    )
    console = Console()
    with progress_shown(console) as progress:
        report = fly_live(load_scenario(scenario), out, options, progress, map_of)
    show_report(console, report, out)


@main.command()
@click.argument("scenario")
@click.option("--out", required=True, metavar="DIR", type=_FOLDER, help="A new or empty folder.")
def render(scenario: str, out: Path) -> None:
    """Render SCENARIO (a TOML file, or the name of an embedded one) into a recording."""
    from rich.console import Console

    from sitl.render import render_scenario
    from sitl.scenario import load_scenario
    from sitl.terminal import progress_shown

    with progress_shown(Console()) as progress:
        render_scenario(
            load_scenario(scenario), out, lambda done, total: progress("rendering", done, total)
        )
    click.echo(f"recording: {out}")


@main.command()
@click.option("--out", required=True, metavar="DIR", type=_FOLDER, help="Results; made if absent.")
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
    callback=_speed,
    help="Seconds of the recording per second, or max: as fast as all daemons keep up; "
    "otherwise the paper's pipeline at max, the default one so that each of three drones has "
    "a processor and a half of this machine, at most in real time.",
)
@click.option(
    "--recordings",
    metavar="DIR",
    type=_FOLDER,
    help="Where rendered scenarios are kept for other runs too; otherwise DIR/recordings.",
)
@click.option(
    "--seconds",
    type=float,
    metavar="S",
    help="Render and fly only the first S seconds: to try it out; nothing is judged then.",
)
@click.option(
    "--start-timeout",
    default=60.0,
    show_default=True,
    metavar="S",
    help="How long the daemons have to come up, and again to make the first map.",
)
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
    type=click.Choice(_PIPELINES),
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


@main.command()
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
@click.option("--out", default=Path("out/bench"), show_default=True, metavar="DIR", type=_FOLDER)
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
    # One thread for everybody: this counts before numpy is loaded.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from rich.console import Console

    from sitl.bench.command import BenchOptions, run_bench

    run_bench(out, BenchOptions(what, only, seeds, quick), Console())


@main.command()
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
@click.option("--out", default=Path("out/torture"), show_default=True, metavar="DIR", type=_FOLDER)
def torture(
    payloads: int, seed: int, processes: int | None, session: int, only: int | None, out: Path
) -> None:
    """Feed mutated payloads of hostile peers to all that a peer's bytes pass in a daemon.

    From MAVLink frames to maps in use and poses fused, with the daemon's own parts. Nothing
    but a WireError may be raised, and memory may not grow. Exit status: 0, 1 when
    something failed, 2 for input that cannot be used.
    """
    # One thread for everybody: this counts before numpy is loaded.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from rich.console import Console

    from sitl.torture.command import run_torture
    from sitl.torture.report import TortureOptions

    options = TortureOptions(payloads, seed, processes or 0, session)
    if not run_torture(out, options, only, Console()):
        click.get_current_context().exit(1)


@main.command()
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
@click.option("--out", default=Path("out/scale"), show_default=True, metavar="DIR", type=_FOLDER)
def scale(drones: str, loss: float, seed: int, out: Path) -> None:
    """Measure how a drone's bytes and processor time grow with the number of drones.

    All drones live in one process over one lossy channel, by counted time: at rest, and while
    a first map and its update are handed out. Minutes for 100. Leaves scale.md, scale.json and
    scale.svg in the output folder. Exit status: 0, 2 for input that cannot be used.
    """
    # One thread for everybody: this counts before numpy is loaded.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from rich.console import Console

    from sitl.scale.command import ScaleOptions, parse_drones, run_scale

    run_scale(out, ScaleOptions(parse_drones(drones), loss, seed), Console())


@main.group(name="import")
def import_() -> None:
    """Turn recordings of other makers into ours."""


@import_.command()
@click.argument("source", type=_FOLDER)
@click.option("--out", required=True, metavar="DIR", type=_FOLDER, help="A new or empty folder.")
def airsim(source: Path, out: Path) -> None:
    """Import SOURCE, an AirSim folder with airsim_rec.txt; settings.json lies there or above."""
    from vcl_companion.recording.airsim import import_airsim

    import_airsim(source, out)
    click.echo(f"recording: {out}")


@import_.command()
@click.argument("sequence", type=_FOLDER)
@click.option("--poses", metavar="FILE", type=_FOLDER, help="The sequence's true poses, NN.txt.")
@click.option("--out", required=True, metavar="DIR", type=_FOLDER, help="A new or empty folder.")
def kitti(sequence: Path, poses: Path | None, out: Path) -> None:
    """Import SEQUENCE, a KITTI odometry folder (sequences/NN), as a recording of one drone."""
    from vcl_companion.recording.kitti import import_kitti

    import_kitti(sequence, poses, out)
    click.echo(f"recording: {out}")


if __name__ == "__main__":
    main(prog_name="python -m sitl")
