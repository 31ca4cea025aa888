"""Poses between frames: of where the drone then was, told as no news, and not for ever."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.daemon.autopilot import Autopilot, autopilot_and_link
from tests.daemon.waiting import beside, run, until
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.teller import Teller, Untold, covariance_between
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import (
    Array,
    euler_from_matrix,
    matrix_from_euler,
    quaternion_from_matrix,
)
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pose_filter import FilterOptions

SYSTEM = 3
START_NS = 1_760_000_000_000_000_000
MS = 1_000_000
PERIOD_NS = 200 * MS
VELOCITY = np.array([2.0, -0.5, 0.1])
TURN_RAD_S = 0.4
SIGMA_M = 0.02


def truth(at_ns: int) -> Pose:
    since_s = (at_ns - START_NS) * 1e-9
    return Pose(matrix_from_euler(0.02, -0.01, TURN_RAD_S * since_s), VELOCITY * since_s)


def seen(at_ns: int, off_m: Array | None = None) -> Localized:
    """A frame's own fix, exact."""
    noise = np.diag([SIGMA_M**2] * 3 + [0.002**2] * 3)
    there = truth(at_ns)
    pose = Pose(there.rotation, there.translation + (np.zeros(3) if off_m is None else off_m))
    return Localized(pose, noise, np.zeros((6, 6)), np.zeros((6, 0)), np.zeros((0, 0)),
                     100, 90, False, 0.5)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Flight:
    """A drone that knows where it is at its frames, and its autopilot."""

    teller: Teller
    estimator: Estimator
    autopilot: Autopilot
    link: AutopilotLink
    clock: ManualClock
    path: Path

    async def turn_until(self, at_ns: int, step_ns: int = 20 * MS) -> None:
        """Let time go on, and the attitude of it come in."""
        now_ns = self.clock.now_ns() // step_ns * step_ns
        while (now_ns := now_ns + step_ns) <= at_ns:
            self.clock.advance_to(now_ns)
            self.autopilot.measure(now_ns, quaternion_from_matrix(truth(now_ns).rotation))
            await until(partial(self._has_heard, now_ns))
            await asyncio.sleep(0)

    def _has_heard(self, at_ns: int) -> bool:
        return (self.link.attitudes.newest_ns() or 0) >= at_ns

    async def frame(self, k: int, *, is_seen: bool = True, late_ms: int = 0) -> FilterState | None:
        """Look at the k-th frame, when its time has come, and tell its pose."""
        at_ns = START_NS + k * PERIOD_NS
        await self.turn_until(at_ns)
        self.teller.arrived(at_ns)
        await self.turn_until(at_ns + late_ms * MS)
        turned = truth(at_ns).rotation
        predicted = self.estimator.predicted(at_ns, turned)
        if not is_seen:
            self.estimator.take_nothing(predicted, at_ns, turned)
            return None
        state = self.estimator.take_fix(predicted, seen(at_ns), at_ns, turned)
        assert not isinstance(state, NotLocalized)
        assert self.teller.tell(state, at_ns) is None
        return state

    async def told(self) -> list[tuple[Any, ...]]:
        """All poses that have come, in their order."""
        await asyncio.sleep(0.02)
        out = []
        while not self.autopilot.poses.empty():
            out.append(self.autopilot.poses.get_nowait())
        return out

    def logged(self) -> list[int]:
        lines = map(json.loads, self.path.read_text().splitlines())
        return [line["at_ns"] for line in lines if line["kind"] == "propagated"]


@contextlib.asynccontextmanager
async def flying(
    path: Path, options: AutopilotOptions | None = None, coast_s: float = 0.0
) -> AsyncIterator[Flight]:
    clock = ManualClock(START_NS)
    level = quaternion_from_matrix(truth(START_NS).rotation)
    async with contextlib.AsyncExitStack() as stack:
        autopilot, link = await stack.enter_async_context(
            autopilot_and_link(SYSTEM, clock, START_NS, level)
        )
        log = stack.enter_context(contextlib.closing(FlightLog(str(path / "log"), clock)))
        estimator = Estimator(FilterOptions(coast_s=coast_s), LocalizationOptions(), lambda _: None)
        teller = Teller(link, estimator, clock, log, options or AutopilotOptions())
        async with beside(link.run(), teller.run()):
            assert await link.attitudes.at(START_NS, 5.0) is not None
            yield Flight(teller, estimator, autopilot, link, clock, path / "log")


