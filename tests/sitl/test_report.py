import io
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

from sitl import report_plots
from sitl.fly import Conduct
from sitl.fly import reported as conclude
from sitl.gathered import gather
from sitl.lives import Life, Lives, write_lives
from sitl.network import Fate
from sitl.network_log import NetworkLog
from sitl.network_report import message_rows
from sitl.partitions import parse_partition
from sitl.peer_traffic import Traffic
from sitl.processes import FlightError
from sitl.recording_axes import sigmas_along_axes
from sitl.reliance import RELIANCES
from sitl.report import report_of, write_report
from sitl.result import FlightResult
from sitl.terminal import show_report
from sitl.trajectory_files import write_trajectories
from tests.sitl.flights import (
    NED_FROM_WORLD,
    PERIOD_NS,
    SIGMAS,
    START_NS,
    Flight,
    at_ns,
    leave_behind,
    ned_from_body,
)
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording import NED_FROM_REFERENCE, ReferenceAxes, read_recording
from vcl_companion.recording.tum import read_tum

EVERY_FRAME = frozenset((f"mav{n}", k) for n in range(2) for k in range(12))


def reported(tmp_path: Path, flight: Flight) -> tuple[FlightResult, dict[str, Any], Path]:
    plan, out = leave_behind(tmp_path, flight)
    result = gather(plan, out)
    write_trajectories(result, out)
    return result, json.loads(json.dumps(report_of(result), allow_nan=False)), out


def page_of(result: FlightResult, out: Path) -> str:
    """Write the report and return its page; report.json must say what ``report_of`` says."""
    written = write_report(result, out, start_s=1.0, flight_s=2.0, late_ms=1.5)
    report = json.loads((out / "report.json").read_text())
    assert report == written == {**report_of(result), "wall": report["wall"]}
    return (out / "report.html").read_text()


def test_a_perfect_flight_lies_on_its_truth(tmp_path: Path) -> None:
    result, report, out = reported(tmp_path, Flight())
    assert result.ref_from_world is not None
    assert np.allclose(result.ref_from_world.matrix(), NED_FROM_WORLD.matrix(), atol=1e-9)
    for name in ("mav0", "mav1"):
        assert (out / name / "estimate.tum").read_text() == (out / name / "truth.tum").read_text()
        drone = report["drones"][name]
        assert drone["ate_m"] == 0.0
        assert drone["within_3_sigma_share"] == 1.0
        assert drone["localized_share"] == 1.0
        assert drone["unaccounted"] == 0
    assert [event["kind"] for event in report["events"]] == ["map", "map"]


def test_the_report_has_exactly_the_keys_that_others_read(tmp_path: Path) -> None:
    _, report, _ = reported(tmp_path, Flight(refused=frozenset({("mav1", 5)})))
    assert {"recording", "pipeline", "options", "drones", "map", "events"} <= set(report)
    assert set(report["drones"]) == {"mav0", "mav1"}
    keys = {
        "frames", "localized_share", "ate_m", "ate_aligned_m", "rmse_m", "yaw_rmse_deg",
        "within_3_sigma_share", "nees_median", "latency_ms", "frames_dropped", "cpu_share",
        "resident_mb", "peer_bytes_per_s", "landmarks", "refusals",
    }  # fmt: skip
    drone = report["drones"]["mav1"]
    assert keys <= set(drone)
    assert set(drone["rmse_m"]) == {"x", "y", "z"}
    assert set(drone["latency_ms"]) == {"p50", "p95", "p99"}
    assert {"revisions", "landmarks", "bytes"} <= set(report["map"])
    assert set(report["events"][0]) == {"at_s", "drone", "kind", "reason"}
    assert report["pipeline"] == "default"


