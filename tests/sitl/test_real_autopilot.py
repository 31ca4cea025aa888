"""Our link to a real ArduCopter that feels a true motion: what it fuses, loses and follows.

Runs when ``VCL_ARDUPILOT`` names a binary built for simulation.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Coroutine
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from sitl.autopilots.ardupilot import start
from sitl.autopilots.ardupilot_parameters import RECORDED
from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.flown import Flown
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.steered import open_udp
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.resets import Resets
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.fusion import FusionState
from vcl_companion.links.vehicle_mode import VehicleMode
from vcl_companion.links.vision_pose import PoseEstimate

_BINARY = os.environ.get("VCL_ARDUPILOT", "")
pytestmark = pytest.mark.skipif(not _BINARY, reason="VCL_ARDUPILOT names no arducopter")

SYSTEM = 2
START_NS = 1_000_000_000_000
BOOTED_BEFORE_NS = 40_000_000_000
STEP_NS = 20_000_000
PERIOD_NS = 100_000_000
SIGMA_M = 0.02
IN_GUIDED = VehicleMode(is_armed=True, follows_positions=True)
BEGINS_AT = np.array([2.0, 2.7, -1.5])


def motion(rests_s: float = 0.0) -> RecordedMotion:
    """A minute and a half of wide turns at up to 1.6 m/s, away from the origin, after a rest."""
    t = np.arange(0.0, 90.0, 0.1)
    at = START_NS + np.round(t * 1e9).astype(np.int64)
    since = np.maximum(t - rests_s, 0.0)
    t = since**2 / (since + 2.0) if rests_s else t
    positions = BEGINS_AT + np.c_[4.0 * np.sin(0.4 * t), 2.0 * np.cos(0.4 * t) - 2.0, -0.1 * t]
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    return RecordedMotion(at, positions, level)


class Flight:
    """The firmware, our link to it, and a drone that knows where it is."""

    def __init__(
        self,
        autopilot: Flown,
        port: int,
        true: RecordedMotion,
        origin: tuple[float, float, float] | None,
    ) -> None:
        self.clock = ManualClock(START_NS)
        options = AutopilotOptions(link=f"udp:127.0.0.1:{port}", origin=origin)
        self.link = AutopilotLink(options, SYSTEM, self.clock)
        self.origin_world: Array | None = None
        self.link.origin.origin_world = lambda: self.origin_world
        self.off = np.zeros(3)
        self.n_resets = 0
        self.slide: Resets | None = None
        self.slid = np.zeros(3)
        self.states: list[FusionState] = []
        self._autopilot = autopilot
        self._true = true

    async def fly(self, seconds: float, *, sends: bool = True) -> None:
        """Go on for so long, told where it is ten times a second."""
        until_ns = self.clock.now_ns() + round(seconds * 1e9)
        self.states = []
        while self.clock.now_ns() < until_ns:
            now_ns = self.clock.now_ns() + STEP_NS
            self._autopilot.advance_to(now_ns)
            self.clock.advance_to(now_ns)
            if sends and now_ns % PERIOD_NS == 0:
                self._send(now_ns)
            await asyncio.sleep(0.002)
            state = self.link.fusion().state
            if not self.states or self.states[-1] is not state:
                self.states.append(state)

    def _send(self, now_ns: int) -> None:
        there = self._true.at(np.array([now_ns], dtype=np.int64))
        told = Pose(np.eye(3), there.positions_m[0] + self.off)
        covariance = np.diag([SIGMA_M**2] * 3 + [1e-4] * 3)
        if self.slide is not None:
            expected = Pose(np.eye(3), there.positions_m[0])
            assert not self.slide.decide(
                told, covariance, now_ns, 1, expected, IN_GUIDED, was_silent=False
            )
            told, _ = self.slide.told(told, now_ns)
            self.slid = told.translation - there.positions_m[0]
        estimate = PoseEstimate(
            told, covariance, there.velocities_m_s[0], 0.01 * np.eye(3), now_ns, self.n_resets
        )
        assert self.link.send_pose(estimate) is None

    def true_at(self, at_ns: int) -> Array:
        """Return (3,) where it was."""
        return np.asarray(self._true.at(np.array([at_ns], dtype=np.int64)).positions_m[0])

    def off_m(self, fused: Path) -> Array:
        """Return (3,) how far from the truth it last said to be."""
        at_ns, *values = fused.read_text().splitlines()[-1].split(",")
        true = self.true_at(int(at_ns))
        return np.asarray(np.array([float(value) for value in values]) - true)

    def apart_m(self, fused: Path) -> Array:
        """Return (T,) how far it was from where it was told to be, in the last second."""
        rows = [line.split(",") for line in fused.read_text().splitlines()[-60:]]
        times = np.array([int(row[0]) for row in rows])
        believed = np.array([[float(value) for value in row[1:]] for row in rows])
        lately = times > self.clock.now_ns() - 1_000_000_000
        told = self._true.at(times[lately]).positions_m + self.off
        return np.asarray(np.linalg.norm(believed[lately] - told, axis=1))


def flown(
    tmp_path: Path,
    scenario: Callable[[Flight, Path], Coroutine[None, None, None]],
    origin: tuple[float, float, float] | None = None,
    rests_s: float = 0.0,
) -> None:
    true = motion(rests_s)
    out = tmp_path / "mav1"
    options = FirmwareOptions(
        Path(_BINARY), SYSTEM, START_NS - BOOTED_BEFORE_NS, true, RECORDED, 0.0, out,
        tmp_path / "firmware",
    )  # fmt: skip
    with ExitStack() as stack:
        udp = stack.enter_context(open_udp())
        autopilot = Flown(options, start, udp, stack)
        autopilot.advance_to(START_NS)

        async def run() -> None:
            flight = Flight(autopilot, udp.getsockname()[1], true, origin)
            async with asyncio.timeout(120.0):
                link = asyncio.ensure_future(flight.link.run())
                try:
                    await scenario(flight, out / "fused.csv")
                finally:
                    link.cancel()

        asyncio.run(run())


def test_poses_are_fused_within_two_seconds_wherever_they_begin(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(2.0)
        assert flight.link.fusion().state is FusionState.FUSED, flight.link.fusion()
        await flight.fly(8.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1
        await flight.fly(20.0)
        assert flight.link.ahead_s is not None
        assert abs(flight.link.ahead_s) < 0.03

    flown(tmp_path, scenario)


def test_a_jump_that_is_told_is_followed_within_a_third_of_a_second(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        flight.off, flight.n_resets = np.array([3.0, -4.0, 0.0]), 1
        await flight.fly(0.3)
        assert flight.apart_m(fused)[-1] < 0.2
        await flight.fly(3.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.15

    flown(tmp_path, scenario)


def test_a_slide_is_followed_without_a_reset(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        told: list[str] = []
        flight.slide = Resets("blend", 0.3, 0.1, lambda what, _: told.append(what))
        flight.slide.decide(Pose.identity(), np.eye(6), 0, 0, None, IN_GUIDED, was_silent=False)
        flight.off = np.array([1.8, -2.4, 0.0])
        while len(told) < 2:
            await flight.fly(1.0)
            assert flight.states == [FusionState.FUSED]
            assert np.linalg.norm(flight.off_m(fused) - flight.slid) < 0.15
        assert flight.n_resets == flight.slide.n_resets == 0
        await flight.fly(3.0)
        assert flight.apart_m(fused).max() < 0.1

    flown(tmp_path, scenario)


def test_a_second_without_vision_is_harmless(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        await flight.fly(1.0, sends=False)
        assert flight.apart_m(fused).max() < 0.3
        await flight.fly(5.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1

    flown(tmp_path, scenario)


def test_vision_that_returns_after_half_a_minute_is_fused_again(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(10.0)
        await flight.fly(25.0, sends=False)
        lost = flight.states[-1]
        assert lost is FusionState.LOST
        await flight.fly(15.0)
        assert flight.states[-1] is FusionState.FUSED
        assert flight.apart_m(fused).max() < 0.15

    flown(tmp_path, scenario)


def test_told_its_origin_before_poses_it_knows_its_global_position_by_them(tmp_path: Path) -> None:
    origin = (47.397742, 8.545594, 488.0)

    async def scenario(flight: Flight, fused: Path) -> None:
        places, heard = (fused.with_name(name) for name in ("global.csv", "received.jsonl"))
        # Another drone's local frame: 30 m north, 20 m west and 2 m above of the leader's.
        flight.origin_world = np.array([30.0, -20.0, -2.0])
        assert places.read_text() == ""
        while "VCL origin set" not in heard.read_text():
            assert flight.clock.now_ns() < START_NS + 20_000_000_000
            await flight.fly(1.0, sends=False)
        await flight.fly(2.0)
        assert flight.link.fusion().state is FusionState.FUSED
        await flight.fly(25.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1
        at_ns, latitude, longitude, altitude = map(
            float, places.read_text().splitlines()[-1].split(",")
        )
        there = flight.true_at(round(at_ns)) + flight.origin_world
        metres_per_deg = 111_318.845  # by LOCATION_SCALING_FACTOR
        off_m = [
            (latitude - origin[0]) * metres_per_deg - there[0],
            (longitude - origin[1]) * metres_per_deg * np.cos(np.deg2rad(origin[0])) - there[1],
            altitude - origin[2] + there[2],
        ]
        assert np.abs(off_m).max() < 0.3, off_m

    flown(tmp_path, scenario, origin, rests_s=20.0)


def test_an_origin_that_would_throw_its_height_waits(tmp_path: Path) -> None:
    async def scenario(flight: Flight, fused: Path) -> None:
        heard = fused.with_name("received.jsonl")
        await flight.fly(10.0)
        flight.origin_world = np.zeros(3)
        while "VCL origin waits until armed" not in heard.read_text():
            assert flight.clock.now_ns() < START_NS + 40_000_000_000
            await flight.fly(1.0)
        await flight.fly(5.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1
        assert '"COMMAND_INT"' not in heard.read_text()

    flown(tmp_path, scenario, (47.397742, 8.545594, 488.0))
