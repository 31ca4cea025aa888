"""The air between the daemons of a flight: their peer datagrams pass through sockets of ours.

Each drone has a socket here, its *air*: what it sends there everybody else hears, as on a
radio or by multicast, and what it hears comes from there. Or, *addressed*, as through an
access point, each ordered pair has one: what drone a sends to the socket a → b becomes a
datagram to b, sent from the socket b → a, which is where b sends what is for a.
What happens in between is ``sitl.network``'s; its seconds are the wall clock's, those of
the partitions the flight's.

It runs in the harness's event loop and is used in every flight, for it also counts what
is sent, message by message.
"""

from __future__ import annotations

import asyncio
import heapq
import socket
from collections.abc import Mapping, Sequence

from sitl.network import Network
from sitl.peer_traffic import PeerTraffic

_MAX_DATAGRAM_BYTES = 65535
# Nobody waits for long behind a burst: not another link, and not the harness.
_MAX_BURST = 16
_RECEIVE_BUFFER_BYTES = 4 << 20
# Several seconds of everything that three daemons may send.
_MAX_UNDER_WAY_BYTES = 64 << 20

_Pair = tuple[str, str]

_AIR = ""  # in the place of a receiver: all others


class Relay:
    """Sockets between daemons; ``close`` must be called whatever happens.

    Args:
        names: the drones.
        network: what becomes of the datagrams.
        addressed: whether drones send to each other one by one.
        max_under_way_bytes: more is dropped.

    Attributes:
        network: what becomes of the datagrams.
        traffic: what was sent.
        n_dropped: datagrams that this machine, not the network, did not get across.
        n_strangers: datagrams of somebody who is not the socket's drone.
        flight_s: the flight's time, for the partitions; the harness moves it on.
    """

    def __init__(
        self,
        names: Sequence[str],
        network: Network,
        *,
        addressed: bool = False,
        max_under_way_bytes: int = _MAX_UNDER_WAY_BYTES,
    ) -> None:
        self.network = network
        self._names = tuple(names)
        self._addressed = addressed
        self.traffic = PeerTraffic()
        self.n_dropped = 0
        self.n_strangers = 0
        self.flight_s = 0.0
        self._sockets: dict[_Pair, socket.socket] = {}
        self._daemons: Mapping[str, int] = {}
        # (due, order, sender and receiver, datagram): equal times keep their order.
        self._under_way: list[tuple[float, int, _Pair, bytes]] = []
        self._under_way_bytes = 0
        self._max_under_way_bytes = max_under_way_bytes
        self._n_taken = 0
        self._timer: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        try:
            for sender in names:
                for receiver in self._others(sender) if addressed else (_AIR,):
                    self._sockets[sender, receiver] = _opened()
        except OSError:
            self.close()
            raise

    def ports(self, sender: str) -> list[int]:
        """Return the ports of 127.0.0.1 that a drone sends to: one, or one for each other."""
        return [
            int(opened.getsockname()[1])
            for pair, opened in self._sockets.items()
            if pair[0] == sender
        ]

    def start(self, daemons: Mapping[str, int]) -> None:
        """Begin to listen.

        Args:
            daemons: each drone's port of 127.0.0.1 that its daemon hears and sends from.
        """
        self._daemons = dict(daemons)
        for pair, opened in self._sockets.items():
            self._loop.add_reader(opened.fileno(), self._receive, pair, opened)

    def close(self) -> None:
        """Stop; what is still under way is not delivered."""
        if self._timer is not None:
            self._timer.cancel()
        for opened in self._sockets.values():
            self._loop.remove_reader(opened.fileno())
            opened.close()
        self._sockets = {}
        self._under_way = []

    def _others(self, name: str) -> tuple[str, ...]:
        return tuple(other for other in self._names if other != name)

    def _receive(self, pair: _Pair, opened: socket.socket) -> None:
        sender, receiver = pair
        now_s = self._loop.time()
        for _ in range(_MAX_BURST):
            try:
                data, (_, port) = opened.recvfrom(_MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                break
            if port != self._daemons[sender]:
                self.n_strangers += 1
                continue
            self.traffic.count(sender, data)
            hearers = self._others(sender) if receiver == _AIR else (receiver,)
            for hearer, (due_s, arriving) in self.network.broadcast(
                now_s, sender, hearers, data, self.flight_s
            ):
                self._take(due_s, (sender, hearer), arriving)
        self._deliver()

    def _take(self, due_s: float, pair: _Pair, data: bytes) -> None:
        if self._under_way_bytes + len(data) > self._max_under_way_bytes:
            self.n_dropped += 1
            return
        heapq.heappush(self._under_way, (due_s, self._n_taken, pair, data))
        self._n_taken += 1
        self._under_way_bytes += len(data)

    def _deliver(self) -> None:
        """Send on what is due, and come back for the rest."""
        now_s = self._loop.time()
        while self._under_way and self._under_way[0][0] <= now_s:
            _, _, (sender, receiver), data = heapq.heappop(self._under_way)
            self._under_way_bytes -= len(data)
            heard_from = self._sockets[receiver, sender if self._addressed else _AIR]
            try:
                heard_from.sendto(data, ("127.0.0.1", self._daemons[receiver]))
            except OSError:
                self.n_dropped += 1
        self._come_back()

    def _come_back(self) -> None:
        next_s = self._under_way[0][0] if self._under_way else None
        if self._timer is not None:
            if self._timer.when() == next_s:
                return
            self._timer.cancel()
            self._timer = None
        if next_s is not None:
            self._timer = self._loop.call_at(next_s, self._timed)

    def _timed(self) -> None:
        self._timer = None
        self._deliver()


def _opened() -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        opened.setblocking(False)
        opened.bind(("127.0.0.1", 0))
    except OSError:
        opened.close()
        raise
    return opened
