"""What a person sees while a swarm flies: a bar, then a table; plain lines into a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.table import Table

from sitl.fly import Progress
from sitl.goals import Goal


@contextmanager
def progress_shown(console: Console) -> Iterator[Progress]:
    """Show progress as a bar on a terminal, as one line per stage elsewhere."""
    if not console.is_terminal:
        yield _line_per_stage(console)
        return
    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(bar_width=40),
        MofNCompleteColumn(),
        TextColumn("frames"),
        TimeElapsedColumn(),
    )
    with Bar(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)

        def show(stage: str, done: int, total: int) -> None:
            if total:
                bar.update(task, description=stage, completed=done, total=total)
            else:
                bar.update(task, description=stage)

        yield show


def _line_per_stage(console: Console) -> Progress:
    last = ""

    def show(stage: str, done: int, total: int) -> None:
        nonlocal last
        if stage != last:
            last = stage
            console.print(f"{stage}: {total} frames" if total else stage, highlight=False)

    return show


def show_report(console: Console, report: Mapping[str, Any], out: Path) -> None:
    """Print a flight's table, what needs attention, and where the report is."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    table.add_column("drone", no_wrap=True)
    for title in (
        "frames", "localized\n%", "refused", "dropped", "ATE\nm", "aligned\nm",
        "yaw\ndeg", "p50\nms", "p99\nms", "CPU\n%", "RSS\nMB",
    ):  # fmt: skip
        table.add_column(title, justify="right", no_wrap=True)
    for name, drone in report["drones"].items():
        table.add_row(
            name,
            str(drone["frames"]),
            f"{100.0 * drone['localized_share']:.1f}",
            str(drone["frames_refused"]),
            str(drone["frames_dropped"]),
            _number(drone["ate_m"], 3),
            _number(drone["ate_aligned_m"], 3),
            _number(drone["yaw_rmse_deg"], 2),
            _number(drone["latency_ms"]["p50"], 1),
            _number(drone["latency_ms"]["p99"], 1),
            _number(None if drone["cpu_share"] is None else 100.0 * drone["cpu_share"], 0),
            _number(drone["resident_mb"], 0),
        )
    console.print(table)
    for event in report["events"]:
        if event["kind"] == "harness":
            text = f"ATTENTION {event['drone']}: {event['reason']}"
            console.print(text, style="bold red", markup=False, highlight=False)
    console.print(f"report: {out / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


def show_goals(console: Console, goals: Mapping[str, Sequence[Goal]], out: Path) -> None:
    """Print what had to be shown and whether it was, and where the page is."""
    for pipeline, rows in goals.items():
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
        for title in ("flight", "shows", "goal", pipeline, ""):
            table.add_column(title, no_wrap=title in ("flight", ""))
        for row in rows:
            mark = {"met": "[green]met", "not met": "[red]not met"}.get(row.verdict, row.verdict)
            texts = (row.experiment or "all", row.what, row.goal, row.measured)
            table.add_row(*(escape(text) for text in texts), mark)
        console.print(table)
    console.print(f"page: {out / 'paper.html'}", markup=False, highlight=False, soft_wrap=True)


def _number(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"
