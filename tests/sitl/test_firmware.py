"""A real autopilot in a recorded flight, or a program that speaks its interface."""

import json
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sitl.autopilots.attitude_source import read_table
from sitl.autopilots.firmware_options import read_options
from sitl.autopilots.px4_parameters import RECORDED, of_a_mission
from sitl.evaluation import Estimates
from sitl.firmware import FirmwareBinary, parse_firmware
from sitl.fly import fly
from sitl.fused import read_fused
from sitl.mission import Mission
from sitl.plan import FlyOptions
from tests.whole_lines import whole_lines
from vcl_companion.daemon.status import read_status
from vcl_companion.errors import ConfigError, VclError
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording import Trajectory

ROOT = Path(__file__).parents[2]
DEMO = ROOT / "sitl" / "recordings" / "demo"
_ARDUPILOT = os.environ.get("VCL_ARDUPILOT", "")


def quiet(*_: object) -> None:
    pass


def program(path: Path, name: str) -> None:
    """Put a program of these tests where a firmware's binary would be."""
    script = ROOT / "tests" / "sitl" / name
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" "{script}" "$@"\n')
    path.chmod(0o755)


@pytest.fixture
def vehicle(tmp_path: Path) -> Path:
    path = tmp_path / "arducopter"
    program(path, "json_vehicle.py")
    return path


@pytest.fixture
def build(tmp_path: Path) -> Path:
    """A folder like that of a PX4 built for simulation."""
    folder = tmp_path / "px4_sitl_default"
    for inner in ("bin", "etc/init.d-posix"):
        (folder / inner).mkdir(parents=True)
    (folder / "etc" / "init.d-posix" / "rcS").touch()
    program(folder / "bin" / "px4", "lockstep_vehicle.py")
    return folder


def flown(tmp_path: Path, firmware: FirmwareBinary, speed: float) -> dict[str, dict[str, float]]:
    options = FlyOptions(speed=speed, firmware=firmware)
    report = fly(DEMO, tmp_path / "out", options, quiet)
    assert report["options"]["autopilot"] == firmware.kind
    for name, drone in report["drones"].items():
        assert drone["localized_share"] == 1.0, name
        assert drone["unaccounted"] == 0
    return {name: drone["fused"] for name, drone in report["drones"].items()}


def test_a_flight_moves_a_firmware_s_sensors_and_hands_it_our_poses(
    tmp_path: Path, vehicle: Path
) -> None:
    fused = flown(tmp_path, parse_firmware(f"ardupilot={vehicle}"), math.inf)
    for said in fused.values():
        assert said["fused_after_s"] < 1.5
        # It holds each pose until the next: what it is off by is the way between, and no more.
        assert said["own_ate_m"] < 0.05
        assert said["ate_m"] < 1.0
    for name in fused:
        attitudes = (tmp_path / "out" / name / "attitude.csv").read_text().splitlines()
        assert len(attitudes) > 100
        assert "estimator flags 0x33f" in (tmp_path / "out" / name / "said.csv").read_text()
        status = read_status(tmp_path / "out" / "run" / name / "status.json")
        assert status.autopilot.firmware == "ardupilot"
    page = (tmp_path / "out" / "report.html").read_text()
    assert "What the autopilots made of it" in page


def test_a_flight_moves_px4_s_sensors_and_hands_it_our_poses_and_the_time(
    tmp_path: Path, build: Path
) -> None:
    fused = flown(tmp_path, parse_firmware(f"px4={build}"), math.inf)
    for name, said in fused.items():
        assert said["fused_after_s"] < 1.5
        # It holds each pose until the next: what it is off by is the way between, and no more.
        assert said["own_ate_m"] < 0.05
        assert said["ate_m"] < 1.0
        status = read_status(tmp_path / "out" / "run" / name / "status.json")
        assert status.autopilot.firmware == "px4"
        measured = read_table(tmp_path / "out" / name / "attitude.csv", 5)
        true = read_table(tmp_path / "out" / "run" / name / "truth.csv", 8)
        turned = Rotation.from_quat(np.roll(measured[1], -1, axis=1)[-1])
        off = turned.inv() * Rotation.from_quat(np.roll(true[1][:, 3:], -1, axis=1)[-1])
        assert np.rad2deg(off.magnitude()) < 1.5
        # It says where it is in the first of each five of its steps.
        config = json.loads((tmp_path / "out" / "run" / name / "stand_in.json").read_text())
        said_ns = [
            int(line.split(",")[0])
            for line in whole_lines(tmp_path / "out" / name / "fused.csv")[1:]
        ]
        since_ns = np.array(said_ns) - config["boot_offset_ns"]
        assert set(since_ns % 20_000_000) == {4_000_000}


