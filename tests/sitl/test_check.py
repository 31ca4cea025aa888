"""``vcl check`` against the stand-in: each wrong parameter is named, mended and put back."""

import asyncio
import contextlib
import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result

from sitl.autopilots.stand_in import PARAMETERS
from sitl.frame_server import FrameServer
from sitl.processes import FlightError
from tests.daemon import turned_by_hand as by_hand
from vcl_companion.cli import main
from vcl_companion.clock import SystemClock
from vcl_companion.daemon.check_host import judge_frames
from vcl_companion.daemon.parameter_rules import Finding, findings, rules_for
from vcl_companion.geometry.pose import Pose
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.vision_pose import Firmware
from vcl_companion.recording.sensor import Sensor, write_sensor

ROOT = Path(__file__).parents[2]
DRONE = ROOT / "sitl" / "recordings" / "demo" / "mav0"
SYSTEM = 3

# What a PX4 that flies on our poses has.
PX4 = {
    "EKF2_EN": 1.0, "EKF2_EV_CTRL": 11.0, "EKF2_HGT_REF": 1.0, "EKF2_GPS_CTRL": 0.0,
    "EKF2_EV_POS_X": 0.0, "EKF2_EV_POS_Y": 0.0, "EKF2_EV_POS_Z": 0.0, "EKF2_EV_NOISE_MD": 0.0,
    "EKF2_EVP_NOISE": 0.01, "EKF2_EV_QMIN": 0.0, "SYS_HAS_GPS": 0.0,
}  # fmt: skip


def at_rest(_: float) -> Pose:
    return Pose(np.eye(3), np.array([0.0, 0.0, -5.0]))


@contextlib.contextmanager
def autopilot(
    folder: Path,
    parameters: Mapping[str, float],
    pose_at: Callable[[float], Pose] = at_rest,
    began_s: float | None = None,
) -> Iterator[int]:
    """A stand-in that is where ``pose_at`` says so long after it began; yields its port."""
    folder.mkdir(exist_ok=True)
    start_ns = 1_760_000_000_000_000_000
    rows = []
    for k in range(20 * 60):
        pose = pose_at(k / 20)
        values = [*pose.translation.tolist(), *pose.quaternion().tolist()]
        rows.append(f"{start_ns + k * 50_000_000},{','.join(map(repr, values))}")
    truth = folder / "truth.csv"
    truth.write_text("\n".join(["at_ns,x,y,z,qw,qx,qy,qz", *rows]) + "\n")
    config = folder / "stand_in.json"
    config.write_text(
        json.dumps(
            {
                "system_id": SYSTEM,
                "boot_offset_ns": start_ns - 60 * 10**9,
                "attitude": {"source": "truth", "file": str(truth)},
                "out": str(folder / "out"),
                "parameters": dict(parameters),
            }
        )
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "sitl.autopilots.stand_in", str(config)],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    over = threading.Event()

    def go_on() -> None:
        assert process.stdin is not None
        assert process.stdout is not None
        since_s = time.monotonic() if began_s is None else began_s
        while not over.wait(0.01):
            now_ns = start_ns + round((time.monotonic() - since_s) * 1e9)
            process.stdin.write(json.dumps({"advance_to_ns": now_ns}) + "\n")
            process.stdin.flush()
            process.stdout.readline()

    try:
        assert process.stdout is not None
        port = json.loads(process.stdout.readline())["port"]
        thread = threading.Thread(target=go_on)
        thread.start()
        try:
            yield port
        finally:
            over.set()
            thread.join()
    finally:
        process.kill()
        process.communicate()


def config_of(tmp_path: Path, port: int, autopilot: str = "", camera: str = "") -> Path:
    path = tmp_path / "one.toml"
    camera = (
        camera
        or f"""source = "recording:{DRONE}"
calibration = "{DRONE / "cam0" / "sensor.yaml"}"
"""
    )
    path.write_text(
        f"""system_id = {SYSTEM}
[camera]
{camera}
[autopilot]
link = "udp:127.0.0.1:{port}"
{autopilot}
[map]
directory = "{tmp_path / "maps"}"
"""
    )
    return path


