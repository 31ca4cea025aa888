"""Make recordings: ``render`` and ``import``."""

from __future__ import annotations

from pathlib import Path

import click

from sitl.commands.options import FOLDER


@click.command()
@click.argument("scenario")
@click.option("--out", required=True, metavar="DIR", type=FOLDER, help="A new or empty folder.")
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


@click.group(name="import")
def import_() -> None:
    """Turn recordings of other makers into ours."""


@import_.command()
@click.argument("source", type=FOLDER)
@click.option("--out", required=True, metavar="DIR", type=FOLDER, help="A new or empty folder.")
def airsim(source: Path, out: Path) -> None:
    """Import SOURCE, an AirSim folder with airsim_rec.txt; settings.json lies there or above."""
    from vcl_companion.recording.airsim import import_airsim

    import_airsim(source, out)
    click.echo(f"recording: {out}")


@import_.command()
@click.argument("sequence", type=FOLDER)
@click.option("--poses", metavar="FILE", type=FOLDER, help="The sequence's true poses, NN.txt.")
@click.option("--out", required=True, metavar="DIR", type=FOLDER, help="A new or empty folder.")
def kitti(sequence: Path, poses: Path | None, out: Path) -> None:
    """Import SEQUENCE, a KITTI odometry folder (sequences/NN), as a recording of one drone."""
    from vcl_companion.recording.kitti import import_kitti

    import_kitti(sequence, poses, out)
    click.echo(f"recording: {out}")
