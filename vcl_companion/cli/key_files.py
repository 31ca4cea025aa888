"""``vcl keys``: make, install and show the key that drones sign with."""

from __future__ import annotations

from pathlib import Path

import click

from vcl_companion.errors import ConfigError


@click.group()
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
