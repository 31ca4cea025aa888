"""Drones that sign, among themselves and against those who have no key, on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.links import signed, wire
from tests.links.drones import Drone
from tests.links.running import Udp, running, udp
from tests.links.signed import NOON, NOON_S, Clocks
from tests.ports import free_ports
from vcl_companion.errors import ConfigError
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerOptions

PAYLOAD_TYPE = 40000
S = 100_000  # ticks
DAY_S = 86400.0
SECRET = hashlib.sha256(b"0f" * 32).digest()  # of signed.key_file


class Swarm:
    """Addresses, a key for all, and a place for what each remembers."""

    def __init__(self, folder: Path, n: int) -> None:
        self.ports = free_ports(n)
        self._folder = folder
        self._key = signed.key_file(folder / "swarm.key")

    def options(self, system_id: int, key: Path | None = None) -> PeerOptions:
        me, *others = (f"127.0.0.1:{p}" for p in sorted(
            self.ports, key=lambda port: port != self.ports[system_id - 1]
        ))  # fmt: skip
        state = str(self._folder / f"{system_id}.json")
        return PeerOptions(me, tuple(others), str(key or self._key), state)

    def drone(self, system_id: int, clocks: Clocks, key: Path | None = None) -> Drone:
        return Drone(self.options(system_id, key), system_id, clocks.now)

    @contextlib.asynccontextmanager
    async def attacked(self, clocks: Clocks) -> AsyncIterator[tuple[Drone, Udp]]:
        """Drone 1, and somebody who sends from the address of drone 2."""
        one = self.drone(1, clocks)
        async with udp(self.ports[1]) as attacker, running(one.link.run()):
            await attacker.got.get()
            yield one, attacker

    def attack(self, attacker: Udp, data: bytes) -> None:
        attacker.transport.sendto(data, ("127.0.0.1", self.ports[0]))


def beat(timestamp: int, secret: bytes = SECRET) -> bytes:
    return signed.frame(timestamp, secret=secret)


def timesync(timestamp: int, tc1_ns: int, ts1_ns: int, secret: bytes = SECRET) -> bytes:
    payload = wire.LAYOUT[wire.TIMESYNC].pack(tc1_ns, ts1_ns)
    return signed.frame(timestamp, wire.TIMESYNC, payload, secret=secret)


async def counted(drone: Drone, reason: str, times: int = 1) -> None:
    while drone.link.counters.refused.get(reason, 0) < times:
        await asyncio.sleep(0.005)


async def question(attacker: Udp) -> int:
    """Wait until the drone asks for the time; return its number."""
    while True:
        data, _ = await attacker.got.get()
        if data[7:10] == bytes([wire.TIMESYNC, 0, 0]):
            tc1_ns, number = wire.LAYOUT[wire.TIMESYNC].unpack(data[10:-15].ljust(16, b"\0"))
            assert (data[2], tc1_ns) == (1, 0)
            assert number < 0
            return int(number)


def test_nothing_but_the_swarm_s_own_frames_is_heard(tmp_path: Path) -> None:
    async def scenario() -> None:
        swarm, clocks = Swarm(tmp_path, 2), Clocks()
        async with swarm.attacked(clocks) as (one, attacker):
            good = signed.tunnel(b"good", NOON + 1)
            good = good[:-13] + signed.trailer(good[:-13], NOON + 1, SECRET)
            for data in (
                wire.tunnel(b"evil", system=2),
                beat(NOON, secret=bytes(32)),
                beat(NOON + 61 * S),
                beat(NOON - 61 * S),
                good[:-1],
                good[:20] + b"\x01" + good[21:],
                good,
                good,
                beat(NOON + 2),
            ):
                swarm.attack(attacker, data)
            assert await one.beats.get() == 2
            assert await one.tunnels.get() == Tunnel(2, 197, 0, 40000, b"good")
            assert one.beats.empty()
            assert one.tunnels.empty()
            refused = dict(one.link.counters.refused)
            refused.pop("garbage bytes")  # of the changed one
            assert refused == {
                "not signed": 1,
                "wrong signature": 1,
                "timestamp in the future": 1,
                "timestamp too old": 1,
                "truncated": 1,
                "wrong checksum": 1,
                "replayed": 1,
            }

    asyncio.run(scenario())


def test_a_drone_with_another_key_is_a_stranger(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        swarm, clocks = Swarm(tmp_path, 3), Clocks()
        other = tmp_path / "other.key"
        other.write_text("1e" * 32)
        other.chmod(0o600)
        one, two = swarm.drone(1, clocks), swarm.drone(2, clocks)
        three = swarm.drone(3, clocks, other)
        async with running(one.link.run(), two.link.run(), three.link.run()):
            await two.hears(1)
            await counted(one, "wrong signature", 2)
            await counted(three, "wrong signature", 2)
            assert three.beats.empty()
            while len(caplog.records) < 3:
                await asyncio.sleep(0.01)
        assert {one.beats.get_nowait() for _ in range(one.beats.qsize())} <= {2}

    caplog.set_level(logging.WARNING)
    asyncio.run(scenario())
    said = {record.getMessage() for record in caplog.records}
    assert len(caplog.records) == 3, "each drone says it once"
    assert said == {
        "peers: a frame was refused: wrong signature (is the key the same on every drone?)"
    }


def test_another_drone_of_our_name_is_told_apart_from_an_echo(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        swarm = Swarm(tmp_path, 2)
        async with swarm.attacked(Clocks()) as (one, attacker):
            echo, _ = await attacker.got.get()
            for data in (echo, signed.frame(NOON + 1 * S, secret=SECRET, system=1)):
                swarm.attack(attacker, data)
            await counted(one, "of another with our system id")
            while not caplog.records:
                await asyncio.sleep(0.01)
            assert one.link.counters.refused == {
                "own echo": 1,
                "of another with our system id": 1,
            }
            assert one.beats.empty()

    caplog.set_level(logging.WARNING)
    asyncio.run(scenario())
    assert [record.getMessage() for record in caplog.records] == [
        "peers: a frame was refused: of another with our system id "
        "(is there another drone with this system_id?)"
    ]


def test_a_drone_without_a_clock_learns_the_time_and_is_heard(tmp_path: Path) -> None:
    async def scenario() -> None:
        swarm = Swarm(tmp_path, 2)
        right, unset = Clocks(), Clocks(wall_s=30.0)
        one, two = swarm.drone(1, right), swarm.drone(2, unset)
        assert two.signing.signing.time.at(unset.now()) < NOON - 60 * S
        async with running(one.link.run(), two.link.run()):
            await two.hears(1)
            await one.hears(2)
            assert abs(two.signing.signing.time.at(unset.now()) - NOON) < S
            # Whoever is right is not moved by it.
            assert one.signing.signing.time.at(right.now()) == NOON
            one.link.send(PAYLOAD_TYPE, b"welcome", target_system=2)
            assert (await two.tunnels.get()).payload == b"welcome"
        # It goes on there after the next reboot, with nobody to ask.
        again = swarm.drone(2, Clocks(wall_s=30.0))
        assert again.signing.signing.time.next(Clocks(wall_s=30.0).now()) > NOON

    asyncio.run(scenario())


def test_drones_whose_clocks_stopped_on_different_days_meet(tmp_path: Path) -> None:
    async def scenario() -> None:
        swarm = Swarm(tmp_path, 3)
        clocks = [Clocks(wall_s=NOON_S - DAY_S * days) for days in (3.0, 0.0, 30.0)]
        drones = [swarm.drone(k + 1, at) for k, at in enumerate(clocks)]
        async with running(*(drone.link.run() for drone in drones)):
            for k, drone in enumerate(drones):
                await drone.hears(*({1, 2, 3} - {k + 1}))
        times = [d.signing.signing.time.at(c.now()) for d, c in zip(drones, clocks, strict=True)]
        assert max(times) - min(times) < S
        assert NOON <= max(times) < NOON + S

    asyncio.run(scenario())


def test_recordings_of_a_later_flight_move_no_clock(tmp_path: Path) -> None:
    async def scenario() -> None:
        swarm, unset = Swarm(tmp_path, 2), Clocks(wall_s=30.0)
        async with swarm.attacked(unset) as (one, attacker):
            time = one.signing.signing.time
            began = time.at(unset.now())
            # Correctly signed, newer than all it knows, and yet a recording.
            for k in range(5):
                swarm.attack(attacker, beat(NOON + k))
            number = await question(attacker)
            swarm.attack(attacker, timesync(NOON + 10, 1, number ^ 1))
            swarm.attack(attacker, timesync(NOON + 11, 1, number, secret=bytes(32)))
            swarm.attack(attacker, timesync(NOON + 12, 0, number))
            await counted(one, "timestamp in the future", 7)
            assert time.at(unset.now()) == began
            assert one.beats.empty()
            # A true answer does, and the recordings are old then.
            swarm.attack(attacker, timesync(NOON + 3600 * S, 1, number))
            await counted(one, "timestamp in the future", 8)
            assert time.at(unset.now()) == NOON + 3600 * S
            swarm.attack(attacker, beat(NOON + 20))
            await counted(one, "timestamp too old")
            assert one.beats.empty()

    asyncio.run(scenario())


def test_one_question_is_asked_and_one_answer_given_at_a_time(tmp_path: Path) -> None:
    async def scenario() -> None:
        swarm, clocks = Swarm(tmp_path, 2), Clocks()
        async with swarm.attacked(clocks) as (one, attacker):
            for k in range(20):
                swarm.attack(attacker, beat(NOON + 3600 * S + k))
                swarm.attack(attacker, timesync(NOON - 3600 * S + k, 0, -1000 - k))
            await counted(one, "timestamp in the future", 20)
            await counted(one, "timestamp too old", 20)
            swarm.attack(attacker, beat(NOON))
            await one.hears(2)
            said = [attacker.got.get_nowait()[0] for _ in range(attacker.got.qsize())]
            asked = [data for data in said if data[7] == wire.TIMESYNC]
            assert len(asked) == 2
            numbers = [wire.LAYOUT[wire.TIMESYNC].unpack(d[10:-15].ljust(16, b"\0")) for d in asked]
            assert sorted(tc1_ns for tc1_ns, _ in numbers) == [0, 1]
            assert (1, -1000) in numbers

    asyncio.run(scenario())


def test_a_clock_of_the_far_future_does_not_take_the_swarm_along(tmp_path: Path) -> None:
    async def scenario() -> None:
        swarm, clocks = Swarm(tmp_path, 2), Clocks()
        async with swarm.attacked(clocks) as (one, attacker):
            swarm.attack(attacker, beat(2**48 - 2))
            number = await question(attacker)
            swarm.attack(attacker, timesync(2**48 - 1, 1, number))
            await counted(one, "timestamp in the future", 2)
            assert one.signing.signing.time.at(clocks.now()) == NOON
            swarm.attack(attacker, beat(NOON))
            await one.hears(2)

    asyncio.run(scenario())


def test_the_log_never_holds_the_key(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)

    async def scenario() -> None:
        swarm = Swarm(tmp_path, 2)
        one, two = swarm.drone(1, Clocks()), swarm.drone(2, Clocks(wall_s=30.0))
        async with running(one.link.run(), two.link.run()):
            await two.hears(1)
        shown = f"{one.signing.signing!r} {vars(one.signing.signing)} {one.link.counters}"
        for text in (caplog.text, shown):
            assert "0f0f" not in text
            assert SECRET.hex()[:8] not in text
            assert repr(SECRET)[2:10] not in text

    asyncio.run(scenario())
    assert "its time is ours now" in caplog.text


def test_others_and_no_key_are_a_mistake_unless_it_is_meant() -> None:
    with pytest.raises(ConfigError, match="vcl keys new") as wrong:
        PeerOptions("0.0.0.0:1", ("127.0.0.1:2",))
    assert "allow_unsigned = true" in str(wrong.value)
    assert PeerOptions("0.0.0.0:1", ("127.0.0.1:2",), allow_unsigned=True).key_file == ""
    assert PeerOptions("0.0.0.0:1").to == ()
    with pytest.raises(ConfigError, match="full path"):
        PeerOptions("0.0.0.0:1", key_file="swarm.key")


def test_a_drone_that_only_listens_takes_nothing_unsigned_either() -> None:
    async def scenario() -> None:
        (port,) = free_ports(1)
        one = Drone(PeerOptions(f"127.0.0.1:{port}"), 1)
        async with udp() as attacker, running(one.link.run()):
            while not one.link.counters.connects:
                await asyncio.sleep(0.005)
            attacker.transport.sendto(wire.tunnel(b"evil", system=2), ("127.0.0.1", port))
            attacker.transport.sendto(beat(NOON), ("127.0.0.1", port))
            await counted(one, "not signed")
            await counted(one, "no key to verify with")
            assert one.tunnels.empty()
            assert one.beats.empty()

    asyncio.run(scenario())
