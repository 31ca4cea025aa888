"""The result of ``bench robust`` as JSON, as Markdown and as a table on the terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from sitl.bench.cases import N_MATCHES, TASKS
from sitl.bench.machine import machine
from sitl.bench.rows import RIVALS, Row, Verdict, verdicts
from sitl.bench.trial import RIGHT_DIRECTION_DEG, RIGHT_POSITION_M, RIGHT_ROTATION_DEG
from sitl.tables import print_table

_SHOWN = ("ours", *RIVALS, "best")


def write_robust(
    out: Path, settings: Mapping[str, Any], rows: Sequence[Row], unfinished: int
) -> None:
    """Write ``robust.json`` and ``robust.md``.

    Args:
        out: folder, made if absent.
        settings: of the run, for the record.
        rows: what is finished.
        unfinished: how many rows are still to come.
    """
    judged = verdicts(rows)
    report = {
        "n_matches": N_MATCHES,
        **settings,
        "right": {
            "rotation_deg": RIGHT_ROTATION_DEG,
            "direction_deg": RIGHT_DIRECTION_DEG,
            "position_m": RIGHT_POSITION_M,
        },
        "machine": machine(),
        "unfinished": unfinished,
        "rows": [_flat(asdict(row)) for row in rows],
        "verdicts": [_flat(asdict(verdict)) for verdict in judged],
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "robust.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    (out / "robust.md").write_text(
        "\n".join(_markdown(report, rows, judged, unfinished)) + "\n", encoding="utf-8"
    )


def show_robust(console: Console, rows: Sequence[Row], out: Path) -> None:
    """Print success and time of everybody, a line per cell, and which cells miss the goal."""
    judged = {verdict.cell: verdict for verdict in verdicts(rows)}
    table, styles = [], []
    for cell, there in _by_cell(rows):
        texts = [
            f"{100 * there[name].success:.1f} {there[name].milliseconds:6.1f}"
            if name in there
            else "-"
            for name in _SHOWN
        ]
        verdict = judged.get(there[next(iter(there))].cell)
        met = verdict is not None and not verdict.missed
        goal = "-" if verdict is None else "met" if met else "MISSED"
        table.append((cell, *texts, goal))
        styles.append(None if met or verdict is None else "bold red")
    heads = ("success %,\nmedian ms", *_SHOWN, "goal")
    print_table(console, heads, table, wraps=(len(heads) - 1,), styles=styles)
    console.print(_summary(list(judged.values())), markup=False, highlight=False)
    console.print(f"report: {out / 'robust.md'}", markup=False, highlight=False, soft_wrap=True)


def _markdown(
    report: Mapping[str, Any], rows: Sequence[Row], judged: Sequence[Verdict], unfinished: int
) -> Iterator[str]:
    yield "# Poses among wrong matches"
    yield ""
    yield (
        f"{N_MATCHES} matches a scene, {report['seeds']} scenes a cell. Right: rotation within "
        f"{RIGHT_ROTATION_DEG:g} deg, and direction within {RIGHT_DIRECTION_DEG:g} deg (relative) "
        f"or position within {RIGHT_POSITION_M:g} m (resection); on a plane the first answer of "
        "the relative pose may be either twin. A cell is task, scene, noise, share of wrong "
        f"matches in %. {report['machine']}."
    )
    yield ""
    if unfinished:
        yield f"Not finished: {unfinished} parts are still to come. So far, against who has run:"
        yield ""
    yield _summary(judged)
    yield ""
    for verdict in judged:
        for text in verdict.missed:
            yield f"* {verdict.cell.name}: {text}"
    for task in TASKS:
        mine = [row for row in rows if row.cell.task == task]
        names = list(dict.fromkeys(row.contender for row in mine))
        if not names:
            continue
        yield ""
        yield f"## {task}: success %, (truth among all answers %), median ms of one thread"
        yield ""
        yield "| cell | " + " | ".join(names) + " |"
        yield "|---" + "|---:" * len(names) + "|"
        for cell, there in _by_cell(mine):
            yield f"| {cell} | " + " | ".join(_text(there.get(name)) for name in names) + " |"
        yield ""
        unit = "deg" if task == "relative" else "m"
        yield f"## {task}: median error of what is right, deg, and of its offset, {unit}"
        yield ""
        yield "| cell | " + " | ".join(names) + " |"
        yield "|---" + "|---:" * len(names) + "|"
        for cell, there in _by_cell(mine):
            yield f"| {cell} | " + " | ".join(_error(there.get(name)) for name in names) + " |"


def _summary(judged: Sequence[Verdict]) -> str:
    missed = [verdict.cell.name for verdict in judged if verdict.missed]
    text = f"The goal is met in {len(judged) - len(missed)} of {len(judged)} cells"
    return text + (f"; missed in {', '.join(missed)}." if missed else ".")


def _by_cell(rows: Sequence[Row]) -> Iterator[tuple[str, dict[str, Row]]]:
    for cell in dict.fromkeys(row.cell for row in rows):
        yield cell.name, {row.contender: row for row in rows if row.cell == cell}


def _text(row: Row | None) -> str:
    if row is None:
        return ""
    return f"{100 * row.success:.1f} ({100 * row.among:.0f}) {row.milliseconds:.1f}"


def _error(row: Row | None) -> str:
    if row is None or row.error_deg is None or row.offset is None:
        return ""
    return f"{row.error_deg:.3f} {row.offset:.3f}"


def _flat(record: dict[str, Any]) -> dict[str, Any]:
    return {**record.pop("cell"), **record}