@contextlib.contextmanager
def camera(began_s: float, rate_hz: float = by_hand.RATE_HZ) -> Iterator[int]:
    """A camera that shows the drone that is turned by hand since an instant; yields its port."""
    ported: queue.Queue[int] = queue.Queue()
    encoded = [bytes(cv2.imencode(".png", image)[1]) for image in by_hand.images()]
    over = threading.Event()

    async def serve() -> None:
        server = FrameServer("mav0")
        ported.put(await server.start())
        k = 0
        while not over.is_set():
            k += 1
            at_s = began_s + k / rate_hz
            if at_s < time.monotonic() - 0.5 / rate_hz:
                continue
            await asyncio.sleep(max(at_s - time.monotonic(), 0.0))
            if server.is_connected:
                shown = round(by_hand.folded(k / rate_hz) * by_hand.RATE_HZ)
                image = encoded[min(shown, len(encoded) - 1)]
                try:
                    server.give(k, round(at_s * 1e9), image)
                except FlightError:
                    await server.was_killed()  # who looked has hung up: another may look
        await server.close()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    try:
        yield ported.get()
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def held(tmp_path: Path, mounting_deg: str, rate_hz: float = by_hand.RATE_HZ) -> Iterator[Path]:
    """A drone that is turned by hand; yields its configuration, with a mounting."""
    by_hand.images()
    began_s = time.monotonic()
    sensor = tmp_path / "camera.yaml"
    write_sensor(sensor, Sensor(by_hand.LENS, by_hand.BODY_FROM_CAM, by_hand.RATE_HZ))

    def pose_at(at_s: float) -> Pose:
        return by_hand.world_from_body(by_hand.folded(at_s))

    with (
        camera(began_s, rate_hz) as camera_port,
        autopilot(tmp_path / "a", {}, pose_at, began_s) as port,
    ):
        lines = f"""source = "stream:127.0.0.1:{camera_port}"
calibration = "{sensor}"
mounting_deg = {mounting_deg}
"""
        yield config_of(tmp_path, port, camera=lines)


def line_of(result: Result, name: str) -> str:
    """What is said of one thing."""
    (line,) = [text for text in result.output.splitlines() if text.split()[1:2] == [name]]
    return line


def test_a_drone_turned_by_hand_shows_that_its_camera_sits_right(tmp_path: Path) -> None:
    with held(tmp_path, "[0, -10, 0]") as config:
        result = check(config, "--tilt")
    assert result.exit_code == 0, result.output
    assert "Hold the drone" in result.output
    assert line_of(result, "axes").startswith("ok ")
    assert line_of(result, "latency").startswith("ok ")


def test_a_drone_turned_by_hand_shows_that_its_camera_sits_wrong(tmp_path: Path) -> None:
    with held(tmp_path, "[90, 0, 0]") as config:
        result = check(config, "--tilt")
    assert result.exit_code == 1
    line = line_of(result, "axes")
    assert line.startswith("failure ")
    assert "camera.mounting_deg = [0, -10, 0]" in line


def test_a_camera_of_one_hertz_is_a_failure(tmp_path: Path) -> None:
    with held(tmp_path, "[0, -10, 0]", rate_hz=1.0) as config:
        result = check(config)
    assert result.exit_code == 1
    assert line_of(result, "camera").startswith("failure ")


def check(config: Path, *options: str, answer: str = "") -> Result:
    return CliRunner().invoke(main, ["check", "--config", str(config), *options], input=answer)


def test_what_is_right_is_said_to_be(tmp_path: Path) -> None:
    with autopilot(tmp_path / "a", {}) as port:
        result = check(config_of(tmp_path, port), "--json")
    said = json.loads(result.output)
    grades = {one["name"]: one["grade"] for one in said["checks"]}
    assert grades["autopilot"] == grades["link"] == grades["time"] == "ok", said
    assert grades["parameters"] == grades["disk"] == "ok", said
    assert grades["camera"] in ("ok", "warning"), said
    assert said["good"]
    assert result.exit_code == 0


