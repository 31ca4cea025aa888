"""The result of ``bench speed`` and ``bench realtime`` as JSON, as Markdown and on the terminal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from sitl.bench.figures import Figure
from sitl.bench.machine import machine
from sitl.bench.speed_growth import COLUMNS, CostTable
from sitl.tables import broken, print_table

_HOW = (
    "Processor time of one thread, where nothing else is said; what stands in one table was "
    "measured in turns. A growth is the exponent of the power law through the column: 1 is "
    "linear."
)
_COST_HEAD = ("size", "in view", "tracking ms", "relocalization ms", "prepare ms", "memory MB",
              "poses right %")  # fmt: skip
_MARKS = {True: "met", False: "MISSED", None: ""}


def write_speed(out: Path, figures: Sequence[Figure], tables: Sequence[CostTable]) -> None:
    """Write ``speed.json`` and ``speed.md``."""
    report = {
        "machine": machine(),
        "figures": [_figure_report(figure) for figure in figures],
        "tables": [
            {
                **asdict(table),
                "growth": {growth.of: _number(growth.exponent) for growth in table.growths()},
            }
            for table in tables
        ],
    }
    lines = ["# Speed", "", f"{_HOW} {machine()}.", ""]
    if figures:
        lines += _figures_markdown(figures)
    for table in tables:
        lines += ["", f"## Costs by {table.title}", "", table.note, ""]
        lines += ["| " + " | ".join(_COST_HEAD) + " |", "|---" + "|---:" * 6 + "|"]
        lines += ["| " + " | ".join(row) + " |" for row in _cost_cells(table)]
    _write(out / "speed", report, lines)


def write_realtime(out: Path, daemons: dict[str, tuple[Figure, ...]], how: str) -> None:
    """Write ``realtime.json`` and ``realtime.md``."""
    report = {
        "machine": machine(),
        "how": how,
        "daemons": {
            name: [_figure_report(f) for f in figures] for name, figures in daemons.items()
        },
    }
    lines = ["# In the time of the cameras", "", f"{how} {machine()}.", ""]
    for name, figures in daemons.items():
        lines += [f"## {name}", "", *_figures_markdown(figures), ""]
    _write(out / "realtime", report, lines)


def show_figures(console: Console, figures: Sequence[Figure], title: str = "") -> None:
    """Print numbers and whether their goals are met; a missed one in red."""
    heads = (title or "what", "measured", "goal", "", "how")
    styles = ["bold red" if figure.met is False else None for figure in figures]
    print_table(console, heads, [*map(_figure_cells, figures)], wraps=(0, 3, 4), styles=styles)


def show_costs(console: Console, tables: Iterable[CostTable]) -> None:
    """Print costs by size, and how they grow."""
    for cost in tables:
        heads = (cost.title, *map(broken, _COST_HEAD[1:]))
        print_table(console, heads, _cost_cells(cost))


def show_where(console: Console, path: Path) -> None:
    """Print where the report is."""
    console.print(f"report: {path}", markup=False, highlight=False, soft_wrap=True)


def _figures_markdown(figures: Sequence[Figure]) -> list[str]:
    lines = ["| what | measured | goal | | how |", "|---|---:|---:|---|---|"]
    return lines + ["| " + " | ".join(_figure_cells(figure)) + " |" for figure in figures]


def _figure_cells(figure: Figure) -> tuple[str, str, str, str, str]:
    goal = ""
    if figure.goal is not None:
        goal = f"{'>=' if figure.at_least else '<='} {figure.goal:g}"
    return (
        figure.name,
        f"{_digits(figure.value)} {figure.unit}".rstrip(),
        goal,
        _MARKS[figure.met],
        figure.note,
    )


def _figure_report(figure: Figure) -> dict[str, Any]:
    return {**asdict(figure), "value": _number(figure.value), "met": figure.met}


def _cost_cells(table: CostTable) -> list[tuple[str, ...]]:
    rows = [
        (row.name, f"{row.in_view:.0f}", *map(_digits, row.costs), f"{100.0 * row.right:.0f}")
        for row in table.rows
    ]
    growths = {growth.of: growth.exponent for growth in table.growths()}
    rows.append(("growth", "", *(f"^{round(growths[name], 2) + 0.0:.2f}" for name in COLUMNS), ""))
    return rows


def _digits(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _write(path: Path, report: dict[str, Any], lines: Sequence[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    path.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
