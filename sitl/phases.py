"""A flight's numbers before, during and after each time that the swarm was in parts.

Of each drone, as ``phases`` of ``report.json`` (none where nobody was cut off): ``phase``, its
``from_s`` and ``until_s``, ``frames`` of the recording in it, ``localized_share`` of these,
``ate_m``, and what its autopilot saw: ``resets`` that were announced to it (``reset_counter``), and
``largest_step_m``, by how much the error of what it was told changed at most from one frame to the
next with no reset between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from sitl.evaluation import position_rms_m
from sitl.page_style import table
from sitl.partitions import Partition
from sitl.result import DroneResult, FlightResult

PHASE_COLUMNS = (
    ("frames", "frames", 0),
    ("localized_share", "localized %", 1),
    ("ate_m", "ATE m", 3),
    ("resets", "resets", 0),
    ("largest_step_m", "largest step m", 3),
)


def phases_of(result: FlightResult, drone: DroneResult) -> list[dict[str, Any]]:
    """Return a drone's numbers of each phase; see the module."""
    plan = result.plan
    partitions = plan.options.network.partitions
    if not partitions:
        return []
    ends_s = (plan.ends_at_ns - plan.starts_at_ns) * 1e-9
    return [
        {
            "phase": name,
            "from_s": from_s,
            "until_s": until_s,
            **_numbers(
                drone,
                plan.starts_at_ns + round(from_s * 1e9),
                plan.starts_at_ns + round(until_s * 1e9) + (until_s == ends_s),  # the last frame
            ),
        }
        for name, from_s, until_s in _phases(partitions, ends_s)
    ]


def phase_rows(report: Mapping[str, Any]) -> list[tuple[str, str, list[str]]]:
    """Return (phase, drone, the columns' texts) of every phase and drone, by phase."""
    rows = [
        (
            n,
            f"{phase['phase']}, {phase['from_s']:g}-{phase['until_s']:g} s",
            name,
            [_text(key, phase[key], decimals) for key, _, decimals in PHASE_COLUMNS],
        )
        for name, drone in report["drones"].items()
        for n, phase in enumerate(drone["phases"])
    ]
    return [(phase, name, texts) for _, phase, name, texts in sorted(rows, key=lambda r: r[0])]


def phases_html(report: Mapping[str, Any]) -> str:
    """Return the table of phases; empty where nobody was cut off."""
    rows = [(phase, name, *texts) for phase, name, texts in phase_rows(report)]
    return table(["", "drone", *(label for _, label, _ in PHASE_COLUMNS)], rows) if rows else ""


def _phases(partitions: tuple[Partition, ...], ends_s: float) -> Iterator[tuple[str, float, float]]:
    """Yield the times in which all hear each other, and those in which they do not, in order."""
    borders = sorted({0.0, ends_s, *(s for p in partitions for s in (p.from_s, p.until_s))})
    borders = [s for s in borders if s <= ends_s]
    was_apart = False
    for from_s, until_s in pairwise(borders):
        is_apart = any(p.from_s <= from_s < p.until_s for p in partitions)
        yield "apart" if is_apart else "after" if was_apart else "before", from_s, until_s
        was_apart |= is_apart


def _numbers(drone: DroneResult, from_ns: int, until_ns: int) -> dict[str, Any]:
    given = drone.frames_at_ns[drone.given]
    sequences = drone.given[(given >= from_ns) & (given < until_ns)]
    localized = np.isin(sequences, sorted(drone.localized))
    out: dict[str, Any] = {
        "frames": len(sequences),
        "localized_share": float(localized.mean()) if len(sequences) else None,
        "ate_m": None,
        "resets": None,
        "largest_step_m": None,
    }
    if drone.errors is None:
        return out
    counters = dict(
        zip(drone.estimates.at_ns.tolist(), drone.estimates.reset_counters, strict=True)
    )
    errors = drone.errors.position_ref_m
    chosen = (drone.errors.at_ns >= from_ns) & (drone.errors.at_ns < until_ns)
    if chosen.any():
        out["ate_m"] = position_rms_m(errors[chosen])
    # A step is one of the phase that it leads into: that of the first frame together again too.
    resets = np.diff([counters[at_ns] for at_ns in drone.errors.at_ns.tolist()]) != 0
    steps = np.linalg.norm(np.diff(errors, axis=0), axis=1)
    into = chosen[1:]
    if into.any():
        out["resets"] = int(resets[into].sum())
    if (into & ~resets).any():
        out["largest_step_m"] = float(steps[into & ~resets].max())
    return out


def _text(key: str, value: float | None, decimals: int) -> str:
    if value is None:
        return "-"
    return f"{100.0 * value if key == 'localized_share' else value:.{decimals}f}"
