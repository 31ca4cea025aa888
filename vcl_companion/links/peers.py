"""The link to the other drones: signed heartbeats, TUNNELs and the time, over one UDP socket."""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from vcl_companion.clock import Clock, Moment, system_moment
from vcl_companion.errors import ConfigError
from vcl_companion.links.counters import LinkCounters, LinkTally
from vcl_companion.links.kept_signing import KeptSigning
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    COMPONENT_COMPANION,
    Heartbeat,
    Message,
    Timesync,
    Tunnel,
    Untimely,
)
from vcl_companion.links.reconnect import Address
from vcl_companion.links.signing import (
    AHEAD,
    BEHIND,
    FORGED,
    NO_KEY,
    NOT_OURS,
    UNSIGNED,
    SigningOptions,
)
from vcl_companion.links.transport import open_peer_socket, parse_peers
from vcl_companion.swarm.pace import FULL_PACE_S, stretch_of

_log = logging.getLogger(__name__)

# A member that was silent for longer may have moved to another address: so many signs of life.
_ADDRESS_STALE = 5
_STATE_ACTIVE = 4
# Nobody who means it asks for the time more often.
_LEAST_BETWEEN_ANSWERS_S = 0.1
_QUESTION_BITS = 62
# What an answer's own clock says is of no use to anybody; only a question's is 0.
_ANSWERED = 1
# Refusals that somebody should see to, and what it may be; told once each.
_TELLING = {
    UNSIGNED: "is a drone without a key?",
    FORGED: "is the key the same on every drone?",
    NO_KEY: "has this drone no key?",
    NOT_OURS: "is there another drone with this system_id?",
    AHEAD: "a drone's clock is ahead of ours",
    BEHIND: "a drone's clock is behind ours",
}


@dataclass(frozen=True)
class PeerOptions:
    """Where the swarm talks.

    Attributes:
        listen: numeric IPv4 ADDRESS:PORT that this drone hears and sends from; for a
            multicast group the address of the interface to join on.
        to: numeric IPv4 ADDRESS:PORT of every other drone, or one broadcast address, or
            one multicast group.
        key_file: full path of the key that frames are signed with, the same on every drone;
            empty for none.
        timestamp_file: what signing remembers from one run to the next, a file for each
            daemon; empty: nothing, for which the host needs a clock that is never wrong.
        allow_unsigned: whether frames without a signature are taken.
    """

    listen: str = "0.0.0.0:14650"
    to: tuple[str, ...] = ()
    key_file: str = ""
    timestamp_file: str = "signing.json"
    allow_unsigned: bool = False

    def __post_init__(self) -> None:
        parse_peers(self.listen, self.to)
        if self.key_file and not Path(self.key_file).is_absolute():
            raise ConfigError(f"key_file: a full path is needed, got {self.key_file!r}")
        if self.to and not self.key_file and not self.allow_unsigned:
            raise ConfigError(
                "key_file: other drones in `to`, and no key to sign with: name a file here, "
                "run `vcl keys new` once and `vcl keys install` on each drone; or set "
                "allow_unsigned = true"
            )


def open_signing(options: PeerOptions, now: Callable[[], Moment] = system_moment) -> KeptSigning:
    """Return the signing of the peer link, with its key and what the last run has left.

    Raises:
        ConfigError: the key cannot be used, or timestamps cannot be kept.
    """
    if options.allow_unsigned and options.to:
        _log.warning("peers: frames are taken from whoever sends them (allow_unsigned)")
    strictness = SigningOptions(allow_unsigned=options.allow_unsigned)
    return KeptSigning(options.key_file, options.timestamp_file, strictness, now)


