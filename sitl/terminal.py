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

from sitl.flown_mission import MISSION_COLUMNS
from sitl.fly import Progress
from sitl.fused import FUSED_COLUMNS
from sitl.goals import Goal
from sitl.lives_report import LIFE_COLUMNS, life_rows
from sitl.network_report import DELAYS, NETWORK_COLUMNS, delay_text, message_rows
from sitl.page_style import Column, cells
from sitl.phases import PHASE_COLUMNS, phase_rows
from sitl.tables import broken, print_table


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
    heads = (
        "drone", "frames", "localized\n%", "refused", "dropped", "ATE\nm", "aligned\nm",
        "yaw\ndeg", "p50\nms", "p99\nms", "CPU\n%", "RSS\nMB",
    )  # fmt: skip
    rows = [
        (
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
        for name, drone in report["drones"].items()
    ]
    print_table(console, heads, rows)
    _show_parts(console, report, "fused", "autopilot", FUSED_COLUMNS)
    _show_parts(console, report, "mission", "drone", MISSION_COLUMNS)
    lives = life_rows(report)
    if lives:
        print_table(
            console,
            ["daemon", *(broken(label) for _, label in LIFE_COLUMNS)],
            [(name, *(_number(value, 2) for value in values)) for name, values in lives],
        )
    phases = phase_rows(report)
    if phases:
        print_table(
            console,
            ["phase", "drone", *(broken(label) for _, label, _ in PHASE_COLUMNS)],
            [(phase, name, *texts) for phase, name, texts in phases],
            keys=2,
        )
    _show_network(console, report)
    for event in report["events"]:
        if event["kind"] == "harness":
            text = f"ATTENTION {event['drone']}: {event['reason']}"
            console.print(text, style="bold red", markup=False, highlight=False)
    console.print(f"report: {out / 'report.html'}", markup=False, highlight=False, soft_wrap=True)


def _show_parts(
    console: Console, report: Mapping[str, Any], part: str, whose: str, columns: Sequence[Column]
) -> None:
    """Print one part of each drone's report, if there is one."""
    said = {name: drone[part] for name, drone in report["drones"].items() if drone[part]}
    if not said:
        return
    heads = (whose, *(broken(label) for _, label, _, _ in columns))
    rows = [(name, *cells(columns, values, none="-")) for name, values in said.items()]
    # A mission that went wrong says how, in a sentence.
    sentences = [k for k, (_, _, form, _) in enumerate(columns, 1) if form == "{}"]
    print_table(console, heads, rows, wraps=sentences)


def _show_network(console: Console, report: Mapping[str, Any]) -> None:
    """Print what the drones sent each other, and what became of it, if it was counted."""
    messages = message_rows(report)
    if not messages:
        return
    drones = report["drones"]
    heads = ("to peers", "messages", "payload\nkB", "wire\nkB", "%", "B/s")
    rows = [
        (
            row.name,
            str(row.messages),
            _number(row.payload_bytes / 1e3, 1),
            _number(row.wire_bytes / 1e3, 1),
            _number(100.0 * row.share, 1),
            _number(row.wire_bytes_per_s, 0),
            *(_number(n / 1e3, 1) for n in row.by_drone),
        )
        for row in messages
    ]
    print_table(console, (*heads, *(f"{name}\nkB" for name in drones)), rows)
    labels = (broken(label) for _, label in NETWORK_COLUMNS)
    said = {name: drone["peer_link"]["network"] for name, drone in drones.items()}
    fates = [
        (
            name,
            *(str(network[key]) for key, _ in NETWORK_COLUMNS),
            *(delay_text(network[key]) for key in DELAYS),
        )
        for name, network in said.items()
    ]
    print_table(console, ("network", *labels, "delay\nms", "longest\nms"), fates)


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
