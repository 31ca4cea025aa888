"""An autopilot's origin is set once, confirmed, and never where it is dangerous."""

import contextlib
import math
import struct
from collections.abc import AsyncIterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.daemon.waiting import beside, passes, passes_until, run
from tests.links import wire
from tests.links.running import Udp, udp
from vcl_companion.clock import ManualClock
from vcl_companion.errors import ConfigError
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.origin import GlobalPlace
from vcl_companion.links.vision_pose import Firmware

SYSTEM = 7
ORIGIN = (47.397742, 8.545594, 488.25)
E7 = (473977420, 85455940, 488250)
Place = tuple[int, int, int]
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
INT32 = 6


class Vehicle:
    """An autopilot with an origin, or without: degrees by 1e7, mm.

    Attributes:
        origin: the one that it has.
        told: which it was told, and by which message.
        texts: it was told.
        is_ready: whether its estimator has begun.
        is_armed: by its heartbeat.
        height_m: above its origin.
    """

    def __init__(self, side: Udp, firmware: int, *, knows_command: bool, height: int) -> None:
        self._side = side
        self._firmware = firmware
        self._knows_command = knows_command
        self.height: int | None = height
        self.origin: Place | None = None
        self.told: list[tuple[int, Place]] = []
        self.texts: list[str] = []
        self.is_ready = True
        self.is_armed, self.height_m = False, 0.0
        self._boot_ms = 90_000

    async def run(self) -> None:
        while True:
            data, where = await self._side.got.get()
            for seen in wire.read(data):
                for answer in self._answers(seen):
                    self._side.transport.sendto(answer, where)

    def restart(self) -> None:
        self.origin, self._boot_ms = None, 1000

    def _answers(self, seen: wire.Seen) -> list[bytes]:
        match seen.message_id:
            case wire.HEARTBEAT:
                beat = (4, 2, self._firmware, 0x81 if self.is_armed else 1, 4, 3)
                self._boot_ms += 1000
                attitude = (self._boot_ms, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0)
                position = (self._boot_ms, 0, 0, -self.height_m, 0, 0, 0)
                return [
                    wire.packed(wire.HEARTBEAT, *beat, system=SYSTEM),
                    wire.packed(wire.ATTITUDE_QUATERNION, *attitude, system=SYSTEM),
                    wire.packed(wire.LOCAL_POSITION_NED, *position, system=SYSTEM),
                ]
            case wire.COMMAND_LONG if seen.fields[7] == 512:
                assert seen.fields[0] == 49
                return self._says()
            case wire.COMMAND_INT:
                *_, x, y, z, command, system, component, frame, _, _ = seen.fields
                assert (command, system, component, frame) == (611, SYSTEM, 1, 0)
                place = (x, y, round(1e3 * z))
                self.told.append((wire.COMMAND_INT, place))
                if not self._knows_command:
                    return [self._ack(UNSUPPORTED)]
                if place[0] == 0:
                    return [self._ack(DENIED)]
                if not self._takes(place):
                    return [self._ack(FAILED)]
                return [self._ack(ACCEPTED), *self._says()]
            case wire.SET_GPS_GLOBAL_ORIGIN:
                assert seen.fields[3] == SYSTEM
                self.told.append((wire.SET_GPS_GLOBAL_ORIGIN, seen.fields[:3]))
                return self._says() if self._takes(seen.fields[:3]) else []
            case wire.PARAM_REQUEST_READ if self.height is not None:
                name = seen.fields[3].rstrip(b"\0")
                if name != b"EKF2_HGT_REF":
                    return []
                raw = struct.pack("<i", self.height)
                fields = (raw, 1, 0xFFFF, name, INT32)
                return [wire.packed(wire.PARAM_VALUE, *fields, system=SYSTEM)]
            case wire.STATUSTEXT:
                self.texts.append(seen.fields[1].rstrip(b"\0").decode())
        return []

    def _takes(self, place: Place) -> bool:
        if self.origin is not None or not self.is_ready:
            return False
        self.origin = place
        return True

    def _says(self) -> list[bytes]:
        if self.origin is None:
            return []
        return [wire.packed(wire.GPS_GLOBAL_ORIGIN, *self.origin, system=SYSTEM)]

    @staticmethod
    def _ack(result: int) -> bytes:
        fields = (611, result, 0, 0, SYSTEM, 197)
        return wire.packed(wire.COMMAND_ACK, *fields, system=SYSTEM)


@contextlib.asynccontextmanager
async def linked(
    firmware: int = 3,
    *,
    knows_command: bool = True,
    height: int = 1,
    origin: tuple[float, float, float] | None = ORIGIN,
    local_origin: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
) -> AsyncIterator[tuple[AutopilotLink, Vehicle]]:
    async with udp() as side:
        vehicle = Vehicle(side, firmware, knows_command=knows_command, height=height)
        options = AutopilotOptions(link=f"udp:127.0.0.1:{side.port}", origin=origin)
        link = AutopilotLink(options, SYSTEM, ManualClock(10**12))
        link.origin.origin_world = lambda: None if local_origin is None else np.array(local_origin)
        async with beside(link.run(), vehicle.run()):
            yield link, vehicle


@pytest.mark.parametrize(
    ("firmware", "knows_command", "by"),
    [
        (3, True, [wire.COMMAND_INT]),
        (3, False, [wire.COMMAND_INT, wire.SET_GPS_GLOBAL_ORIGIN]),
        (12, False, [wire.SET_GPS_GLOBAL_ORIGIN]),
    ],
)
def test_each_firmware_is_told_it_once_by_what_it_understands(
    firmware: int, knows_command: bool, by: list[int]
) -> None:
    async def scenario() -> None:
        async with linked(firmware, knows_command=knows_command) as (_, vehicle):
            await passes_until(lambda: "VCL origin set" in vehicle.texts)
            await passes(30.0)
            assert vehicle.origin == E7
            assert vehicle.told == [(message, E7) for message in by]

    run(scenario())


