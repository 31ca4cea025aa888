"""The command ``python -m sitl``: render scenes, import recordings, fly them, measure."""

from __future__ import annotations

import signal
import sys

import click

from sitl.commands.flying import fly, live
from sitl.commands.measuring import bench, consistency, paper, scale, torture
from sitl.commands.recordings import import_, render
from vcl_companion.errors import VclError
from vcl_companion.one_line import OneLineGroup


class _Commands(OneLineGroup):
    """A group whose failures are one line: 2 for bad input, 1 for a flight that broke off."""

    speaker = "sitl"

    def status_of(self, error: VclError) -> int:
        from sitl.processes import FlightError

        return 1 if isinstance(error, FlightError) else 2


@click.group(cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Fly a swarm in software: real daemons, stand-in autopilots, recorded or rendered images."""


for command in (fly, live, render, paper, bench, torture, scale, consistency, import_):
    main.add_command(command)

if __name__ == "__main__":
    # As Ctrl-C does: through every ``finally``, which clears what is half made.
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    main(prog_name="python -m sitl")
