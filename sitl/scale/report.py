"""What each number of drones costs: ``scale.json``, ``scale.md``, a plot, the terminal's table."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console

from sitl.bench.figures import Growth
from sitl.bench.machine import machine
from sitl.plotting import STYLE, WIDTH_IN, colour, svg
from sitl.report import rounded
from sitl.scale.swarm import Phase, SwarmResult
from sitl.tables import broken, print_table

_COLUMNS = ("drones", "phase", "s", "sent B/s", "most", "heard B/s", "CPU %", "most",
            "held by half s", "by all s")  # fmt: skip
_HOW = (
    "All drones in one process, by counted time. *Sent* and *heard*: whole signed MAVLink frames "
    "of one drone a second, the mean of all and the most of any (of a map: the coordinator). "
    "*CPU*: processor time of this machine spent in one drone's handling of its datagrams and in "
    "its own steps, per second of the drones' time; making a map ready included, frames not. "
    "*Held*: from the coordinator's flying on it until half of the others did, and all; computing "
    "takes none of this time."
)


def report_of(results: Sequence[SwarmResult], loss: float, seed: int) -> dict[str, Any]:
    """Return what a run comes to, as JSON knows it."""
    report = {
        "machine": machine(),
        "loss": loss,
        "seed": seed,
        "swarms": [
            {
                "drones": result.drones,
                "all_known_s": _finite(result.known_s),
                "dropped_share": result.dropped,
                "refused": result.refused,
                "phases": [_phase_report(phase) for phase in result.phases],
            }
            for result in results
        ],
        "growth": {
            phase: {what: _finite(growth) for what, growth in of.items()}
            for phase, of in _growths(results).items()
        },
    }
    checked = rounded(report)
    assert isinstance(checked, dict)
    return checked


def _phase_report(phase: Phase) -> dict[str, Any]:
    sent, heard = np.array(phase.sent_bytes), np.array(phase.heard_bytes)
    cpu = np.array(phase.cpu_s) / phase.seconds
    return {
        "name": phase.name,
        "seconds": phase.seconds,
        "sent_bytes_per_s": {
            "mean": float(sent.mean()) / phase.seconds,
            "most": float(sent.max()) / phase.seconds,
            "coordinator": float(sent[0]) / phase.seconds,
        },
        "heard_bytes_per_s": float(heard.mean()) / phase.seconds,
        "cpu_share": {
            "mean": float(cpu.mean()), "most": float(cpu.max()), "coordinator": float(cpu[0]),
        },
        "by_message": {
            name: {"messages": of.messages, "wire_bytes": of.wire_bytes}
            for name, of in phase.by_message.items()
        },
        "blob_bytes": phase.blob_bytes,
        "held_by_half_s": _finite(float(np.median(phase.held_s))) if phase.held_s else None,
        "held_by_all_s": _finite(max(phase.held_s)) if phase.held_s else None,
    }  # fmt: skip


def _growths(results: Sequence[SwarmResult]) -> dict[str, dict[str, float]]:
    """Return the exponents by which a drone's costs grow with the drones, of each phase."""
    sizes = tuple(float(result.drones) for result in results)
    out = {}
    for n, first in enumerate(results[0].phases):
        phases = [result.phases[n] for result in results]
        costs = {
            "sent_bytes": tuple(float(np.mean(p.sent_bytes)) / p.seconds for p in phases),
            "heard_bytes": tuple(float(np.mean(p.heard_bytes)) / p.seconds for p in phases),
            "cpu": tuple(float(np.mean(p.cpu_s)) / p.seconds for p in phases),
        }
        out[first.name] = {of: Growth(of, "", sizes, cost).exponent for of, cost in costs.items()}
    return out


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def cells_of(report: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return the table's rows, in the order of ``_COLUMNS``."""
    return [
        (
            str(swarm["drones"]),
            phase["name"],
            f"{phase['seconds']:.1f}",
            f"{phase['sent_bytes_per_s']['mean']:.0f}",
            f"{phase['sent_bytes_per_s']['most']:.0f}",
            f"{phase['heard_bytes_per_s']:.0f}",
            f"{100.0 * phase['cpu_share']['mean']:.2f}",
            f"{100.0 * phase['cpu_share']['most']:.2f}",
            _held(phase, "held_by_half_s"),
            _held(phase, "held_by_all_s"),
        )
        for swarm in report["swarms"]
        for phase in swarm["phases"]
    ]


def _held(phase: dict[str, Any], key: str) -> str:
    if not phase["blob_bytes"]:
        return ""
    return "never" if phase[key] is None else f"{phase[key]:.2f}"


def markdown_of(report: dict[str, Any]) -> str:
    """Return ``scale.md``."""
    lines = ["# Many drones", "", f"{_HOW} Loss {report['loss']:g}, seed {report['seed']}. "]
    lines += [f"{report['machine']}.", "", "| " + " | ".join(_COLUMNS) + " |"]
    lines += ["|---:|---|" + "---:|" * (len(_COLUMNS) - 2)]
    lines += ["| " + " | ".join(row) + " |" for row in cells_of(report)]
    lines += ["", "![](scale.svg)", "", "## Growth", "", "Exponent of the power law by drones, of "]
    lines += ["what one drone sends, hears and computes: 0 is constant, 1 is linear.", ""]
    lines += ["| phase | sent | heard | CPU |", "|---|---:|---:|---:|"]
    for name, growth in report["growth"].items():
        values = ("" if v is None else f"{v:.2f}" for v in growth.values())
        lines.append(f"| {name} | " + " | ".join(values) + " |")
    return "\n".join(lines) + "\n"


def plot_of(report: dict[str, Any]) -> str:
    """Draw what one drone sends and computes, and when all hold a map, by the number of drones."""
    swarms = report["swarms"]
    drones = [swarm["drones"] for swarm in swarms]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(WIDTH_IN, 3.6), layout="constrained")
        sent, cpu, held = figure.subplots(1, 3)
        for n, name in enumerate(phase["name"] for phase in swarms[0]["phases"]):
            phases = [swarm["phases"][n] for swarm in swarms]
            sent.plot(drones, [p["sent_bytes_per_s"]["mean"] for p in phases], "o-",
                      color=colour(n), label=name)  # fmt: skip
            cpu.plot(drones, [100.0 * p["cpu_share"]["mean"] for p in phases], "o-",
                     color=colour(n))  # fmt: skip
            if phases[0]["blob_bytes"]:
                times = [np.nan if p["held_by_all_s"] is None else p["held_by_all_s"]
                         for p in phases]  # fmt: skip
                held.plot(drones, times, "o-", color=colour(n))
        for axes, title, unit, log in (
            (sent, "Sent by a drone", "B/s", True),
            (cpu, "Processor of a drone", "% of a core", True),
            (held, "Held by all after", "s", False),
        ):
            _frame(axes, title, unit, drones, log=log)
        held.set_ylim(bottom=0.0)
        figure.legend(loc="outside lower center", ncols=4)
        return svg(figure, "Bytes, processor time and time to a common map by drones")


def _frame(axes: Axes, title: str, unit: str, drones: list[int], *, log: bool) -> None:
    axes.set(title=title, xlabel="drones", ylabel=unit, xscale="log")
    if log:
        axes.set_yscale("log")
    axes.set_xticks(drones, [str(n) for n in drones])
    axes.minorticks_off()


def write_scale(out: Path, report: dict[str, Any]) -> None:
    """Write ``scale.json``, ``scale.md`` and ``scale.svg``."""
    text = json.dumps(report, indent=1, ensure_ascii=False, allow_nan=False)
    (out / "scale.json").write_text(text + "\n", encoding="utf-8")
    (out / "scale.md").write_text(markdown_of(report), encoding="utf-8")
    (out / "scale.svg").write_text(plot_of(report), encoding="utf-8")


def show_scale(console: Console, report: dict[str, Any], out: Path) -> None:
    """Print the table, and where it is."""
    print_table(console, [broken(head) for head in _COLUMNS], cells_of(report), keys=2)
    console.print(f"report: {out / 'scale.md'}", markup=False, highlight=False, soft_wrap=True)
