"""An autopilot's parameters, read and set as each firmware means their bytes."""

import asyncio
import struct

import pytest

from tests.links import wire
from tests.links.running import Udp, running, udp
from vcl_companion.clock import ManualClock
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.messages import ParameterValue
from vcl_companion.links.parameters import raw_of, value_of
from vcl_companion.links.vision_pose import Firmware

SYSTEM = 7


@pytest.mark.parametrize(
    ("firmware", "kind", "value", "raw"),
    [
        (Firmware.ARDUPILOT, 2, 6.0, struct.pack("<f", 6.0)),
        (Firmware.ARDUPILOT, 6, -1.0, struct.pack("<f", -1.0)),
        (Firmware.PX4, 6, 11.0, struct.pack("<i", 11)),
        (Firmware.PX4, 6, -1.0, b"\xff\xff\xff\xff"),
        (Firmware.PX4, 9, 0.1, struct.pack("<f", 0.1)),
    ],
)
def test_a_value_is_its_firmware_s_bytes(
    firmware: Firmware, kind: int, value: float, raw: bytes
) -> None:
    assert raw_of(value, kind, firmware) == raw
    assert value_of(ParameterValue(1, 1, "X", raw, kind), firmware) == pytest.approx(value)


class Vehicle:
    """Some parameters behind a UDP socket; every other question for each is lost."""

    def __init__(self, side: Udp, parameters: dict[str, tuple[bytes, int]]) -> None:
        self._side = side
        self.parameters = parameters
        self.asked: list[str] = []

    async def run(self) -> None:
        while True:
            data, where = await self._side.got.get()
            for seen in wire.read(data):
                if seen.message_id == wire.PARAM_REQUEST_READ:
                    name = seen.fields[3].rstrip(b"\0").decode()
                    self.asked.append(name)
                    if self.asked.count(name) % 2 == 0:
                        self._tell(name, where)
                elif seen.message_id == wire.PARAM_SET:
                    raw, _, _, name_bytes, kind = seen.fields
                    name = name_bytes.rstrip(b"\0").decode()
                    assert kind == self.parameters[name][1]
                    self.parameters[name] = (raw, kind)
                    self._tell(name, where)

    def _tell(self, name: str, where: tuple[str, int]) -> None:
        if name in self.parameters:
            raw, kind = self.parameters[name]
            answer = wire.packed(
                wire.PARAM_VALUE, raw, 900, 0xFFFF, name.encode(), kind, system=SYSTEM
            )
            self._side.transport.sendto(answer, where)


def test_parameters_are_read_and_set_over_a_link_that_loses_half() -> None:
    async def scenario() -> None:
        async with udp() as side:
            vehicle = Vehicle(
                side, {"EKF2_EV_CTRL": (b"\0\0\0\0", 6), "SENTINEL": (b"\xff\xff\xff\xff", 6)}
            )
            options = AutopilotOptions(link=f"udp:127.0.0.1:{side.port}", profile="px4")
            link = AutopilotLink(options, SYSTEM, ManualClock(1))
            async with running(link.run(), vehicle.run()):
                assert await link.parameter("EKF2_EV_CTRL") == 0.0
                assert await link.parameter("SENTINEL") == -1.0
                assert await link.set_parameter("EKF2_EV_CTRL", 11.0) == 11.0
                assert vehicle.parameters["EKF2_EV_CTRL"][0] == struct.pack("<i", 11)
                assert await link.set_parameter("SENTINEL", -1.0) == -1.0
                assert vehicle.parameters["SENTINEL"][0] == b"\xff\xff\xff\xff"

    asyncio.run(scenario())


def test_what_the_autopilot_has_not_is_none_and_so_is_no_number() -> None:
    async def scenario() -> None:
        async with udp() as side:
            no_numbers = {"NAN": float("nan"), "INFINITE": float("inf")}
            told = {name: (struct.pack("<f", value), 9) for name, value in no_numbers.items()}
            vehicle = Vehicle(side, told)
            options = AutopilotOptions(link=f"udp:127.0.0.1:{side.port}", profile="ardupilot")
            link = AutopilotLink(options, SYSTEM, ManualClock(1))
            async with running(link.run(), vehicle.run()):
                assert await link.parameter("NO_SUCH") is None
                for name in no_numbers:
                    assert await link.parameter(name) is None
                    assert vehicle.asked.count(name) == 2
                # The first may go before the link is up.
                assert 3 <= vehicle.asked.count("NO_SUCH") <= 4

    asyncio.run(scenario())
