"""The flight log: its lines as the report reads them, its counts, and a disk that is full."""

from __future__ import annotations

import gc
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sitl.flight_log import estimates_of, read_flight_log
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler
from vcl_companion.swarm.peer_time import ClockRelation

SUMMARY = {
    "cpu_s": 1.5,
    "wall_s": 3.0,
    "resident_mb": 99.0,
    "peer_bytes_sent": 7,
    "peer_bytes_received": 8,
}


def fill(log: FlightLog) -> None:
    log.frame(0, 100, "localized", latency_ms=12.5, matched=40, inliers=30, source="fused",
              by="patches")  # fmt: skip
    log.frame(1, 200, "refused", reason="fog", latency_ms=8.0, matched=3)
    log.frame(2, 300, "dropped")
    log.frame(3, 400, "refused", reason="fog", latency_ms=9.0, by="motion")
    log.missed(2)


def fly(path: Path) -> None:
    log = FlightLog(str(path), ManualClock())
    fill(log)
    log.close(**SUMMARY)


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def test_lines_are_as_specified(tmp_path: Path) -> None:
    path = tmp_path / "new" / "flight.jsonl"
    clock = ManualClock(41)
    log = FlightLog(str(path), clock)
    fill(log)
    clock.advance_to(42)
    log.event("lost", "fog \u2601")
    log.map(bytes(range(8)), b"", 120, 4567, 3)
    log.peer_clock(2, ClockRelation(42, -5_000_000_000, 1_500_000, 3e-6, 2e-6))
    before_the_end = lines(path)
    log.close(**SUMMARY)
    assert lines(path)[:-1] == before_the_end == [
        {"kind": "frame", "sequence": 0, "captured_at_ns": 100, "outcome": "localized",
         "reason": None, "latency_ms": 12.5, "matched": 40, "inliers": 30, "source": "fused",
         "by": "patches"},
        {"kind": "frame", "sequence": 1, "captured_at_ns": 200, "outcome": "refused",
         "reason": "fog", "latency_ms": 8.0, "matched": 3, "inliers": 0, "source": None,
         "by": None},
        {"kind": "frame", "sequence": 2, "captured_at_ns": 300, "outcome": "dropped",
         "reason": None, "latency_ms": None, "matched": 0, "inliers": 0, "source": None,
         "by": None},
        {"kind": "frame", "sequence": 3, "captured_at_ns": 400, "outcome": "refused",
         "reason": "fog", "latency_ms": 9.0, "matched": 0, "inliers": 0, "source": None,
         "by": "motion"},
        {"kind": "event", "at_ns": 42, "event": "lost", "reason": "fog \u2601"},
        {"kind": "map", "at_ns": 42, "revision": "0001020304050607", "parent": "",
         "landmarks": 120, "bytes": 4567, "keyframes": 3},
        {"kind": "clock", "at_ns": 42, "peer": 2, "offset_ns": -5_000_000_000,
         "bound_ns": 1_500_000, "drift_ppm": 3.0, "drift_bound_ppm": 2.0},
    ]  # fmt: skip
    assert lines(path)[-1] == {
        "kind": "summary",
        "frames": {"localized": 1, "refused": 2, "dropped": 3},
        "refusals": {"fog": 2},
        **SUMMARY,
    }


def test_an_estimate_is_written_as_the_autopilot_would_get_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    log = FlightLog(str(path), ManualClock())
    pose = Pose(matrix_from_euler(0.0, 0.0, np.pi / 2), np.array([1.0, 2.0, 3.0]))
    local = np.diag([0.01, 0.04, 0.09, 1e-4, 2e-4, 3e-4])
    log.estimate(5, pose, local, fused=True)
    log.estimate(6, pose, local, fused=False, host=2, reason="far off")
    log.close(**SUMMARY)
    own, said = read_flight_log(path).estimates
    assert (own.source, own.host, own.fused, own.reason) == ("intra", None, True, None)
    assert (said.source, said.host, said.fused, said.reason) == ("inter", 2, False, "far off")
    assert (said.captured_at_ns, said.position) == (6, (1.0, 2.0, 3.0))
    read = estimates_of([own])
    # Heading east, body x lies along world y.
    expected = np.diag([0.04, 0.01, 0.09, 1e-4, 2e-4, 3e-4])
    np.testing.assert_allclose(read.covariances[0], expected, atol=1e-12)
    np.testing.assert_allclose(read.world_from_body[0].rotation, pose.rotation, atol=1e-12)


