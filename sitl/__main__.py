"""The command ``python -m sitl``: render scenes, import recordings, fly them, measure."""

from __future__ import annotations

from typing import Any

import click

from sitl.commands.flying import fly, live
from sitl.commands.measuring import bench, consistency, paper, scale, torture
from sitl.commands.recordings import import_, render
from vcl_companion.errors import VclError


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


for command in (fly, live, render, paper, bench, torture, scale, consistency, import_):
    main.add_command(command)

if __name__ == "__main__":
    main(prog_name="python -m sitl")
