"""The result of ``bench steps`` as JSON, as Markdown and as a table on the terminal."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.console import Console

from sitl.bench.machine import machine
from sitl.bench.timing import Measured
from sitl.tables import broken, print_table

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
    rows = [_cells(results, k) for k in range(len(results))]
    styles = [None if result.accuracy.right else "bold red" for result in results]
    heads = [broken(head) for head in _HEAD]
    print_table(console, heads, rows, keys=2, wraps=(0, 1, 5), styles=styles)
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