def test_the_report_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    log = FlightLog(str(path), ManualClock())
    fill(log)
    log.peer_clock(2, ClockRelation(42, -5_000_000_000, 1_500_000, 3e-6, 2e-6))
    log.close(**SUMMARY)
    read = read_flight_log(path)
    (clock,) = read.clocks
    assert (clock.peer, clock.offset_ns, clock.bound_ns) == (2, -5_000_000_000, 1_500_000)
    assert (clock.drift_ppm, clock.drift_bound_ppm) == (3.0, 2.0)
    assert len(read.frames) == 4
    assert read.summary is not None
    assert read.summary.refusals == {"fog": 2}


def test_nothing_follows_the_summary(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    log = FlightLog(str(path), ManualClock())
    log.close(**SUMMARY)
    log.event("late", "a thread that ends after us")
    log.close(**SUMMARY)
    assert [line["kind"] for line in lines(path)] == ["summary"]


def test_earlier_flights_are_kept_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    for n in range(23):
        log = FlightLog(str(path), ManualClock())
        log.event("flight", str(n))
        log.frame(0, 100, "dropped")
        log.close(**SUMMARY)
    kept = {file.name: lines(file)[0]["reason"] for file in tmp_path.iterdir()}
    earlier = {f"flight.jsonl.{back}": str(22 - back) for back in range(1, 21)}
    assert kept == {"flight.jsonl": "22", **earlier}


def test_starts_that_come_to_nothing_shift_no_flight_out(tmp_path: Path) -> None:
    path = tmp_path / "flight.jsonl"
    fly(path)
    flown = lines(path)
    for _ in range(30):
        log = FlightLog(str(path), ManualClock())
        log.event("waiting", "for a camera")
        log.close(**SUMMARY)
    assert len(lines(path)) == 2
    assert {file.name for file in tmp_path.iterdir()} == {"flight.jsonl", "flight.jsonl.1"}
    assert lines(tmp_path / "flight.jsonl.1") == flown


def test_what_points_to_the_file_stays_where_it_is(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    path = tmp_path / "flight.jsonl"
    path.symlink_to(tmp_path / "disk" / "log")
    for _ in range(2):
        fly(path)
    assert path.is_symlink()
    assert {file.name for file in (tmp_path / "disk").iterdir()} == {"log", "log.1"}


def test_where_an_earlier_flight_cannot_be_moved_this_one_follows_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "flight.jsonl"
    fly(path)
    (tmp_path / "flight.jsonl.19").touch()
    (tmp_path / "flight.jsonl.20").mkdir()  # in the way, and nothing to be removed as a file
    n_lines = len(lines(path))
    log = FlightLog(str(path), ManualClock())
    log.event("again", "")
    log.close(**SUMMARY)
    assert [line["kind"] for line in lines(path)[n_lines:]] == ["event", "summary"]
    assert "goes on where it was" in caplog.text


def test_without_a_file_it_still_counts() -> None:
    log = FlightLog("", ManualClock())
    fill(log)
    log.close(**SUMMARY)
    assert log.frames == {"localized": 1, "refused": 2, "dropped": 3}
    assert log.refusals == {"fog": 2}


def test_reasons_without_end_do_not_grow_it() -> None:
    log = FlightLog("", ManualClock())
    for k in range(1000):
        log.frame(k, k, "refused", reason=f"{k} landmarks agree")
    log.frame(1000, 1000, "refused", reason="0 landmarks agree")
    assert sum(log.refusals.values()) == log.frames["refused"] == 1001
    assert 100 <= len(log.refusals) <= 300
    assert log.refusals["0 landmarks agree"] == 2
    assert log.refusals["other reasons"] > 700


def test_a_full_disk_ends_the_log_but_not_the_flight(caplog: pytest.LogCaptureFixture) -> None:
    log = FlightLog("/dev/full", ManualClock())
    fill(log)
    log.close(**SUMMARY)
    assert log.frames["refused"] == 2
    assert caplog.text.count("No space left on device") == 1
    del log
    gc.collect()  # a file that is still open would complain now


@pytest.mark.parametrize("path", ["/proc/flight.jsonl", "/dev/null/flight.jsonl", "/tmp", "a\0b"])
def test_a_file_that_cannot_be_written_is_a_wrong_configuration(path: str) -> None:
    with pytest.raises(ConfigError, match=r"^\[log\] flight_log '.*': \w") as raised:
        FlightLog(path, ManualClock())
    assert "\n" not in str(raised.value)
