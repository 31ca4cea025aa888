"""The command ``vcl``."""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vcl_companion.errors import ConfigError, VclError

if TYPE_CHECKING:
    from vcl_companion.config import LogOptions

# sd-daemon(3): journald reads the severity from the start of a line on standard error.
_JOURNAL_PRIORITIES = {
    logging.DEBUG: 7,
    logging.INFO: 6,
    logging.WARNING: 4,
    logging.ERROR: 3,
    logging.CRITICAL: 2,
}


class _Commands(click.Group):
    """A group whose expected failures are one line and exit status 2, never a traceback."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except VclError as error:
            _tell(error)
            ctx.exit(2)


def _tell(error: VclError) -> None:
    click.echo(f"vcl: {' '.join(str(error).split())}", err=True)


class _JournalFormatter(logging.Formatter):
    """Every line with its severity; the journal adds the time itself."""

    def format(self, record: logging.LogRecord) -> str:
        prefix = f"<{_JOURNAL_PRIORITIES.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines())


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


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="vcl-companion", prog_name="vcl")
def main() -> None:
    """Collaborative visual localization for drones, as a MAVLink companion service."""


@main.command()
@click.option(
    "--config",
    "config_path",
    required=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="The daemon's configuration (systemd/vcl-companion.toml documents every setting).",
)
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
        _tell(error)
        status = 2
    # A worker may still be deep in OpenCV. The interpreter, ending, would cut its thread
    # off there, which C++ answers with an abort; everything is closed and flushed by now.
    logging.shutdown()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


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
