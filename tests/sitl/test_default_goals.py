"""The default pipeline is judged by issue 4's numbers, on flights of which all is known."""

from __future__ import annotations

from pathlib import Path

import pytest

from sitl.default_goals import default_goals
from tests.sitl.flights import Flight
from tests.sitl.test_paper import left_behind, off_by, told_of


@pytest.mark.parametrize(("error_cm", "verdict"), [(3.9, "met"), (4.1, "not met")])
def test_the_flights_back_and_forth(tmp_path: Path, error_cm: float, verdict: str) -> None:
    flown = left_behind(
        tmp_path / "a", "forward_back_near", True, Flight(n_drones=3, error=off_by(error_cm))
    )
    rows = default_goals({("forward_back_near", True): flown}, whole=True)
    row = next(row for row in rows if row.experiment == "forward_back_near")
    assert row.verdict == verdict
    assert f"mav1 {error_cm:.1f} cm" in row.measured
    assert {row.verdict for row in rows if row.experiment == "forward_back"} == {"not judged"}
    assert "not met" not in {r.verdict for r in default_goals({}, whole=True)}


@pytest.mark.parametrize(
    ("error_cm", "dropped", "verdict"),
    [(14.0, False, "met"), (16.0, False, "not met"), (14.0, True, "not met")],
)
def test_the_starved(tmp_path: Path, error_cm: float, dropped: bool, verdict: str) -> None:
    flight = Flight(
        n_drones=3,
        error=off_by(error_cm),
        refused=frozenset({("mav1", 5)}),
        dropped=frozenset({("mav2", 5)}) if dropped else frozenset(),
    )
    flown = left_behind(tmp_path / "a", "sparse", True, flight)
    rows = default_goals({("sparse", True): flown}, whole=True)
    assert told_of(rows, "see little").verdict == verdict


@pytest.mark.parametrize(
    ("error_cm", "refused", "localized", "drift"),
    [(0.1, False, "met", "met"), (9.0, False, "met", "not met"), (0.1, True, "not met", "met")],
)
def test_the_street(
    tmp_path: Path, error_cm: float, refused: bool, localized: str, drift: str
) -> None:
    flight = Flight(
        n_drones=3,
        error=off_by(error_cm),
        refused=frozenset({("mav1", 5)}) if refused else frozenset(),
    )
    rows = default_goals(
        {("urban", True): left_behind(tmp_path / "a", "urban", True, flight)}, whole=True
    )
    assert told_of(rows, "localized").verdict == localized
    assert told_of(rows, "drift").verdict == drift


def test_poses_are_as_true_as_they_say(tmp_path: Path) -> None:
    flown = left_behind(tmp_path / "a", "rotate", True, Flight(n_drones=3, error=off_by(0.0)))
    row = told_of(default_goals({("rotate", True): flown}, whole=True), "as true as")
    assert row.verdict == "not met"  # no error at all: far too cautious
    assert "100 % within" in row.measured
