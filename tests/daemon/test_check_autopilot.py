"""What ``vcl check`` says of an autopilot's clock, and of the frame that it is told poses in."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping

import pytest

from tests.daemon.waiting import beside
from tests.links import wire
from tests.links.running import Udp, udp
from tests.sitl.test_check import PX4
from vcl_companion.clock import SystemClock
from vcl_companion.config import Config
from vcl_companion.daemon.check import of_autopilot
from vcl_companion.daemon.check_host import Check
from vcl_companion.daemon.frame_rules import of_frames
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions, Heading
from vcl_companion.links.vision_pose import Firmware

SYSTEM = 7
ORIGIN = (47.397742, 8.545594, 488.0)
REAL32 = 9


async def answer(side: Udp, mav_autopilot: int, parameters: Mapping[str, float]) -> None:
    """Play an autopilot that has parameters, and does not answer questions for the time."""
    while True:
        data, where = await side.got.get()
        for seen in wire.read(data):
            if seen.message_id == wire.HEARTBEAT:
                beat = wire.packed(wire.HEARTBEAT, 4, 2, mav_autopilot, 1, 4, 3, system=SYSTEM)
                side.transport.sendto(beat, where)
            elif seen.message_id == wire.PARAM_REQUEST_READ:
                name = seen.fields[3].rstrip(b"\0").decode()
                if name in parameters:
                    raw = struct.pack("<f", parameters[name])
                    fields = (raw, 1, 0xFFFF, name.encode(), REAL32)
                    value = wire.packed(wire.PARAM_VALUE, *fields, system=SYSTEM)
                    side.transport.sendto(value, where)


def checks_of(
    mav_autopilot: int,
    parameters: Mapping[str, float],
    origin: tuple[float, float, float] | None = None,
) -> dict[str, Check]:
    """Return what is said of such an autopilot, by name."""

    async def scenario() -> list[Check]:
        async with udp() as side:
            options = AutopilotOptions(link=f"udp:127.0.0.1:{side.port}", origin=origin)
            config = Config(system_id=SYSTEM, autopilot=options)
            link = AutopilotLink(options, SYSTEM, SystemClock())
            async with beside(link.run(), answer(side, mav_autopilot, parameters)):
                checks, _ = await of_autopilot(config, link)
                return checks

    return {check.name: check for check in asyncio.run(scenario())}


def test_a_px4_whose_clock_is_not_known_does_not_fuse() -> None:
    checks = checks_of(12, PX4)
    assert checks["time"].grade == "failure"
    assert "not answered" in checks["time"].what
    assert "TIMESYNC" in checks["time"].advice
    assert "origin" not in checks


def test_one_that_answers_no_question_for_a_parameter_is_not_taken_to_have_none() -> None:
    checks = checks_of(3, {})
    assert checks["parameters"].grade == "failure"
    assert "answers no question" in checks["parameters"].what
    assert "EK3_ENABLE" not in checks
    assert "AHRS_EKF_TYPE" not in checks


def test_a_px4_with_height_by_vision_is_warned_of_an_origin() -> None:
    checks = checks_of(12, {**PX4, "EKF2_HGT_REF": 3.0})
    assert checks["origin"].grade == "warning"
    assert "climbs away" in checks["origin"].what
    assert "EKF2_HGT_REF" not in checks


def test_a_px4_with_height_by_vision_gets_no_origin_and_fails() -> None:
    checks = checks_of(12, {**PX4, "EKF2_HGT_REF": 3.0}, ORIGIN)
    assert checks["EKF2_HGT_REF"].grade == "failure"
    assert checks["origin"].grade == "failure"
    assert "climb away" in checks["origin"].what
    assert checks_of(12, PX4, ORIGIN).get("origin") is None


@pytest.mark.parametrize(
    ("firmware", "values", "heading", "advice"),
    [
        (Firmware.ARDUPILOT, {"EK3_SRC1_YAW": 6.0}, "map", ""),
        (Firmware.ARDUPILOT, {"EK3_SRC1_YAW": 6.0}, "autopilot", '"map"'),
        (Firmware.ARDUPILOT, {"EK3_SRC1_YAW": 1.0}, "map", '"autopilot"'),
        (Firmware.ARDUPILOT, {"EK3_SRC1_YAW": 1.0}, "autopilot", ""),
        (Firmware.ARDUPILOT, {"EK3_SRC1_YAW": 2.0}, "map", ""),  # a failure of its own
        (Firmware.ARDUPILOT, {}, "map", ""),
        (Firmware.PX4, {"EKF2_EV_CTRL": 11.0}, "map", ""),
        (Firmware.PX4, {"EKF2_EV_CTRL": 11.0}, "autopilot", '"map"'),
        (Firmware.PX4, {"EKF2_EV_CTRL": 3.0}, "map", '"autopilot"'),
        (Firmware.PX4, {"EKF2_EV_CTRL": 3.0}, "autopilot", ""),
        (Firmware.OTHER, {"EK3_SRC1_YAW": 1.0}, "map", ""),
    ],
)
def test_the_heading_has_to_fit_who_tells_it(
    firmware: Firmware, values: Mapping[str, float], heading: Heading, advice: str
) -> None:
    checks = list(of_frames(AutopilotOptions(heading=heading), firmware, values))
    assert [check.grade for check in checks] == (["warning"] if advice else [])
    assert all(check.advice == f"set autopilot.heading = {advice}" for check in checks)
