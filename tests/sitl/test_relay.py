"""The relay between daemons, over real sockets of loopback."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from sitl.network import Network, NetworkOptions
from sitl.network_log import read_network_log, write_network_log
from sitl.partitions import parse_partition
from sitl.relay import Relay
from tests.ports import free_ports
from vcl_companion.clock import ManualClock
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerLink, PeerOptions, open_signing
from vcl_companion.wire.messages import MapState
from vcl_companion.wire.tunnel import encode_payload

NAMES = ("mav0", "mav1", "mav2")
WAIT_S = 10.0
STATE = encode_payload(MapState(b"", 0, False))


class Drone:
    """A daemon's end: one socket that keeps what it hears and from which port."""

    def __init__(self) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.port = int(self.socket.getsockname()[1])

    async def heard(self) -> tuple[bytes, int]:
        async with asyncio.timeout(WAIT_S):
            data, (_, port) = await asyncio.get_running_loop().sock_recvfrom(self.socket, 65535)
        return data, port

    def send(self, data: bytes, port: int) -> None:
        self.socket.sendto(data, ("127.0.0.1", port))


@asynccontextmanager
async def swarm(
    options: NetworkOptions | None = None,
    max_under_way_bytes: int = 1 << 20,
    *,
    addressed: bool = True,
) -> AsyncIterator[tuple[Relay, list[Drone]]]:
    relay = Relay(
        NAMES,
        Network(options or NetworkOptions(), 1),
        addressed=addressed,
        max_under_way_bytes=max_under_way_bytes,
    )
    drones = [Drone() for _ in NAMES]
    try:
        relay.start({name: drone.port for name, drone in zip(NAMES, drones, strict=True)})
        yield relay, drones
    finally:
        relay.close()
        for drone in drones:
            drone.socket.close()


def run(test: Coroutine[Any, Any, None]) -> None:
    asyncio.run(asyncio.wait_for(test, 3 * WAIT_S))


def test_a_datagram_comes_from_where_its_answer_goes() -> None:
    async def test() -> None:
        async with swarm() as (relay, (a, b, c)):
            to_b, to_c = relay.ports("mav0")
            from_b = relay.ports("mav1")
            a.send(b"question", to_b)
            data, port = await b.heard()
            assert (data, port) == (b"question", from_b[0])
            b.send(b"answer", port)
            assert await a.heard() == (b"answer", to_b)
            a.send(b"other", to_c)
            assert await c.heard() == (b"other", relay.ports("mav2")[0])

    run(test())


def test_on_one_air_all_hear_what_one_sends_and_it_counts_once() -> None:
    async def test() -> None:
        async with swarm(addressed=False) as (relay, (a, b, c)):
            airs = {name: relay.ports(name) for name in NAMES}
            assert all(len(ports) == 1 for ports in airs.values())
            a.send(b"to all", airs["mav0"][0])
            assert await b.heard() == (b"to all", airs["mav1"][0])
            assert await c.heard() == (b"to all", airs["mav2"][0])
            b.send(b"back", airs["mav1"][0])
            assert await a.heard() == (b"back", airs["mav0"][0])
            assert await c.heard() == (b"back", airs["mav2"][0])
            messages = [t.messages for t in relay.traffic.sent["mav0"].values()]
            assert messages == [1]

    run(test())


def test_nobody_else_gets_through_and_is_counted() -> None:
    async def test() -> None:
        async with swarm() as (relay, (a, b, c)):
            to_b = relay.ports("mav0")[0]
            c.send(b"not from mav0", to_b)
            a.send(b"from mav0", to_b)
            assert (await b.heard())[0] == b"from mav0"
            assert relay.n_strangers == 1
            assert list(relay.network.fates) == [("mav0", "mav1")]

    run(test())


def test_a_flood_arrives_whole_and_in_order() -> None:
    async def test() -> None:
        async with swarm() as (relay, (a, b, _)):
            to_b = relay.ports("mav0")[0]
            # More than is read at once, less than a socket's buffer.
            for k in range(300):
                a.send(k.to_bytes(2, "big"), to_b)
            heard = [int.from_bytes((await b.heard())[0], "big") for _ in range(300)]
            assert heard == list(range(300))
            assert relay.network.fates["mav0", "mav1"].delivered == 300

    run(test())


