"""What several commands may be told."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

_Command = TypeVar("_Command", bound=Callable[..., Any])

FOLDER = click.Path(path_type=Path)
PIPELINES = ("default", "paper")


def speed(_: click.Context, param: click.Parameter, value: str | None) -> float | None:
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


parameters_option = click.option(
    "--parameter",
    "parameters",
    multiple=True,
    metavar="NAME=VALUE",
    help="Of the real --autopilot, set before it starts (repeatable).",
)
speed_option = click.option(
    "--speed",
    default="1",
    show_default=True,
    metavar="X|max",
    callback=speed,
    help="Seconds of the flight per second, or max: as fast as all daemons keep up, their maps "
    "included.",
)


def _names(_: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Return the names between commas; none when it was not given."""
    names = tuple(name.strip() for name in (value or "").split(",") if name.strip())
    if value is not None and not names:
        raise click.BadParameter(f"{value!r} names nobody", param=param)
    return names


drones_option = click.option(
    "--drones",
    metavar="mav0,mav1",
    callback=_names,
    help="Only these fly; otherwise all of them.",
)
blind_option = click.option(
    "--blind",
    multiple=True,
    metavar="mav0=12-20",
    help="A drone's camera gives nothing from a second on, or between two (repeatable).",
)
settings_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="SECTION.KEY=VALUE",
    help="More of the daemons' configuration, the value in TOML's notation (repeatable).",
)


def start_timeout_option(default_s: float) -> Callable[[_Command], _Command]:
    """Return --start-timeout with a default."""
    return click.option(
        "--start-timeout",
        default=default_s,
        show_default=True,
        metavar="S",
        help="How long the daemons have to come up, and again to make the first map.",
    )
