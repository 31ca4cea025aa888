"""When each daemon was started and killed, and how soon it flew: for report.json and its page."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

from sitl.lives import Life
from sitl.result import DroneResult, FlightResult

LIFE_COLUMNS = (
    ("started_s", "started s"),
    ("ready_s", "ready s"),
    ("killed_s", "killed s"),
    ("seconds_to_map", "to a map s"),
    ("seconds_to_newest_map", "to the others' s"),
    ("seconds_to_localized", "to a pose s"),
)


def lives_of(result: FlightResult, drone: DroneResult) -> list[dict[str, Any]]:
    """Return a drone's lives as the report has them; see ``sitl.report``."""
    starts_at_ns = result.plan.starts_at_ns

    def second(at_ns: int | None) -> float | None:
        return None if at_ns is None else (at_ns - starts_at_ns) * 1e-9

    return [
        {
            "started_s": second(life.started_at_ns),
            "ready_s": second(life.ready_at_ns),
            "killed_s": second(life.killed_at_ns),
            **_first_steps(result, drone, life),
        }
        for life in drone.lives
    ]


def life_rows(report: Mapping[str, Any]) -> list[tuple[str, list[float | None]]]:
    """Return (drone, the columns' values) of every life; none when nobody was late or killed."""
    if not report["options"]["absences"]:
        return []
    return [
        (name, [life[key] for key, _ in LIFE_COLUMNS])
        for name, drone in report["drones"].items()
        for life in drone["lives"]
    ]


def lives_html(report: Mapping[str, Any]) -> str:
    """Return the table of lives; empty when nobody was late or killed."""
    rows = [
        f"<tr><td>{escape(name)}</td>"
        + "".join(f"<td>{'—' if value is None else f'{value:.2f}'}</td>" for value in values)
        + "</tr>"
        for name, values in life_rows(report)
    ]
    heads = "".join(f"<th>{escape(label)}</th>" for _, label in LIFE_COLUMNS)
    table = f"<table><tr><th>drone</th>{heads}</tr>{''.join(rows)}</table>"
    return f"<div class=scroll>{table}</div>" if rows else ""


def _first_steps(result: FlightResult, drone: DroneResult, life: Life) -> dict[str, float | None]:
    """Return how soon a daemon that came to others in flight had a map and sent a pose."""
    names = ("seconds_to_map", "seconds_to_newest_map", "seconds_to_localized")
    speed, ready_at_ns = result.plan.options.speed, life.ready_at_ns
    from_start = life.started_at_ns == result.plan.starts_at_ns
    if ready_at_ns is None or from_start or math.isinf(speed):
        return dict.fromkeys(names)
    until_ns = math.inf if life.killed_at_ns is None else life.killed_at_ns

    def waited_s(at_ns: int) -> float:
        return (at_ns - ready_at_ns) * 1e-9 / speed

    maps = [row for row in drone.log.maps if ready_at_ns <= row.at_ns < until_ns]
    others = [other.log for other in result.drones if other is not drone]
    theirs = {row.revision for log in others for row in log.maps}
    poses_s = [
        waited_s(frame.captured_at_ns) + (frame.latency_ms or 0.0) * 1e-3
        for frame in drone.log.frames
        if frame.outcome == "localized" and ready_at_ns <= frame.captured_at_ns < until_ns
    ]
    found = (
        min((waited_s(row.at_ns) for row in maps), default=None),
        min((waited_s(row.at_ns) for row in maps if row.revision in theirs), default=None),
        min(poses_s, default=None),
    )
    return dict(zip(names, found, strict=True))