def test_a_delay_is_never_cut_short() -> None:
    async def test() -> None:
        async with swarm(NetworkOptions(delay_s=0.2)) as (relay, (a, b, _)):
            sent_s = asyncio.get_running_loop().time()
            a.send(b"first", relay.ports("mav0")[0])
            a.send(b"second", relay.ports("mav0")[0])
            assert [(await b.heard())[0] for _ in range(2)] == [b"first", b"second"]
            assert asyncio.get_running_loop().time() - sent_s >= 0.2

    run(test())


def test_what_the_network_loses_does_not_arrive() -> None:
    async def test() -> None:
        async with swarm(NetworkOptions(loss=0.5)) as (relay, (a, b, _)):
            to_b = relay.ports("mav0")[0]
            expected = Network(NetworkOptions(loss=0.5), 1)
            through = []
            for k in range(100):
                data = bytes([k])
                through += [one.data for one in expected.send(0.0, "mav0", "mav1", data)]
                a.send(data, to_b)
            assert [(await b.heard())[0] for _ in through] == through
            fate = relay.network.fates["mav0", "mav1"]
            while fate.offered < 100:
                await asyncio.sleep(0.01)
            assert (fate.lost, fate.delivered) == (100 - len(through), len(through))

    run(test())


def test_a_partition_goes_by_the_flight_s_time() -> None:
    async def test() -> None:
        options = NetworkOptions(partitions=(parse_partition("10-40:mav0|mav1,mav2"),))
        async with swarm(options) as (relay, (a, b, c)):
            to_b = relay.ports("mav0")[0]
            relay.flight_s = 10.0
            a.send(b"cut off", to_b)
            fates = relay.network.fates
            while ("mav0", "mav1") not in fates:
                await asyncio.sleep(0.01)
            c.send(b"near", relay.ports("mav2")[1])
            assert (await b.heard())[0] == b"near"
            relay.flight_s = 40.0
            a.send(b"back", to_b)
            assert (await b.heard())[0] == b"back"
            assert fates["mav0", "mav1"].cut == 1

    run(test())


def test_what_is_under_way_is_bounded() -> None:
    async def test() -> None:
        async with swarm(NetworkOptions(delay_s=0.3), 3000) as (relay, (a, b, _)):
            for _ in range(5):
                a.send(bytes(1000), relay.ports("mav0")[0])
            for _ in range(3):
                assert (await b.heard())[0] == bytes(1000)
            assert relay.n_dropped == 2

    run(test())


def test_peer_links_find_each_other_through_it_and_are_counted(tmp_path: Path) -> None:
    """The daemons' own link: broadcasts, then unicast to the address that it learned."""

    async def test() -> None:
        relay = Relay(NAMES[:2], Network(NetworkOptions(), 1))
        ports = free_ports(2)
        heard: list[list[Tunnel]] = [[], []]
        alive: list[set[int]] = [set(), set()]
        options = [
            PeerOptions(
                f"127.0.0.1:{ports[n]}",
                tuple(f"127.0.0.1:{port}" for port in relay.ports(NAMES[n])),
                timestamp_file="",
                allow_unsigned=True,
            )
            for n in range(2)
        ]
        links = [
            PeerLink(
                options[n], n + 1, frozenset({1, 2}), heard[n].append, alive[n].add,
                ManualClock(), lambda *_: None, open_signing(options[n]),
            )
            for n in range(2)
        ]  # fmt: skip
        tasks = [asyncio.create_task(link.run()) for link in links]
        try:
            relay.start(dict(zip(NAMES, ports, strict=False)))
            async with asyncio.timeout(WAIT_S):
                while alive != [{2}, {1}]:
                    await asyncio.sleep(0.01)
                links[0].send(*STATE)
                while not heard[1]:
                    await asyncio.sleep(0.01)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            relay.close()
        assert (heard[1][0].payload_type, heard[1][0].payload) == STATE
        sent = relay.traffic.sent
        assert sent["mav0"]["map state"].messages == 1
        for n, link in enumerate(links):
            assert sent[NAMES[n]]["heartbeat"].messages >= 1
            counted = sum(one.wire_bytes for one in sent[NAMES[n]].values())
            assert counted <= link.counters.bytes_out
        (tmp_path / "run").mkdir()
        write_network_log(tmp_path, relay)
        log = read_network_log(tmp_path)
        assert log is not None
        assert log.sent == sent
        assert log.fates == {s: {r: fate} for (s, r), fate in relay.network.fates.items()}

    run(test())
