"""A real firmware that feels a true motion, our link to it, and who knows where it is."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Coroutine, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sitl.autopilots import ardupilot, px4
from sitl.autopilots.ardupilot_parameters import RECORDED
from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.flown import Flown, Start
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.px4_parameters import RECORDED as PX4_RECORDED
from sitl.autopilots.steered import open_udp
from sitl.firmware import parse_firmware
from tests.whole_lines import whole_lines
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.resets import Resets
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_quaternion
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.fusion import FusionState
from vcl_companion.links.vehicle_mode import VehicleMode
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
        message: what it is sent.
    """

    kind: str
    start: Start
    parameters: Mapping[str, float]
    variable: str
    booted_before_ns: int
    message: Literal["vision_position_estimate", "odometry"] = "vision_position_estimate"


ARDUPILOT = Real(
    "ardupilot",
    ardupilot.start,
    RECORDED,
    "VCL_ARDUPILOT",
    40_000_000_000,
)
# By the first pose it has our clock.
PX4 = Real("px4", px4.start, PX4_RECORDED, "VCL_PX4", 60_000_000_000)


SYSTEM = 2
START_NS = 1_000_000_000_000
STEP_NS = 20_000_000
PERIOD_NS = 100_000_000
SIGMA_M = 0.02
IN_GUIDED = VehicleMode(is_armed=True, follows_positions=True)
BEGINS_AT = np.array([2.0, 2.7, -1.5])


def motion(starts_ns: int = START_NS, rests_s: float = 0.0) -> RecordedMotion:
    """A minute and a half of wide turns at up to 1.6 m/s, away from the origin, looking around.

    It begins with a rest, if it is to.
    """
    at = starts_ns + np.round(np.arange(0.0, 90.0, 0.1) * 1e9).astype(np.int64)
    t = np.arange(0.0, 90.0, 0.1)
    since = np.maximum(t - rests_s, 0.0)
    t = since**2 / (since + 2.0) if rests_s else t
    positions = BEGINS_AT + np.c_[4.0 * np.sin(0.4 * t), 2.0 * np.cos(0.4 * t) - 2.0, -0.1 * t]
    half_rad = 0.5 * (0.6 + 0.5 * np.sin(0.3 * t))
    level = np.c_[np.cos(half_rad), 0.0 * t, 0.0 * t, np.sin(half_rad)]
    return RecordedMotion(at, positions, level)


class Flight:
    """The firmware, our link to it, and a drone that knows where it is."""

    def __init__(
        self,
        real: Real,
        autopilot: Flown,
        port: int,
        true: RecordedMotion,
        origin: tuple[float, float, float] | None,
    ) -> None:
        self.clock = ManualClock(START_NS)
        link = f"udp:127.0.0.1:{port}"
        options = AutopilotOptions(link=link, message=real.message, origin=origin)
        self.link = AutopilotLink(options, SYSTEM, self.clock)
        self.origin_world: Array | None = None
        self.link.origin.origin_world = lambda: self.origin_world
        self.slide: Resets | None = None
        self.slid = np.zeros(3)
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
        if self.slide is not None:
            expected = Pose(turn, there.positions_m[0])
            assert not self.slide.decide(
                told, covariance, at_ns, 1, expected, IN_GUIDED, was_silent=False
            )
            told, _ = self.slide.told(told, at_ns)
            self.slid = told.translation - there.positions_m[0]
        estimate = PoseEstimate(
            told, covariance, there.velocities_m_s[0], 0.01 * np.eye(3), at_ns, self.n_resets
        )
        assert self.link.poses.send(estimate) is None

    def true_at(self, at_ns: int) -> Array:
        """Return (3,) where it was."""
        return np.asarray(self._true.at(np.array([at_ns], dtype=np.int64)).positions_m[0])

    def off_m(self, fused: Path) -> Array:
        """Return (3,) how far from the truth it last said to be."""
        at_ns, *values = whole_lines(fused)[-1].split(",")
        return np.asarray(np.array([float(value) for value in values]) - self.true_at(int(at_ns)))

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
        """Return (T,) instants of the last second, and how far it was from where it was told."""
        times, believed = self._lately(fused)
        apart = believed - self._true.at(times).positions_m - self.off
        return times, np.asarray(np.linalg.norm(apart, axis=1))

    def _lately(self, fused: Path) -> tuple[NDArray[np.int64], Array]:
        rows = [line.split(",") for line in whole_lines(fused)[-60:]]
        times = np.array([int(row[0]) for row in rows])
        believed = np.array([[float(value) for value in row[1:]] for row in rows])
        lately = times > self.clock.now_ns() - 1_000_000_000
        return times[lately], believed[lately]


def flown(
    real: Real,
    tmp_path: Path,
    scenario: Callable[[Flight, Path], Coroutine[None, None, None]],
    moves_from_ns: int = START_NS,
    origin: tuple[float, float, float] | None = None,
    rests_s: float = 0.0,
) -> None:
    """Fly the firmware along a motion, with our link to it, as a scenario says."""
    true = motion(moves_from_ns, rests_s)
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
            flight = Flight(real, autopilot, udp.getsockname()[1], true, origin)
            async with asyncio.timeout(120.0):
                link = asyncio.ensure_future(flight.link.run())
                try:
                    await scenario(flight, out / "fused.csv")
                finally:
                    link.cancel()

        asyncio.run(run())
