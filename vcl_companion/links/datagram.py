"""UDP links: one fixed peer, a listener that adopts one, and the socket the swarm shares."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar

from vcl_companion.links.counters import LinkTally
from vcl_companion.links.reconnect import (
    Address,
    Backoff,
    LinkLostError,
    OnBytes,
    Reconnecting,
    socket_at,
)

_MAX_DATAGRAM_BYTES = 65535
# A flood must not keep the event loop from everything else, whatever its datagrams hold.
_MAX_BURST, _MAX_BURST_BYTES = 64, 65536
_SILENT_S = 5.0


class DatagramTransport(Reconnecting):
    """What the UDP links share: a socket that is read in bursts and never waits to send."""

    is_stream: ClassVar[bool] = False

    def __init__(
        self, name: str, receive_buffer_bytes: int, tally: LinkTally, backoff: Backoff
    ) -> None:
        super().__init__(name, tally, backoff)
        self._receive_buffer_bytes = receive_buffer_bytes
        self._socket: socket.socket | None = None

    @abstractmethod
    async def _open(self) -> socket.socket:
        """Return a bound or connected socket."""

    def _heard_nothing(self, opened: socket.socket) -> None:
        """React to nothing having come for a while."""

    def _accepts(self, sender: Address) -> bool:
        return True

    def _accepted(self, sender: Address) -> None:
        """Note that a datagram from ``sender`` held an accepted message."""

    async def _serve(self, on_bytes: OnBytes, on_connected: Callable[[], None]) -> None:
        try:
            opened = await self._open()
        except (OSError, ValueError) as error:  # a host name may be none
            raise LinkLostError(f"cannot open: {error}") from error
        with opened:
            opened.setblocking(False)
            # The kernel grants what net.core.rmem_max allows; less is no reason to stop.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, self._receive_buffer_bytes)
            self._socket = opened
            try:
                self._came_up(on_connected)
                while True:
                    try:
                        async with asyncio.timeout(_SILENT_S):
                            await self._readable(opened.fileno())
                    except TimeoutError:
                        self._heard_nothing(opened)
                    else:
                        self._receive_burst(opened, on_bytes)
            finally:
                self._socket = None

    def _receive_burst(self, opened: socket.socket, on_bytes: OnBytes) -> None:
        n_bytes = n_received = 0
        while n_received < _MAX_BURST and n_bytes < _MAX_BURST_BYTES:
            n_received += 1
            try:
                data, sender = opened.recvfrom(_MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                return
            except ConnectionRefusedError:
                self._tally.refuse("nobody listens at the other side")
                continue
            except OSError as error:
                raise LinkLostError(f"receive failed: {error.strerror}") from error
            n_bytes += len(data)
            address = _bare(sender)
            if not self._accepts(address):
                self._tally.refuse("sender's address not accepted")
                continue
            self._took(len(data))
            if on_bytes(data, address):
                self._accepted(address)

    def _send(self, data: bytes, to: Address | None) -> None:
        """Send to an address, or to the peer of a connected socket; drop and count if it cannot."""
        if self._socket is None:
            self._tally.refuse("not sent: link is down")
            return
        # The error of an earlier datagram that nobody wanted is reported once, in the
        # place of this one's sending; so it gets a second try.
        for _ in range(2):
            try:
                if to is None:
                    self._socket.send(data)
                else:
                    self._socket.sendto(data, to)
            except ConnectionRefusedError:
                self._tally.refuse("nobody listens at the other side")
                continue
            except BlockingIOError:
                self._tally.refuse("not sent: device is busy")
                return
            except OSError as error:
                self._tally.refuse(f"not sent: {error.strerror}")
                self._send_failed(error)
                return
            self._tally.bytes_out += len(data)
            return

    def _send_failed(self, error: OSError) -> None:
        """React to a send that failed for good; the network of one destination may be down."""


class UdpClient(DatagramTransport):
    """We send to one address, and the kernel lets us hear only that address."""

    def __init__(
        self, host: str, port: int, receive_buffer_bytes: int, tally: LinkTally, backoff: Backoff
    ) -> None:
        super().__init__(f"udp:{host}:{port}", receive_buffer_bytes, tally, backoff)
        self._host = host
        self._port = port

    async def _open(self) -> socket.socket:
        return await socket_at(self._host, self._port, socket.SOCK_DGRAM, _connect)

    def write(self, data: bytes) -> None:
        """Send one frame as one datagram."""
        self._send(data, None)

    def _send_failed(self, error: OSError) -> None:
        # Our own address may have changed: a connected socket keeps the old one.
        self._fail(f"send failed: {error.strerror}")


class UdpListener(DatagramTransport):
    """We listen; the first sender that says something acceptable becomes the one we answer.

    A peer that is silent for ``forgotten_after_s`` may be replaced, so that a
    restarted router with a new port is found again.
    """

    def __init__(
        self,
        host: str,
        port: int,
        allowed_senders: Sequence[str],
        receive_buffer_bytes: int,
        tally: LinkTally,
        backoff: Backoff,
        forgotten_after_s: float = 5.0,
    ) -> None:
        super().__init__(f"udpin:{host}:{port}", receive_buffer_bytes, tally, backoff)
        self._forgotten_after_s = forgotten_after_s
        self._host = host
        self._port = port
        self._allowed = [ipaddress.ip_network(text, strict=False) for text in allowed_senders]
        self._peer: Address | None = None
        self._peer_heard_at_s = 0.0

    async def _open(self) -> socket.socket:
        return await socket_at(self._host, self._port, socket.SOCK_DGRAM, _bind)

    def write(self, data: bytes) -> None:
        """Send one frame to the peer, if there is one."""
        if self._peer is None:
            self._tally.refuse("not sent: nobody heard yet")
            return
        self._send(data, self._peer)

    def _accepts(self, sender: Address) -> bool:
        if self._allowed:
            host = ipaddress.ip_address(sender[0])
            # A socket of both families hears who has an IPv4 address by one that holds it.
            host = getattr(host, "ipv4_mapped", None) or host
            if not any(host in network for network in self._allowed):
                return False
        silent_s = asyncio.get_running_loop().time() - self._peer_heard_at_s
        return self._peer in (None, sender) or silent_s > self._forgotten_after_s

    def _accepted(self, sender: Address) -> None:
        self._peer = sender
        self._peer_heard_at_s = asyncio.get_running_loop().time()


class PeerSocket(DatagramTransport):
    """One socket to all peers: a list of addresses, or one broadcast or multicast group.

    A multicast group is joined on the interface that ``listen`` names. Only
    with a group may several daemons of one host share the port.
    """

    def __init__(
        self,
        listen: Address,
        to: Sequence[Address],
        receive_buffer_bytes: int,
        tally: LinkTally,
        backoff: Backoff,
    ) -> None:
        super().__init__(f"peers {listen[0]}:{listen[1]}", receive_buffer_bytes, tally, backoff)
        self._listen = listen
        self._to = tuple(to)

    @property
    def destinations(self) -> tuple[Address, ...]:
        """Where a message to everybody goes."""
        return self._to

    def write(self, data: bytes) -> None:
        """Send one frame to every destination."""
        for destination in self._to:
            self._send(data, destination)

    def write_to(self, data: bytes, destination: Address) -> None:
        """Send one frame to one of the destinations."""
        self._send(data, destination)

    async def _open(self) -> socket.socket:
        host, port = self._listen
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with _closed_on_error(opened):
            groups = self._groups()
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
            # Broadcast addresses cannot be told from hosts without the netmask; most end so.
            if groups or any(to[0].endswith(".255") for to in self._to):
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if groups:
                # Bound to the group, the socket hears the group and nothing else.
                host = groups[0]
                self._join(opened, host)
            opened.bind((host, port))
        return opened

    def _groups(self) -> list[str]:
        return [to[0] for to in self._to if ipaddress.ip_address(to[0]).is_multicast]

    def _join(self, opened: socket.socket, group: str) -> None:
        interface = socket.inet_aton(self._listen[0])
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, self._membership(group))
        opened.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, interface)

    def _membership(self, group: str) -> bytes:
        return socket.inet_aton(group) + socket.inet_aton(self._listen[0])

    def _heard_nothing(self, opened: socket.socket) -> None:
        # Not even our own is heard: a network interface that went and came back is in no group.
        for group in self._groups():
            with contextlib.suppress(OSError):
                leaving = socket.IP_DROP_MEMBERSHIP
                opened.setsockopt(socket.IPPROTO_IP, leaving, self._membership(group))
            with contextlib.suppress(OSError):  # it is not back yet
                self._join(opened, group)


async def _connect(opened: socket.socket, address: Any) -> None:
    opened.connect(address)


async def _bind(opened: socket.socket, address: Any) -> None:
    opened.bind(address)


@contextlib.contextmanager
def _closed_on_error(opened: socket.socket) -> Iterator[None]:
    try:
        yield
    except BaseException:
        opened.close()
        raise


def _bare(sender: tuple[object, ...]) -> Address:
    """Return host, with the interface of a link-local one, and port."""
    host, port = str(sender[0]), sender[1]
    assert isinstance(port, int)
    return host, port
