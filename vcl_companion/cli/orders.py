"""``vcl ground``: orders to drones from the ground."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeVar

import click

_Function = TypeVar("_Function", bound=Callable[..., Any])


@click.group()
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


def _plain(name: str, within_s: float, help_text: str) -> None:
    """Add the command of an order that takes no more than to whom it goes, and within what time."""

    @ground.command(name, help=help_text)
    @_to_drones(within_s)
    def order(links: tuple[str, ...], drones: tuple[int, ...], within_s: float) -> None:
        _order(name, links, drones, within_s)


_plain(
    "update-map",
    90.0,
    """Have drones update their map now, and follow it to the end; Ctrl-C cancels it.

    Exit status: 0 when all of them have a new map, 1 when not, 2 when nobody is heard.
    """,
)
_plain(
    "reload-map",
    30.0,
    """Have drones go back to the map that they have saved, and look for where they are in it.

    Exit status: 0 when all of them fly on it, 1 when not, 2 when nobody is heard.
    """,
)
_plain(
    "relocalize",
    30.0,
    """Have drones forget where they are, and look for it anew.

    Exit status: 0 when all of them do, 1 when not, 2 when nobody is heard.
    """,
)
_plain(
    "pause",
    30.0,
    """Have drones send their autopilots no poses, until they are resumed.

    Exit status: 0 when all of them hold them back, 1 when not, 2 when nobody is heard.
    """,
)
_plain(
    "resume",
    30.0,
    """Have drones send their autopilots poses again.

    Exit status: 0 when all of them do, 1 when not, 2 when nobody is heard.
    """,
)


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