def test_wrong_parameters_are_named_mended_and_put_back(tmp_path: Path) -> None:
    wrong = {"EK3_SRC1_POSXY": 3.0, "VISO_TYPE": 0.0, "GPS1_TYPE": 1.0}
    kept = tmp_path / "one.parameters.json"
    with autopilot(tmp_path / "a", wrong) as port:
        config = config_of(tmp_path, port)
        result = check(config)
        assert result.exit_code == 1
        for name, advice in (("EK3_SRC1_POSXY", "6"), ("VISO_TYPE", "1"), ("GPS1_TYPE", "0")):
            (line,) = [text for text in result.output.splitlines() if name in text]
            assert line.endswith(f"set it to {advice}")
        assert check(config, "--fix", answer="n\n").exit_code == 1
        assert not kept.exists()
        # What they were is kept before anything is set, or nothing is.
        kept.mkdir()
        unkept = check(config, "--fix", "--yes")
        assert unkept.exit_code == 2
        assert "one.parameters.json: Is a directory" in unkept.output
        assert "EK3_SRC1_POSXY" in check(config).output
        kept.rmdir()
        mended = check(config, "--fix", answer="y\n")
        assert mended.exit_code == 0, mended.output
        assert json.loads(kept.read_text()) == wrong
        assert check(config, "--fix").exit_code == 0  # nothing is left to mend
        back = check(config, "--restore", "--yes")
        assert back.exit_code == 0, back.output
        assert not kept.exists()

        async def values() -> dict[str, float | None]:
            link = AutopilotLink(
                AutopilotOptions(link=f"udp:127.0.0.1:{port}"), SYSTEM, SystemClock()
            )
            running = asyncio.ensure_future(link.run())
            found = {name: await link.parameter(name) for name in wrong}
            running.cancel()
            return found

        assert asyncio.run(values()) == wrong
        again = check(config, "--restore")
        assert again.exit_code == 2
        assert "nothing to restore" in again.output
    for broken in ('{"VISO_TYPE": NaN}', "{}"):
        kept.write_text(broken)
        nothing = check(config, "--restore", "--yes")
        assert nothing.exit_code == 2
        assert "one.parameters.json: holds no parameters" in nothing.output
    kept.write_text('{"VISO_TYPE": 0}')
    alone = check(config, "--restore", "--yes")
    assert alone.exit_code == 2
    assert alone.output.endswith(f"over udp:127.0.0.1:{port}: nothing is changed\n")


def test_an_autopilot_that_is_not_there_is_said_in_words(tmp_path: Path) -> None:
    result = check(config_of(tmp_path, 9))
    assert result.exit_code == 1
    (line,) = [text for text in result.output.splitlines() if " autopilot " in text]
    assert "no heartbeat of system 3" in line
    assert "Traceback" not in result.output
    assert check(config_of(tmp_path, 9), "--fix", "--restore").exit_code == 2
    assert check(config_of(tmp_path, 9), "--tilt", "--restore").exit_code == 2


