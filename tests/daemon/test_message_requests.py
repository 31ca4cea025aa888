"""Who asks for our messages, over the autopilot's link; what comes is read by pymavlink too."""

import asyncio
import importlib.metadata
from pathlib import Path
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from tests.daemon import demo
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import passes, passes_until, run, until
from tests.links import wire
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.message_requests import MessageRequests
from vcl_companion.daemon.onboard_computer import OnboardComputer
from vcl_companion.daemon.worker import Worker
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions, ServiceState
from vcl_companion.links.messages import CommandLong

GET_INTERVAL, SET_INTERVAL, REQUEST = 510, 511, 512
HEARTBEAT, POSE, VERSION, INTERVAL, ODOMETRY, COMPUTER = 0, 102, 148, 244, 331, 390
ACCEPTED, BUSY, DENIED, UNSUPPORTED = range(4)
NAN, INF = float("nan"), float("inf")


async def answered(drone: Drone, command: int, first: float, second: float = 0.0) -> int:
    drone.autopilot.forward(command, first, second)
    told, result, _ = await drone.autopilot.answers.get()
    assert told == command
    return result


async def next_of(drone: Drone, message_id: int) -> Any:
    """Wait for the next message of a kind, as pymavlink reads it."""
    while True:
        seen = await drone.autopilot.others.get()
        assert (seen.system, seen.component) == (drone.system_id, 197)
        if seen.message_id == message_id:
            payload = wire.LAYOUT[message_id].pack(*seen.fields)
            return dialect.MAVLink(None).decode(bytearray(wire.frame(message_id, payload)))


async def interval_us(drone: Drone, message_id: int) -> int:
    assert await answered(drone, REQUEST, INTERVAL, message_id) == ACCEPTED
    told = await next_of(drone, INTERVAL)
    assert told.message_id == message_id
    return int(told.interval_us)


def n_told(drone: Drone, message_id: int) -> int:
    """Take what has come so far; return how many of a kind that were."""
    others = drone.autopilot.others
    taken = [others.get_nowait() for _ in range(others.qsize())]
    return sum(seen.message_id == message_id for seen in taken)


async def started(members: Any) -> Drone:
    one: Drone = await members.start(1)
    await one.see(demo.frame(1, 0))  # who asks reaches us once we have been heard
    return one