def instants_ms(poses: list[tuple[Any, ...]]) -> list[int]:
    return [(pose[0] * 1000 - START_NS) // MS for pose in poses]


def test_a_camera_of_five_hertz_makes_ten_poses_a_second(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(6):
                await up.frame(k)
            poses = await up.told()
            between = [at_ms for at_ms in instants_ms(poses) if at_ms % 200]
            assert instants_ms(poses) == [0, 100, 200, 300, 400, 500, 600, 700, 800, 900, 1000]
            assert [(at_ns - START_NS) // MS for at_ns in up.logged()] == between
            for usec, x, y, z, roll, pitch, yaw, *_ in poses[4:]:
                there = truth(usec * 1000)
                # The autopilot tells its time in milliseconds, half of which the filter's turn is.
                assert np.allclose((x, y, z), there.translation, atol=0.03)
                assert np.allclose((roll, pitch, yaw), euler_from_matrix(there.rotation), atol=0.01)

    run(scenario())


def test_what_lies_between_frames_is_told_as_less_than_a_fifth_of_one(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(6):
                await up.frame(k)
            poses = await up.told()
            variances = {
                at_ms: pose[7] for at_ms, pose in zip(instants_ms(poses), poses, strict=True)
            }
            assert variances[900] > 19.9 * variances[800]
            of_yaw = {
                at_ms: pose[27] for at_ms, pose in zip(instants_ms(poses), poses, strict=True)
            }
            assert of_yaw[900] > 1.0 > 1e3 * of_yaw[800]

    run(scenario())


@pytest.mark.parametrize("n_between", [1, 2, 5])
def test_information_does_not_grow_with_the_rate(n_between: int) -> None:
    pose = np.diag([0.01, 0.04, 0.02, 1e-4, 1e-4, 4e-4])
    told, velocity = covariance_between(pose, 0.3 * np.eye(3), 1.0 / (n_between + 1))
    together = n_between * np.linalg.inv(told)[:3, :3]
    assert np.all(together @ pose[:3, :3] <= 0.1)
    assert np.all(np.diag(n_between * np.linalg.inv(velocity) * 0.3) <= 0.1)


def test_a_camera_that_dies_ends_in_silence(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(5):
                await up.frame(k)
            await up.turn_until(START_NS + 3000 * MS)
            assert instants_ms(await up.told())[-6:] == [800, 900, 1000, 1100, 1200, 1300]

    run(scenario())


def test_a_frame_that_gives_no_pose_ends_what_lies_between(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(5):
                await up.frame(k)
            await up.frame(5, is_seen=False)
            await up.turn_until(START_NS + 1300 * MS)
            assert instants_ms(await up.told())[-2:] == [800, 900]
            await up.frame(8)
            await up.turn_until(START_NS + 1780 * MS)
            assert instants_ms(await up.told()) == [1600, 1700]

    run(scenario())


def test_coasting_goes_on_as_long_as_it_may(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, coast_s=0.7) as up:
            for k in range(5):
                await up.frame(k)
            await up.frame(5, is_seen=False)
            await up.turn_until(START_NS + 2500 * MS)
            assert instants_ms(await up.told())[-7:] == [*range(900, 1501, 100)]

    run(scenario())


def test_nothing_is_told_between_frames_while_paused(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(5):
                await up.frame(k)
            up.link.poses.is_paused = True
            await up.turn_until(START_NS + 980 * MS)
            assert instants_ms(await up.told())[-1] == 800
            assert len(up.logged()) == 4

    run(scenario())


def test_nothing_is_told_of_after_a_frame_that_is_still_looked_at(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(5):
                await up.frame(k)
            # Looked at for 0.38 s, when three more would have been due.
            await up.frame(5, late_ms=380)
            await up.turn_until(START_NS + 1400 * MS)
            assert instants_ms(await up.told())[-4:] == [1000, 1100, 1200, 1300]

    run(scenario())


def test_frames_that_nobody_looks_at_are_not_remembered_for_ever(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(1000):
                up.teller.arrived(START_NS + k * 33 * MS)
            assert len(up.teller._unseen) < 200

    run(scenario())


def test_a_pose_older_than_one_that_was_told_is_held_back(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            first = await up.frame(0)
            second = await up.frame(1)
            assert first is not None
            assert second is not None
            for state in (first, second):
                untold = up.teller.tell(state, state.at_ns)
                assert untold is not None
                assert untold.is_held_back
            assert instants_ms(await up.told()) == [0, 100, 200]

    run(scenario())


def test_without_a_least_rate_frames_alone_are_told(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, AutopilotOptions(min_rate_hz=0.0)) as up:
            for k in range(4):
                await up.frame(k)
            await up.turn_until(START_NS + 1500 * MS)
            assert instants_ms(await up.told()) == [0, 200, 400, 600]
            assert up.logged() == []

    run(scenario())


GUIDED = {"autopilot": 3, "base_mode": 128 | 1, "custom_mode": 4}
LOITER = {**GUIDED, "custom_mode": 5}


async def jumps(up: Flight, k: int, off_m: Array) -> Untold | None:
    """Look at the k-th frame after the drone has been found again, elsewhere."""
    at_ns = START_NS + k * PERIOD_NS
    await up.turn_until(at_ns)
    up.teller.arrived(at_ns)
    turned = truth(at_ns).rotation
    predicted = up.estimator.predicted(at_ns, turned)
    state = up.estimator.take_fix(predicted, seen(at_ns, off_m), at_ns, turned)
    assert not isinstance(state, NotLocalized)
    return up.teller.tell(state, at_ns)


AWAY = np.array([3.0, 4.0, 0.0])


async def flown_to_a_jump(up: Flight, heartbeat: dict[str, int]) -> Untold | None:
    for k in range(6):
        await up.frame(k)
    up.autopilot.beat(**heartbeat)
    await until(lambda: up.link.mode.is_armed)
    up.estimator.forget()
    return await jumps(up, 6, AWAY)


@pytest.mark.parametrize("heartbeat", [GUIDED, LOITER])
def test_a_place_elsewhere_resets_the_autopilot(tmp_path: Path, heartbeat: dict[str, int]) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            assert await flown_to_a_jump(up, heartbeat) is None
            poses = await up.told()
            assert poses[-1][28] == poses[-2][28] + 1
            assert np.allclose(poses[-1][1:4], truth(START_NS + 6 * PERIOD_NS).translation + AWAY)
            assert "5.0 m away: the autopilot is reset" in await up.autopilot.texts.get()

    run(scenario())


def test_the_same_place_found_anew_does_not(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(6):
                await up.frame(k)
            up.estimator.forget()
            await jumps(up, 6, np.zeros(3))
            assert len({pose[28] for pose in await up.told()}) == 1

    run(scenario())


def test_who_flies_to_positions_is_slid_there(tmp_path: Path) -> None:
    async def scenario() -> None:
        options = AutopilotOptions(resets="blend", blend_speed_m_s=1.0)
        async with flying(tmp_path, options) as up:
            assert await flown_to_a_jump(up, GUIDED) is None
            for k in range(7, 65):
                assert await jumps(up, k, AWAY) is None
            poses = await up.told()
            assert len({pose[28] for pose in poses}) == 1
            off = [np.array(p[1:4]) - truth(p[0] * 1000).translation for p in poses]
            of_jump = instants_ms(poses).index(1200)
            assert np.linalg.norm(off[of_jump]) < 0.01
            # How fast it flies is not known before the next frame.
            off, poses = off[of_jump + 2 :], poses[of_jump + 2 :]
            slid = [float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(off)]
            apart_s = [(b[0] - a[0]) * 1e-6 for a, b in itertools.pairwise(poses)]
            # Between frames as well.
            assert all(d < 1.0 * s + 0.03 for d, s in zip(slid, apart_s, strict=True))
            assert np.allclose(off[-1], AWAY, atol=0.01)

    run(scenario())


def test_nothing_is_told_until_the_ground_commands_it(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, AutopilotOptions(resets="wait")) as up:
            untold = await flown_to_a_jump(up, GUIDED)
            assert untold is not None
            assert not untold.is_held_back
            assert "waiting for the ground" in untold.reason
            before = (await up.told())[-1]
            assert await jumps(up, 7, AWAY) is not None
            await up.turn_until(START_NS + 7 * PERIOD_NS + 180 * MS)
            assert await up.told() == []  # nor between frames
            up.teller.allow_jump()
            assert await jumps(up, 8, AWAY) is None
            assert (await up.told())[-1][28] == before[28] + 1

    run(scenario())


def test_nothing_is_told_until_the_mode_is_another(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, AutopilotOptions(resets="wait")) as up:
            assert await flown_to_a_jump(up, GUIDED) is not None
            up.autopilot.beat(**LOITER)
            await until(lambda: not up.link.mode.is_steered_by_positions)
            assert await jumps(up, 7, AWAY) is None

    run(scenario())
