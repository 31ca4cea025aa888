"""Whose heading an autopilot flies by, as its parameters say."""

from __future__ import annotations

import asyncio

import pytest

from tests.daemon.waiting import until
from tests.links.running import running
from vcl_companion.links.heading_source import HeadingSource
from vcl_companion.links.vision_pose import Firmware


class Autopilot:
    """Parameters, and who asked for which."""

    def __init__(self, **parameters: float) -> None:
        self.parameters = parameters
        self.asked: list[str] = []

    async def parameter(self, name: str) -> float | None:
        self.asked.append(name)
        await asyncio.sleep(0)
        return self.parameters.get(name)


def is_own(firmware: Firmware, **parameters: float) -> bool:
    """Return what is made of these parameters."""

    async def scenario() -> bool:
        autopilot = Autopilot(**parameters)
        source = HeadingSource(autopilot.parameter)
        source.is_of(firmware)
        async with running(source.run()):
            await until(lambda: len(autopilot.asked) >= 1)
            for _ in range(10):
                await asyncio.sleep(0)
            return source.is_own

    return asyncio.run(scenario())


@pytest.mark.parametrize(
    ("source", "own"), [(0, False), (1, True), (2, True), (3, True), (6, False), (8, False)]
)
def test_an_ardupilot_has_the_heading_of_its_source(source: float, own: bool) -> None:
    assert is_own(Firmware.ARDUPILOT, EK3_SRC1_YAW=source) is own


@pytest.mark.parametrize(
    ("parameters", "own"),
    [
        ({"EKF2_MAG_TYPE": 0.0, "SYS_HAS_MAG": 1.0}, True),
        ({"EKF2_MAG_TYPE": 0.0}, True),
        ({"EKF2_MAG_TYPE": 5.0, "SYS_HAS_MAG": 1.0}, False),
        ({"EKF2_MAG_TYPE": 1.0, "SYS_HAS_MAG": 0.0}, False),
    ],
)
def test_a_px4_begins_by_its_compass(parameters: dict[str, float], own: bool) -> None:
    assert is_own(Firmware.PX4, **parameters) is own


@pytest.mark.parametrize("firmware", [Firmware.ARDUPILOT, Firmware.PX4])
def test_one_that_does_not_say_is_not_believed(firmware: Firmware) -> None:
    assert not is_own(firmware)


def test_nobody_has_one_before_he_is_heard_of_and_others_have_one() -> None:
    source = HeadingSource(Autopilot().parameter)
    assert not source.is_own
    source.is_of(Firmware.OTHER)
    assert source.is_own


def test_a_restart_and_another_firmware_are_asked_again() -> None:
    async def scenario() -> None:
        autopilot = Autopilot(EK3_SRC1_YAW=6.0, EKF2_MAG_TYPE=0.0)
        source = HeadingSource(autopilot.parameter)
        async with running(source.run()):
            source.is_of(Firmware.ARDUPILOT)
            await until(lambda: len(autopilot.asked) == 1)
            source.is_of(Firmware.ARDUPILOT)  # the next heartbeat
            autopilot.parameters["EK3_SRC1_YAW"] = 1.0
            source.forget()
            assert not source.was_own
            await until(lambda: source.is_own)
            source.forget()
            assert not source.is_own
            assert source.was_own
            await until(lambda: source.is_own)
            assert autopilot.asked == ["EK3_SRC1_YAW"] * 3
            source.is_of(Firmware.PX4)
            assert not source.was_own
            await until(lambda: "EKF2_MAG_TYPE" in autopilot.asked)

    asyncio.run(scenario())


def test_one_that_restarts_while_it_does_not_say_is_asked_at_once() -> None:
    async def scenario() -> None:
        autopilot = Autopilot()
        source = HeadingSource(autopilot.parameter)
        async with running(source.run()):
            source.is_of(Firmware.ARDUPILOT)
            await until(lambda: len(autopilot.asked) == 1)
            for _ in range(10):
                await asyncio.sleep(0)
            autopilot.parameters["EK3_SRC1_YAW"] = 1.0
            source.forget()
            async with asyncio.timeout(1.0):  # else asked after a pause of two seconds, or more
                await until(lambda: source.is_own)

    asyncio.run(scenario())