def test_one_that_is_not_ready_is_told_again() -> None:
    async def scenario() -> None:
        async with linked() as (_, vehicle):
            vehicle.is_ready = False
            await passes_until(lambda: len(vehicle.told) >= 3)
            assert vehicle.texts == []
            vehicle.is_ready = True
            await passes_until(lambda: "VCL origin set" in vehicle.texts)
            assert vehicle.origin == E7

    run(scenario())


def test_one_that_restarts_is_told_again() -> None:
    async def scenario() -> None:
        async with linked() as (_, vehicle):
            await passes_until(lambda: vehicle.origin is not None)
            await passes(5.0)
            vehicle.restart()
            await passes_until(lambda: len(vehicle.told) == 2)
            await passes(5.0)
            assert vehicle.texts == ["VCL origin set"] * 2

    run(scenario())


def test_one_that_has_another_keeps_it_and_that_is_said() -> None:
    async def scenario() -> None:
        async with linked(12) as (_, vehicle):
            # 0.001 degrees of latitude are 111 m.
            vehicle.origin = (E7[0] + 10_000, *E7[1:])
            await passes_until(lambda: bool(vehicle.texts))
            await passes(10.0)
            assert "".join(vehicle.texts) == "VCL the autopilot's origin is 111 m from ours"
            assert vehicle.told == []

    run(scenario())


def test_an_ardupilot_high_up_is_told_once_it_is_armed() -> None:
    async def scenario() -> None:
        async with linked() as (_, vehicle):
            vehicle.height_m = 3.0
            await passes_until(lambda: bool(vehicle.texts))
            await passes(20.0)
            assert vehicle.told == []
            text = "".join(vehicle.texts)
            assert text == "VCL origin waits until armed: its height would jump by 3 m"
            vehicle.is_armed = True
            await passes_until(lambda: vehicle.origin == E7)

    run(scenario())


def test_with_height_by_vision_a_px4_is_told_none() -> None:
    async def scenario() -> None:
        async with linked(12, height=3) as (_, vehicle):
            await passes_until(lambda: len(vehicle.texts) >= 2)
            await passes(30.0)
            text = "".join(vehicle.texts)
            assert text == "VCL no origin is set: with EKF2_HGT_REF 3 it would climb away; set 0"
            assert vehicle.told == []

    run(scenario())


def test_a_px4_that_does_not_tell_its_height_is_told_none_until_it_does() -> None:
    async def scenario() -> None:
        async with linked(12) as (_, vehicle):
            vehicle.height = None
            await passes_until(lambda: bool(vehicle.texts))
            await passes(30.0)
            assert vehicle.told == []
            assert vehicle.texts == ["VCL no origin is set: EKF2_HGT_REF is not said"]
            vehicle.height = 0
            await passes_until(lambda: vehicle.origin == E7)

    run(scenario())


@pytest.mark.parametrize("missing", ["origin", "local_origin"])
def test_nothing_is_told_before_it_is_known(missing: str) -> None:
    async def scenario() -> None:
        origin = None if missing == "origin" else ORIGIN
        local_origin = None if missing == "local_origin" else (0.0, 0.0, 0.0)
        async with linked(origin=origin, local_origin=local_origin) as (_, vehicle):
            await passes(20.0)
            assert vehicle.told == []

    run(scenario())


def test_a_frame_that_begins_elsewhere_has_another_place() -> None:
    async def scenario() -> None:
        async with linked(local_origin=(100.0, -200.0, -3.5)) as (_, vehicle):
            await passes_until(lambda: vehicle.origin is not None)
            assert vehicle.origin is not None
            latitude, longitude, altitude = vehicle.origin
            # Metres by ArduPilot's LOCATION_SCALING_FACTOR, 0.0111318845 m per 1e-7 degrees.
            assert (latitude - E7[0]) * 0.011131884 == pytest.approx(100.0, abs=0.02)
            across = math.cos(math.radians(ORIGIN[0]))
            assert (longitude - E7[1]) * 0.011131884 * across == pytest.approx(-200.0, abs=0.02)
            assert altitude - E7[2] == 3500

    run(scenario())


@given(
    st.floats(-80.0, 80.0), st.floats(-180.0, 180.0),
    st.lists(st.floats(-300.0, 300.0), min_size=3, max_size=3),
    st.sampled_from([Firmware.ARDUPILOT, Firmware.PX4]),
)  # fmt: skip
def test_a_place_is_as_far_as_it_was_moved(
    latitude: float, longitude: float, ned: list[float], firmware: Firmware
) -> None:
    place = GlobalPlace(latitude, longitude, 100.0)
    moved = place.moved(np.array(ned), firmware)
    assert -180.0 <= moved.longitude_deg <= 180.0
    # Their spheres differ by 0.1 %.
    assert place.distance_m(moved) == pytest.approx(math.hypot(*ned), rel=2e-3, abs=1e-3)


@pytest.mark.parametrize(
    ("origin", "what"),
    [
        ((91.0, 8.0, 400.0), "must be [latitude"),
        ((47.0, 181.0, 400.0), "must be [latitude"),
        ((47.0, 8.0, 488250.0), "its altitude must be in"),
        ((0.0, 0.0, 0.0), "0, 0 is what autopilots take for none"),
    ],
)
def test_what_is_no_place_is_refused(origin: tuple[float, float, float], what: str) -> None:
    with pytest.raises(ConfigError) as caught:
        AutopilotOptions(origin=origin)
    assert str(caught.value).startswith(f"origin: {what}")
