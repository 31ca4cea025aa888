"""The stand-in autopilot as a process of its own, our link to it, and MAVSDK's opinion of both."""

import asyncio
import contextlib
import json
import math
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect

from sitl.autopilots.attitude_source import AttitudeErrors, ReplayedAttitude, TruthAttitude
from tests.daemon.waiting import until
from tests.links.running import LONGEST_S, running, udp
from tests.whole_lines import json_lines
from vcl_companion.clock import ManualClock
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose, euler_pose_covariance
from vcl_companion.geometry.rotation import (
    Array,
    about_down,
    euler_from_matrix,
    exp_so3,
    heading_of,
    log_so3,
    matrix_from_euler,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions, ServiceState
from vcl_companion.links.texts import Severity
from vcl_companion.links.vehicle_mode import VehicleMode
from vcl_companion.links.vision_pose import PoseEstimate

REPOSITORY = Path(__file__).parents[2]
MS = 1_000_000
START_NS = 1_403_636_579_763_555_584
BOOT_OFFSET_NS = START_NS - 60_000 * MS
SYSTEM = 3
RATE_RAD_S = np.array([0.3, -0.2, 0.9])
ERRORS = {"tilt_bias_deg": 0.3, "heading_bias_deg": 2.0, "white_deg": 0.1}


def true_at(at_ns: int) -> Array:
    return exp_so3(RATE_RAD_S * (at_ns - START_NS) * 1e-9)


def write_trajectory(path: Path) -> None:
    """5 s at 20 Hz of a body that turns evenly, so that interpolating on the arc is exact."""
    rows = ["at_ns,x,y,z,qw,qx,qy,qz"]
    for at_ns in range(START_NS, START_NS + 5000 * MS, 50 * MS):
        quaternion = quaternion_from_matrix(true_at(at_ns)).tolist()
        rows.append(f"{at_ns},0,0,-5," + ",".join(map(repr, quaternion)))
    path.write_text("\n".join(rows) + "\n")


class StandInProcess:
    """The process, and its line of control."""

    def __init__(self, process: asyncio.subprocess.Process, port: int) -> None:
        self._process = process
        self.port = port

    async def ask(self, command: dict[str, object]) -> dict[str, Any]:
        self._say(json.dumps(command) + "\n")
        return await self._answer()

    async def advance_to(self, at_ns: int) -> None:
        assert (await self.ask({"advance_to_ns": at_ns}))["at_ns"] == at_ns

    async def finish(self) -> None:
        self._say('{"finish": true}\n')
        assert await self._process.wait() == 0

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode())

    async def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        answer = json.loads(await self._process.stdout.readline())
        assert isinstance(answer, dict)
        return answer


async def start(*arguments: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "sitl.autopilots.stand_in", *arguments,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE, cwd=REPOSITORY,
    )  # fmt: skip


@contextlib.asynccontextmanager
async def stand_in(
    out: Path, attitude: dict[str, object], *, arms: bool = False
) -> AsyncIterator[StandInProcess]:
    config = out.with_suffix(".json")
    settings = {
        "system_id": SYSTEM,
        "boot_offset_ns": BOOT_OFFSET_NS,
        "attitude": attitude,
        "arms": arms,
        "out": str(out),
    }
    config.write_text(json.dumps(settings))
    process = await start(str(config))
    try:
        async with asyncio.timeout(LONGEST_S):
            assert process.stdout is not None
            port = json.loads(await process.stdout.readline())["port"]
            yield StandInProcess(process, port)
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


def truth(tmp_path: Path, **settings: object) -> dict[str, object]:
    path = tmp_path / "truth.csv"
    write_trajectory(path)
    return {"source": "truth", "file": str(path), "seed": 4, "rate_hz": 50, **ERRORS, **settings}


def received(out: Path, kind: str) -> list[dict[str, Any]]:
    return [line for line in json_lines(out / "received.jsonl") if line["type"] == kind]


