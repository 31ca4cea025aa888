"""Our link to a real firmware that feels a true motion: what it fuses, loses and follows.

Runs with ArduCopter when ``VCL_ARDUPILOT`` names a binary built for simulation, with PX4 when
``VCL_PX4`` names the folder of such a build.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Coroutine, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.autopilots import ardupilot, px4
from sitl.autopilots.ardupilot_parameters import RECORDED
from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.flown import Firmware, Flown, Start
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.steered import open_udp
from sitl.autopilots.wire import Wire
from sitl.firmware import parse_firmware
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.parameter_rules import findings, names_of, rules_for
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_quaternion
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.fusion import FusionState
from vcl_companion.links.vision_pose import PoseEstimate


@dataclass(frozen=True)
class Real:
    """A firmware that these tests fly.

    Attributes:
        kind: whose.
        start: starts it.
        parameters: set before.
        variable: of the environment, that says where it is.
        booted_before_ns: how long it has run before the first pose.
        has_own_height: whether its height is a barometer's, from where it was switched on.
        message: what it is sent.
    """

    kind: str
    start: Start
    parameters: Mapping[str, float]
    variable: str
    booted_before_ns: int
    has_own_height: bool
    message: Literal["vision_position_estimate", "odometry"] = "vision_position_estimate"


ARDUPILOT = Real(
    "ardupilot",
    ardupilot.start,
    RECORDED,
    "VCL_ARDUPILOT",
    40_000_000_000,
    has_own_height=False,
)
# By the first pose it has our clock.
PX4 = Real("px4", px4.Px4, px4.PARAMETERS, "VCL_PX4", 60_000_000_000, has_own_height=True)


@pytest.fixture(params=[ARDUPILOT, PX4], ids=lambda real: real.kind)
def real(request: pytest.FixtureRequest) -> Real:
    wanted: Real = request.param
    if not os.environ.get(wanted.variable):
        pytest.skip(f"{wanted.variable} names no firmware")
    return wanted


SYSTEM = 2
START_NS = 1_000_000_000_000
STEP_NS = 20_000_000
PERIOD_NS = 100_000_000
SIGMA_M = 0.02
BEGINS_AT = np.array([2.0, 2.7, -1.5])


def motion(starts_ns: int = START_NS) -> RecordedMotion:
    """A minute and a half of wide turns at up to 1.6 m/s, away from the origin, looking around."""
    t = np.arange(0.0, 90.0, 0.1)
    positions = BEGINS_AT + np.c_[4.0 * np.sin(0.4 * t), 2.0 * np.cos(0.4 * t) - 2.0, -0.1 * t]
    half_rad = 0.5 * (0.6 + 0.5 * np.sin(0.3 * t))
    level = np.c_[np.cos(half_rad), 0.0 * t, 0.0 * t, np.sin(half_rad)]
    return RecordedMotion(starts_ns + np.round(t * 1e9).astype(np.int64), positions, level)


class Flight:
    """The firmware, our link to it, and a drone that knows where it is."""

    def __init__(self, real: Real, autopilot: Flown, port: int, true: RecordedMotion) -> None:
        self._real = real
        self.clock = ManualClock(START_NS)
        options = AutopilotOptions(link=f"udp:127.0.0.1:{port}", message=real.message)
        self.link = AutopilotLink(options, SYSTEM, self.clock)
        self.off = np.zeros(3)
        self.n_resets = 0
        self.step_ns, self.late_ns = STEP_NS, 0
        self.states: list[FusionState] = []
        self._autopilot = autopilot
        self._true = true

    async def fly(self, seconds: float, *, sends: bool = True) -> None:
        """Go on for so long, told where it is ten times a second."""
        until_ns = self.clock.now_ns() + round(seconds * 1e9)
        self.states = []
        while self.clock.now_ns() < until_ns:
            now_ns = self.clock.now_ns() + self.step_ns
            self._autopilot.advance_to(now_ns)
            self.clock.advance_to(now_ns)
            if sends and now_ns % PERIOD_NS == 0:
                self._send(now_ns - self.late_ns)
            await asyncio.sleep(0.002)
            state = self.link.fusion().state
            if not self.states or self.states[-1] is not state:
                self.states.append(state)

    def _send(self, at_ns: int) -> None:
        there = self._true.at(np.array([at_ns], dtype=np.int64))
        turn = matrix_from_quaternion(there.quaternions[0])
        told = Pose(turn, there.positions_m[0] + self.off)
        covariance = np.diag([SIGMA_M**2] * 3 + [1e-4] * 3)
        estimate = PoseEstimate(
            told, covariance, there.velocities_m_s[0], 0.01 * np.eye(3), at_ns, self.n_resets
        )
        assert self.link.send_pose(estimate) is None

    def behind_s(self, fused: Path) -> float:
        """Return by how much its position was that of an earlier instant, in the last second."""
        times, believed = self._lately(fused)
        true = self._true.at(times)
        speeds = true.velocities_m_s[:, :2]
        behind = true.positions_m[:, :2] - believed[:, :2]
        return float(np.sum(speeds * behind) / np.sum(speeds**2))

    def apart_m(self, fused: Path) -> Array:
        """Return (T,) how far it was from where it was told to be, in the last second."""
        return self.apart(fused)[1]

    def apart(self, fused: Path) -> tuple[NDArray[np.int64], Array]:
        """Return (T,) instants of the last second, and how far it was then from where it was told.

        Where its height is its own, that has to go as ours goes.
        """
        times, believed = self._lately(fused)
        apart = believed - self._true.at(times).positions_m - self.off
        if self._real.has_own_height:
            apart[:, 2] -= np.median(apart[:, 2])
        return times, np.asarray(np.linalg.norm(apart, axis=1))

    def _lately(self, fused: Path) -> tuple[NDArray[np.int64], Array]:
        rows = [line.split(",") for line in fused.read_text().splitlines()[-60:]]
        times = np.array([int(row[0]) for row in rows])
        believed = np.array([[float(value) for value in row[1:]] for row in rows])
        lately = times > self.clock.now_ns() - 1_000_000_000
        return times[lately], believed[lately]


def flown(
    real: Real,
    tmp_path: Path,
    scenario: Callable[[Flight, Path], Coroutine[None, None, None]],
    moves_from_ns: int = START_NS,
) -> None:
    true = motion(moves_from_ns)
    out = tmp_path / "mav1"
    binary = parse_firmware(f"{real.kind}={os.environ[real.variable]}").path
    options = FirmwareOptions(
        binary, SYSTEM, START_NS - real.booted_before_ns, true, real.parameters, 0.0, out,
        tmp_path / "firmware",
    )  # fmt: skip
    with ExitStack() as stack:
        udp = stack.enter_context(open_udp())
        autopilot = Flown(options, real.start, udp, stack)
        autopilot.advance_to(START_NS)

        async def run() -> None:
            flight = Flight(real, autopilot, udp.getsockname()[1], true)
            async with asyncio.timeout(120.0):
                link = asyncio.ensure_future(flight.link.run())
                try:
                    await scenario(flight, out / "fused.csv")
                finally:
                    link.cancel()

        asyncio.run(run())


def test_poses_are_fused_within_two_seconds_wherever_they_begin(real: Real, tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(2.0)
        assert flight.link.fusion().state is FusionState.FUSED, flight.link.fusion()
        await flight.fly(8.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1
        await flight.fly(20.0)
        assert flight.link.ahead_s is not None
        assert abs(flight.link.ahead_s) < 0.03

    flown(real, tmp_path, scenario)


def test_a_jump_that_is_told_is_followed_within_a_third_of_a_second(
    real: Real, tmp_path: Path
) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        flight.off, flight.n_resets = np.array([3.0, -4.0, 0.0]), 1
        told_ns = flight.clock.now_ns() + PERIOD_NS
        await flight.fly(1.0)
        times, apart = flight.apart(fused)
        followed_ns = times[np.flatnonzero(apart > 0.2)[-1] + 1]
        assert 0 < followed_ns - told_ns <= 300_000_000
        await flight.fly(3.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.15

    flown(real, tmp_path, scenario)


def test_a_second_without_vision_is_harmless(real: Real, tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        await flight.fly(1.0, sends=False)
        assert flight.apart_m(fused).max() < 0.3
        await flight.fly(5.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1

    flown(real, tmp_path, scenario)


def test_vision_that_returns_after_half_a_minute_is_fused_again(real: Real, tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        await flight.fly(25.0, sends=False)
        lost = flight.states[-1]
        assert lost is FusionState.LOST
        await flight.fly(15.0)
        assert flight.states[-1] is FusionState.FUSED
        assert flight.apart_m(fused).max() < 0.15

    flown(real, tmp_path, scenario)


def test_who_stands_on_the_ground_and_fuses_is_told_as_fused(real: Real, tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(3.0)
        await flight.fly(12.0)
        assert flight.states == [FusionState.FUSED], flight.link.fusion()
        assert flight.apart_m(fused).max() < 0.1

    flown(real, tmp_path, scenario, moves_from_ns=START_NS + 60_000_000_000)


def test_the_parameters_that_we_fly_by_are_read_and_set(real: Real, tmp_path: Path) -> None:
    delay = {"ardupilot": "VISO_DELAY_MS", "px4": "EKF2_EV_DELAY"}[real.kind]

    async def scenario(flight: Flight, _: Path) -> None:
        await flight.fly(2.0)
        link = flight.link

        async def ask() -> None:
            rules = rules_for(link.firmware, sends_velocity=False)
            read = {name: await link.parameter(name) for name in names_of(rules)}
            values = {name: value for name, value in read.items() if value is not None}
            assert not [f for f in findings(rules, values) if f.severity != "warns"]
            assert await link.parameter(delay) == 0.0
            assert await link.set_parameter(delay, 12.0) == 12.0
            assert await link.parameter("NO_SUCH_ONE") is None

        asked = asyncio.ensure_future(ask())
        while not asked.done():
            await flight.fly(0.2)
        await asked

    flown(real, tmp_path, scenario)


@pytest.mark.skipif(not os.environ.get("VCL_PX4"), reason="VCL_PX4 names no firmware")
def test_px4_takes_a_velocity_with_our_poses(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(2.0)
        await flight.fly(28.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.05

    # Velocity as well as position, height and heading.
    parameters = {**px4.PARAMETERS, "EKF2_EV_CTRL": 15.0}
    flown(replace(PX4, parameters=parameters, message="odometry"), tmp_path, scenario)


@pytest.mark.skipif(not os.environ.get("VCL_PX4"), reason="VCL_PX4 names no firmware")
def test_px4_takes_our_instants_once_we_have_told_it_the_time(tmp_path: Path) -> None:
    def start(options: FirmwareOptions, wire: Wire, stack: ExitStack) -> Firmware:
        return px4.Px4(options, wire, stack, tells_time=False)

    async def scenario(flight: Flight, fused: Path) -> None:
        # It takes no answer that is later than 10 ms.
        flight.step_ns, flight.late_ns = 4_000_000, 120_000_000
        await flight.fly(10.0)
        assert 0.1 < flight.behind_s(fused) < 0.16
        # 500 answers, ten a second.
        await flight.fly(45.0)
        assert abs(flight.behind_s(fused)) < 0.025
        assert flight.states == [FusionState.FUSED]

    flown(replace(PX4, start=start, booted_before_ns=25_000_000_000), tmp_path, scenario)