def test_a_partition_s_phases_are_told_apart(tmp_path: Path) -> None:
    """Frames are 0.2 s apart; off by 0.3 m while apart, then told so and off by 0.1."""

    def error(_: str, k: int) -> Array:
        return np.array([0.0 if k < 3 else 0.3 if k < 8 else 0.1, 0.0, 0.0, 0.0, 0.0, 0.0])

    flight = Flight(
        partitions=(parse_partition("0.5-1.5:mav0|mav1"),),
        reset=("mav1", 8),
        refused=frozenset({("mav1", 4)}),
        error=error,
    )
    result, report, out = reported(tmp_path, flight)
    before, apart, after = report["drones"]["mav1"]["phases"]
    assert [p["phase"] for p in (before, apart, after)] == ["before", "apart", "after"]
    assert (apart["from_s"], apart["until_s"]) == (0.5, 1.5)
    assert [p["frames"] for p in (before, apart, after)] == [3, 5, 4]
    assert [p["localized_share"] for p in (before, apart, after)] == [1.0, 0.8, 1.0]
    # The leader's first pose is exact, so all is off as it was made to be.
    assert [p["ate_m"] for p in (before, apart, after)] == pytest.approx([0.0, 0.3, 0.1])
    assert [p["resets"] for p in (before, apart, after)] == [0, 0, 1]
    # A step into a phase is that phase's.
    for phase, step in ((before, 0.0), (apart, 0.3), (after, 0.0)):
        assert phase["largest_step_m"] == pytest.approx(step, abs=1e-9)
    unannounced = report["drones"]["mav0"]["phases"][2]
    assert unannounced["resets"] == 0
    assert unannounced["largest_step_m"] == pytest.approx(0.2)
    page = page_of(result, out)
    assert "Apart and together" in page
    assert "apart, 0.5-1.5 s" in page
    console = Console(file=io.StringIO(), width=120)
    show_report(console, report, out)
    assert isinstance(console.file, io.StringIO)
    assert "apart, 0.5-1.5 s" in console.file.getvalue()


@pytest.mark.parametrize("width", [60, 80, 120])
def test_no_figure_is_cut_on_a_narrow_terminal(tmp_path: Path, width: int) -> None:
    _, report, out = reported(tmp_path, Flight())
    drone = report["drones"]["mav1"]
    drone |= {"ate_m": 0.123, "yaw_rmse_deg": 12.34, "resident_mb": 2048.0}
    drone["latency_ms"] |= {"p50": 118.1, "p99": 1150.9}
    printed = io.StringIO()
    show_report(Console(file=printed, width=width), report, out)
    assert "…" not in printed.getvalue()
    words = printed.getvalue().split()
    for figure in ("0.123", "12.34", "118.1", "1150.9", "2048"):
        assert words.count(figure) == 1


def test_the_first_frame_of_who_begins_later_is_one_like_all_others(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight(n_frames=12))
    assert plan.waited_for == {"mav0", "mav1"}
    report = report_of(gather(replace(plan, waited_for=frozenset({"mav0"})), out))
    waits, comes = report["drones"]["mav0"], report["drones"]["mav1"]
    assert waits["first_frame_ms"] == 900.0
    assert waits["latency_ms"]["p99"] < 32.0
    assert comes["first_frame_ms"] is None
    assert comes["latency_ms"]["p99"] > 800.0


