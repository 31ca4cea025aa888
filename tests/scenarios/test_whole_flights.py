"""Whole recordings through real daemons, stand-ins and sockets, as `python -m sitl fly` does."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from sitl.fly import fly
from sitl.plan import FlyOptions

ROOT = Path(__file__).parents[2]
SHARED = ROOT.parent / "shared" / "data"


def flown(recording: Path, out: Path) -> dict[str, Any]:
    return fly(recording, out, FlyOptions(speed=math.inf), lambda *_: None)


def assert_accounted_and_honest(report: dict[str, Any]) -> None:
    for name, drone in report["drones"].items():
        outcomes = [drone[f"frames_{o}"] for o in ("localized", "refused", "dropped")]
        assert sum(outcomes) == drone["frames"], name
        assert sum(drone["refusals"].values()) == drone["frames_refused"], name
        if drone["frames_localized"]:
            assert drone["within_3_sigma_or_10cm_share"] == 1.0, name


def test_the_demo_is_localized_throughout(tmp_path: Path) -> None:
    report = flown(ROOT / "sitl" / "recordings" / "demo", tmp_path / "out")
    assert_accounted_and_honest(report)
    assert len(report["drones"]) == 3
    for drone in report["drones"].values():
        assert drone["frames_localized"] == drone["frames"] == 60
        assert 0.0 < drone["ate_m"] <= 0.15


@pytest.mark.parametrize(
    ("name", "ate_m"),
    [("yard", 0.05), ("fountain-P11", 0.04), ("Herz-Jesus-P8", 0.04), ("castle-P19", 0.15)],
)
def test_shared_recordings_are_localized_throughout(
    name: str, ate_m: float, tmp_path: Path
) -> None:
    if not (SHARED / name).is_dir():
        pytest.skip("../shared/data is not here")
    report = flown(SHARED / name, tmp_path / "out")
    assert_accounted_and_honest(report)
    assert report["map"]["revisions"] > 1
    for drone in report["drones"].values():
        assert drone["localized_share"] == 1.0
        assert drone["ate_m"] <= ate_m