def test_a_folder_without_px4_s_scripts_ends_the_flight_in_one_line(
    tmp_path: Path, build: Path
) -> None:
    (build / "etc" / "init.d-posix" / "rcS").unlink()
    with pytest.raises(VclError, match=r"px4_sitl_default: has no etc/init\.d-posix/rcS") as raised:
        fly(DEMO, tmp_path / "out", FlyOptions(firmware=parse_firmware(f"px4={build}")), quiet)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["ardupilot", "px4"])
def test_a_firmware_that_does_not_run_ends_the_flight_in_one_line(
    tmp_path: Path, build: Path, kind: str
) -> None:
    binary = build / "bin" / "px4"
    binary.write_text("#!/bin/sh\necho no such thing >&2\nexit 3\n")
    firmware = parse_firmware(f"{kind}={build if kind == 'px4' else binary}")
    with pytest.raises(VclError, match=r"firmware ended with exit code 3.*firmware\.log") as raised:
        fly(DEMO, tmp_path / "out", FlyOptions(firmware=firmware), quiet)
    assert "\n" not in str(raised.value)


def test_a_px4_that_dies_in_flight_ends_the_flight_in_one_line(
    tmp_path: Path, build: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DIES_AFTER_STEPS", "1000")
    with pytest.raises(VclError, match=r"firmware ended with exit code 4.*firmware\.log") as raised:
        fly(DEMO, tmp_path / "out", FlyOptions(firmware=parse_firmware(f"px4={build}")), quiet)
    assert "\n" not in str(raised.value)


@pytest.mark.skipif(not _ARDUPILOT, reason="VCL_ARDUPILOT names no arducopter")
def test_a_real_arducopter_fuses_our_poses(tmp_path: Path) -> None:
    for name, said in flown(tmp_path, parse_firmware(f"ardupilot={_ARDUPILOT}"), 0.7).items():
        status = read_status(tmp_path / "out" / "run" / name / "status.json")
        assert (status.state, status.autopilot.fusion) == ("active", "fused")
        assert said["fused_after_s"] < 2.0
        assert said["fused_share"] > 0.9
        assert abs(said["ahead_ms"]) < 10.0
        assert said["ate_m"] < 1.3 * said["own_ate_m"] + 0.01


@pytest.mark.parametrize(
    ("text", "parameters", "what"),
    [
        ("ardupilot", (), "expected"),
        ("betaflight=/bin/true", (), "expected"),
        ("ardupilot=/no/such/file", (), "is no program"),
        ("ardupilot=/tmp", (), "is no program"),
        ("px4=/tmp", (), "bin/px4 is no program"),
        ("ardupilot=/bin/true", ("VISO_DELAY_MS",), "NAME=NUMBER"),
        ("ardupilot=/bin/true", ("viso=1",), "NAME=NUMBER"),
        ("ardupilot=/bin/true", ("VISO_TYPE=much",), "NAME=NUMBER"),
    ],
)
def test_what_is_no_firmware_is_refused(text: str, parameters: tuple[str, ...], what: str) -> None:
    with pytest.raises(ConfigError, match=what):
        parse_firmware(text, parameters)


def test_parameters_are_named_with_the_firmware() -> None:
    firmware = parse_firmware("ardupilot=/bin/true", ("VISO_DELAY_MS=20", "VISO_TYPE = 1"))
    assert firmware.parameters == (("VISO_DELAY_MS", 20.0), ("VISO_TYPE", 1.0))


def test_a_wrong_configuration_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "ardupilot.json"
    path.write_text(json.dumps({"binary": "/bin/true"}))
    with pytest.raises(ConfigError, match="key 'attitude' is missing"):
        read_options(path)
    path.write_text("{")
    with pytest.raises(ConfigError, match=r"ardupilot\.json"):
        read_options(path)


def test_what_a_firmware_was_never_sent_it_has_not_fused(tmp_path: Path) -> None:
    at_ns = np.arange(0, 10_000_000_000, 100_000_000, dtype=np.int64)
    still = Trajectory(at_ns, np.zeros((100, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (100, 1)))
    sent = Estimates(at_ns, (Pose.identity(),) * 100, np.zeros((100, 6, 6)))
    assert read_fused(tmp_path, sent, still, Pose.identity()) is None
    (tmp_path / "fused.csv").write_text("at_ns,x,y,z\n" + "".join(f"{t},1,0,0\n" for t in at_ns))
    said = tmp_path / "said.csv"
    said.write_text('at_ns,severity,text\n0,6,"estimator flags 0xa7"\n')
    never = read_fused(tmp_path, sent, still, Pose.identity())
    assert never is not None
    assert (never.fused_after_s, never.fused_share, never.ate_m) == (None, 0.0, None)
    said.write_text(
        'at_ns,severity,text\n0,6,"estimator flags 0xa7"\n1000000000,6,"estimator flags 0x33f"\n'
        '4000000000,6,"estimator flags 0xa7"\n'
    )
    some = read_fused(tmp_path, sent, still, Pose.identity())
    assert some is not None
    assert some.fused_after_s == 1.0
    assert some.ate_m == 1.0
    assert np.isclose(some.fused_share, 3.0 / 9.9)


def test_a_px4_that_stands_calls_the_position_that_it_has_constant(tmp_path: Path) -> None:
    at_ns = np.arange(0, 10_000_000_000, 100_000_000, dtype=np.int64)
    still = Trajectory(at_ns, np.zeros((100, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (100, 1)))
    sent = Estimates(at_ns, (Pose.identity(),) * 100, np.zeros((100, 6, 6)))
    (tmp_path / "fused.csv").write_text("at_ns,x,y,z\n" + "".join(f"{t},1,0,0\n" for t in at_ns))
    (tmp_path / "said.csv").write_text(
        'at_ns,severity,text\n0,6,"estimator flags 0xa5"\n1000000000,6,"estimator flags 0x1af"\n'
        '8000000000,6,"estimator flags 0x13f"\n'
    )
    for holds_at_rest, after_s in ((True, 1.0), (False, 8.0)):
        found = read_fused(tmp_path, sent, still, Pose.identity(), holds_at_rest=holds_at_rest)
        assert found is not None
        assert found.fused_after_s == after_s


def test_a_height_that_counts_from_elsewhere_is_judged_by_how_it_goes(tmp_path: Path) -> None:
    at_ns = np.arange(0, 10_000_000_000, 100_000_000, dtype=np.int64)
    still = Trajectory(at_ns, np.zeros((100, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (100, 1)))
    sent = Estimates(at_ns, (Pose.identity(),) * 100, np.zeros((100, 6, 6)))
    heights = np.where(np.arange(100) % 2, 7.1, 6.9)
    rows = zip(at_ns.tolist(), heights.tolist(), strict=True)
    (tmp_path / "fused.csv").write_text(
        "at_ns,x,y,z\n" + "".join(f"{t},0,0,{z}\n" for t, z in rows)
    )
    (tmp_path / "said.csv").write_text('at_ns,severity,text\n0,6,"estimator flags 0x12f"\n')
    as_it_is = read_fused(tmp_path, sent, still, Pose.identity())
    as_it_goes = read_fused(tmp_path, sent, still, Pose.identity(), has_own_height=True)
    assert as_it_is is not None
    assert as_it_goes is not None
    assert as_it_is.ate_m == pytest.approx(7.0, abs=0.01)
    assert as_it_goes.ate_m == pytest.approx(0.1, abs=0.003)


@pytest.mark.parametrize(
    ("kind", "given", "flies_itself", "has_own_height"),
    [
        ("px4", (), True, True),
        ("px4", (), False, False),
        ("px4", ("EKF2_HGT_REF=3",), True, False),
        ("px4", ("EKF2_HGT_REF=0",), False, True),
        ("ardupilot", (), True, False),
    ],
)
def test_px4_s_height_is_its_own_unless_vision_gives_it(
    build: Path, kind: str, given: tuple[str, ...], flies_itself: bool, has_own_height: bool
) -> None:
    if kind == "px4" and not given:
        usual = of_a_mission(Mission((0, 0, 0), ())) if flies_itself else RECORDED
        assert (usual["EKF2_HGT_REF"] != 3.0) == has_own_height
    path = build if kind == "px4" else build / "bin" / "px4"
    firmware = parse_firmware(f"{kind}={path}", given)
    assert firmware.has_own_height(flies_itself=flies_itself) == has_own_height
    assert firmware.holds_at_rest == (kind == "px4")