def test_frames_that_were_not_flown_are_told_of(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    begun = tuple(replace(d, n_left_out=15 if d.name == "mav0" else 0) for d in plan.drones)
    result = gather(replace(plan, drones=begun), out)
    (said,) = (event for event in result.events if event.kind == "harness")
    assert said.drone == "mav0"
    assert said.reason.startswith("15 frames not flown")
    assert "15 frames not flown" in page_of(result, out)


def test_without_a_partition_there_are_no_phases(tmp_path: Path) -> None:
    result, report, out = reported(tmp_path, Flight())
    assert report["drones"]["mav0"]["phases"] == []
    assert "Apart and together" not in page_of(result, out)


def test_numbers_are_those_of_the_logs(tmp_path: Path) -> None:
    flight = Flight(
        n_frames=12, refused=frozenset({("mav1", 5), ("mav1", 6)}), dropped=frozenset({("mav1", 9)})
    )
    _, report, out = reported(tmp_path, flight)
    drone = report["drones"]["mav1"]
    assert drone["frames"] == 12
    assert drone["localized_share"] == pytest.approx(9 / 12)
    assert (drone["frames_localized"], drone["frames_refused"]) == (9, 2)
    assert (drone["frames_dropped"], drone["unaccounted"]) == (1, 0)
    assert drone["refusals"] == {"9 of 30 <landmarks>": 2}
    # The first frame's 900 ms are the wait for the map; of the others 21..31 but the dropped 29.
    assert drone["latency_ms"]["p50"] == pytest.approx(25.5)
    assert 30.5 < drone["latency_ms"]["p99"] < 31.0
    assert drone["first_frame_ms"] == 900.0
    assert drone["cpu_share"] == pytest.approx(0.5)
    assert drone["peer_bytes_per_s"] == pytest.approx(4400 / (11 * PERIOD_NS * 1e-9 + 0.003))
    assert drone["landmarks"] == 96.0
    (kept,) = (out / "run" / "mav0" / "maps").iterdir()
    size = len(kept.read_bytes())
    assert report["map"] == {
        "revision": kept.stem,
        "revisions": 1,
        "landmarks": 200,
        "bytes": size,
        "keyframes": 1,
    }


def test_the_report_says_what_was_sent_and_what_became_of_it(tmp_path: Path) -> None:
    state = {"map state": Traffic(10, 190, 420)}
    log = NetworkLog(
        sent={"mav0": {**state, "chunk: map": Traffic(100, 12_800, 14_500)}, "mav1": state},
        fates={
            "mav0": {
                "mav1": Fate(offered=110, cut=5, queue_full=20, lost=15, duplicated=10,
                             delivered=80, delay_sum_s=8.0, delay_max_s=0.25),
            },
        },
        n_dropped=3,
        n_strangers=0,
    )  # fmt: skip
    result, report, out = reported(tmp_path, Flight(network=log))
    link = report["drones"]["mav0"]["peer_link"]
    assert list(link["by_message"]) == ["chunk: map", "map state"]
    assert (link["messages"], link["payload_bytes"], link["wire_bytes"]) == (110, 12_990, 14_920)
    assert link["wire_bytes_per_s"] == pytest.approx(14_920 / report["duration_s"], rel=1e-6)
    assert link["network"] == {
        "offered": 110, "delivered": 80, "lost": 15, "queue_full": 20, "cut": 5, "corrupted": 0,
        "duplicated": 10, "held_back": 0, "delay_mean_ms": 100.0, "delay_max_ms": 250.0,
    }  # fmt: skip
    silent = report["drones"]["mav1"]["peer_link"]["network"]
    assert (silent["offered"], silent["delay_mean_ms"]) == (0, None)
    assert [e["reason"] for e in report["events"] if e["kind"] == "harness"] == [
        "3 datagrams were lost by the harness, not by the network"
    ]
    rows = message_rows(report)
    assert [row.name for row in rows] == ["chunk: map", "map state", "all"]
    assert rows[1].by_drone == (420, 420)
    assert rows[2].share == 1.0
    assert rows[2].wire_bytes == 14_920 + 420
    page = page_of(result, out)
    assert "<td>chunk: map</td><td>100</td><td>12.8</td><td>14.5</td><td>94.5</td>" in page
    assert "<td>mav0</td><td>110</td><td>80</td><td>15</td><td>20</td><td>5</td>" in page
    printed = io.StringIO()
    show_report(Console(file=printed, width=120), report, out)
    said = printed.getvalue()
    assert re.search(r"chunk: map +100 +12\.8 +14\.5 +94\.5 +\d+ +14\.5 +0\.0", said)
    assert re.search(r"mav0 +110 +80 +15 +20 +5 +0 +10 +0 +100\.0 +250\.0", said)


def test_a_flight_that_was_not_counted_is_reported_without_the_table(tmp_path: Path) -> None:
    result, report, out = reported(tmp_path, Flight())
    assert report["drones"]["mav0"]["peer_link"] is None
    assert message_rows(report) == []
    assert "Between the drones" not in page_of(result, out)


def test_a_network_log_that_is_broken_is_named(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    (out / "run" / "network.json").write_text('{"sent": 1}')
    with pytest.raises(FlightError, match=r"network\.json"):
        gather(plan, out)


def test_the_report_tells_whence_the_poses_came_and_how_good_each_source_was(
    tmp_path: Path,
) -> None:
    flight = Flight(
        n_frames=10,
        proposed={("mav1", 2): 0.1, ("mav1", 4): 0.1, ("mav1", 6): 2.0},
        starved=frozenset({("mav1", 4)}),
        refused=frozenset({("mav1", 9)}),
    )
    result, report, out = reported(tmp_path, flight)
    said = report["drones"]["mav1"]["sources"]
    assert said["share"] == {"intra": 0.6, "inter": 0.1, "fused": 0.2}
    assert (said["proposals"], said["proposals_fused"]) == (3, 2)
    assert said["nees_median"]["intra"] == pytest.approx(0.0, abs=1e-6)
    assert said["nees_median"]["inter"] == pytest.approx((0.1 / SIGMAS[0]) ** 2, rel=1e-3)
    assert said["ate_m"]["inter"] == pytest.approx(np.sqrt((0.01 + 0.01 + 4.0) / 3), rel=1e-3)
    assert said["ate_m"]["sent"] == report["drones"]["mav1"]["ate_m"]
    assert report["drones"]["mav1"]["landmarks"] == 96.0  # the starved frame has none
    nobody = report["drones"]["mav0"]["sources"]
    assert (nobody["nees_median"]["inter"], nobody["proposals"]) == (None, 0)
    assert "Whence the poses" in page_of(result, out)


def test_the_report_tells_what_every_pose_relies_on(tmp_path: Path) -> None:
    flight = Flight(
        n_frames=10,
        features=frozenset({("mav1", 0)}),
        odometry=frozenset({("mav1", 3)}),
        proposed={("mav1", 2): 0.1, ("mav1", 4): 0.1},
        starved=frozenset({("mav1", 4)}),
        coasted=frozenset({("mav1", 5), ("mav1", 6)}),
        refused=frozenset({("mav1", 7)}),
        dropped=frozenset({("mav1", 9)}),
    )
    result, report, out = reported(tmp_path, flight)
    drone = report["drones"]["mav1"]
    assert drone["relies_on"] == {
        "patches": 0.3, "features": 0.1, "odometry": 0.1, "peer": 0.1, "motion": 0.2,
        "nothing": 0.2,
    }  # fmt: skip
    # What nobody measured is not localized, though it was sent.
    assert (drone["localized_share"], drone["frames_refused"]) == (pytest.approx(0.6), 3)
    assert len(result.drones[1].estimates.at_ns) == 8
    assert report["drones"]["mav0"]["relies_on"]["patches"] == 1.0
    assert not [event for event in report["events"] if event["kind"] == "harness"]
    page = page_of(result, out)
    strip = page[page.index("What the poses rely on") : page.index("Whence the poses")]
    assert strip.count("<svg role=") == 1
    for _, ink in RELIANCES.values():  # in the strip, in its legend and in the table's head
        assert strip.count(ink) >= 3


def test_a_log_of_before_patches_says_what_it_knew(tmp_path: Path) -> None:
    flight = Flight(
        n_frames=4, proposed={("mav1", 1): 0.1}, starved=frozenset({("mav1", 1)}),
        refused=frozenset({("mav1", 2)}),
    )  # fmt: skip
    plan, out = leave_behind(tmp_path, flight)
    for path in (out / "run").glob("*/flight.jsonl"):
        path.write_text(re.sub(r', "by": ("\w+"|null)', "", path.read_text()))
    said = report_of(gather(plan, out))["drones"]["mav1"]["relies_on"]
    assert said == {
        "patches": 0.0, "features": 0.5, "odometry": 0.0, "peer": 0.25, "motion": 0.0,
        "nothing": 0.25,
    }  # fmt: skip


def test_a_coasted_pose_that_was_not_received_is_said_aloud(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight(coasted=frozenset({("mav1", 5)})))
    path = out / "mav1" / "received.jsonl"
    kept = [row for row in path.read_text().splitlines() if str(at_ns(1, 5) // 1000) not in row]
    path.write_text("\n".join(kept) + "\n")
    said = [event.reason for event in gather(plan, out).events if event.kind == "harness"]
    assert said == ["1 frames by motion by the log, 0 poses received"]


def test_errors_come_out_as_they_were_put_in(tmp_path: Path) -> None:
    """White errors of the stated sigmas, but for the leader's first, which is the origin."""
    rng = np.random.default_rng(11)
    errors = {(f"mav{n}", k): rng.normal(size=6) * SIGMAS for n in range(2) for k in range(150)}
    errors["mav0", 0] = np.zeros(6)
    flight = Flight(n_frames=150, error=lambda name, k: errors[name, k])
    _, report, _ = reported(tmp_path, flight)
    for name in ("mav0", "mav1"):
        drone = report["drones"][name]
        put_in = np.array([errors[name, k] for k in range(150)])
        ate_m = float(np.sqrt(np.mean(np.sum(put_in[:, :3] ** 2, axis=1))))
        assert drone["ate_m"] == pytest.approx(ate_m, abs=2e-6)
        assert drone["yaw_rmse_deg"] == pytest.approx(
            np.degrees(np.sqrt(np.mean(put_in[:, 5] ** 2))), abs=1e-3
        )
        assert 0.9 * ate_m < drone["ate_aligned_m"] < ate_m
        assert 4.0 < drone["nees_median"] < 6.8
        assert 0.96 < drone["within_3_sigma_share"] <= 1.0


def test_timestamps_are_the_frames_own_to_the_nanosecond(tmp_path: Path) -> None:
    """Usec cut them to the microsecond; a float of epoch seconds would lose more."""
    _, _, out = reported(tmp_path, Flight())
    rows = read_tum(out / "mav1" / "estimate.tum")
    assert [row[0] for row in rows] == [at_ns(1, k) for k in range(12)]
    first = (out / "mav1" / "covariance.csv").read_text().splitlines()[1].split(",")
    assert first[0] == str(at_ns(1, 0))
    assert [float(cell) for cell in first[1:]] == pytest.approx(
        np.diag(SIGMAS**2)[np.triu_indices(6)].tolist()
    )
    assert len(first) == 22


def test_poses_go_out_in_the_recording_s_own_axes(tmp_path: Path) -> None:
    _, report, out = reported(tmp_path, Flight(axes="ENU"))
    assert report["drones"]["mav1"]["ate_m"] < 1e-6
    enu_from_ned = NED_FROM_REFERENCE["ENU"].T
    for name in ("estimate.tum", "truth.tum"):
        _, pose = read_tum(out / "mav1" / name)[7]
        truth = ned_from_body(1, 7)
        assert pose.translation == pytest.approx(enu_from_ned @ truth.translation, abs=1e-6)
        assert np.allclose(pose.rotation, enu_from_ned @ truth.rotation, atol=1e-6)


def figures_of(result: FlightResult, monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Draw trajectories and errors, and return the figures."""
    drawn: list[Figure] = []

    def keep(figure: Figure, _: str) -> str:
        drawn.append(figure)
        return ""

    monkeypatch.setattr(report_plots, "svg", keep)
    report_plots.trajectories_svg(result)
    report_plots.errors_svg(result)
    return drawn


@pytest.mark.parametrize(
    ("kind", "names", "from_above", "height"),
    [
        ("NED", ("x, north", "y, east", "z, down"), ("y, east", "x, north"), "height, −z"),
        ("ENU", ("x, east", "y, north", "z, up"), ("x, east", "y, north"), "height, z"),
        ("NWU", ("x, north", "y, west", "z, up"), ("−y, east", "x, north"), "height, z"),
    ],
)
def test_pictures_are_in_the_axes_that_errors_are_told_along(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: ReferenceAxes,
    names: tuple[str, str, str],
    from_above: tuple[str, str],
    height: str,
) -> None:
    off_m = np.array([0.01, 0.03, 0.07])

    def error(drone: str, k: int) -> Array:
        along_world = NED_FROM_WORLD.rotation.T @ off_m
        return np.concatenate(
            [along_world if (drone, k) != ("mav0", 0) else 0 * off_m, np.zeros(3)]
        )

    result, report, _ = reported(tmp_path, Flight(axes=kind, error=error))
    trajectories, errors = figures_of(result, monkeypatch)
    above, side = trajectories.axes
    assert (above.get_xlabel(), above.get_ylabel()) == tuple(f"{name} [m]" for name in from_above)
    assert (side.get_xlabel(), side.get_ylabel()) == (f"{from_above[1]} [m]", f"{height} [m]")
    drone = report["drones"]["mav1"]
    assert drone["axes"] == kind
    # Columns are drones: the second one's, without the yaw.
    for axes, name, letter in zip(errors.axes[1:6:2], names, "xyz", strict=True):
        (_, line, *_) = axes.lines
        drawn_m = 0.01 * np.array(line.get_ydata())
        assert np.sqrt(np.mean(drawn_m**2)) == pytest.approx(drone["rmse_m"][letter], abs=1e-6)
        row = names.index(name)
        assert errors.axes[2 * row].get_ylabel() == f"{name} [cm]"
    signed = NED_FROM_REFERENCE[kind].T @ off_m
    assert [np.array(axes.lines[1].get_ydata())[5] for axes in errors.axes[1:6:2]] == pytest.approx(
        100.0 * signed, abs=1e-6
    )


def test_a_sigma_along_an_axis_is_one_whichever_way_that_points() -> None:
    along_ned = np.array([[1.0, 2.0, 3.0]])
    assert sigmas_along_axes(along_ned, "ENU").tolist() == [[2.0, 1.0, 3.0]]
    assert sigmas_along_axes(along_ned, "NWU").tolist() == [[1.0, 2.0, 3.0]]


def test_the_legend_names_the_truth_whoever_has_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, _, _ = reported(tmp_path, Flight())
    first, second = result.drones
    without = replace(first, truth=(None,) * len(first.truth), errors=None)
    for drones in ((first, second), (without, second)):
        trajectories, _ = figures_of(replace(result, drones=drones), monkeypatch)
        (legend,) = trajectories.legends
        names = [text.get_text() for text in legend.get_texts()]
        assert sorted(names) == ["map points", "mav0", "mav1", "truth"]


def test_drones_of_several_axes_are_each_in_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result, _, _ = reported(tmp_path, Flight())
    first, second = result.drones
    mixed = replace(result, drones=(first, replace(second, axes="ENU")))
    trajectories, errors = figures_of(mixed, monkeypatch)
    assert trajectories.axes[0].get_xlabel() == "east [m]"
    assert [axes.get_title(loc="left") for axes in errors.axes[:2]] == ["mav0 (NED)", "mav1 (ENU)"]
    assert errors.axes[0].get_ylabel() == "x [cm]"


def test_without_truth_estimates_stay_in_world_and_errors_are_unknown(tmp_path: Path) -> None:
    result, report, out = reported(tmp_path, Flight(with_truth=False))
    assert result.ref_from_world is None
    drone = report["drones"]["mav0"]
    assert [drone[k] for k in ("ate_m", "ate_aligned_m", "yaw_rmse_deg", "nees_median")] == [
        None
    ] * 4
    assert drone["rmse_m"] == {"x": None, "y": None, "z": None}
    assert drone["localized_share"] == 1.0
    assert not (out / "mav0" / "truth.tum").exists()
    _, pose = read_tum(out / "mav0" / "estimate.tum")[3]
    in_world = NED_FROM_WORLD.inverse() @ ned_from_body(0, 3)
    assert pose.translation == pytest.approx(in_world.translation, abs=1e-8)
    assert "No truth to compare with" in page_of(result, out)


def test_a_leader_without_a_pose_leaves_nothing_to_compare(tmp_path: Path) -> None:
    everything = frozenset(("mav0", k) for k in range(12))
    result, report, _ = reported(tmp_path, Flight(refused=everything))
    assert result.ref_from_world is None
    assert report["drones"]["mav0"]["localized_share"] == 0.0
    assert report["drones"]["mav1"]["ate_m"] is None
    assert any("no estimate with a truth" in event["reason"] for event in report["events"])


def test_the_alignment_is_the_leader_s_first_estimate_even_a_late_one(tmp_path: Path) -> None:
    """Frame 0 refused: frame 1, which is 10 cm off, becomes the reference of all."""
    flight = Flight(
        refused=frozenset({("mav0", 0)}),
        error=lambda name, k: np.array([0.1, 0, 0, 0, 0, 0]) * (name == "mav0" and k == 1),
    )
    _, report, _ = reported(tmp_path, flight)
    assert report["drones"]["mav1"]["ate_m"] == pytest.approx(0.1, abs=1e-6)
    assert report["drones"]["mav1"]["ate_aligned_m"] == pytest.approx(0.0, abs=1e-6)


def test_what_does_not_add_up_is_said_aloud(tmp_path: Path) -> None:
    unlogged = frozenset({("mav1", 4), ("mav1", 5)})
    result, report, out = reported(tmp_path, Flight(unlogged=unlogged))
    assert report["drones"]["mav1"]["unaccounted"] == 2
    said = [event["reason"] for event in report["events"] if event["kind"] == "harness"]
    assert "2 of 12 frames are not accounted for" in said
    assert "10 frames localized by the log, 12 poses received" in said
    assert "Look at this first" in page_of(result, out)


def test_a_pose_at_the_time_of_no_frame_is_kept_and_said(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    path = out / "mav1" / "received.jsonl"
    lines = path.read_text().splitlines()
    late = json.loads(lines[-1])
    late["fields"]["usec"] += 50_000
    path.write_text("\n".join([*lines, json.dumps(late)]) + "\n")
    result = gather(plan, out)
    assert result.drones[1].frame_of.tolist() == [*range(12), -1]
    assert result.drones[1].estimates.at_ns[-1] == (at_ns(1, 11) // 1000 + 50_000) * 1000
    assert [e.reason for e in result.events if e.kind == "harness"] == [
        "1 poses carry the time of no frame"
    ]


def test_poses_between_frames_are_counted_apart(tmp_path: Path) -> None:
    plain, _, _ = reported(tmp_path / "plain", Flight())
    between = {("mav1", k): 0.3 for k in range(2, 6)}
    result, report, out = reported(tmp_path / "between", Flight(between=between))
    drone = report["drones"]["mav1"]
    assert drone["between"]["poses"] == 4
    assert drone["between"]["ate_m"] == pytest.approx(0.3, abs=1e-3)
    assert report["drones"]["mav0"]["between"] == {
        "poses": 0, "ate_m": None, "within_3_sigma_share": None,
    }  # fmt: skip
    # Everything else is of frames, as if there were none.
    assert result.drones[1].scores == plain.drones[1].scores
    assert result.drones[1].frame_of.tolist() == [*range(12)]
    assert not [event for event in report["events"] if event["kind"] == "harness"]
    assert "between frames" in page_of(result, out)


def test_a_localized_frame_that_was_held_back_is_no_pose_that_got_lost(tmp_path: Path) -> None:
    result, report, _ = reported(tmp_path, Flight(held_back=frozenset({("mav1", 3), ("mav1", 7)})))
    drone = report["drones"]["mav1"]
    assert (drone["frames_localized"], result.drones[1].n_localized) == (12, 10)
    assert drone["relies_on"]["nothing"] == pytest.approx(2 / 12, abs=1e-6)
    assert drone["unaccounted"] == 0
    assert not [event for event in report["events"] if event["kind"] == "harness"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ('{"kind":"frame","sequence":"one"}', r"flight\.jsonl, row 1: .*int"),
        (
            f'{{"kind":"frame","sequence":0,"captured_at_ns":{2**63},"outcome":"refused"}}',
            r"flight\.jsonl, row 1: .*<= 9223372036854775807",
        ),
        ('{"kind":"frame"', r"flight\.jsonl, row 1: not JSON"),
        ("[1]", r"flight\.jsonl, row 1: not a JSON object"),
    ],
)
def test_a_broken_log_names_file_and_row(tmp_path: Path, damage: str, message: str) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    path = out / "run" / "mav1" / "flight.jsonl"
    path.write_text(damage + "\n" + path.read_text())
    with pytest.raises(FlightError, match=message):
        gather(plan, out)


def test_an_autopilot_that_hears_nan_is_told_so(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    path = out / "mav0" / "received.jsonl"
    lines = path.read_text().splitlines()
    row = json.loads(lines[2])
    row["fields"]["x"] = float("nan")
    path.write_text("\n".join([*lines[:2], json.dumps(row), *lines[3:]]) + "\n")
    with pytest.raises(FlightError, match=r"received\.jsonl, row 3: .*finite"):
        gather(plan, out)


def test_a_missing_map_file_is_named(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    for path in (out / "run" / "mav0" / "maps").iterdir():
        path.unlink()
    with pytest.raises(FlightError, match=r"\.vclmap: No such file"):
        gather(plan, out)


class _Fetched(HTMLParser):
    """Collects what a browser would go and fetch, and whether tags are balanced."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [
            value or ""
            for key, value in attrs
            if key in ("src", "href", "xlink:href", "srcset", "data", "action")
        ]
        assert tag not in ("script", "link", "iframe", "object")
        if tag in ("section", "table", "svg", "main", "body", "html", "div"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self.open and tag == self.open[-1]:
            self.open.pop()

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_fetches_nothing_and_shows_every_plot(tmp_path: Path) -> None:
    flight = Flight(refused=frozenset({("mav1", 5)}), dropped=frozenset({("mav1", 6)}))
    result, _, out = reported(tmp_path, flight)
    text = page_of(result, out)
    page = _Fetched()
    page.feed(text)
    assert page.open == []
    assert all(a.startswith(("#", "data:image/png;base64,")) for a in page.addresses)
    assert not re.search(r"url\((?!#)|@import", text)
    assert text.count("<svg role=") == 5
    assert "paper <&>" in page.text
    assert "9 of 30 <landmarks>" in page.text
    assert "nan" not in re.sub(r"<[^>]*>", " ", text).lower().split()


def test_the_page_of_a_flight_that_never_had_a_map(tmp_path: Path) -> None:
    everything = frozenset((f"mav{n}", k) for n in range(2) for k in range(12))
    plan, out = leave_behind(tmp_path, Flight(refused=everything))
    for name in ("mav0", "mav1"):
        path = out / "run" / name / "flight.jsonl"
        kept = [row for row in path.read_text().splitlines() if '"kind": "map"' not in row]
        path.write_text("\n".join(kept) + "\n")
    result = gather(plan, out)
    page = page_of(result, out)
    assert ">0.0 %</b><span>of frames localized" in page
    assert report_of(result)["map"] == {
        "revision": None,
        "revisions": 0,
        "landmarks": 0,
        "bytes": 0,
        "keyframes": 0,
    }
    assert len(result.points_ref_m) == 0


def test_a_log_that_is_no_text_is_one_line(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    (out / "mav1" / "received.jsonl").write_bytes(b"\xff\xfe{}\n")
    with pytest.raises(FlightError, match=r"received\.jsonl: .*invalid start byte"):
        gather(plan, out)


def test_a_report_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    plan, out = leave_behind(tmp_path, Flight())
    (out / "report.json").mkdir()
    with pytest.raises(FlightError, match=r"report\.json: Is a directory$"):
        conclude(plan, out, Conduct(), lambda *_: None)


def test_a_flight_without_a_frame_has_a_report(tmp_path: Path) -> None:
    """All daemons were killed with their first frames in hand."""
    plan, out = leave_behind(tmp_path, Flight(unlogged=EVERY_FRAME, refused=EVERY_FRAME))
    begins_ns = plan.starts_at_ns
    write_lives(out, {d.name: Lives([Life(begins_ns, begins_ns)], ()) for d in plan.drones})
    result = gather(plan, out)
    assert [drone.n_frames for drone in result.drones] == [0, 0]
    assert "<b>—</b><span>of frames localized" in page_of(result, out)


def test_map_points_are_carried_into_the_recording_s_frame(tmp_path: Path) -> None:
    result, _, _ = reported(tmp_path, Flight())
    in_world = NED_FROM_WORLD.inverse().apply(result.points_ref_m)
    # The map's own grid is 2^-12 m.
    assert np.all(in_world > np.array([5, -8, -9]) - 2e-4)
    assert np.all(in_world < np.array([12, 8, 1]) + 2e-4)


def test_the_recording_on_paper_is_one_that_can_be_read(tmp_path: Path) -> None:
    plan, _ = leave_behind(tmp_path, Flight(axes="NWU"))
    truth = read_recording(plan.recording.path).drone("mav1").truth
    assert truth is not None
    assert plan.starts_at_ns == START_NS
    assert truth.positions_m[7] == pytest.approx(ned_from_body(1, 7).translation, abs=1e-9)
