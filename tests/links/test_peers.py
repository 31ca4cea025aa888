"""Peer links among themselves, and against strangers, on loopback."""

import asyncio
import socket
from pathlib import Path

import pytest

from tests.links import wire
from tests.links.drones import Drone, unicast
from tests.links.running import running, udp
from tests.ports import free_ports
from vcl_companion.clock import ManualClock, SystemClock
from vcl_companion.errors import ConfigError
from vcl_companion.links import datagram
from vcl_companion.links.key_file import make_key_file
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerOptions
from vcl_companion.swarm.peer_time import PeerTime

PAYLOAD_TYPE = 40000


@pytest.fixture
def key(tmp_path: Path) -> str:
    """The path of a new key."""
    path = tmp_path / "swarm.key"
    make_key_file(path)
    return str(path)


def open_to_all(listen: str, *to: str) -> PeerOptions:
    """A link without a key that takes everything."""
    return PeerOptions(listen, to, allow_unsigned=True)


def test_unicast_reaches_all_or_the_one_addressed(key: str) -> None:
    async def scenario() -> None:
        drones = one, two, three = unicast(3, key)
        async with running(*(drone.link.run() for drone in drones)):
            await one.hears(2, 3)
            one.link.send(PAYLOAD_TYPE, b"to all")
            for drone in (two, three):
                got = await drone.tunnels.get()
                assert got == Tunnel(1, 197, 0, PAYLOAD_TYPE, b"to all")
            before = one.link.counters.bytes_out
            one.link.send(PAYLOAD_TYPE, b"to three" * 16, target_system=3)
            # Its address is known from its heartbeat: one datagram, and only there.
            assert one.link.counters.bytes_out - before == 158
            assert await three.tunnels.get() == Tunnel(1, 197, 3, PAYLOAD_TYPE, b"to three" * 16)
            assert two.tunnels.empty()
            assert two.link.counters.refused.get("tunnel for another system", 0) == 0

    asyncio.run(scenario())


def test_one_addressed_to_an_unknown_address_goes_to_all_and_is_ignored_by_others(key: str) -> None:
    async def scenario() -> None:
        one, two, _ = unicast(3, key)
        async with running(one.link.run(), two.link.run()):
            await two.hears(1)
            await one.hears(2)
            two.link.send(PAYLOAD_TYPE, b"to three", target_system=3)
            two.link.send(PAYLOAD_TYPE, b"to one", target_system=1)
            assert (await one.tunnels.get()).payload == b"to one"
            assert one.link.counters.refused["tunnel for another system"] == 1

    asyncio.run(scenario())


def test_strangers_and_nonsense_are_counted_and_not_heard() -> None:
    async def scenario() -> None:
        port, other = free_ports(2)
        drone = Drone(open_to_all(f"127.0.0.1:{port}", f"127.0.0.1:{other}"), 1)
        async with udp(other) as side, running(drone.link.run()):
            await side.got.get()
            for data in (
                wire.tunnel(b"x", system=9),
                wire.tunnel(b"x", system=1),
                wire.tunnel(b"x", system=2, component=1),
                wire.tunnel(b"x", system=2, target=3),
                wire.tunnel(b"x", system=2, length=200),
                wire.heartbeat(2, 1),
                wire.packed(wire.TIMESYNC, 0, 1, system=2, component=197),
                b"\xfd\x09",
                wire.tunnel(b"good", system=2) + wire.heartbeat(2, 197),
            ):
                side.transport.sendto(data, ("127.0.0.1", port))
            assert await drone.beats.get() == 2
            assert (await drone.tunnels.get()).payload == b"good"
            assert drone.tunnels.empty()
            assert drone.link.counters.refused == {
                "not a member": 1,
                "own echo": 1,
                "not a companion": 2,
                "tunnel for another system": 1,
                "tunnel length is a lie": 1,
                "timesync for another": 1,
                "truncated": 1,
            }

    asyncio.run(scenario())