def attitude_rows(out: Path) -> tuple[list[int], Array]:
    text = (out / "attitude.csv").read_text().splitlines()
    assert text[0] == "at_ns,qw,qx,qy,qz"
    rows = [line.split(",") for line in text[1:]]
    return [int(row[0]) for row in rows], np.array([[float(x) for x in row[1:]] for row in rows])


def angle_deg(a: Array, b: Array) -> float:
    return math.degrees(float(np.linalg.norm(log_so3(a.T @ b))))


def link_to(port: int, clock: ManualClock) -> AutopilotLink:
    return AutopilotLink(AutopilotOptions(link=f"udp:127.0.0.1:{port}"), SYSTEM, clock)


def attitudes_of(frames_at_ns: list[int], out: Path, source: dict[str, object]) -> list[Array]:
    """Fly past frames with our link; return its attitude at each."""
    clock = ManualClock()
    found: list[Array] = []

    async def scenario() -> None:
        async with stand_in(out, source) as process:
            # The first instant comes before anybody listens: a late companion gets it as well.
            await process.advance_to(frames_at_ns[0])
            link = link_to(process.port, clock)
            async with running(link.run()):
                for at_ns in frames_at_ns:
                    await process.advance_to(at_ns)
                    clock.advance_to(at_ns)
                    attitude = await link.attitudes.at(at_ns, LONGEST_S)
                    assert attitude is not None
                    found.append(attitude.ned_from_body)
                await process.finish()

    asyncio.run(scenario())
    return found


def test_our_link_finds_the_attitude_of_every_frame(tmp_path: Path) -> None:
    out = tmp_path / "mav"
    frames_at_ns = [START_NS + k * 200 * MS + 123_457 * (k % 7) for k in range(12)]
    found = attitudes_of(frames_at_ns, out, truth(tmp_path))
    times, quaternions = attitude_rows(out)
    sent = dict(zip(times, quaternions, strict=True))
    errors_deg = [
        angle_deg(matrix_from_quaternion(sent[at_ns]), rotation)
        for at_ns, rotation in zip(frames_at_ns, found, strict=True)
    ]
    # The stamp's resolution (half a millisecond, at 56 degrees a second) against noise of
    # 0.1 degree per axis between neighbours that are interpolated.
    assert 0.0 < max(errors_deg) < 0.06
    questions = received(out, "TIMESYNC")
    assert any(line["fields"]["tc1"] == 0 for line in questions)
    # We have answered its questions, echoing them.
    answers = [line["fields"] for line in questions if line["fields"]["tc1"] != 0]
    assert len(answers) > 5
    for fields in answers:
        asked_at_ns = fields["ts1"] - SYSTEM + BOOT_OFFSET_NS
        assert asked_at_ns % (100 * MS) == 0
        assert fields["tc1"] in frames_at_ns

    replay: dict[str, object] = {"source": "replay", "file": str(out / "attitude.csv")}
    for k in range(2):
        again = attitudes_of(frames_at_ns, tmp_path / f"again{k}", replay)
        np.testing.assert_array_equal(again, found)


def test_it_knows_no_north_until_it_is_told_poses(tmp_path: Path) -> None:
    out = tmp_path / "mav"
    clock = ManualClock(START_NS)
    frames_at_ns = [START_NS + k * 100 * MS for k in range(1, 20)]
    told = Pose(about_down(1.2) @ true_at(frames_at_ns[9]), np.array([1.0, 2.0, -3.0]))

    async def scenario() -> None:
        exact = truth(tmp_path, tilt_bias_deg=0, heading_bias_deg=0, white_deg=0)
        async with stand_in(out, exact) as process:
            await process.advance_to(START_NS + 50 * MS)
            link = link_to(process.port, clock)
            async with running(link.run()):
                for at_ns in frames_at_ns:
                    await process.advance_to(at_ns)
                    clock.advance_to(at_ns)
                    await link.attitudes.at(at_ns, LONGEST_S)
                    assert not link.has_heading
                    if at_ns == frames_at_ns[9]:
                        estimate = PoseEstimate(
                            told, np.eye(6) * 1e-4, np.zeros(3), np.eye(3), at_ns, 1
                        )
                        assert link.poses.send(estimate) is None
                        await until(lambda: bool(received(out, "VISION_POSITION_ESTIMATE")))
                await process.finish()

    asyncio.run(scenario())
    times, quaternions = attitude_rows(out)
    north_rad = [
        heading_of(matrix_from_quaternion(quaternion) @ true_at(at_ns).T)
        for at_ns, quaternion in zip(times, quaternions, strict=True)
    ]
    first = -euler_from_matrix(true_at(times[0]))[2]
    before = [r for at_ns, r in zip(times, north_rad, strict=True) if at_ns <= frames_at_ns[9]]
    after = north_rad[len(before) :]
    np.testing.assert_allclose(before, first, atol=1e-5)
    np.testing.assert_allclose(after, 1.2, atol=1e-3)


