"""Keeping a connection alive: open, serve until it is lost, wait a little longer each time."""

from __future__ import annotations

import asyncio
import logging
import socket
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from vcl_companion.links.counters import LinkTally

_log = logging.getLogger(__name__)

Address = tuple[str, int]
"""Numeric host, without an IPv6 scope, and port."""

OnBytes = Callable[[bytes, Address | None], bool]
"""Takes what arrived, and from where if it was a datagram; says whether any was accepted."""


async def socket_at(
    host: str,
    port: int,
    kind: socket.SocketKind,
    use: Callable[[socket.socket, Any], Awaitable[None]],
) -> socket.socket:
    """Return a socket that is bound or connected to the first address of a host that takes it.

    Of IPv4 where it has one: ``localhost`` is both, and most that speak MAVLink know the one only.

    Raises:
        OSError: it is not known, or none of its addresses takes it: why the first does not.
        ValueError: no host has such a name.
    """
    found = await asyncio.get_running_loop().getaddrinfo(host, port, type=kind)
    failure: OSError | None = None
    for family, _, protocol, _, address in sorted(found, key=lambda f: f[0] != socket.AF_INET):
        opened = socket.socket(family, kind, protocol)
        try:
            await use(opened, address)
        except OSError as error:
            opened.close()
            failure = failure or error
        except BaseException:
            opened.close()
            raise
        else:
            return opened
    raise failure or OSError(f"{host} has no address")


class LinkLostError(Exception):
    """The device or socket is gone or could not be opened; the message says why."""


@dataclass(frozen=True)
class Backoff:
    """How long to wait before opening again.

    Attributes:
        first_s: after a connection that had delivered something.
        longest_s: each further failure doubles the wait up to this.
    """

    first_s: float = 0.1
    longest_s: float = 5.0


class Reconnecting(ABC):
    """A transport that opens its device again and again, for as long as it runs."""

    def __init__(self, name: str, tally: LinkTally, backoff: Backoff) -> None:
        self._name = name
        self._tally = tally
        self._backoff = backoff
        self._heard = False
        self._lost_because: str | None = None
        self._wake: asyncio.Future[None] | None = None

    @abstractmethod
    async def _serve(self, on_bytes: OnBytes, on_connected: Callable[[], None]) -> None:
        """Open, report, receive; raise LinkLostError when it ends; leave nothing open."""

    async def run(self, on_bytes: OnBytes, on_connected: Callable[[], None]) -> None:
        """Keep the link up until cancelled.

        Args:
            on_bytes: called with everything that arrives, in order.
            on_connected: called each time the link has come up and can be written to.
        """
        delay_s = self._backoff.first_s
        said = None
        while True:
            self._heard = False
            self._lost_because = None
            try:
                await self._serve(on_bytes, on_connected)
            except LinkLostError as lost:
                # The same line at every attempt would bury what matters.
                if str(lost) != said or self._heard:
                    _log.warning("%s: %s; trying again", self._name, lost)
                    said = str(lost)
            if self._heard:
                delay_s = self._backoff.first_s
            await asyncio.sleep(delay_s)
            delay_s = min(2.0 * delay_s, self._backoff.longest_s)

    def _came_up(self, on_connected: Callable[[], None]) -> None:
        self._tally.connects += 1
        _log.info("%s: open", self._name)
        on_connected()

    def _took(self, n_bytes: int) -> None:
        self._heard = True
        self._tally.bytes_in += n_bytes

    async def _readable(self, fd: int) -> None:
        """Wait until ``fd`` can be read; raise LinkLostError when a write found the link dead."""
        if self._lost_because is None:
            loop = asyncio.get_running_loop()
            self._wake = loop.create_future()
            loop.add_reader(fd, _wake_up, self._wake)
            try:
                await self._wake
            finally:
                loop.remove_reader(fd)
                self._wake = None
        if self._lost_because is not None:
            raise LinkLostError(self._lost_because)

    def _fail(self, reason: str) -> None:
        """Have the receiving side give the connection up; for errors found while writing."""
        self._lost_because = reason
        if self._wake is not None:
            _wake_up(self._wake)


def _wake_up(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
