"""Our link to a real firmware that feels a true motion: what it fuses, loses and follows.

Runs with ArduCopter when ``VCL_ARDUPILOT`` names a binary built for simulation, with PX4 when
``VCL_PX4`` names the folder of such a build.
"""

from __future__ import annotations

import asyncio
import os
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from sitl.autopilots import px4
from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.flown import Firmware
from sitl.autopilots.motion import RecordedMotion
from sitl.autopilots.px4_parameters import RECORDED
from sitl.autopilots.px4_process import STEP_NS
from sitl.autopilots.wire import Wire
from tests.sitl.real_firmware import (
    ARDUPILOT,
    IN_GUIDED,
    PERIOD_NS,
    PX4,
    START_NS,
    Flight,
    Real,
    flown,
)
from tests.whole_lines import whole_lines
from vcl_companion.daemon.parameter_rules import findings, names_of, rules_for
from vcl_companion.daemon.resets import Resets
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.fusion import FusionState


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
            rules = rules_for(link.firmware, sends_velocity=False, sets_origin=False)
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
    parameters = {**RECORDED, "EKF2_EV_CTRL": 15.0}
    flown(replace(PX4, parameters=parameters, message="odometry"), tmp_path, scenario)


@pytest.mark.skipif(not os.environ.get("VCL_PX4"), reason="VCL_PX4 names no firmware")
def test_px4_takes_our_instants_once_we_have_told_it_the_time(tmp_path: Path) -> None:
    def start(options: FirmwareOptions, wire: Wire, stack: ExitStack) -> Firmware:
        assert isinstance(options.flies, RecordedMotion)
        return px4.Px4(options, options.flies, wire, stack, tells_time=False)

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


@pytest.mark.skipif(not os.environ.get("VCL_PX4"), reason="VCL_PX4 names no firmware")
@pytest.mark.parametrize("steps", range(3))
def test_px4_is_neither_ahead_nor_behind_whichever_of_its_steps_our_poses_fall_in(
    tmp_path: Path, steps: int
) -> None:
    behind_s: list[float] = []

    async def scenario(flight: Flight, fused: Path) -> None:
        await flight.fly(6.0)
        for _ in range(12):
            await flight.fly(1.0)
            behind_s.append(flight.behind_s(fused))

    booted_before_ns = PX4.booted_before_ns + steps * STEP_NS
    flown(replace(PX4, booted_before_ns=booted_before_ns), tmp_path, scenario)
    # A step is 4 ms: of that hardly anything, and in no second, whose motion tells less, all of it.
    assert abs(np.mean(behind_s)) < 0.001, behind_s
    assert np.abs(behind_s).max() < 0.003, behind_s


@pytest.mark.skipif(not os.environ.get("VCL_ARDUPILOT"), reason="VCL_ARDUPILOT names no firmware")
def test_an_arducopter_follows_a_slide_without_a_reset(tmp_path: Path) -> None:
    # What it swings by at these turns, by up to 0.04 m, is not the slide's: it flies them twice.
    beside: dict[bool, list[Array]] = {False: [], True: []}
    told: list[str] = []
    n_told: list[int] = []

    async def scenario(flight: Flight, fused: Path, *, slides: bool) -> None:
        await flight.fly(10.0)
        if slides:
            flight.slide = Resets("blend", 0.3, 0.1, lambda what, _: told.append(what))
            flight.slide.decide(Pose.identity(), np.eye(6), 0, 0, None, IN_GUIDED, was_silent=False)
            flight.off = np.array([1.8, -2.4, 0.0])
        for _ in range(30):
            await flight.fly(1.0)
            assert flight.states == [FusionState.FUSED]
            beside[slides].append(flight.off_m(fused) - flight.slid)
            if slides:
                n_told.append(len(told))
        assert flight.n_resets == 0
        assert flight.slide is None or flight.slide.n_resets == 0

    for slides in (False, True):
        flown(ARDUPILOT, tmp_path / str(slides), partial(scenario, slides=slides))
    arrived = n_told.index(2)
    swung = np.subtract(beside[True], beside[False])
    for off in (np.linalg.norm(beside[True], axis=1), np.linalg.norm(swung, axis=1)):
        assert off.max() < 0.15
        assert off[arrived + 3 :].max() < 0.1
    assert np.linalg.norm(swung[arrived + 10 :], axis=1).max() < 0.03


@pytest.mark.skipif(not os.environ.get("VCL_ARDUPILOT"), reason="VCL_ARDUPILOT names no firmware")
def test_told_its_origin_before_poses_it_knows_its_global_position_by_them(tmp_path: Path) -> None:
    origin = (47.397742, 8.545594, 488.0)

    async def scenario(flight: Flight, fused: Path) -> None:
        places, heard = (fused.with_name(name) for name in ("global.csv", "received.jsonl"))
        # Another drone's local frame: 30 m north, 20 m west and 2 m above of the leader's.
        flight.origin_world = np.array([30.0, -20.0, -2.0])
        assert len(places.read_text().splitlines()) <= 1  # its first line at most
        while "VCL origin set" not in heard.read_text():
            assert flight.clock.now_ns() < START_NS + 20_000_000_000
            await flight.fly(1.0, sends=False)
        await flight.fly(2.0)
        assert flight.link.fusion().state is FusionState.FUSED
        await flight.fly(25.0)
        assert flight.states == [FusionState.FUSED]
        assert flight.apart_m(fused).max() < 0.1
        at_ns, latitude, longitude, altitude = map(float, whole_lines(places)[-1].split(","))
        there = flight.true_at(round(at_ns)) + flight.origin_world
        metres_per_deg = 111_318.845  # by LOCATION_SCALING_FACTOR
        off_m = [
            (latitude - origin[0]) * metres_per_deg - there[0],
            (longitude - origin[1]) * metres_per_deg * np.cos(np.deg2rad(origin[0])) - there[1],
            altitude - origin[2] + there[2],
        ]
        assert np.abs(off_m).max() < 0.3, off_m

    flown(ARDUPILOT, tmp_path, scenario, origin=origin, rests_s=20.0)


@pytest.mark.skipif(not os.environ.get("VCL_ARDUPILOT"), reason="VCL_ARDUPILOT names no firmware")
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

    flown(ARDUPILOT, tmp_path, scenario, origin=(47.397742, 8.545594, 488.0))
