"""The network that all drones share: each is heard by every other one, with loss and delay."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextvars import Context

from sitl.network import Network, NetworkOptions
from sitl.peer_traffic import PeerTraffic
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.datagram import PeerSocket
from vcl_companion.links.reconnect import Address, Backoff, OnBytes

# All of one channel: 802.11 sends what is for everybody at its base rate of 6 Mbit/s. What goes
# before each datagram (IP, UDP, preamble, contention) is left out.
CHANNEL_BITS_PER_S = 6e6
_DELAY_S, _JITTER_S = 0.002, 0.001
# Where everybody sends to: a broadcast address, so that one copy reaches all.
_NET: Address = ("192.0.2.255", 14650)
_LISTEN: Address = ("0.0.0.0", 14650)


def channel(loss: float) -> NetworkOptions:
    """Return the network of a run."""
    return NetworkOptions(
        loss=loss,
        delay_s=_DELAY_S,
        jitter_s=_JITTER_S,
        rate_bits_per_s=CHANNEL_BITS_PER_S,
        shared=True,
    )


class AirSocket(PeerSocket):
    """A drone's socket, without a kernel behind it.

    Args:
        tally: where it counts.
        transmit: takes what is sent.
    """

    def __init__(self, tally: LinkTally, transmit: Callable[[bytes], None]) -> None:
        super().__init__(_LISTEN, (_NET,), 0, tally, Backoff())
        self._transmit = transmit
        self._on_bytes: OnBytes | None = None

    def hear(self, data: bytes) -> None:
        """Take one datagram; nobody hears before ``run``."""
        if self._on_bytes is not None:
            self._took(len(data))
            self._on_bytes(data, None)

    async def _serve(self, on_bytes: OnBytes, on_connected: Callable[[], None]) -> None:
        self._on_bytes = on_bytes
        self._came_up(on_connected)
        await asyncio.Event().wait()

    def _send(self, data: bytes, to: Address | None) -> None:
        self._tally.bytes_out += len(data)
        self._transmit(data)


class Air:
    """Carries what drones send to all the others, as the running event loop's time passes.

    Args:
        options: how bad it is.
        seed: of what is lost.

    Attributes:
        traffic: what was sent, counted; the owner may put another one in its place.
    """

    def __init__(self, options: NetworkOptions, seed: int) -> None:
        self.traffic = PeerTraffic()
        self._loop = asyncio.get_running_loop()
        self._network = Network(options, seed)
        self._context = Context()  # nobody's: carrying is no drone's work
        self._ears: dict[str, tuple[Callable[[bytes], None], Context]] = {}
        self._others: dict[str, Sequence[str]] = {}

    def join(self, name: str, hear: Callable[[bytes], None], context: Context) -> None:
        """Let a drone hear, in its own context, what the others send."""
        self._ears[name] = hear, context
        self._others = {one: [o for o in self._ears if o != one] for one in self._ears}

    def transmit(self, sender: str, data: bytes) -> None:
        """Take what a drone sends; it is carried when the drone is done with what it does."""
        self._loop.call_soon(self._carry, sender, data, context=self._context)

    def dropped(self) -> float:
        """Return the share of all datagrams that found the channel's queue too long."""
        fates = self._network.fates.values()
        return sum(f.queue_full for f in fates) / max(sum(f.offered for f in fates), 1)

    def _carry(self, sender: str, data: bytes) -> None:
        self.traffic.count(sender, data)
        at_s, others = self._loop.time(), self._others[sender]
        for receiver, (due_s, heard) in self._network.broadcast(at_s, sender, others, data):
            hear, context = self._ears[receiver]
            self._loop.call_at(due_s, hear, heard, context=context)
