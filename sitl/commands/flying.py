"""Fly a recording, or missions: ``fly`` and ``live``."""

from __future__ import annotations

from pathlib import Path

import click

from sitl.commands.options import (
    FOLDER,
    PIPELINES,
    blind_option,
    drones_option,
    parameters_option,
    settings_option,
    speed_option,
    start_timeout_option,
)
from vcl_companion.errors import ConfigError


@click.command()
@click.argument("recording", metavar="[RECORDING]", default="demo", type=FOLDER)
@click.option("--out", required=True, metavar="DIR", type=FOLDER, help="Results; made if absent.")
@click.option(
    "--autopilot",
    metavar="ardupilot=FILE|px4=FOLDER",
    help="A real firmware built for simulation, in the stand-in's place.",
)
@parameters_option
@speed_option
@drones_option
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
    type=FOLDER,
    help="Send the attitude streams of an earlier flight again: its --out.",
)
@click.option(
    "--seed",
    default=0,
    show_default=True,
    help="Of the noise of the attitude made from the truth, and of the network.",
)
@start_timeout_option(30.0)
@settings_option
@click.option(
    "--pipeline",
    type=click.Choice(PIPELINES),
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
    type=float,
    metavar="S",
    help="A datagram that would wait for longer for its transmission is dropped, with --rate; "
    "0.5 if not given.",
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
@blind_option
def fly(
    recording: Path,
    out: Path,
    autopilot: str | None,
    parameters: tuple[str, ...],
    speed: float,
    drones: tuple[str, ...],
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
    queue: float | None,
    partitions: tuple[str, ...],
    late: tuple[str, ...],
    kills: tuple[str, ...],
    blind: tuple[str, ...],
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

    from sitl.absences import parse_blind, parse_kill, parse_late
    from sitl.embedded import DEMO
    from sitl.firmware import parse_firmware
    from sitl.fly import fly as fly_recording
    from sitl.known_distances import parse_known_distance
    from sitl.network import NetworkOptions
    from sitl.partitions import parse_partition
    from sitl.plan import FlyOptions, parse_setting, pipeline_setting
    from sitl.terminal import progress_shown, show_report

    if parameters and not autopilot:
        raise ConfigError("--parameter: is for a real --autopilot; the stand-in takes none")
    if queue is not None and rate is None:
        raise ConfigError("--queue says how long datagrams wait for the --rate; give one")
    options = FlyOptions(
        speed=speed,
        attitude=attitude,
        known_distances=tuple(map(parse_known_distance, distances)),
        drones=drones,
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
            queue_s=NetworkOptions.queue_s if queue is None else queue,
            partitions=tuple(map(parse_partition, partitions)),
        ),
        absences=(*map(parse_late, late), *map(parse_kill, kills)),
        blind=tuple(map(parse_blind, blind)),
        firmware=parse_firmware(autopilot, parameters) if autopilot else None,
    )
    embedded = str(recording) == "demo" and not recording.exists()
    console = Console()
    with progress_shown(console) as progress:
        report = fly_recording(DEMO if embedded else recording, out, options, progress)
    show_report(console, report, out)


@click.command()
@click.argument("scenario")
@click.option("--out", required=True, metavar="DIR", type=FOLDER, help="Results; made if absent.")
@click.option(
    "--autopilot",
    metavar="ardupilot=FILE|px4=FOLDER",
    required=True,
    help="A real firmware built for simulation.",
)
@parameters_option
@speed_option
@drones_option
@click.option(
    "--map",
    "map_of",
    metavar="DIR",
    type=FOLDER,
    help="Begin with the last map of an earlier flight: its --out. One drone alone needs one.",
)
@start_timeout_option(60.0)
@blind_option
@settings_option
def live(
    scenario: str,
    out: Path,
    autopilot: str,
    parameters: tuple[str, ...],
    speed: float,
    drones: tuple[str, ...],
    map_of: Path | None,
    start_timeout: float,
    blind: tuple[str, ...],
    settings: tuple[str, ...],
) -> None:
    """Fly the missions of SCENARIO without GPS (a TOML file, or the name of an embedded one).

    A model of a quad flies as the firmware commands, what its camera sees is rendered, and its
    estimator has nothing but our poses. Leaves what a flight leaves, and DIR/recording, to be
    flown again. Exit status: 0, 2 for input that cannot be used, 1 when a process ended.
    """
    from rich.console import Console

    from sitl.absences import parse_blind
    from sitl.firmware import parse_firmware
    from sitl.live import fly_live
    from sitl.plan import FlyOptions, parse_setting
    from sitl.scenario import load_scenario
    from sitl.terminal import progress_shown, show_report

    options = FlyOptions(
        speed=speed,
        drones=drones,
        start_timeout_s=start_timeout,
        settings=tuple(map(parse_setting, settings)),
        blind=tuple(map(parse_blind, blind)),
        firmware=parse_firmware(autopilot, parameters),
    )
    console = Console()
    with progress_shown(console) as progress:
        report = fly_live(load_scenario(scenario), out, options, progress, map_of)
    show_report(console, report, out)
