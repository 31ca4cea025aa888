"""Serial ports, TCP and UDP: what arrives, what is dropped, and coming back after a loss."""

import asyncio
import contextlib
import os
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.links.running import Inbox, running, udp
from vcl_companion.errors import ConfigError
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.datagram import UdpListener
from vcl_companion.links.reconnect import Backoff
from vcl_companion.links.stream import MAX_WAITING_BYTES, SerialTransport
from vcl_companion.links.transport import LinkAddress, open_transport, parse_link, parse_peers

QUICK = Backoff(0.001, 0.01)


def test_link_strings() -> None:
    by_path = "/dev/serial/by-path/platform-xhci.0-usb-0:1.3:1.0-port0"
    assert parse_link(f"serial:{by_path}:921600") == LinkAddress("serial", by_path, 921600)
    assert parse_link("udp:drone.local:14550") == LinkAddress("udp", "drone.local", 14550)
    assert parse_link("udpin:0.0.0.0:14550") == LinkAddress("udpin", "0.0.0.0", 14550)
    assert parse_link("tcp:[::1]:5760") == LinkAddress("tcp", "::1", 5760)


@pytest.mark.parametrize(
    "link",
    ["", "udp", "udp:host", "udp:host:x", "udp:host:65536", "udp::1:14550", "udp:[]:1",
     "serial:/dev/ttyS0", "serial:ttyS0:9600", "serial:/dev/ttyS0:fast", "serial:/dev/ttyS0:0",
     "tcp:host:-1", "tcp:host:0", "tcp:host:1²", "bluetooth:host:1"],
)  # fmt: skip
def test_a_wrong_link_string_is_one_clear_line(link: str) -> None:
    with pytest.raises(ConfigError, match="link") as caught:
        open_transport(link, LinkTally())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("listen", "to", "message"),
    [
        ("239.1.1.1:14650", ["10.0.0.2:14650"], "listen: 239.1.1.1 is a multicast group"),
        ("0.0.0.0:0", ["10.0.0.2:14650"], "listen: 0.0.0.0:0 needs a port above 0"),
        ("0.0.0.0:14650", ["10.0.0.2:0"], "to: 10.0.0.2 needs a port above 0"),
        ("0.0.0.0:14650", ["::1:14650"], "to: expected a numeric IPv4 ADDRESS:PORT, got '::1:146"),
        ("0.0.0.0:14650", ["[::1]:14650"], "to: expected a numeric IPv4 ADDRESS:PORT"),
        ("drone:14650", [], "listen: expected a numeric IPv4 ADDRESS:PORT, got 'drone:14650'"),
        ("0.0.0.0", [], "listen: expected a numeric IPv4 ADDRESS:PORT, got '0.0.0.0'"),
    ],
)
def test_a_wrong_address_of_the_swarm_is_one_clear_line(
    listen: str, to: list[str], message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_peers(listen, to)
    assert str(caught.value).startswith(message)


def test_a_serial_port_that_cannot_be_opened_is_named_once(tmp_path: Path) -> None:
    transport = open_transport(f"serial:{tmp_path / 'none'}:9600", LinkTally(), backoff=QUICK)
    assert isinstance(transport, SerialTransport)
    with pytest.raises(OSError, match=r"^No such file or directory$"):
        asyncio.run(transport._open())


def test_allowed_senders_are_addresses_or_networks() -> None:
    with pytest.raises(ConfigError, match="allowed_senders"):
        open_transport("udpin:127.0.0.1:0", LinkTally(), allowed_senders=["drone"])


class Port:
    """A pseudo terminal behind a stable path, as udev gives a serial port."""

    def __init__(self, path: Path) -> None:
        self.controller, self._terminal = os.openpty()
        tty.setraw(self._terminal)
        os.set_blocking(self.controller, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self._terminal))

    def unplug(self) -> None:
        for fd in (self.controller, self._terminal):
            with contextlib.suppress(OSError):
                os.close(fd)
        self.controller = self._terminal = -1

    async def read(self, n_bytes: int) -> bytes:
        data = b""
        while len(data) < n_bytes:
            await self._readable()
            data += os.read(self.controller, n_bytes - len(data))
        return data

    async def _readable(self) -> None:
        loop = asyncio.get_running_loop()
        ready = asyncio.Event()
        loop.add_reader(self.controller, ready.set)
        try:
            await ready.wait()
        finally:
            loop.remove_reader(self.controller)