class SkewedClock:
    """The system's clock as another machine has it: begun at another time, going faster."""

    def __init__(self, offset_ns: int, drift: float) -> None:
        self.offset_ns, self.drift = offset_ns, drift
        self._began_ns = SystemClock().now_ns()

    def now_ns(self) -> int:
        since_ns = SystemClock().now_ns() - self._began_ns
        return self._began_ns + self.offset_ns + round(since_ns * (1.0 + self.drift))


def test_two_links_relate_their_clocks_within_the_bound() -> None:
    async def scenario() -> None:
        ours, theirs = SystemClock(), SkewedClock(-123_456_789, 80e-6)
        listen = [f"127.0.0.1:{port}" for port in free_ports(2)]
        one = Drone(open_to_all(listen[0], listen[1]), 1, clock=ours)
        two = Drone(open_to_all(listen[1], listen[0]), 2, clock=theirs)
        async with running(one.link.run(), two.link.run()):
            await one.hears(2)
            time = PeerTime()
            for _ in range(5):
                one.link.ask_time(time.ask(ours.now_ns()), 2)
                peer, ts1_ns, tc1_ns = await one.times.get()
                assert peer == 2
                assert time.answered(ts1_ns, tc1_ns, ours.now_ns()) is None
                await asyncio.sleep(0.11)  # asked more often it does not answer
            relation = time.relation(ours.now_ns())
            assert relation is not None
            before_ns = ours.now_ns()
            apart_ns = before_ns - theirs.now_ns()
            read_in_ns = ours.now_ns() - before_ns
            assert abs(apart_ns - relation.offset_ns) <= relation.bound_ns + read_in_ns
            assert relation.bound_ns < 50_000_000  # a busy machine's answer takes a while
            assert one.link.counters.refused == two.link.counters.refused == {}

    asyncio.run(scenario())


def test_who_asks_for_the_time_all_the_time_is_answered_now_and_then() -> None:
    async def scenario() -> None:
        port, other = free_ports(2)
        drone = Drone(
            open_to_all(f"127.0.0.1:{port}", f"127.0.0.1:{other}"), 1, clock=ManualClock(77)
        )
        async with udp(other) as side, running(drone.link.run()):
            await side.got.get()
            for ts1_ns in range(1, 51):
                question = wire.LAYOUT[wire.TIMESYNC].pack(0, ts1_ns) + bytes([1, 197])
                side.transport.sendto(
                    wire.frame(wire.TIMESYNC, question, system=2, component=197),
                    ("127.0.0.1", port),
                )
            side.transport.sendto(wire.heartbeat(2, 197), ("127.0.0.1", port))
            await drone.hears(2)
            n_answers = 50 - drone.link.counters.refused["asked for the time too often"]
            # Fifty in a moment; more than the first only where the machine was busy meanwhile.
            assert 1 <= n_answers < 25
            answers: list[tuple[int, ...]] = []
            while len(answers) < n_answers:
                seen = wire.read((await side.got.get())[0])
                answers += [s.fields for s in seen if s.message_id == wire.TIMESYNC]
            assert answers[0] == (77, 1)

    asyncio.run(scenario())


def test_a_clock_that_was_not_told_the_time_tells_none(key: str) -> None:
    async def scenario() -> None:
        one, two, _ = unicast(3, key)
        async with running(one.link.run(), two.link.run()):
            await one.hears(2)
            await two.hears(1)
            one.link.ask_time(5, 2)
            one.link.send(PAYLOAD_TYPE, b"after it", target_system=2)
            assert (await two.tunnels.get()).payload == b"after it"
            two.link.send(PAYLOAD_TYPE, b"and back", target_system=1)
            assert (await one.tunnels.get()).payload == b"and back"
            assert one.times.empty()

    asyncio.run(scenario())


def test_a_stranger_that_claims_to_be_a_member_is_never_answered() -> None:
    async def scenario() -> None:
        port, other = free_ports(2)
        drone = Drone(open_to_all(f"127.0.0.1:{port}", f"127.0.0.1:{other}"), 1)
        async with udp(other) as side, udp() as liar, running(drone.link.run()):
            await side.got.get()
            liar.transport.sendto(wire.heartbeat(2, 197), ("127.0.0.1", port))
            await drone.hears(2)
            drone.link.send(PAYLOAD_TYPE, b"secret", target_system=2)
            (seen,) = wire.read((await side.got.get())[0])
            assert seen.message_id == wire.TUNNEL
            assert liar.got.empty()

    asyncio.run(scenario())


