"""Peer links among themselves on loopback."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from tests.ports import free_ports
from vcl_companion.clock import Clock, ManualClock, Moment, system_moment
from vcl_companion.links.messages import Tunnel
from vcl_companion.links.peers import PeerLink, PeerOptions, open_signing

MEMBERS = frozenset({1, 2, 3})


class Drone:
    """A peer link and what it heard."""

    def __init__(
        self,
        options: PeerOptions,
        system_id: int,
        now: Callable[[], Moment] = system_moment,
        clock: Clock | None = None,
    ) -> None:
        self.times: asyncio.Queue[tuple[int, int, int]] = asyncio.Queue()
        self.tunnels: asyncio.Queue[Tunnel] = asyncio.Queue()
        self.beats: asyncio.Queue[int] = asyncio.Queue()
        self.signing = open_signing(options, now)
        self.link = PeerLink(
            options, system_id, MEMBERS, self.tunnels.put_nowait, self.beats.put_nowait,
            clock or ManualClock(), lambda *answer: self.times.put_nowait(answer), self.signing,
        )  # fmt: skip

    async def hears(self, *systems: int) -> None:
        missing = set(systems)
        while missing:
            missing.discard(await self.beats.get())


def unicast(n: int, key: str) -> list[Drone]:
    """Drones that sign."""
    addresses = [f"127.0.0.1:{port}" for port in free_ports(n)]
    return [
        Drone(PeerOptions(me, tuple(a for a in addresses if a != me), key, f"{key}.{k}"), k + 1)
        for k, me in enumerate(addresses)
    ]
