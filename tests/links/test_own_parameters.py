"""Our settings as MAVLink parameters: by hand-made frames, by any bytes, and by MAVSDK."""

import asyncio
import contextlib
import math
import struct
import threading
from collections.abc import AsyncIterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.param import Param, ParamError, ProtocolVersion

from tests.links import wire
from tests.links.running import LONGEST_S, Udp, running, udp
from tests.ports import free_ports
from vcl_companion.clock import ManualClock
from vcl_companion.errors import ConfigError
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import ParameterSet
from vcl_companion.links.own_messages import parameter_value
from vcl_companion.links.own_parameters import OwnParameters, Setting

SYSTEM, GROUND, REAL32, INT32 = 7, 255, 9, 6
NAMES = ("VCL_ONE", "VCL_TWO", "VCL_SIXTEEN_LONG")


class Settings:
    """Three numbers from 0 to 10, and what was said of their changes."""

    def __init__(self) -> None:
        self.values = dict(zip(NAMES, (1.0, 0.1, 3.0), strict=True))
        self.changes: list[tuple[str, float, int]] = []
        self.refusals: list[tuple[str, str]] = []

    def on(self, link: AutopilotLink) -> OwnParameters:
        parameters = OwnParameters(
            [self._one(name) for name in NAMES],
            lambda *told: link.send(parameter_value(*told)),
            lambda *change: self.changes.append(change),
            lambda *refusal: self.refusals.append(refusal),
        )
        link.on_parameter = parameters.take
        return parameters

    def _one(self, name: str) -> Setting:
        def write(value: float) -> None:
            if not 0.0 <= value <= 10.0:
                raise ConfigError(f"must be in 0..10, got {value}")
            self.values[name] = value

        return Setting(name, lambda: self.values[name], write)


class Ground:
    """Who asks, over the autopilot."""

    def __init__(self, side: Udp) -> None:
        self._side = side
        self.where = ("", 0)

    def say(self, message_id: int, *fields: int | float | bytes, system: int = GROUND) -> None:
        data = wire.packed(message_id, *fields, system=system, component=190)
        self._side.transport.sendto(data, self.where)

    def list(self, system: int = SYSTEM, component: int = 197, by: int = GROUND) -> None:
        self.say(wire.PARAM_REQUEST_LIST, system, component, system=by)

    def read(self, name: bytes = b"", index: int = -1, component: int = 197) -> None:
        self.say(wire.PARAM_REQUEST_READ, index, SYSTEM, component, name)

    def set(
        self, name: bytes, raw: bytes, kind: int = REAL32, by: int = GROUND, component: int = 197
    ) -> None:
        self.say(wire.PARAM_SET, raw, SYSTEM, component, name, kind, system=by)

    async def told(self) -> tuple[str, float, int, int]:
        """Wait for the next PARAM_VALUE: name, value, index, how many."""
        while True:
            data, self.where = await self._side.got.get()
            for seen in wire.read(data):
                if seen.message_id == wire.PARAM_VALUE:
                    assert (seen.system, seen.component) == (SYSTEM, 197)
                    raw, count, index, name, kind = seen.fields
                    assert kind == REAL32
                    return name.rstrip(b"\0").decode(), struct.unpack("<f", raw)[0], index, count


def real(value: float) -> bytes:
    return struct.pack("<f", value)


@contextlib.asynccontextmanager
async def linked() -> AsyncIterator[tuple[Settings, AutopilotLink, Ground]]:
    async with udp() as side:
        settings = Settings()
        link = AutopilotLink(
            AutopilotOptions(link=f"udp:127.0.0.1:{side.port}"), SYSTEM, ManualClock(1)
        )
        parameters = settings.on(link)
        async with running(link.run(), parameters.run()):
            ground = Ground(side)
            _, ground.where = await side.got.get()
            yield settings, link, ground


@pytest.mark.parametrize("component", [197, 0])
@pytest.mark.parametrize("by", [GROUND, SYSTEM])
def test_who_asks_for_all_is_told_all_in_order(component: int, by: int) -> None:
    async def scenario() -> None:
        async with linked() as (_, _, ground):
            ground.list(component=component, by=by)
            told = [await ground.told() for _ in NAMES]
            assert [(name, index, count) for name, _, index, count in told] == [
                (name, i, 3) for i, name in enumerate(NAMES)
            ]
            assert [value for _, value, _, _ in told] == pytest.approx([1.0, 0.1, 3.0])

    asyncio.run(scenario())


def test_one_is_read_by_name_or_by_index() -> None:
    async def scenario() -> None:
        async with linked() as (_, _, ground):
            for name, index in ((b"VCL_TWO", -1), (b"", 1), (b"VCL_ONE", 1)):
                ground.read(name, index)
                assert (await ground.told())[0] == "VCL_TWO"
            for name, index in ((b"NO_SUCH", -1), (b"", 3), (b"", 32767), (b"", -1)):
                ground.read(name, index)  # somebody else's
            ground.read(NAMES[2].encode(), component=0)  # sixteen characters, and no zero
            assert (await ground.told())[:3] == (NAMES[2], 3.0, 2)

    asyncio.run(scenario())