@pytest.mark.parametrize("arms", [True, False])
def test_it_may_be_armed_from_its_first_position_on(tmp_path: Path, arms: bool) -> None:
    clock = ManualClock(START_NS)

    async def scenario() -> None:
        async with stand_in(tmp_path / "mav", truth(tmp_path), arms=arms) as process:
            await process.advance_to(START_NS)
            link = link_to(process.port, clock)
            async with running(link.run()):
                await until(lambda: link.has_been_heard)
                assert await link.attitudes.at(START_NS, LONGEST_S) is not None
                assert not link.mode.is_armed
                still = PoseEstimate(
                    Pose.identity(), np.eye(6), np.zeros(3), np.eye(3), START_NS, 0
                )
                assert link.poses.send(still) is None
                await until(lambda: bool(received(tmp_path / "mav", "VISION_POSITION_ESTIMATE")))
                if arms:
                    await until(lambda: link.mode.is_steered_by_positions)
                else:
                    link._mode = VehicleMode(is_armed=True)
                    await until(lambda: not link.mode.is_armed)
            await process.finish()

    asyncio.run(scenario())


def test_its_errors_are_what_it_states(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    write_trajectory(path)
    tilts_deg, headings_deg, whites_deg = [], [], []
    for seed in range(300):
        source = TruthAttitude(path, 50.0, AttitudeErrors(), seed)
        samples = source.between(None, START_NS)
        samples += source.between(START_NS, START_NS + 100 * MS)
        errors_deg = np.rad2deg(
            [log_so3(matrix_from_quaternion(q) @ true_at(at_ns).T) for at_ns, q in samples]
        )
        assert len(samples) == 6
        mean_deg = errors_deg.mean(axis=0)
        tilts_deg += mean_deg[:2].tolist()
        headings_deg.append(mean_deg[2])
        whites_deg += (errors_deg - mean_deg).ravel().tolist()
    # One sigma, from 600, 300 and 4500 degrees of freedom: within 3 of their own.
    assert 0.3 * 0.91 < float(np.std(tilts_deg)) < 0.3 * 1.11
    assert 2.0 * 0.88 < float(np.std(headings_deg)) < 2.0 * 1.12
    assert 0.1 * 0.96 < float(np.std(whites_deg)) * math.sqrt(6 / 5) < 0.1 * 1.04


def test_who_turns_at_once_from_photograph_to_photograph_keeps_the_north(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """What its gyros feel is told with its attitude: it is no turn of the autopilot's north."""
    out, path = tmp_path / "mav", tmp_path / "truth.csv"
    rows = ["at_ns,x,y,z,qw,qx,qy,qz"]
    for k, heading_deg in enumerate((0.0, 0.0, 70.0, 70.0, -20.0, 10.0, 10.0, 0.0)):
        half = np.deg2rad(0.5 * heading_deg)
        rows.append(f"{START_NS + k * 200 * MS},0,0,-5,{np.cos(half)},0,0,{np.sin(half)}")
    path.write_text("\n".join(rows) + "\n")
    source: dict[str, object] = {"source": "truth", "file": str(path), "seed": 4, "rate_hz": 50}
    frames_at_ns = [START_NS + k * 100 * MS for k in range(15)]
    with caplog.at_level("INFO"):
        found = attitudes_of(frames_at_ns, out, source)
    assert "north" not in caplog.text
    sent = dict(zip(*attitude_rows(out), strict=True))
    for at_ns, rotation in zip(frames_at_ns, found, strict=True):
        assert angle_deg(matrix_from_quaternion(sent[at_ns]), rotation) < 1.0


def test_the_same_instants_give_the_same_attitude_in_any_steps(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    write_trajectory(path)
    at_once = TruthAttitude(path, 50.0, AttitudeErrors(), 1)
    stepwise = TruthAttitude(path, 50.0, AttitudeErrors(), 1)
    first = at_once.between(None, START_NS)
    want = first + at_once.between(START_NS, START_NS + 1000 * MS)
    got = stepwise.between(None, START_NS)
    for k in range(50):
        now_ns = START_NS + k * 20 * MS
        got += stepwise.between(now_ns, now_ns + 20 * MS)
    assert [at_ns for at_ns, _ in got] == [START_NS + k * 20 * MS for k in range(51)]
    for (at_ns, a), (same_ns, b) in zip(want, got, strict=True):
        assert at_ns == same_ns
        np.testing.assert_array_equal(a, b)


def test_outside_of_the_trajectory_its_ends_hold(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    write_trajectory(path)
    source = TruthAttitude(path, 50.0, AttitudeErrors(0.0, 0.0, 0.0), 1)
    (_, before), (_, after) = (
        *source.between(None, START_NS - 7000 * MS),
        *source.between(None, START_NS + 9000 * MS),
    )
    np.testing.assert_allclose(matrix_from_quaternion(before), np.eye(3), atol=1e-12)
    end = true_at(START_NS + 4950 * MS)
    np.testing.assert_allclose(matrix_from_quaternion(after), end, atol=1e-12)


def test_a_replay_sends_the_same_attitudes_again(tmp_path: Path) -> None:
    instants = [START_NS + k * 70 * MS for k in range(10)]

    async def fly(out: Path, attitude: dict[str, object]) -> None:
        async with stand_in(out, attitude) as process:
            for at_ns in instants:
                await process.advance_to(at_ns)
            await process.finish()

    first, second = tmp_path / "first", tmp_path / "second"
    asyncio.run(fly(first, truth(tmp_path)))
    again: dict[str, object] = {"source": "replay", "file": str(first / "attitude.csv")}
    asyncio.run(fly(second, again))
    assert (first / "attitude.csv").read_bytes() == (second / "attitude.csv").read_bytes()
    assert set(instants) < set(attitude_rows(first)[0])


def test_a_pause_of_hours_is_nothing_that_ends_it(tmp_path: Path) -> None:
    """Flat out a recording's pause is one step; an autopilot says its last minute."""
    pause_ns = 3 * 3600 * 1000 * MS

    async def scenario() -> None:
        async with stand_in(tmp_path / "mav", truth(tmp_path)) as process:
            for at_ns in (START_NS, START_NS + pause_ns, START_NS + pause_ns + 20 * MS):
                await process.advance_to(at_ns)
            await process.finish()

    asyncio.run(scenario())
    at_ns, _ = attitude_rows(tmp_path / "mav")
    said = np.array(at_ns) - START_NS
    assert said[0] == 0
    assert pause_ns - 60_000 * MS < said[1] <= pause_ns - 59_980 * MS
    assert said[-2:].tolist() == [pause_ns, pause_ns + 20 * MS]
    assert np.diff(said[1:]).tolist() == [20 * MS] * 3000


def test_time_does_not_run_back_and_nonsense_ends_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with stand_in(tmp_path / "mav", truth(tmp_path)) as process:
            await process.advance_to(START_NS + 5 * MS)
            answer = await process.ask({"advance_to_ns": START_NS})
            assert answer["at_ns"] == START_NS + 5 * MS
            with pytest.raises(ValueError, match="Expecting value"):
                await process.ask({"fly": "away"})

    asyncio.run(scenario())


def test_the_end_of_its_input_ends_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        attitude = truth(tmp_path)
        config = {"system_id": 1, "boot_offset_ns": 0, "attitude": attitude, "out": str(tmp_path)}
        (tmp_path / "config.json").write_text(json.dumps(config))
        process = await start(str(tmp_path / "config.json"))
        async with asyncio.timeout(LONGEST_S):
            out, err = await process.communicate(b"")
        assert (process.returncode, err) == (0, b"")
        assert list(json.loads(out)) == ["port"]

    asyncio.run(scenario())


def test_a_wrong_configuration_is_one_line(tmp_path: Path) -> None:
    async def scenario(text: str) -> str:
        (tmp_path / "config.json").write_text(text)
        process = await start(str(tmp_path / "config.json"))
        async with asyncio.timeout(LONGEST_S):
            _, err = await process.communicate(b"")
        assert process.returncode == 2
        return err.decode()

    message = asyncio.run(scenario('{"system_id": 1}'))
    assert message.count("\n") == 1
    assert "attitude" in message


@pytest.mark.parametrize(
    ("row", "why"),
    [("1,0,0,0,1,0,0", "8 finite"), ("1,0,0,0,1,0,0,x", "could not"), ("1,0,0,0,nan,0,0,0", "8"),
     ("1,0,0,0,2,0,0,0", "unit"), ("0,0,0,0,1,0,0,0", "rise"),
     ("9223372036854775808,0,0,0,1,0,0,0", "no time in nanoseconds")],
)  # fmt: skip
def test_a_broken_trajectory_names_its_row(tmp_path: Path, row: str, why: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(f"at_ns,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n{row}\n")
    with pytest.raises(ConfigError, match=rf"truth\.csv, row 3: .*{why}"):
        TruthAttitude(path, 50.0, AttitudeErrors(), 1)
    path.write_text("at_ns,qw,qx,qy,qz\n")
    with pytest.raises(ConfigError, match="no rows"):
        ReplayedAttitude(path)


def test_it_keeps_the_first_origin_that_it_is_told(tmp_path: Path) -> None:
    out = tmp_path / "mav"

    async def tell(port: int, origin: tuple[float, float, float], n_texts: int) -> None:
        options = AutopilotOptions(link=f"udp:127.0.0.1:{port}", origin=origin)
        link = AutopilotLink(options, SYSTEM, ManualClock(START_NS))
        link.origin.origin_world = lambda: np.zeros(3)
        async with running(link.run()):
            await until(lambda: len(received(out, "STATUSTEXT")) == n_texts)

    async def scenario() -> None:
        async with stand_in(out, truth(tmp_path)) as process:
            await process.advance_to(START_NS)
            await tell(process.port, (47.0, 8.0, 500.0), 1)
            await tell(process.port, (47.001, 8.0, 500.0), 2)
            await process.finish()

    asyncio.run(scenario())
    (command,) = [line["fields"] for line in received(out, "COMMAND_INT")]
    assert (command["command"], command["x"], command["y"]) == (611, 470000000, 80000000)
    assert command["z"] == 500.0
    texts = "".join(line["fields"]["text"] for line in received(out, "STATUSTEXT"))
    assert texts == "VCL origin set" + "VCL the autopilot's origin is 111 m from ours"


@dataclass(frozen=True)
class Told:
    """What MAVSDK made of a message."""

    kind: str
    system: int
    component: int
    fields: dict[str, Any]


class SecondOpinion:
    """MAVSDK, fed with the bytes of a link."""

    def __init__(self, mavsdk: Mavsdk) -> None:
        self._mavsdk = mavsdk
        self._loop = asyncio.get_running_loop()
        self._met = asyncio.Event()
        self._told: asyncio.Queue[Told] = asyncio.Queue()
        self._messages: MavlinkDirect | None = None
        mavsdk.subscribe_on_new_system(lambda _: self._from_its_thread(self._met.set))

    def hear(self, data: bytes) -> None:
        self._mavsdk.pass_received_raw_bytes(data)

    async def meet(self) -> None:
        """Wait for the system of the first heartbeat, and hear all it says from then on."""
        await self._met.wait()
        (system,) = self._mavsdk.get_systems()
        # Kept, since the end of the object is the end of the subscription.
        self._messages = MavlinkDirect(system)
        # An empty name subscribes to every message.
        self._messages.subscribe_message("", self._tell)

    async def next_of(self, kind: str) -> Told:
        while True:
            told = await self._told.get()
            if told.kind == kind:
                return told

    def _tell(self, message: Any, _: object) -> None:
        fields = json.loads(message.fields_json)
        told = Told(message.message_name, message.system_id, message.component_id, fields)
        self._from_its_thread(self._told.put_nowait, told)

    def _from_its_thread(self, callback: Any, *arguments: Any) -> None:
        self._loop.call_soon_threadsafe(callback, *arguments)


@contextlib.contextmanager
def second_opinion() -> Any:
    configuration = Configuration.create_with_component_type(ComponentType.AUTOPILOT)
    with Mavsdk(configuration) as mavsdk:
        mavsdk.add_any_connection("raw://")
        yield SecondOpinion(mavsdk)
    configuration.destroy()


@contextlib.asynccontextmanager
async def overheard(port: int, opinion: SecondOpinion) -> AsyncIterator[int]:
    """A wire to ``port``, given as the port of its near end, on which another one listens in."""
    async with udp() as near, udp() as far:
        companion: list[tuple[str, int]] = []

        async def to_autopilot() -> None:
            while True:
                data, sender = await near.got.get()
                companion[:] = [sender]
                opinion.hear(data)
                far.transport.sendto(data, ("127.0.0.1", port))

        async def to_companion() -> None:
            while True:
                data, _ = await far.got.get()
                near.transport.sendto(data, companion[0])

        async with running(to_autopilot(), to_companion()):
            yield near.port


VELOCITY = np.array([2.0, -1.0, 0.3])


def poses() -> list[tuple[Pose, Array, int, int]]:
    rng = np.random.default_rng(8)
    out = []
    for k in range(20):
        root = rng.normal(size=(6, 6)) * [0.05, 0.05, 0.05, 0.01, 0.01, 0.01]
        rotation = exp_so3(rng.normal(0.0, 0.7, 3))
        pose = Pose(rotation, rng.normal(0.0, 50.0, 3))
        out.append((pose, root.T @ root, START_NS + k * 33_333_333, 250 + k))
    return out


def assert_is(fields: dict[str, Any], sent: tuple[Pose, Array, int, int]) -> None:
    """Compare a decoded VISION_POSITION_ESTIMATE with what was to be said."""
    pose, covariance, at_ns, reset_counter = sent
    assert fields["usec"] == at_ns // 1000
    assert fields["reset_counter"] == 1 + (START_NS // 1_000_000_000 + reset_counter) % 255
    np.testing.assert_allclose([fields[k] for k in "xyz"], pose.translation, rtol=1e-6)
    rotation = matrix_from_euler(fields["roll"], fields["pitch"], fields["yaw"])
    np.testing.assert_allclose(rotation, pose.rotation, atol=1e-6)
    # It is ArduPilot: see tests/links/test_vision_pose.py for how that reads it.
    expected = euler_pose_covariance(pose, covariance)
    said = np.array(fields["covariance"])
    worst = np.linalg.eigvalsh(expected[:3, :3])[-1]
    np.testing.assert_allclose(said[[0, 6, 11]].sum(), worst, rtol=1e-6)
    np.testing.assert_allclose(said[[15, 18, 20]], np.diag(expected)[3:], rtol=1e-6)
    assert all(fields["covariance"][k] > 0.0 for k in (0, 6, 11, 15, 18, 20))


def overheard_poses(
    tmp_path: Path, message: Literal["vision_position_estimate", "odometry"]
) -> list[Told]:
    """Send ``poses`` to the stand-in; return what MAVSDK made of them, and of a heartbeat last."""
    clock = ManualClock(START_NS)
    told: list[Told] = []

    async def scenario() -> None:
        with second_opinion() as opinion:
            async with (
                stand_in(tmp_path / "mav", truth(tmp_path)) as process,
                overheard(process.port, opinion) as port,
            ):
                await process.advance_to(START_NS)
                options = AutopilotOptions(
                    link=f"udp:127.0.0.1:{port}", message=message, time_error_s=0.0
                )
                link = AutopilotLink(options, SYSTEM, clock)
                link.set_state(ServiceState.ACTIVE)
                async with running(link.run()):
                    await opinion.meet()
                    assert await link.attitudes.at(START_NS, LONGEST_S) is not None
                    link.say(Severity.WARNING, "no map yet")
                    for pose, covariance, at_ns, reset_counter in poses():
                        sent = link.poses.send(
                            PoseEstimate(
                                pose, covariance, VELOCITY, np.eye(3), at_ns, reset_counter
                            )
                        )
                        assert sent is None
                        told.append(await opinion.next_of(message.upper()))
                    told.append(await opinion.next_of("HEARTBEAT"))
                await process.finish()

    asyncio.run(scenario())
    return told


def test_mavsdk_and_the_stand_in_decode_the_same(tmp_path: Path) -> None:
    out = tmp_path / "mav"
    told = overheard_poses(tmp_path, "vision_position_estimate")
    *mavsdk_poses, beat = told
    assert {(t.system, t.component) for t in told} == {(SYSTEM, 197)}
    assert (beat.fields["type"], beat.fields["autopilot"]) == (18, 8)
    assert beat.fields["system_status"] == 4
    heard = received(out, "VISION_POSITION_ESTIMATE")
    assert len(heard) == len(poses())
    for mavsdk_pose, line, sent in zip(mavsdk_poses, heard, poses(), strict=True):
        assert_is(mavsdk_pose.fields, sent)
        assert_is(line["fields"], sent)
        assert (line["system"], line["component"]) == (SYSTEM, 197)
        assert line["arrived_at_ns"] == START_NS
        mine = {k: v for k, v in mavsdk_pose.fields.items() if k in line["fields"]}
        assert mine == line["fields"]
    assert [line["fields"]["text"] for line in received(out, "STATUSTEXT")] == ["no map yet"]
    asked = {line["fields"]["param1"] for line in received(out, "COMMAND_LONG")}
    assert asked == {31.0, 32.0, 193.0}  # attitude, local position, estimator


def test_mavsdk_reads_our_odometry_as_an_arducopter_takes_it(tmp_path: Path) -> None:
    *odometries, _ = overheard_poses(tmp_path, "odometry")
    assert len(odometries) == len(poses())
    for told, (pose, covariance, at_ns, _) in zip(odometries, poses(), strict=True):
        fields = told.fields
        assert fields["time_usec"] == at_ns // 1000
        # What it takes: LOCAL_FRD, of BODY_FRD; it drops all else.
        assert (fields["frame_id"], fields["child_frame_id"]) == (20, 12)
        np.testing.assert_allclose([fields[k] for k in "xyz"], pose.translation, rtol=1e-6)
        rotation = matrix_from_quaternion(np.array(fields["q"]))
        np.testing.assert_allclose(rotation, pose.rotation, atol=1e-6)
        speed = np.array([fields[f"v{k}"] for k in "xyz"])
        np.testing.assert_allclose(pose.rotation @ speed, VELOCITY, atol=1e-6)
        said = np.array(fields["pose_covariance"])
        expected = euler_pose_covariance(pose, covariance)
        worst = np.linalg.eigvalsh(expected[:3, :3])[-1]
        np.testing.assert_allclose(said[[0, 6, 11]].sum(), worst, rtol=1e-6)
        np.testing.assert_allclose(said[[15, 18, 20]], np.diag(expected)[3:], rtol=1e-6)
