"""The daemon as a process: how it begins, and above all how it ends."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import pytest

from sitl.daemon_config import toml_text
from tests.daemon import demo
from tests.ports import free_ports
from tests.whole_lines import json_lines
from vcl_companion.recording import Description, RecordingWriter
from vcl_companion.wire.map_codec import revision_of

ROOT = Path(__file__).parents[2]
N_FRAMES = 4
BOUND_S = 30.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of one drone, as a recording of its own."""
    path = tmp_path_factory.mktemp("recorded") / "start"
    source = demo.recording().drones[0]
    with RecordingWriter(path, Description("start", 5.0, source.name, ())) as writer:
        writer.add_drone(source.name, source.sensor, source.truth)
        for frame in source.frames[:N_FRAMES]:
            writer.add_file(source.name, frame.at_ns, frame.path)
    return path


@dataclass(frozen=True)
class Daemon:
    """A running daemon and the files around it."""

    process: subprocess.Popen[str]
    log: Path

    @property
    def errors(self) -> IO[str]:
        assert self.process.stderr is not None
        return self.process.stderr

    def says(self, text: str) -> None:
        """Read its messages until one holds a text."""
        assert any(text in line for line in iter(self.errors.readline, "")), text

    def end(self) -> tuple[int, str]:
        """Wait for its end; return the exit status and the rest of what it said."""
        _, errors = self.process.communicate(timeout=BOUND_S)
        return self.process.returncode, errors

    def lines(self, kind: str) -> list[dict[str, Any]]:
        return [line for line in json_lines(self.log) if line["kind"] == kind]

    def assert_log_is_complete(self) -> dict[str, Any]:
        """Every frame that was read has its line, and the summary is the last one."""
        (summary,) = self.lines("summary")
        assert json.loads(self.log.read_text().splitlines()[-1]) == summary
        frames = self.lines("frame")
        assert [frame["sequence"] for frame in frames] == list(range(len(frames)))
        assert sum(summary["frames"].values()) == len(frames)
        assert sum(summary["refusals"].values()) == summary["frames"]["refused"]
        assert 0.0 < summary["cpu_s"] < 60.0
        assert 10.0 < summary["resident_mb"] < 4000.0
        return summary


@contextlib.contextmanager
def daemon(
    path: Path, camera: Mapping[str, str], level: str = "debug", **environment: str
) -> Iterator[Daemon]:
    """Start `vcl run` with an autopilot that never answers and no peers."""
    autopilot_port, peer_port = free_ports(2)
    config = {
        "system_id": 1,
        "clock": "camera",
        "camera": camera,
        "autopilot": {"link": f"udp:127.0.0.1:{autopilot_port}"},
        "peers": {"listen": f"127.0.0.1:{peer_port}", "to": []},
        "log": {"flight_log": str(path / "flight.jsonl"), "level": level},
        "map": {"directory": str(path / "maps")},
    }
    (path / "vcl.toml").write_text(toml_text(config))
    with subprocess.Popen(
        [sys.executable, "-m", "vcl_companion", "run", "--config", str(path / "vcl.toml")],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    ) as process:
        try:
            yield Daemon(process, path / "flight.jsonl")
        finally:
            process.kill()


def recorded(recording: Path) -> dict[str, str]:
    folder = recording / "mav0"
    return {"source": f"recording:{folder}", "calibration": str(folder / "cam0" / "sensor.yaml")}


def test_a_recording_ends_by_itself_and_a_service_manager_follows(
    recording: Path, tmp_path: Path
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(BOUND_S)
        with daemon(tmp_path, recorded(recording), NOTIFY_SOCKET=str(tmp_path / "notify")) as alone:
            status, errors = alone.end()
        assert status == 0, errors
        assert "Traceback" not in errors
        said = [manager.recv(1000).decode()]
        while said[-1] != "STOPPING=1":
            said.append(manager.recv(1000).decode())
        assert said[:2] == ["STATUS=compiling, once on this machine", "READY=1"]
        assert "STATUS=waiting for a map" in said
    summary = alone.assert_log_is_complete()
    assert summary["frames"] == {"localized": 0, "refused": N_FRAMES, "dropped": 0}
    reasons = {frame["reason"] for frame in alone.lines("frame")}
    assert all(reason.startswith("no map: ") for reason in reasons)


def test_a_restart_flies_on_the_map_that_was_saved(tmp_path: Path) -> None:
    saved = demo.encoded_map(1, 2)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "saved.vclmap").write_bytes(saved)
    with daemon(tmp_path, recorded(demo.DEMO)) as again:
        again.says("begins on the saved map")
        again.says("localized")
        again.process.terminate()
        status, errors = again.end()
    assert (status, "Traceback" in errors) == (0, False)
    assert again.lines("map")[0]["revision"] == revision_of(saved).hex()
    (summary,) = again.lines("summary")
    assert summary["frames"]["localized"] > 0


def test_sigterm_while_it_waits_for_its_camera(recording: Path, tmp_path: Path) -> None:
    (nobody,) = free_ports(1)
    camera = {**recorded(recording), "source": f"stream:127.0.0.1:{nobody}"}
    with daemon(tmp_path, camera) as starting:
        starting.says("peers 127.0.0.1")  # the camera is tried for ten seconds
        starting.process.terminate()
        status, errors = starting.end()
    assert (status, "Traceback" in errors) == (0, False)
    assert starting.assert_log_is_complete()["frames"]["refused"] == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_in_flight(recording: Path, tmp_path: Path, number: signal.Signals) -> None:
    with daemon(tmp_path, recorded(recording)) as flying:
        flying.says("frame 0: ")
        flying.process.send_signal(number)
        status, errors = flying.end()
    assert (status, "Traceback" in errors) == (0, False)
    assert 1 <= flying.assert_log_is_complete()["frames"]["refused"] <= N_FRAMES


def test_sigterm_again_and_again_until_the_end(recording: Path, tmp_path: Path) -> None:
    with daemon(tmp_path, recorded(recording)) as flying:
        flying.says("frame 0: ")
        while flying.process.poll() is None:
            flying.process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                flying.process.wait(0.002)
        assert flying.process.returncode == 0
    flying.assert_log_is_complete()


def test_a_camera_that_cannot_be_used_is_one_line_and_status_2(
    recording: Path, tmp_path: Path
) -> None:
    missing = shutil.copytree(recording, tmp_path / "missing")
    sorted((missing / "mav0" / "cam0" / "data").iterdir())[2].unlink()
    nowhere = {**recorded(recording), "calibration": str(tmp_path / "nowhere.yaml")}
    for camera, named in ((nowhere, "nowhere.yaml"), (recorded(missing), "mav0")):
        with daemon(tmp_path, camera, level="info") as failing:
            status, errors = failing.end()
        assert status == 2, errors
        assert errors.startswith("vcl: ")
        assert errors.count("\n") == 1
        assert named in errors


def test_a_camera_that_breaks_in_flight_leaves_a_complete_log(tmp_path: Path) -> None:
    flown = shutil.copytree(demo.DEMO, tmp_path / "demo")
    with daemon(tmp_path, recorded(flown)) as failing:
        failing.says("frame 0: ")
        shutil.rmtree(flown / "mav0" / "cam0" / "data")
        status, errors = failing.end()
    assert status == 2, errors
    (said,) = (line for line in errors.splitlines() if line.startswith("vcl: "))
    assert "mav0" in said
    assert "Traceback" not in errors
    frames = failing.assert_log_is_complete()["frames"]
    assert 2 <= frames["refused"] < len(demo.recording().drones[0].frames)
