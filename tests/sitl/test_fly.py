"""Whole flights from the command line: real daemons, real stand-ins, real sockets."""

from __future__ import annotations

import itertools
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from sitl.__main__ import main
from tests.whole_lines import json_lines
from vcl_companion.recording import Description, RecordingWriter, read_recording
from vcl_companion.recording.tum import read_tum

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "sitl" / "recordings" / "demo"
N_FRAMES = 4
DRONES = ("mav0", "mav1", "mav2")
TIMEOUT_S = 60.0


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "sitl", "fly", *map(str, arguments)]


def sitl_fly(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


def start_of_demo(path: Path, frames: dict[str, slice] | None = None) -> Path:
    """Write the first frames of the demo, or some of each drone, as a recording of its own."""
    demo = read_recording(DEMO)
    description = Description(
        "start of demo",
        demo.frame_rate_hz,
        demo.leader,
        demo.known_distances,
        demo.distance_sigma_m,
        demo.calibration_px,
    )
    with RecordingWriter(path, description) as writer:
        for drone in demo.drones:
            writer.add_drone(drone.name, drone.sensor, drone.truth)
            for frame in drone.frames[frames[drone.name] if frames else slice(N_FRAMES)]:
                writer.add_file(drone.name, frame.at_ns, frame.path)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return start_of_demo(tmp_path_factory.mktemp("a recording") / "start")


@pytest.fixture(scope="module")
def flown(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of one flight as fast as the daemons keep up."""
    out = tmp_path_factory.mktemp("flown") / "out put"
    done = sitl_fly(recording, "--out", out, "--speed", "max")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert str(out / "report.html") in done.stdout
    assert "\x1b" not in done.stdout
    return out


def report_in(out: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((out / "report.json").read_text())
    return report


def poses_received(out: Path, drone: str) -> list[dict[str, Any]]:
    """Return the fields of every VISION_POSITION_ESTIMATE an autopilot heard."""
    lines = json_lines(out / drone / "received.jsonl")
    return [line["fields"] for line in lines if line["type"] == "VISION_POSITION_ESTIMATE"]


def test_a_flight_accounts_for_every_frame_and_is_close_to_the_truth(flown: Path) -> None:
    report = report_in(flown)
    assert set(report["drones"]) == set(DRONES)
    for name in DRONES:
        drone = report["drones"][name]
        assert drone["frames"] == N_FRAMES
        outcomes = [drone[f"frames_{how}"] for how in ("localized", "refused", "dropped")]
        assert sum(outcomes) == N_FRAMES
        assert drone["unaccounted"] == drone["frames_dropped"] == 0
        assert drone["localized_share"] == 1.0
        assert 0.0 <= drone["ate_m"] <= 0.15
        assert 0.0 < drone["latency_ms"]["p50"] <= drone["latency_ms"]["p99"] < 2000.0
    assert report["map"]["landmarks"] >= 50
    assert [event for event in report["events"] if event["kind"] == "harness"] == []


def test_a_flight_at_five_hertz_tells_ten_poses_a_second(flown: Path) -> None:
    report = report_in(flown)
    for name in DRONES:
        instants = [pose["usec"] for pose in poses_received(flown, name)]
        assert instants == sorted(set(instants))
        assert [b - a for a, b in itertools.pairwise(instants)] == [100_000] * (2 * N_FRAMES - 2)
        between = report["drones"][name]["between"]
        assert between["poses"] == N_FRAMES - 1
        # Its speed is not known between the first two.
        assert 0.0 < between["ate_m"] < 0.3


def test_a_flight_leaves_the_files_that_the_format_promises(flown: Path, recording: Path) -> None:
    frames = {d.name: [f.at_ns for f in d.frames] for d in read_recording(recording).drones}
    for name in DRONES:
        assert [row[0] for row in read_tum(flown / name / "truth.tum")] == frames[name]
        estimates = read_tum(flown / name / "estimate.tum")
        assert [row[0] for row in estimates] == frames[name]
        covariances = (flown / name / "covariance.csv").read_text().splitlines()
        assert len(covariances) == 1 + len(estimates)
        assert all(len(row.split(",")) == 22 for row in covariances)
    first, true = (read_tum(flown / "mav0" / f"{kind}.tum")[0][1] for kind in ("estimate", "truth"))
    assert first.translation == pytest.approx(true.translation, abs=1e-6)
    assert (flown / "report.html").stat().st_size > 50_000


def test_the_drones_of_a_flight_sign_what_they_say_to_each_other(flown: Path) -> None:
    key = flown / "run" / "swarm.key"
    assert key.stat().st_mode & 0o077 == 0
    secret = key.read_text().strip().encode()
    for name in DRONES:
        config = tomllib.loads((flown / "run" / name / "daemon.toml").read_text())
        assert config["peers"]["key_file"] == str(key)
        # It has taken signed frames of all others, and so have they of it.
        remembered = json.loads((flown / "run" / name / "signing.json").read_text())
        heard = {stream[0] for stream in remembered["streams"]}
        assert heard == set(config["swarm"]["members"]) - {config["system_id"]}
    told = (path for path in flown.rglob("*") if path.is_file() and path != key)
    assert not any(secret in path.read_bytes() for path in told)


def test_what_the_drones_say_to_each_other_is_counted_by_message(flown: Path) -> None:
    for drone in report_in(flown)["drones"].values():
        link = drone["peer_link"]
        said = link["by_message"]
        assert {"heartbeat", "map state", "transfer status"} <= set(said)
        assert said["heartbeat"]["payload_bytes"] == 0
        assert sum(one["wire_bytes"] for one in said.values()) == link["wire_bytes"]
        assert 0 < link["payload_bytes"] < link["wire_bytes"]
        # The daemon's own count ends a moment before it falls silent.
        assert link["wire_bytes"] == pytest.approx(drone["peer_bytes_sent"], rel=0.02)
        network = link["network"]
        # On one air, where two others hear what one sends.
        assert network["offered"] == network["delivered"] == 2 * link["messages"]
        assert network["delay_max_ms"] == 0.0
    chunks = {
        name for d in report_in(flown)["drones"].values() for name in d["peer_link"]["by_message"]
    }
    # The first map goes without the images that all have heard.
    assert {"chunk: map update", "chunk: frame answer"} <= chunks


def test_a_swarm_flies_over_a_bad_network_and_the_report_says_how_bad(
    recording: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    done = sitl_fly(
        recording, "--out", out, "--speed", "max", "--loss", "0.2", "--burst", "3", "--delay",
        "0.02", "--jitter", "0.01", "--duplicate", "0.1", "--corrupt", "0.05",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    report = report_in(out)
    assert report["options"]["network"]["loss"] == 0.2
    for name, drone in report["drones"].items():
        assert drone["localized_share"] == 1.0, name
        network = drone["peer_link"]["network"]
        assert network["offered"] == (
            network["lost"] + network["delivered"] - network["duplicated"]
        )
        assert min(network[key] for key in ("lost", "duplicated", "corrupted")) > 0
        assert 20.0 <= network["delay_mean_ms"] <= network["delay_max_ms"] <= 30.001
    assert "chunk: map" in done.stdout
    assert "Between the drones" in (out / "report.html").read_text()
    assert [event for event in report["events"] if event["kind"] == "harness"] == []


def test_a_camera_that_dies_ends_in_silence_and_its_return_in_poses(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = sitl_fly(DEMO, "--out", out, "--speed", "max", "--blind", "mav1=1-4")
    assert done.returncode == 0, done.stderr
    report = report_in(out)
    assert report["options"]["blind"] == ["--blind mav1=1-4"]
    assert "--blind mav1=1-4" in (out / "report.html").read_text()
    for name, n_blind in (("mav0", 0), ("mav1", 15)):
        drone = report["drones"][name]
        n_frames = 60 - n_blind
        assert (drone["frames"], drone["frames_localized"]) == (n_frames, n_frames)
    told_s = np.array([pose["usec"] for pose in poses_received(out, "mav1")]) * 1e-6
    told_s -= told_s[0]
    # Between frames, and half a second beyond the last one.
    assert told_s[told_s < 4.0].max() == pytest.approx(0.8 + 0.5, abs=0.01)
    assert told_s[told_s > 1.4].min() == pytest.approx(4.0, abs=0.01)


def test_drones_that_begin_apart_fly_from_where_they_are_together(tmp_path: Path) -> None:
    """mav1, whose distance is known, comes 1.4 s after the others; one image of mav2 is damaged."""
    frames = {"mav0": slice(11), "mav1": slice(7, 11), "mav2": slice(11)}
    path = start_of_demo(tmp_path / "apart", frames)
    drone = read_recording(path).drone("mav2")
    height, width = drone.sensor.camera.height_px, drone.sensor.camera.width_px
    size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    # A header, the end marker, and nothing between them.
    drone.frames[9].path.write_bytes(
        b"\xff\xd8\xff\xc0\x00\x0b\x08" + size + b"\x01\x01\x11\x00\xff\xd9"
    )
    out = tmp_path / "out"
    done = sitl_fly(path, "--out", out, "--speed", "max")
    assert done.returncode == 0, done.stderr
    report = report_in(out)
    assert report["duration_s"] == pytest.approx(0.6)
    for name, drone_report in report["drones"].items():
        damaged = int(name == "mav2")
        assert drone_report["frames"] == 4
        assert drone_report["frames_localized"] == 4 - damaged
        assert drone_report["refusals"] == ({"undecodable image": 1} if damaged else {})
        assert drone_report["unaccounted"] == 0
        assert drone_report["ate_m"] < 0.05
    told = {e["drone"]: e["reason"] for e in report["events"] if e["kind"] == "harness"}
    assert told.keys() == {"mav0", "mav2"}
    assert all(reason.startswith("7 frames not flown") for reason in told.values())


def test_nothing_of_the_truth_reaches_a_daemon(
    flown: Path, recording: Path, tmp_path: Path
) -> None:
    """With the truth files gone, the same attitude gives the same poses, bit for bit."""
    blind = shutil.copytree(recording, tmp_path / "blind")
    for name in DRONES:
        shutil.rmtree(blind / name / "state_groundtruth_estimate0")
    distance_m = report_in(flown)["options"]["known_distances_m"]
    known = [f"--known-distance={pair}={metres!r}" for pair, metres in distance_m.items()]
    known.append(f"--set=map.distance_sigma_m={read_recording(recording).distance_sigma_m}")
    out = tmp_path / "again"
    done = sitl_fly(blind, "--out", out, "--speed", "max", "--attitude", flown, *known)
    assert done.returncode == 0, done.stderr
    for name in DRONES:
        before, after = poses_received(flown, name), poses_received(out, name)
        assert after == before
        # Those between frames are the same as well.
        assert len(before) == 2 * N_FRAMES - 1
        assert report_in(out)["drones"][name]["ate_m"] is None
        assert not (out / name / "truth.tum").exists()
        attitudes = [(folder / name / "attitude.csv").read_bytes() for folder in (flown, out)]
        assert attitudes[0] == attitudes[1]


@contextmanager
def under_way(recording: Path, out: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Start a flight and hand it over when its first frames are out and all processes run."""
    # A test run in the background ignores Ctrl-C; what it starts must not inherit that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        command(recording, "--out", out, *options),
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        bufsize=1,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    ) as flight:
        signal.signal(signal.SIGINT, before)
        try:
            assert flight.stdout is not None
            stages = iter(flight.stdout.readline, "")
            assert any(stage.startswith("making the first map") for stage in stages)
            yield flight
        finally:
            flight.kill()


def processes_of(out: Path) -> dict[str, int]:
    """Return a pidfd of every process of a flight, by drone and kind."""
    files = sorted((out / "run").glob("mav*/*.pid"))
    return {f"{f.parent.name} {f.stem}": os.pidfd_open(int(f.read_text())) for f in files}


def assert_all_end(processes: dict[str, int]) -> None:
    """Every process is gone within a moment; a pidfd can be read when its process is."""
    for name, pidfd in processes.items():
        assert select.select([pidfd], [], [], 10.0)[0], f"{name} still runs"
        os.close(pidfd)


def test_a_crash_of_one_ends_all_and_is_named(recording: Path, tmp_path: Path) -> None:
    with under_way(recording, tmp_path / "out") as flight:
        processes = processes_of(tmp_path / "out")
        assert len(processes) == 6
        signal.pidfd_send_signal(processes["mav1 daemon"], signal.SIGKILL)
        _, errors = flight.communicate(timeout=TIMEOUT_S)
    assert flight.returncode == 1
    assert errors.startswith("sitl: daemon of mav1 was ended by SIGKILL")
    assert errors.count("\n") == 1
    assert_all_end(processes)


@pytest.mark.parametrize(
    ("sent", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)]
)
def test_no_process_is_left_however_a_flight_is_ended(
    recording: Path, tmp_path: Path, sent: signal.Signals, status: int
) -> None:
    with under_way(recording, tmp_path / "out") as flight:
        processes = processes_of(tmp_path / "out")
        flight.send_signal(sent)
        _, errors = flight.communicate(timeout=TIMEOUT_S)
    assert flight.returncode == status
    assert "Traceback" not in errors
    assert_all_end(processes)