def test_a_ground_station_the_autopilot_and_who_asks_all_are_told_our_version(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await started(members)
            for system, component in ((255, 197), (1, 197), (255, 0)):
                one.autopilot.forward(REQUEST, VERSION, system=system, component=component)
                version = await next_of(one, VERSION)
                assert version.capabilities == (
                    dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
                    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
                )
                number = version.flight_sw_version
                told = f"{number >> 24}.{number >> 16 & 255}.{number >> 8 & 255}"
                assert told == importlib.metadata.version("vcl-companion")
                assert (version.vendor_id, version.product_id, version.uid) == (0, 0, 0)
                assert await one.autopilot.answers.get() == (REQUEST, ACCEPTED, 255)
            one.autopilot.forward(REQUEST, VERSION, system=77)
            refused = one.autopilot_link.counters.refused
            await until(lambda: "a command of a stranger" in one.autopilot_link.counters.refused)
            assert "a command of a stranger" not in refused
            assert n_told(one, VERSION) == 0

    run(scenario())


def test_a_heartbeat_is_told_while_there_is_one(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await started(members)
            one.autopilot_link.set_state(ServiceState.CRITICAL)
            assert await answered(one, REQUEST, HEARTBEAT) == ACCEPTED
            while await one.autopilot.states.get() != ServiceState.CRITICAL.value:
                pass
            one.autopilot_link.set_state(ServiceState.STALLED)
            assert await answered(one, REQUEST, HEARTBEAT) == BUSY

    run(scenario())


def test_the_computer_is_told_of_now_and_then_and_on_request(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await started(members)
            n_told(one, COMPUTER)
            await passes(20.0)
            assert 3 <= n_told(one, COMPUTER) <= 5
            assert await answered(one, REQUEST, COMPUTER) == ACCEPTED
            status = await next_of(one, COMPUTER)
            assert 0 < status.ram_usage < status.ram_total < 1 << 24
            assert 0 < status.storage_usage[0] <= status.storage_total[0]
            assert status.uptime > 0
            assert 0 <= status.cpu_cores[0] <= 100
            assert status.cpu_combined == [255] * 10
            assert status.storage_total[1:] == [0xFFFFFFFF] * 3

    run(scenario())


def test_how_often_it_is_told_can_be_set(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await started(members)
            assert await interval_us(one, COMPUTER) == 5_000_000
            assert await answered(one, SET_INTERVAL, COMPUTER, 1e6) == ACCEPTED
            assert await interval_us(one, COMPUTER) == 1_000_000
            n_told(one, COMPUTER)
            await passes(10.0)
            assert 8 <= n_told(one, COMPUTER) <= 11
            assert await answered(one, SET_INTERVAL, COMPUTER, -1.0) == ACCEPTED
            assert await interval_us(one, COMPUTER) == -1
            n_told(one, COMPUTER)
            await passes(20.0)
            assert n_told(one, COMPUTER) == 0
            assert await answered(one, REQUEST, COMPUTER) == ACCEPTED
            await next_of(one, COMPUTER)
            for wrong in (1.0, 999_999.0, 4e9, -2.0, NAN, INF, -INF):
                assert await answered(one, SET_INTERVAL, COMPUTER, wrong) == DENIED
            assert await answered(one, SET_INTERVAL, COMPUTER, 0.0) == ACCEPTED
            assert await answered(one, GET_INTERVAL, COMPUTER) == ACCEPTED
            assert (await next_of(one, INTERVAL)).interval_us == 5_000_000

    run(scenario())


def test_no_other_rate_can_be_set_and_no_other_message_asked_for(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await started(members)
            for message_id in (HEARTBEAT, VERSION, POSE):
                assert await answered(one, SET_INTERVAL, message_id, 1e6) == DENIED
            for message_id in (ODOMETRY, 1, 300, 65535, (1 << 24) - 1):
                assert await answered(one, SET_INTERVAL, message_id, 1e6) == UNSUPPORTED
                assert await answered(one, REQUEST, message_id) == UNSUPPORTED
            for wrong in (NAN, INF, -INF, -1.0, 0.5, float(1 << 24), 3e38):
                for command in (REQUEST, SET_INTERVAL, GET_INTERVAL):
                    assert await answered(one, command, wrong, 1e6) == DENIED
                assert await answered(one, REQUEST, INTERVAL, wrong) == DENIED
            assert await answered(one, GET_INTERVAL, 65536) == DENIED  # cannot be told
            assert await interval_us(one, HEARTBEAT) == 1_000_000
            assert await interval_us(one, VERSION) == -1
            assert await interval_us(one, 30) == 0  # none of ours

    run(scenario())


def test_a_pose_that_is_asked_for_is_the_next_one(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one, two = [await members.fly(system_id) for system_id in (1, 2)]
            one.autopilot.measure(one.clock.now_ns(), demo.shot(1).ned_from_body.quaternion())
            assert await answered(one, REQUEST, POSE) == BUSY
            assert await interval_us(one, POSE) == -1
            await asyncio.gather(one.fly(0), two.fly(0))
            for k in (2, 4):
                await one.fly(k)
            n_poses = one.autopilot.poses.qsize()
            assert await answered(one, REQUEST, POSE) == ACCEPTED
            assert 0 < await interval_us(one, POSE) < 20_000_000
            # An autopilot would fuse the same measurement twice.
            assert one.autopilot.poses.qsize() == n_poses
            await passes_until(lambda: one.autopilot_link.poses.interval_s is None)
            assert await answered(one, REQUEST, POSE) == BUSY

    run(scenario())


@given(st.sampled_from([GET_INTERVAL, SET_INTERVAL, REQUEST]), st.floats(), st.floats())
def test_no_numbers_raise(command: int, first: float, second: float) -> None:
    async def scenario() -> None:
        worker = Worker("beside")
        link = AutopilotLink(AutopilotOptions(link="udp:127.0.0.1:9"), 1, ManualClock(1))
        requests = MessageRequests(link, OnboardComputer(Path()), worker)
        parameters = (first, second, 0.0, 0.0, 0.0, 0.0, 0.0)
        result, then = requests.take(CommandLong(255, 190, 1, 197, command, 0, parameters))
        assert result in (ACCEPTED, BUSY, DENIED, UNSUPPORTED)
        if then is not None:
            then()  # the link is not up: what is sent is dropped
        worker.shutdown()

    asyncio.run(scenario())
