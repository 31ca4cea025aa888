"""Running something of ours in the background of a test, and waiting for what it hands over."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Coroutine
from typing import Any, cast

from vcl_companion.links.reconnect import Address

LONGEST_S = 10.0


@contextlib.asynccontextmanager
async def running(*work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    """Run coroutines beside the block; an error of theirs is the test's."""
    tasks = [asyncio.ensure_future(coroutine) for coroutine in work]
    try:
        async with asyncio.timeout(LONGEST_S):
            yield
    finally:
        for task in tasks:
            task.cancel()
        for outcome in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(outcome, Exception):
                raise outcome


class Inbox:
    """Keeps what a transport hands over, and when it came up."""

    def __init__(self, accepts: bool = True) -> None:
        self._got: asyncio.Queue[tuple[bytes, Address | None]] = asyncio.Queue()
        self._connected: asyncio.Queue[None] = asyncio.Queue()
        self.accepts = accepts

    def on_bytes(self, data: bytes, sender: Address | None) -> bool:
        self._got.put_nowait((data, sender))
        return self.accepts

    def on_connected(self) -> None:
        self._connected.put_nowait(None)

    async def connected(self) -> None:
        await self._connected.get()

    async def datagram(self) -> bytes:
        return (await self._got.get())[0]

    async def exactly(self, n_bytes: int) -> bytes:
        """What a stream delivers, until it is this much."""
        data = b""
        while len(data) < n_bytes:
            data += (await self._got.get())[0]
        return data


class Udp(asyncio.DatagramProtocol):
    """The other side of a UDP link."""

    def __init__(self) -> None:
        self.got: asyncio.Queue[tuple[bytes, Address]] = asyncio.Queue()
        self._transport: asyncio.DatagramTransport | None = None

    @property
    def transport(self) -> asyncio.DatagramTransport:
        assert self._transport is not None
        return self._transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # The selector loop's transport is one in all but its base class.
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self.got.put_nowait((data, (addr[0], addr[1])))

    @property
    def port(self) -> int:
        return int(self.transport.get_extra_info("sockname")[1])


@contextlib.asynccontextmanager
async def udp(port: int = 0, host: str = "127.0.0.1") -> AsyncIterator[Udp]:
    """A UDP socket on loopback."""
    loop = asyncio.get_running_loop()
    transport, protocol = await loop.create_datagram_endpoint(Udp, local_addr=(host, port))
    try:
        yield protocol
    finally:
        transport.close()