class PeerLink:
    """Our side of the swarm's link; everything happens in the event loop's thread.

    Args:
        options: where it talks.
        system_id: this drone.
        members: system ids of the swarm; nobody else is heard.
        on_tunnel: takes a payload for us or for everybody.
        on_heartbeat: takes the system id of a member that has shown itself.
        clock: what members that ask for the time are told.
        on_time: takes a member's answer about the time: system id, ts1, tc1.
        signing: of ``open_signing``.
        disk: does the writing that signing needs; None: the loop's own executor.
        stretch: tells how many times as rarely as in a small swarm heartbeats are sent.
    """

    def __init__(
        self,
        options: PeerOptions,
        system_id: int,
        members: frozenset[int],
        on_tunnel: Callable[[Tunnel], None],
        on_heartbeat: Callable[[int], None],
        clock: Clock,
        on_time: Callable[[int, int, int], None],
        signing: KeptSigning,
        disk: Executor | None = None,
        stretch: Callable[[], float] = lambda: 1.0,
    ) -> None:
        self._system_id = system_id
        self._members = members
        self._on_tunnel = on_tunnel
        self._on_heartbeat = on_heartbeat
        self._clock = clock
        self._on_time = on_time
        self._kept = signing
        self._disk = disk
        self._stretch = stretch
        self._address_stale_s = _ADDRESS_STALE * FULL_PACE_S * stretch_of(len(members))
        self._beat_at_s = float("-inf")
        self._tally = LinkTally()
        self._codec = Codec(
            system_id, COMPONENT_COMPANION, self._tally, signing.signing, signing.now
        )
        self._socket = open_peer_socket(options.listen, options.to, self._tally)
        self._addresses: dict[int, tuple[Address, float]] = {}
        self._told_time_at_s: dict[int, float] = {}
        self._told: set[str] = set()

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
            group.create_task(self._kept.run(self._disk))

    def send(self, payload_type: int, payload: bytes, target_system: int = 0) -> None:
        """Send a TUNNEL of at most 128 bytes to one member, or to all (0).

        One for a single member goes only to its address once that is known,
        else to everybody, who ignore it.

        Raises:
            ValueError: the payload is too long.
        """
        self._send(self._codec.tunnel(target_system, payload_type, payload), target_system)

    def ask_time(self, ts1_ns: int, target_system: int) -> None:
        """Ask a member for its time; the answer comes to ``on_time`` with this ``ts1_ns``."""
        self._send(self._codec.timesync(0, ts1_ns, target_system), target_system)

    def _send(self, frame: bytes, target_system: int) -> None:
        address, heard_at_s = self._addresses.get(target_system, (None, 0.0))
        silent_s = asyncio.get_running_loop().time() - heard_at_s
        if address is None or silent_s > self._address_stale_s:
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
            if isinstance(message, Untimely):
                self._hear_time(message)
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
                case Timesync(ts1_ns=number) if number < 0:
                    self._answer(message)
                case Timesync(tc1_ns=0):
                    self._tell_time(message)
                case Timesync():
                    self._on_time(message.sender_system, message.ts1_ns, message.tc1_ns)
        return accepted

    def _tell_time(self, question: Timesync) -> None:
        """Answer at once: every moment in between makes the answer vaguer."""
        asker, now_s = question.sender_system, asyncio.get_running_loop().time()
        if now_s - self._told_time_at_s.get(asker, float("-inf")) < _LEAST_BETWEEN_ANSWERS_S:
            self._tally.refuse("asked for the time too often")
            return
        now_ns = self._clock.now_ns()
        if now_ns > 0:  # a clock that has not been told the time yet has none to tell
            self._told_time_at_s[asker] = now_s
            self._send(self._codec.timesync(now_ns, question.ts1_ns, asker), asker)

    def _hear_time(self, message: Untimely) -> None:
        """Find out what time it is with a member that is not of our time (``swarm_time.py``)."""
        now, time = self._kept.now(), self._kept.signing.time
        said = message.timesync
        if said is not None and said.tc1_ns == 0:
            self._answer(said)
        elif said is not None:
            ahead_s = time.told(said.ts1_ns, message.timestamp, now)
            if ahead_s is not None:
                _log.warning(
                    "the swarm is %.0f s ahead of us, drone %d says: its time is ours now",
                    ahead_s,
                    message.sender_system,
                )
                return
        if message.ahead:
            number = -1 - secrets.randbits(_QUESTION_BITS)
            if time.asks(number, now):
                self._socket.write(self._codec.timesync(0, number))

    def _answer(self, said: Timesync) -> None:
        """Repeat the number of a question about the swarm's time, signed; else say nothing."""
        if said.tc1_ns != 0 or said.ts1_ns >= 0:
            return
        if self._kept.signing.time.answers(said.sender_system, self._kept.now()):
            self._socket.write(self._codec.timesync(_ANSWERED, said.ts1_ns))

    def _refusal(self, message: Message) -> str | None:
        if message.sender_system == self._system_id:
            return "own echo"
        if message.sender_system not in self._members:
            return "not a member"
        if message.sender_component != COMPONENT_COMPANION:
            return "not a companion"
        match message:
            case Heartbeat() | Untimely():
                return None
            # Below 0: of the swarm's time; no clock stands there.
            case Timesync(ts1_ns=number) if number < 0 and self._kept.signing.signs:
                return None
            case Tunnel(target_system=target):
                return None if target in (0, self._system_id) else "tunnel for another system"
            case Timesync(target_system=system, target_component=component):
                is_ours = (system, component) == (self._system_id, COMPONENT_COMPANION)
                return None if is_ours else "timesync for another"
        return "not a peer's message"

    def _beat(self) -> None:
        self._beat_at_s = asyncio.get_running_loop().time()
        self._socket.write(self._codec.heartbeat(_STATE_ACTIVE))

    async def _heartbeats(self) -> None:
        while True:
            await asyncio.sleep(FULL_PACE_S)
            # A turn comes a little early or late: due is what the next one would be too late for.
            since_s = asyncio.get_running_loop().time() - self._beat_at_s
            if since_s >= FULL_PACE_S * (self._stretch() - 0.5):
                self._beat()
            self._tell()

    def _tell(self) -> None:
        """Let the log say, once, what keeps drones from hearing each other."""
        refused = self._tally.snapshot().refused
        for reason in _TELLING.keys() & refused.keys() - self._told:
            self._told.add(reason)
            _log.warning("peers: a frame was refused: %s (%s)", reason, _TELLING[reason])
