"""The command ``vcl``."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from vcl_companion.errors import ConfigError, VclError
from vcl_companion.one_line import OneLineGroup, tell

if TYPE_CHECKING:
    from vcl_companion.config import LogOptions

_Function = TypeVar("_Function", bound=Callable[..., Any])

# sd-daemon(3): journald reads the severity from the start of a line on standard error.
_JOURNAL_PRIORITIES = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}


class _JournalFormatter(logging.Formatter):
    """Every line with its severity; the journal adds the time itself."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{_JOURNAL_PRIORITIES.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines())


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


def set_up_logging(options: LogOptions) -> None:
    """Send messages from ``options.level`` up to standard error, in journald's form under it."""
    # The compiler tells of every instruction.
    logging.getLogger("numba").setLevel(logging.WARNING)
    handler = logging.StreamHandler(sys.stderr)
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(_JournalFormatter("%(name)s: %(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=options.level.upper(), handlers=[handler], force=True)


@click.group(cls=OneLineGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="vcl-companion", prog_name="vcl")
def main() -> None:
    """Collaborative visual localization for drones, as a MAVLink companion service."""


@main.command()
@_config_option("The daemon's configuration (systemd/vcl-companion.toml documents every setting).")
def run(config_path: Path) -> None:
    """Run the daemon of one drone until SIGTERM or Ctrl-C.

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
    sys.stdout.flush()
    sys.stderr.flush()
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
@click.option("--yes", is_flag=True, help="With --fix or --restore: do not ask.")
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
    from vcl_companion.daemon.parameter_backup import read_before, write_before

    if sum((as_json, fix, restore)) > 1:
        raise ConfigError("check: --json, --fix and --restore are each for themselves")
    config = load_config(config_path)
    kept = config_path.with_suffix(".parameters.json")
    context = click.get_current_context()
    if restore:
        wanted = read_before(kept)
    else:
        asks = sys.stdin.isatty() and not (as_json or yes)
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
    before, failed = asyncio.run(set_parameters(config, wanted))
    if restore and not failed:
        kept.unlink()
    elif not restore and before:
        write_before(kept, before)
        click.echo(f"{kept}: what they were; --restore puts it back")
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


@main.group()
def ground() -> None:
    """Ask drones for things from the ground, over their telemetry."""


def _a_number(_context: click.Context, _option: click.Parameter, value: float) -> float:
    """Refuse NaN, which lies in every range as it lies outside of none."""
    if math.isnan(value):
        raise click.BadParameter("nan is no number of seconds")
    return value


def _to_drones(within_s: float) -> Callable[[_Function], _Function]:
    """Return the options of an order: to which drones it goes, and how long they have."""
    options = (
        click.option(
            "--link",
            "links",
            multiple=True,
            default=("udpin:0.0.0.0:14550",),
            show_default=True,
            metavar="LINK",
            help="Where drones are heard, as autopilot.link: udpin:, udp:, tcp:, serial: "
            "(repeatable).",
        ),
        click.option(
            "--drone",
            "drones",
            multiple=True,
            type=click.IntRange(1, 255),
            metavar="N",
            help="System id (repeatable); otherwise all that are heard.",
        ),
        click.option(
            "--within",
            "within_s",
            default=within_s,
            show_default=True,
            metavar="S",
            type=click.FloatRange(1.0, 3600.0),
            callback=_a_number,
            help="How long they have.",
        ),
    )

    def add(function: _Function) -> _Function:
        for option in reversed(options):
            function = option(function)
        return function

    return add


def _order(name: str, links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
    """Give drones an order and follow it; exit with 0 when all have done it, 1 when not."""
    import asyncio

    from vcl_companion.ground.orders import ORDERS, Ordering, Told

    def tell(told: Told) -> None:
        click.echo(f"drone {told.system_id}: {told.text}")

    is_done = asyncio.run(Ordering(ORDERS[name], links, drones, within_s, tell).run())
    click.get_current_context().exit(0 if is_done else 1)


@ground.command("update-map")
@_to_drones(within_s=90.0)
def ground_update_map(links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
    """Have drones update their map now, and follow it to the end; Ctrl-C cancels it.

    Exit status: 0 when all of them have a new map, 1 when not, 2 when nobody is heard.
    """
    _order("update-map", links, drones, within_s)


@ground.command("save-map")
@_to_drones(within_s=30.0)
@click.option("--forget", is_flag=True, help="Forget the saved map: the next start makes one.")
def ground_save_map(
    links: tuple[str, ...], drones: tuple[int, ...], within_s: float, forget: bool
) -> None:
    """Have drones save the map that they fly on, to begin with it after a restart.

    Exit status: 0 when all of them have, 1 when not, 2 when nobody is heard.
    """
    _order("forget-map" if forget else "save-map", links, drones, within_s)


@ground.command("reload-map")
@_to_drones(within_s=30.0)
def ground_reload_map(links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
    """Have drones go back to the map that they have saved, and look for where they are in it.

    Exit status: 0 when all of them fly on it, 1 when not, 2 when nobody is heard.
    """
    _order("reload-map", links, drones, within_s)


@ground.command("relocalize")
@_to_drones(within_s=30.0)
def ground_relocalize(links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
    """Have drones forget where they are, and look for it anew.

    Exit status: 0 when all of them do, 1 when not, 2 when nobody is heard.
    """
    _order("relocalize", links, drones, within_s)


@ground.command("pause")
@_to_drones(within_s=30.0)
def ground_pause(links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
    """Have drones send their autopilots no poses, until they are resumed.

    Exit status: 0 when all of them hold them back, 1 when not, 2 when nobody is heard.
    """
    _order("pause", links, drones, within_s)


@ground.command("resume")
@_to_drones(within_s=30.0)
def ground_resume(links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
    """Have drones send their autopilots poses again.

    Exit status: 0 when all of them do, 1 when not, 2 when nobody is heard.
    """
    _order("resume", links, drones, within_s)


@main.group()
def keys() -> None:
    """Make, install and look at the key that drones sign with."""


@keys.command("new")
@click.argument("file", type=click.Path(path_type=Path))
def new_key(file: Path) -> None:
    """Make a key in FILE, which must not be there yet.

    Keep it as you would a password, and bring it to each drone by cable.
    """
    from vcl_companion.links.key_file import make_key_file

    key = make_key_file(file)
    click.echo(f"{file}: key {key.fingerprint}")


@keys.command("install")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--config",
    "config_path",
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The configuration of the daemon that is to use it: goes where peers.key_file says.",
)
@click.option(
    "--to",
    "directory",
    metavar="DIRECTORY",
    type=click.Path(path_type=Path),
    help="Goes there instead, under its own name.",
)
def install_key(file: Path, config_path: Path | None, directory: Path | None) -> None:
    """Copy the key in FILE to where a daemon looks for it.

    With --config the copy belongs to the owner and group of the configuration, so that who
    can read that, and nobody else, can read the key; else to who runs this, alone.
    """
    from vcl_companion.links.key_file import install_key_file

    if (config_path is None) == (directory is None):
        raise ConfigError("keys install: give either --config or --to")
    if config_path is not None:
        from vcl_companion.config import load_config

        key_file = load_config(config_path).peers.key_file
        if not key_file:
            raise ConfigError(f"{config_path}: [peers] key_file: is not set; name the file there")
        target = Path(key_file)
    else:
        assert directory is not None
        target = directory / file.name
    key = install_key_file(file, target, like=config_path)
    click.echo(f"{target}: key {key.fingerprint}")


@keys.command("show")
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--secret",
    is_flag=True,
    help="Print the secret itself: the passphrase for QGroundControl and MAVProxy.",
)
def show_key(file: Path, secret: bool) -> None:
    """Print the fingerprint of the key in FILE: the same on every drone of a swarm."""
    from vcl_companion.links.key_file import read_key_file, read_passphrase

    click.echo(f"{file}: key {read_key_file(file).fingerprint}")
    if secret:
        click.echo(f"passphrase: {read_passphrase(file)}")


if __name__ == "__main__":
    main(prog_name="vcl")