@pytest.mark.parametrize(
    ("firmware", "right", "name", "value", "severity"),
    [
        (Firmware.ARDUPILOT, PARAMETERS, "AHRS_EKF_TYPE", 10.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "EK3_ENABLE", 0.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "VISO_TYPE", 3.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "EK3_SRC1_POSXY", 3.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "EK3_SRC1_VELXY", 6.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "EK3_SRC1_VELZ", 3.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "EK3_SRC1_POSZ", 3.0, "warns"),
        (Firmware.ARDUPILOT, PARAMETERS, "EK3_SRC1_YAW", 2.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "VISO_ORIENT", 4.0, "dangerous"),
        (Firmware.ARDUPILOT, PARAMETERS, "VISO_SCALE", 2.0, "dangerous"),
        (Firmware.ARDUPILOT, PARAMETERS, "VISO_POS_Z", 0.1, "dangerous"),
        (Firmware.ARDUPILOT, PARAMETERS, "VISO_QUAL_MIN", 1.0, "prevents"),
        (Firmware.ARDUPILOT, PARAMETERS, "VISO_POS_M_NSE", 0.1, "warns"),
        (Firmware.ARDUPILOT, PARAMETERS, "GPS1_TYPE", 1.0, "warns"),
        (Firmware.PX4, PX4, "EKF2_EV_CTRL", 0.0, "prevents"),
        (Firmware.PX4, PX4, "EKF2_EV_CTRL", 15.0, "prevents"),
        (Firmware.PX4, PX4, "EKF2_HGT_REF", 3.0, "dangerous"),
        (Firmware.PX4, PX4, "EKF2_EV_POS_X", 0.1, "dangerous"),
        (Firmware.PX4, PX4, "EKF2_EN", 0.0, "prevents"),
        (Firmware.PX4, PX4, "EKF2_EV_QMIN", 1.0, "prevents"),
        (Firmware.PX4, PX4, "EKF2_GPS_CTRL", 7.0, "warns"),
        (Firmware.PX4, PX4, "EKF2_EV_NOISE_MD", 1.0, "warns"),
        (Firmware.PX4, PX4, "EKF2_EVP_NOISE", 0.1, "warns"),
        (Firmware.PX4, PX4, "SYS_HAS_GPS", 1.0, "warns"),
    ],
)
def test_each_parameter_that_is_wrong_is_found_alone(
    firmware: Firmware, right: Mapping[str, float], name: str, value: float, severity: str
) -> None:
    rules = rules_for(firmware, sends_velocity=False, sets_origin=True)
    assert findings(rules, right) == []
    (found,) = findings(rules, {**right, name: value})
    assert (found.name, found.value, found.severity) == (name, value, severity)
    assert findings(rules, {**right, name: found.should_be}) == []
    missing = {key: one for key, one in right.items() if key != name}
    assert all(one.value is None for one in findings(rules, missing))


def test_who_is_sent_odometry_may_fuse_its_velocity() -> None:
    def found(firmware: Firmware, values: Mapping[str, float]) -> list[Finding]:
        return findings(rules_for(firmware, sends_velocity=True, sets_origin=False), values)

    assert found(Firmware.ARDUPILOT, {**PARAMETERS, "EK3_SRC1_VELXY": 6.0}) == []
    assert found(Firmware.PX4, {**PX4, "EKF2_EV_CTRL": 15.0}) == []
    assert found(Firmware.OTHER, {}) == []


def test_a_height_by_vision_is_a_danger_only_with_an_origin() -> None:
    rules = rules_for(Firmware.PX4, sends_velocity=False, sets_origin=False)
    assert findings(rules, {**PX4, "EKF2_HGT_REF": 3.0}) == []
    (found,) = findings(rules, {key: value for key, value in PX4.items() if key != "EKF2_HGT_REF"})
    assert (found.name, found.value) == ("EKF2_HGT_REF", None)


@pytest.mark.parametrize(
    ("rate_hz", "grey", "grade"),
    [
        (30.0, 120.0, "ok"),
        (7.0, 120.0, "warning"),
        (1.0, 120.0, "failure"),
        (30.0, 5.0, "warning"),
        (30.0, 250.0, "warning"),
    ],
)
def test_a_camera_is_judged_by_its_rate_and_its_exposure(
    rate_hz: float, grey: float, grade: str
) -> None:
    n_frames = int(4.0 * rate_hz)
    times = [round(k * 1e9 / rate_hz) for k in range(n_frames)]
    assert judge_frames(times, [grey] * n_frames).grade == grade


def test_a_camera_without_frames_is_a_failure() -> None:
    assert judge_frames([], []).grade == "failure"
