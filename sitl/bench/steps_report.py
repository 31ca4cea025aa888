"""The result of ``bench steps`` as JSON, as Markdown and as a table on the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from sitl.bench.machine import machine
from sitl.bench.timing import Measured

_HEAD = ("step", "who", "median ms", "p95 ms", "times ours", "accuracy")
_HOW = (
    "Processor time of one thread, repetitions of all entries of a step interleaved; a step's "
    "ratio is to its first entry. A wrong answer has no ratio."
)


def write_steps(out: Path, results: Sequence[Measured]) -> None:
    """Write ``steps.json`` and ``steps.md``."""
    out.mkdir(parents=True, exist_ok=True)
    report = {"machine": machine(), "results": [asdict(result) for result in results]}
    (out / "steps.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    lines = ["# Times of each step", "", f"{_HOW} {machine()}.", ""]
    lines += ["| " + " | ".join(_HEAD) + " |", "|---|---|---:|---:|---:|---|"]
    lines += ["| " + " | ".join(_cells(results, k)) + " |" for k in range(len(results))]
    (out / "steps.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def show_steps(console: Console, results: Sequence[Measured], out: Path) -> None:
    """Print all times; a wrong answer in red."""
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    for k, title in enumerate(_HEAD):
        table.add_column(title, justify="right" if 2 <= k <= 4 else "left", no_wrap=k < 5)
    for k, result in enumerate(results):
        style = None if result.accuracy.right else "bold red"
        table.add_row(*_cells(results, k), style=style)
    console.print(table)
    console.print(f"report: {out / 'steps.md'}", markup=False, highlight=False, soft_wrap=True)


def _cells(results: Sequence[Measured], k: int) -> tuple[str, ...]:
    result = results[k]
    is_first = k == 0 or results[k - 1].step != result.step
    right = result.accuracy.right
    return (
        result.step if is_first else "",
        result.name,
        f"{result.median_ms:.3g}",
        f"{result.p95_ms:.3g}",
        f"{result.ratio:.2f}" if right else "-",
        result.accuracy.text if right else f"WRONG: {result.accuracy.text}",
    )