@contextlib.contextmanager
def plugged(path: Path) -> Iterator[Port]:
    port = Port(path)
    try:
        yield port
    finally:
        port.unplug()


def test_serial_both_ways_and_back_after_unplugging(tmp_path: Path) -> None:
    path = tmp_path / "usb-autopilot"
    tally = LinkTally()
    inbox = Inbox()

    async def scenario() -> None:
        serial = open_transport(f"serial:{path}:921600", tally, backoff=QUICK)
        async with running(serial.run(inbox.on_bytes, inbox.on_connected)):
            serial.write(b"nobody there")
            for _ in range(2):
                with plugged(path) as port:
                    await inbox.connected()
                    os.write(port.controller, b"\x00\x11\x13\n\r\x03hello")
                    assert await inbox.exactly(11) == b"\x00\x11\x13\n\r\x03hello"
                    serial.write(b"\xfd\x0a\x0d pose")
                    assert await port.read(8) == b"\xfd\x0a\x0d pose"

    asyncio.run(scenario())
    counters = tally.snapshot()
    assert counters.refused == {"not sent: link is down": 1}
    assert (counters.connects, counters.bytes_in, counters.bytes_out) == (2, 22, 16)


def test_a_busy_serial_port_keeps_the_newest_frames_whole(tmp_path: Path) -> None:
    frames = [k.to_bytes(4, "big") * 32 for k in range(2000)]
    tally = LinkTally()
    inbox = Inbox()

    async def scenario() -> bytes:
        with plugged(tmp_path / "port") as port:
            serial = open_transport(f"serial:{tmp_path / 'port'}:57600", tally, backoff=QUICK)
            async with running(serial.run(inbox.on_bytes, inbox.on_connected)):
                await inbox.connected()
                for frame in frames:
                    serial.write(frame)
                n_dropped = tally.snapshot().refused["not sent: device is busy"]
                return await port.read(128 * (len(frames) - n_dropped))

    data = asyncio.run(scenario())
    got = [data[i : i + 128] for i in range(0, len(data), 128)]
    assert set(got) < set(frames)
    assert got == sorted(got)
    newest = MAX_WAITING_BYTES // 128 - 1
    assert got[-newest:] == frames[-newest:]
    assert tally.snapshot().bytes_out == len(data)


def test_one_serial_port_is_not_shared(tmp_path: Path) -> None:
    async def scenario() -> None:
        with plugged(tmp_path / "port") as port:
            link = f"serial:{tmp_path / 'port'}:57600"
            first, second = (open_transport(link, LinkTally(), backoff=QUICK) for _ in range(2))
            here, there = Inbox(), Inbox()
            async with running(
                first.run(here.on_bytes, here.on_connected),
                second.run(there.on_bytes, there.on_connected),
            ):
                owner = await first_of(here, there)
                os.write(port.controller, b"x")
                assert await owner.exactly(1) == b"x"

    async def first_of(*inboxes: Inbox) -> Inbox:
        tasks = [asyncio.ensure_future(inbox.connected()) for inbox in inboxes]
        done, rest = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in rest:
            task.cancel()
        assert len(done) == 1
        return inboxes[tasks.index(done.pop())]

    asyncio.run(scenario())


def test_tcp_both_ways_and_back_after_a_loss() -> None:
    tally = LinkTally()
    inbox = Inbox()
    heard: asyncio.Queue[bytes] = asyncio.Queue()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"attitude")
        heard.put_nowait(await reader.readexactly(4))
        writer.close()

    async def scenario() -> None:
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        tcp = open_transport(f"tcp:127.0.0.1:{port}", tally, backoff=QUICK)
        async with server, running(tcp.run(inbox.on_bytes, inbox.on_connected)):
            for k in range(3):
                await inbox.connected()
                tcp.write(b"%04d" % k)
                assert await inbox.exactly(8) == b"attitude"
                assert await heard.get() == b"%04d" % k

    asyncio.run(scenario())
    assert tally.snapshot().bytes_in == 24