def test_a_daemon_that_does_not_start_says_why(recording: Path, tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere.yaml"
    done = sitl_fly(
        recording, "--out", tmp_path / "out", "--set", f"camera.calibration='{nowhere}'"
    )
    assert done.returncode == 1
    assert "ended with exit code 2" in done.stderr
    assert f"{nowhere}: " in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--set", "camera.sorce='oak'"), "--set: camera.sorce: unknown key"),
        (("--queue", "3"), "--queue says how long datagrams wait for the --rate; give one"),
        (("--parameter", "EK3_X=1"), "--parameter: is for a real --autopilot"),
    ],
)
def test_what_would_do_nothing_is_refused_before_anything_is_done(
    recording: Path, tmp_path: Path, options: tuple[str, str], says: str
) -> None:
    done = sitl_fly(recording, "--out", tmp_path / "out", *options)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_input_that_cannot_be_used_is_one_line_and_status_2(
    recording: Path, tmp_path: Path
) -> None:
    broken = shutil.copytree(recording, tmp_path / "broken")
    next((broken / "mav1" / "cam0" / "data").iterdir()).unlink()
    out = tmp_path / "out"
    for arguments, message in (
        ((tmp_path / "nowhere",), "no such folder"),
        ((broken,), "mav1"),
        ((recording, "--drones", "mav9"), "no 'mav9'"),
        ((recording, "--drones", " ,"), "' ,' names nobody"),
        ((recording, "--speed", "fast"), "'fast' is neither a positive number nor max"),
        ((recording, "--set", "system_id=3"), "--set system_id: each daemon is given its own"),
        ((recording, "--set", "log.level=debug"), "a string needs quotes"),
        ((recording, "--attitude", tmp_path), "no mav0/attitude.csv"),
        ((recording, "--loss", "1.5"), "--loss must be a share of 0 to 1, got 1.5"),
        ((recording, "--burst", "5"), "--burst needs a --loss"),
        ((recording, "--rate", "-57600"), "--rate must be positive bits per second"),
        ((recording, "--partition", "10-40"), "like 10-40:mav0|mav1,mav2"),
        ((recording, "--partition", "1-2:mav0|mav7"), "'mav7' does not fly (mav0, mav1, mav2)"),
    ):
        done = CliRunner().invoke(main, ["fly", *map(str, arguments), "--out", str(out)])
        assert done.exit_code == 2, arguments
        assert message in done.stderr
        assert done.stderr.startswith("sitl: ")
        assert done.stderr.count("\n") == 1
        assert not out.exists()


def test_two_of_three_fly_against_the_clock(recording: Path, tmp_path: Path) -> None:
    """Nobody waits for a daemon then: a frame may be dropped, but never be forgotten."""
    out = tmp_path / "out"
    done = sitl_fly(recording, "--out", out, "--speed", "4", "--drones", "mav0,mav1")
    assert done.returncode == 0, done.stderr
    report = report_in(out)
    assert list(report["drones"]) == ["mav0", "mav1"]
    assert all(drone["unaccounted"] == 0 for drone in report["drones"].values())
    assert report["wall"]["flight_s"] >= (N_FRAMES - 1) * 0.2 / 4
    assert not (out / "mav2").exists()
