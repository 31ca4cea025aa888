"""One row of what must be shown: goal, measured value, met or not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from sitl.paper_flights import PaperFlight

Verdict = Literal["met", "not met", "reported", "not judged"]
# Flights of one pipeline by (experiment, fused).
Flights = Mapping[tuple[str, bool], PaperFlight]


@dataclass(frozen=True)
class Goal:
    """One row.

    Attributes:
        experiment: its name; empty: all.
        what: what must be shown.
        goal: the number.
        measured: ours.
        verdict: whether that meets it.
    """

    experiment: str
    what: str
    goal: str
    measured: str
    verdict: Verdict


def judged(rows: list[Goal], whole: bool) -> list[Goal]:
    """Return the rows, without verdicts where flights were cut short."""
    if whole:
        return rows
    verdicts = ("met", "not met")
    return [replace(g, verdict="not judged") if g.verdict in verdicts else g for g in rows]


def at_most(
    experiment: str, what: str, asked: str, value: float | None, limit: float, form: str
) -> Goal:
    """Return a row that is met by a value of at most a limit; None: there was nothing."""
    if value is None:
        return Goal(experiment, what, asked, "never localized", "not met")
    return Goal(experiment, what, asked, form.format(value), "met" if value <= limit else "not met")


def not_flown(experiment: str, what: str, asked: str) -> Goal:
    """Return a row of what was not flown."""
    return Goal(experiment, what, asked, "not flown", "not judged")


def rmse_cm(flight: PaperFlight, name: str) -> float | None:
    """Return a drone's absolute trajectory error without further alignment; None without any."""
    scores = flight.drone(name).scores
    return None if scores is None else 100.0 * scores.ate_m


def cm(value: float | None) -> str:
    """Return a length in words."""
    return "never localized" if value is None else f"{value:.1f} cm"