def test_what_is_set_is_meant_as_it_is_written() -> None:
    async def scenario() -> None:
        async with linked() as (settings, _, ground):
            ground.set(b"VCL_ONE", real(0.3))
            assert (await ground.told())[1] == pytest.approx(0.3)
            assert settings.values["VCL_ONE"] == 0.3  # not 0.30000001192
            ground.set(b"VCL_ONE", real(0.3))  # the answer was lost
            await ground.told()
            assert settings.changes == [("VCL_ONE", 0.3, GROUND)]

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("raw", "kind", "why"),
    [
        (real(10.1), REAL32, "must be in 0..10"),
        (real(-1.0), REAL32, "must be in 0..10"),
        (real(math.nan), REAL32, "finite"),
        (real(math.inf), REAL32, "finite"),
        (struct.pack("<i", 5), INT32, "REAL32"),
        (real(5.0), 200, "REAL32"),
    ],
)
def test_what_cannot_be_is_answered_with_what_is(raw: bytes, kind: int, why: str) -> None:
    async def scenario() -> None:
        async with linked() as (settings, _, ground):
            ground.set(b"VCL_ONE", raw, kind)
            assert await ground.told() == ("VCL_ONE", 1.0, 0, 3)
            assert settings.values["VCL_ONE"] == 1.0
            ((name, reason),) = settings.refusals
            assert name == "VCL_ONE"
            assert why in reason
            assert settings.changes == []

    asyncio.run(scenario())


def test_only_the_ground_sets_and_no_stranger_asks() -> None:
    async def scenario() -> None:
        async with linked() as (settings, link, ground):
            ground.set(b"VCL_ONE", real(5.0), by=SYSTEM)
            ground.set(b"VCL_ONE", real(5.0), by=77)
            ground.list(by=77)
            ground.list(system=9)
            ground.set(b"VCL_ONE", real(5.0), component=1)
            ground.read(b"VCL_ONE")
            assert await ground.told() == ("VCL_ONE", 1.0, 0, 3)
            assert settings.changes == []
            assert link.counters.refused == {
                "a parameter for a stranger": 3,
                "a parameter of somebody else": 2,
            }

    asyncio.run(scenario())


names = st.one_of(
    st.sampled_from([name.encode() for name in NAMES]), st.binary(min_size=0, max_size=16)
)


@given(names, st.binary(min_size=4, max_size=4), st.integers(0, 255))
def test_no_bytes_of_a_setting_raise_and_bounds_hold(name: bytes, raw: bytes, kind: int) -> None:
    settings = Settings()
    told: list[tuple[str, float, int, int]] = []
    parameters = OwnParameters(
        [settings._one(one) for one in NAMES],
        lambda *one: told.append(one),
        lambda *one: settings.changes.append(one),
        lambda *one: settings.refusals.append(one),
    )
    tally = LinkTally()
    codec = Codec(SYSTEM, 197, tally)
    data = wire.packed(wire.PARAM_SET, raw, SYSTEM, 197, name, kind, system=GROUND)
    messages = codec.decode_datagram(data)
    assert len(messages) == (name.partition(b"\0")[0].isascii())
    for message in messages:
        assert isinstance(message, ParameterSet)
        assert message.raw == raw
        parameters.take(message)
        assert len(told) == (message.name in NAMES)
    assert all(0.0 <= value <= 10.0 for value in settings.values.values())
    for one in told:
        codec.frame(parameter_value(*one))


@given(st.floats())
def test_any_number_can_be_told(value: float) -> None:
    if not math.isnan(value):
        (seen,) = wire.read(Codec(1, 197, LinkTally()).frame(parameter_value("X", value, 1, 0)))
        assert math.isfinite(struct.unpack("<f", seen.fields[0])[0])


@pytest.mark.parametrize("name", ["", "SEVENTEEN_LETTERS", "VCL_µ"])
def test_a_name_that_does_not_fit_is_a_bug_of_ours(name: str) -> None:
    with pytest.raises(ValueError, match="1 to 16"):
        Setting(name, lambda: 0.0, lambda _: None)


def by_mavsdk(port: int) -> tuple[float, dict[str, float]]:
    """Set one as MAVSDK does it; return what it reads then, of that one and of all."""
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    try:
        with Mavsdk(configuration) as mavsdk:
            met = threading.Event()
            mavsdk.subscribe_on_new_system(lambda _: met.set())
            mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            assert met.wait(LONGEST_S)
            parameters = Param(mavsdk.get_systems()[0])
            with contextlib.suppress(ParamError):  # it has no result to tell, but does it
                parameters.select_component(197, ProtocolVersion.V1)
            parameters.set_param_float("VCL_TWO", 7.25)
            every = parameters.get_all_params()
            assert not every.int_params
            listed = {one.name: one.value for one in every.float_params}
            return parameters.get_param_float("VCL_TWO"), listed
    finally:
        configuration.destroy()


def test_mavsdk_reads_and_sets_them() -> None:
    async def scenario() -> None:
        (port,) = free_ports(1)
        settings = Settings()
        mavsdk_system = 245
        options = AutopilotOptions(
            link=f"udp:127.0.0.1:{port}", ground_systems=(GROUND, mavsdk_system)
        )
        link = AutopilotLink(options, SYSTEM, ManualClock(1))
        parameters = settings.on(link)
        async with running(link.run(), parameters.run()):
            read, listed = await asyncio.to_thread(by_mavsdk, port)
        assert read == 7.25
        assert listed == pytest.approx({"VCL_ONE": 1.0, "VCL_TWO": 7.25, "VCL_SIXTEEN_LONG": 3.0})
        assert settings.changes == [("VCL_TWO", 7.25, mavsdk_system)]

    asyncio.run(scenario())
