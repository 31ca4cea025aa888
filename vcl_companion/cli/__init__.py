"""The command ``vcl``: a drone's daemon run, looked at and checked; orders and keys are beside."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from vcl_companion.cli.journal import set_up_logging
from vcl_companion.cli.key_files import keys
from vcl_companion.cli.orders import ground
from vcl_companion.errors import ConfigError, VclError
from vcl_companion.one_line import OneLineGroup, tell

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _config_option(help_text: str) -> Callable[[_Function], _Function]:
    """Return the option that names a daemon's configuration."""
    return click.option(
        "--config",
        "config_path",
        required=True,
        metavar="FILE",
        type=click.Path(path_type=Path),
        help=help_text,
    )


@click.group(cls=OneLineGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="vcl-companion", prog_name="vcl")
def main() -> None:
    """Collaborative visual localization for drones, as a MAVLink companion service."""


@main.command()
@_config_option("The daemon's configuration (systemd/vcl-companion.toml documents every setting).")
def run(config_path: Path) -> None:
    """Run the daemon of one drone until SIGTERM, SIGHUP, Ctrl-C or the end of a recording.

    Exit status: 0 after a clean end, 2 when the configuration or a device
    cannot be used, another when it failed.
    """
    # Imported here: `vcl --help` need not load OpenCV and pymavlink, and a broken
    # configuration is told before the daemon's own imports have taken their seconds.
    from vcl_companion.config import load_config

    config = load_config(config_path)
    set_up_logging(config.log)
    from vcl_companion.daemon.assemble import run_daemon

    try:
        status = run_daemon(config)
    except VclError as error:
        tell("vcl", str(error))
        status = 2
    # A worker may still be deep in OpenCV. The interpreter, ending, would cut its thread
    # off there, which C++ answers with an abort; everything is closed and flushed by now.
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as of a program that was started without
            stream.flush()
    os._exit(status)


@main.command()
@_config_option("The configuration of the daemon that runs.")
@click.option("--json", "as_json", is_flag=True, help="As its file has it.")
def status(config_path: Path, as_json: bool) -> None:
    """Say how the running daemon is, and whether the autopilot uses its poses.

    Exit status: 0 when it does, 1 when not, or not any more, 2 when there is nothing to read.
    """
    from vcl_companion.config import load_config
    from vcl_companion.daemon.status import read_status, status_json, status_lines

    file = load_config(config_path).log.status_file
    if not file:
        raise ConfigError(f"{config_path}: [log] status_file: is not set; name a file there")
    said = read_status(Path(file))
    if as_json:
        click.echo(status_json(said), nl=False)
    else:
        click.echo("\n".join(status_lines(said)))
    if not said.is_good:
        click.get_current_context().exit(1)


@main.command()
@_config_option("The configuration of the daemon, which must not run meanwhile.")
@click.option("--json", "as_json", is_flag=True, help="For programs; changes nothing.")
@click.option("--fix", is_flag=True, help="Set the autopilot's parameters that are wrong.")
@click.option("--yes", is_flag=True, help="Ask nothing.")
@click.option("--restore", is_flag=True, help="Put back what --fix has changed.")
@click.option("--tilt", is_flag=True, help="Check the axes as well: turn the drone by hand.")
def check(
    config_path: Path, as_json: bool, fix: bool, yes: bool, restore: bool, tilt: bool
) -> None:
    """Look before flight at what keeps the service and the autopilot from working together.

    With --tilt, drones are held in the hands and turned to all sides: that shows a camera that
    sits otherwise than configured, swapped axes, and images that are stamped late.
    What --fix changes is kept beside the configuration, in NAME.parameters.json.
    Exit status: 0 when nothing failed, 1 when something did, 2 when it cannot be looked at.
    """
    import asyncio

    from vcl_companion.config import load_config
    from vcl_companion.daemon.check import check_all, outcome_json, set_parameters
    from vcl_companion.daemon.parameter_backup import forget_before, read_before, write_before

    if sum((as_json, fix, restore)) > 1:
        raise ConfigError("check: --json, --fix and --restore are each for themselves")
    if restore and tilt:
        raise ConfigError("check: --restore looks at nothing, and --tilt does")
    config = load_config(config_path)
    kept = config_path.with_suffix(".parameters.json")
    context = click.get_current_context()
    if restore:
        wanted = read_before(kept)
    else:
        is_there = sys.stdin is not None and sys.stdin.isatty()
        asks = is_there and not (as_json or yes)
        tilt = tilt or (asks and click.confirm("Turn the drone by hand, to check its axes?"))
        outcome = asyncio.run(check_all(config, _ask_for_tilt if tilt else None))
        if as_json:
            click.echo(outcome_json(outcome))
        else:
            for one in outcome.checks:
                advice = f"; {one.advice}" if one.advice else ""
                click.echo(f"{one.grade:8} {one.name:16} {one.what}{advice}")
        wanted = {found.name: found.should_be for found in outcome.wrong if found.value is not None}
        if not fix or not wanted:
            context.exit(0 if outcome.is_good else 1)
    for name, value in wanted.items():
        click.echo(f"{name} = {value:g}")
    if not yes and not click.confirm("Set these in the autopilot?"):
        context.exit(1)

    def keep(before: Mapping[str, float]) -> None:
        if restore:
            return
        write_before(kept, before)
        click.echo(f"{kept}: what they were; --restore puts it back")

    failed = asyncio.run(set_parameters(config, wanted, keep))
    if restore and not failed:
        forget_before(kept)
    for name in failed:
        click.echo(f"vcl: {name}: the autopilot did not take it", err=True)
    click.echo("Restart the autopilot: some take effect only then.")
    context.exit(1 if failed else 0)


def _ask_for_tilt() -> None:
    click.echo(
        "Hold the drone before what stands still, metres away. Slowly: its nose up and down, "
        "either side down, and turn it, by 30 degrees or more each.",
        err=True,
    )


main.add_command(ground)
main.add_command(keys)
