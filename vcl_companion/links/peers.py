"""The link to the other drones: heartbeats and TUNNEL payloads over one UDP socket."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass

from vcl_companion.links.counters import LinkCounters, LinkTally
from vcl_companion.links.mavlink import COMPONENT_COMPANION, Codec, Heartbeat, Message, Tunnel
from vcl_companion.links.reconnect import Address
from vcl_companion.links.transport import open_peer_socket, parse_peers

_HEARTBEAT_S = 1.0
# A member that was silent for longer may have moved to another address.
_ADDRESS_STALE_S = 5.0
_STATE_ACTIVE = 4


@dataclass(frozen=True)
class PeerOptions:
    """Where the swarm talks.

    Attributes:
        listen: numeric IPv4 ADDRESS:PORT that this drone hears and sends from; for a
            multicast group the address of the interface to join on.
        to: numeric IPv4 ADDRESS:PORT of every other drone, or one broadcast address, or
            one multicast group.
    """

    listen: str = "0.0.0.0:14650"
    to: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        parse_peers(self.listen, self.to)


class PeerLink:
    """Our side of the swarm's link; everything happens in the event loop's thread.

    Args:
        options: where it talks.
        system_id: this drone.
        members: system ids of the swarm; nobody else is heard.
        on_tunnel: takes a payload for us or for everybody.
        on_heartbeat: takes the system id of a member that has shown itself.
    """

    def __init__(
        self,
        options: PeerOptions,
        system_id: int,
        members: frozenset[int],
        on_tunnel: Callable[[Tunnel], None],
        on_heartbeat: Callable[[int], None],
    ) -> None:
        self._system_id = system_id
        self._members = members
        self._on_tunnel = on_tunnel
        self._on_heartbeat = on_heartbeat
        self._tally = LinkTally()
        self._codec = Codec(system_id, COMPONENT_COMPANION, self._tally)
        self._socket = open_peer_socket(options.listen, options.to, self._tally)
        self._addresses: dict[int, tuple[Address, float]] = {}

    @property
    def counters(self) -> LinkCounters:
        """What went over the link so far."""
        return self._tally.snapshot()

    @property
    def copies_to_all(self) -> int:
        """How often a message to everybody is sent; once, where the group shares a network."""
        return len(self._socket.destinations)

    async def run(self) -> None:
        """Keep the link alive until cancelled."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._socket.run(self._receive, self._beat))
            group.create_task(self._heartbeats())

    def send(self, payload_type: int, payload: bytes, target_system: int = 0) -> None:
        """Send a TUNNEL of at most 128 bytes to one member, or to all (0).

        One for a single member goes only to its address once that is known,
        else to everybody, who ignore it.

        Raises:
            ValueError: the payload is too long.
        """
        frame = self._codec.tunnel(target_system, payload_type, payload)
        address, heard_at_s = self._addresses.get(target_system, (None, 0.0))
        if address is None or asyncio.get_running_loop().time() - heard_at_s > _ADDRESS_STALE_S:
            self._socket.write(frame)
        else:
            self._socket.write_to(frame, address)

    def _receive(self, data: bytes, sender: Address | None) -> bool:
        accepted = False
        for message in self._codec.decode_datagram(data):
            refusal = self._refusal(message)
            if refusal is not None:
                self._tally.refuse(refusal)
                continue
            accepted = True
            # Only configured addresses are ever sent to, whatever claims to be a member.
            if sender is not None and sender in self._socket.destinations:
                now_s = asyncio.get_running_loop().time()
                self._addresses[message.sender_system] = (sender, now_s)
            match message:
                case Tunnel():
                    self._on_tunnel(message)
                case Heartbeat():
                    self._on_heartbeat(message.sender_system)
        return accepted

    def _refusal(self, message: Message) -> str | None:
        if message.sender_system == self._system_id:
            return "own echo"
        if message.sender_system not in self._members:
            return "not a member"
        if message.sender_component != COMPONENT_COMPANION:
            return "not a companion"
        match message:
            case Heartbeat():
                return None
            case Tunnel(target_system=target):
                return None if target in (0, self._system_id) else "tunnel for another system"
        return "not a peer's message"

    def _beat(self) -> None:
        self._socket.write(self._codec.heartbeat(_STATE_ACTIVE))

    async def _heartbeats(self) -> None:
        while True:
            await asyncio.sleep(_HEARTBEAT_S)
            self._beat()
