"""A real firmware flies a mission, and has no position but ours.

Runs with ArduCopter when ``VCL_ARDUPILOT`` names a binary built for simulation, with PX4 when
``VCL_PX4`` names the folder of such a build.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path

import msgspec
import numpy as np

from sitl.firmware import parse_firmware
from sitl.mission import COMMANDED_FILE, Mission
from sitl.processes import end_children, start_child
from sitl.stand_in_process import StandIn
from tests.sitl.real_firmware import Real
from vcl_companion.clock import ManualClock
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_euler
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.vision_pose import PoseEstimate

SYSTEM = 3
START_NS = 1_000_000_000_000
STEP_NS, PERIOD_NS = 20_000_000, 100_000_000
MISSION = Mission(
    (7.0, -3.0, 30.0),
    ((7.0, -3.0, -2.5, 30.0), (11.0, -3.0, -2.5, 30.0), (11.0, 1.0, -3.0, 90.0)),
    begins_s=3.0,
)


# The local frame begins where it stands. An ArduCopter's north may be some way from the true one; a
# PX4 has found that by its compass before.
NORTH_RAD = {"ardupilot": -0.6, "px4": 0.0}
# When each is on its way; what it flies in then.
UNDER_WAY_S = {"ardupilot": 9.0, "px4": 18.0}
# More than the five that PX4 follows of itself in the air, where it is told of none.
N_RESETS, RESET_EVERY_S, RESET_M = 7, 1.5, np.array([0.6, 0.0, 0.0])
STEERED_IN = {"ardupilot": "GUIDED", "px4": "OFFBOARD"}


class Companion:
    """Our link to the firmware, which is told where it truly is."""

    def __init__(
        self, real: Real, autopilot: StandIn, silent_after_s: float, resets_s: tuple[float, ...]
    ) -> None:
        self.clock = ManualClock(START_NS)
        options = AutopilotOptions(link=f"udp:127.0.0.1:{autopilot.port}")
        self.link = AutopilotLink(options, SYSTEM, self.clock)
        self.autopilot = autopilot
        self.true: list[Pose] = []
        self.told: list[tuple[int, Array]] = []
        self._silent_after_s, self._resets_s = silent_after_s, resets_s
        north = Pose(matrix_from_euler(0.0, 0.0, NORTH_RAD[real.kind]), np.zeros(3))
        self._local_from_ned = north @ Pose(np.eye(3), -MISSION.ned_from_body.translation)

    async def fly(self, seconds: float) -> None:
        until_ns = START_NS + round(seconds * 1e9)
        while self.clock.now_ns() < until_ns and not self.autopilot.state.get("is_over"):
            now_ns = self.clock.now_ns() + STEP_NS
            await self.autopilot.advance_to(now_ns)
            self.clock.advance_to(now_ns)
            values = np.array(self.autopilot.state["pose"])
            self.true.append(Pose.from_quaternion(values[3:], values[:3]))
            is_told = now_ns < START_NS + self._silent_after_s * 1e9
            if now_ns % PERIOD_NS == 0 and is_told:
                self._tell(now_ns)
            await asyncio.sleep(0.001)

    def _tell(self, at_ns: int) -> None:
        n_resets = sum(at_ns >= START_NS + at_s * 1e9 for at_s in self._resets_s)
        shift = Pose(np.eye(3), RESET_M * (n_resets % 2))
        told = self._local_from_ned @ shift @ self.true[-1]
        self.told.append((at_ns, told.translation))
        covariance = np.diag([0.02**2] * 3 + [1e-4] * 3)
        estimate = PoseEstimate(told, covariance, np.zeros(3), 0.01 * np.eye(3), at_ns, n_resets)
        assert self.link.poses.send(estimate) is None


async def flown(
    real: Real,
    tmp_path: Path,
    seconds: float,
    silent_after_s: float = np.inf,
    resets_s: tuple[float, ...] = (),
) -> Companion:
    config = {
        "binary": str(parse_firmware(f"{real.kind}={os.environ[real.variable]}").path),
        "system_id": SYSTEM,
        "boot_offset_ns": START_NS - real.booted_before_ns,
        "mission": msgspec.to_builtins(MISSION),
        "begins_ns": START_NS + round(MISSION.begins_s * 1e9),
        "out": str(tmp_path / "out"),
        "run": str(tmp_path / "run"),
    }
    path = tmp_path / "config.json"
    path.write_text(json.dumps(config))
    child = await start_child(
        "autopilot",
        (sys.executable, "-m", f"sitl.autopilots.{real.kind}", str(path)),
        log_prefix=tmp_path / "autopilot",
        environment={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        piped=True,
    )
    try:
        companion = Companion(real, await StandIn.of(child), silent_after_s, resets_s)
        await companion.autopilot.advance_to(START_NS)
        async with asyncio.timeout(300.0):
            link = asyncio.ensure_future(companion.link.run())
            try:
                await companion.fly(seconds)
            finally:
                link.cancel()
        await companion.autopilot.finish()
    finally:
        await end_children([child], 5.0)
    return companion


def test_it_arms_takes_off_goes_where_it_is_sent_and_lands_there(
    real: Real, tmp_path: Path
) -> None:
    companion = asyncio.run(flown(real, tmp_path, 90.0))
    state = companion.autopilot.state
    said = (tmp_path / "out" / "said.csv").read_text()
    assert (state["is_over"], state["trouble"]) == (True, ""), said
    ended = companion.true[-1].translation
    assert np.linalg.norm(ended[:2] - (11.0, 1.0)) < 0.3
    assert abs(ended[2] + MISSION.gear_m) < 0.05
    highest = min(pose.translation[2] for pose in companion.true)
    assert -3.4 < highest < -2.9
    commanded = (tmp_path / "out" / COMMANDED_FILE).read_text().splitlines()
    steps = [line.rsplit(",", 1)[1] for line in commanded[1:]]
    assert steps == [
        "stands",
        "takes off",
        *(f"leg {n} of 3" for n in (1, 2, 3)),
        "lands",
        "landed",
    ]


def test_resets_in_the_air_are_each_followed_and_the_mission_is_flown_to_its_end(
    real: Real, tmp_path: Path
) -> None:
    first_s = UNDER_WAY_S[real.kind]
    resets_s = tuple(first_s + RESET_EVERY_S * n for n in range(N_RESETS))
    companion = asyncio.run(flown(real, tmp_path, 90.0, resets_s=resets_s))
    state = companion.autopilot.state
    said = (tmp_path / "out" / "said.csv").read_text()
    assert (state["is_over"], state["trouble"]) == (True, ""), said
    fused = np.loadtxt(tmp_path / "out" / "fused.csv", delimiter=",", skiprows=1)
    told_ns = np.array([at_ns for at_ns, _ in companion.told])
    told_m = np.array([place for _, place in companion.told])
    at = [np.interp(fused[:, 0], told_ns, told_m[:, i]) for i in range(2)]
    apart_m = np.hypot(fused[:, 1] - at[0], fused[:, 2] - at[1])
    for reset_s in resets_s:
        since_s = (fused[:, 0] - START_NS) * 1e-9 - reset_s
        assert apart_m[(since_s > 0.3) & (since_s < RESET_EVERY_S - 0.2)].max() < 0.25
    # It flies to where it was sent in the frame that it was left in.
    ended = companion.true[-1].translation
    assert np.linalg.norm(ended[:2] - (11.0, 1.0) + RESET_M[:2]) < 0.3


def test_where_we_fall_silent_it_gives_up_its_mission_and_lands_by_itself(
    real: Real, tmp_path: Path
) -> None:
    companion = asyncio.run(flown(real, tmp_path, 90.0, UNDER_WAY_S[real.kind]))
    state = companion.autopilot.state
    said = (tmp_path / "out" / "said.csv").read_text()
    assert state["is_over"], said
    assert f"left {STEERED_IN[real.kind]}" in state["trouble"], said
    assert abs(companion.true[-1].translation[2] + MISSION.gear_m) < 0.1