def test_udp_hears_only_its_peer() -> None:
    tally = LinkTally()
    inbox = Inbox()

    async def scenario() -> None:
        async with udp() as peer, udp() as stranger:
            client = open_transport(f"udp:127.0.0.1:{peer.port}", tally, backoff=QUICK)
            async with running(client.run(inbox.on_bytes, inbox.on_connected)):
                await inbox.connected()
                client.write(b"hello")
                data, address = await peer.got.get()
                assert data == b"hello"
                stranger.transport.sendto(b"evil", address)
                peer.transport.sendto(b"good", address)
                assert await inbox.datagram() == b"good"

    asyncio.run(scenario())
    assert tally.snapshot().bytes_in == 4


def test_udp_to_nobody_is_counted_and_heard_when_somebody_comes() -> None:
    tally = LinkTally()
    inbox = Inbox()

    async def scenario() -> None:
        async with udp() as gone:
            port = gone.port
        client = open_transport(f"udp:127.0.0.1:{port}", tally, backoff=QUICK)
        async with running(client.run(inbox.on_bytes, inbox.on_connected)):
            await inbox.connected()
            client.write(b"one")
            client.write(b"two")
            async with udp(port) as peer:
                client.write(b"three")
                client.write(b"four")
                assert {(await peer.got.get())[0] for _ in range(2)} == {b"three", b"four"}

    asyncio.run(scenario())
    assert tally.snapshot().refused["nobody listens at the other side"] >= 1


@pytest.mark.parametrize("host", ["127.0.0.1", "[::]"])
def test_a_listener_adopts_the_first_who_makes_sense(host: str) -> None:
    """Also where it hears IPv4 on a socket of both families, and is told its network."""
    tally = LinkTally()
    inbox = Inbox(accepts=False)

    async def scenario() -> None:
        async with udp() as free:
            port = free.port
        listener = open_transport(
            f"udpin:{host}:{port}", tally, allowed_senders=["127.0.0.0/8"], backoff=QUICK
        )
        async with running(listener.run(inbox.on_bytes, inbox.on_connected)):
            await inbox.connected()
            listener.write(b"lost")
            async with udp() as noise, udp() as autopilot, udp() as late:
                noise.transport.sendto(b"noise", ("127.0.0.1", port))
                assert await inbox.datagram() == b"noise"
                inbox.accepts = True
                autopilot.transport.sendto(b"heartbeat", ("127.0.0.1", port))
                assert await inbox.datagram() == b"heartbeat"
                late.transport.sendto(b"me too", ("127.0.0.1", port))
                autopilot.transport.sendto(b"attitude", ("127.0.0.1", port))
                assert await inbox.datagram() == b"attitude"
                listener.write(b"pose")
                assert (await autopilot.got.get())[0] == b"pose"
                assert late.got.empty()

    asyncio.run(scenario())
    assert tally.snapshot().refused == {
        "not sent: nobody heard yet": 1,
        "sender's address not accepted": 1,
    }


def test_a_listener_follows_a_silent_peer_that_comes_back_elsewhere() -> None:
    inbox = Inbox()

    async def scenario() -> None:
        async with udp() as free:
            port = free.port
        listener = UdpListener("127.0.0.1", port, (), 1 << 16, LinkTally(), QUICK, 0.0)
        async with running(listener.run(inbox.on_bytes, inbox.on_connected)):
            await inbox.connected()
            for _ in range(2):
                async with udp() as autopilot:
                    autopilot.transport.sendto(b"heartbeat", ("127.0.0.1", port))
                    assert await inbox.datagram() == b"heartbeat"
                    listener.write(b"pose")
                    assert (await autopilot.got.get())[0] == b"pose"

    asyncio.run(scenario())


def test_a_listener_keeps_to_its_allowed_senders() -> None:
    tally = LinkTally()
    inbox = Inbox()

    async def scenario() -> None:
        async with udp() as free:
            port = free.port
        listener = open_transport(
            f"udpin:127.0.0.1:{port}", tally, allowed_senders=["127.0.0.2"], backoff=QUICK
        )
        async with running(listener.run(inbox.on_bytes, inbox.on_connected)):
            await inbox.connected()
            async with udp() as stranger, udp(host="127.0.0.2") as autopilot:
                stranger.transport.sendto(b"evil", ("127.0.0.1", port))
                autopilot.transport.sendto(b"good", ("127.0.0.1", port))
                assert await inbox.datagram() == b"good"

    asyncio.run(scenario())
    assert tally.snapshot().refused == {"sender's address not accepted": 1}