@pytest.mark.parametrize("group", ["127.255.255.255", "239.255.42.99"])
def test_a_group_address_reaches_everybody_and_the_own_echo_is_ignored(
    group: str, key: str
) -> None:
    async def scenario() -> None:
        (port,) = free_ports(1)
        listen = "127.0.0.1" if group.startswith("239") else group
        options = PeerOptions(f"{listen}:{port}", (f"{group}:{port}",), key, "")
        drones = one, two, three = [Drone(options, k) for k in (1, 2, 3)]
        async with running(*(drone.link.run() for drone in drones)):
            await one.hears(2, 3)
            await two.hears(1, 3)
            one.link.send(PAYLOAD_TYPE, b"to all")
            two.link.send(PAYLOAD_TYPE, b"to three", target_system=3)
            assert (await two.tunnels.get()).payload == b"to all"
            assert {(await three.tunnels.get()).payload for _ in range(2)} == {
                b"to all",
                b"to three",
            }
            assert one.tunnels.empty()
            assert one.link.counters.refused["own echo"] >= 2

    asyncio.run(scenario())


def test_a_group_that_was_lost_with_its_interface_is_joined_again(
    key: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(datagram, "_SILENT_S", 0.2)

    async def scenario() -> None:
        (port,) = free_ports(1)
        options = PeerOptions(f"127.0.0.1:{port}", (f"239.255.42.99:{port}",), key, "")
        drones = one, two = [Drone(options, k) for k in (1, 2)]
        async with running(*(drone.link.run() for drone in drones)):
            await one.hears(2)
            for drone in drones:
                opened = drone.link._socket._socket
                assert isinstance(opened, socket.socket)
                membership = socket.inet_aton("239.255.42.99") + socket.inet_aton("127.0.0.1")
                opened.setsockopt(socket.IPPROTO_IP, socket.IP_DROP_MEMBERSHIP, membership)
            async with asyncio.timeout(20.0):
                while two.tunnels.empty():
                    one.link.send(PAYLOAD_TYPE, b"again")
                    await asyncio.sleep(0.1)

    asyncio.run(scenario())


def test_a_burst_of_a_map_is_not_lost_while_the_receiver_is_busy(key: str) -> None:
    async def scenario() -> None:
        one, two = unicast(2, key)
        async with running(one.link.run(), two.link.run()):
            await two.hears(1)
            for k in range(150):
                one.link.send(PAYLOAD_TYPE, k.to_bytes(2, "big") * 64)
            got = [await two.tunnels.get() for _ in range(150)]
            assert [t.payload for t in got] == [k.to_bytes(2, "big") * 64 for k in range(150)]

    asyncio.run(scenario())


@pytest.mark.parametrize(
    ("to", "n_copies"),
    [
        (("239.0.0.1:14650",), 1),
        (("192.168.1.255:14650",), 1),
        (("127.0.0.1:1", "127.0.0.1:2"), 2),
        ((), 0),
    ],
)
def test_it_is_known_how_often_a_message_to_all_is_sent(to: tuple[str, ...], n_copies: int) -> None:
    assert Drone(open_to_all("0.0.0.0:14650", *to), 1).link.copies_to_all == n_copies


@pytest.mark.parametrize(
    ("listen", "to"),
    [("0.0.0.0", ()), ("drone:14650", ()), ("0.0.0.0:1", ("::1:14650",)),
     ("[::]:1", ("[::1]:14650",)), ("0.0.0.0:1", ("127.0.0.1:0",)),
     ("0.0.0.0:1", ("239.0.0.1:1", "127.0.0.1:1")), ("0.0.0.0:1", ("239.0.0.1:2",)),
     ("0.0.0.0:1", ("127.0.0.1:2", "127.0.0.1:2"))],
)  # fmt: skip
def test_wrong_peer_addresses_are_refused(listen: str, to: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError):
        PeerOptions(listen, to, allow_unsigned=True)
