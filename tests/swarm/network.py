"""A bad network between transfers in one process: loss, delay, reordering, duplication.

The bytes go through the real wire format both ways; time is counted, not waited for.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.swarm.budget import FRAME_OVERHEAD_BYTES
from vcl_companion.swarm.transfer import (
    BlobDelivered,
    BlobReceived,
    Event,
    Outgoing,
    TransferFailed,
    TransferOptions,
    Transfers,
)
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.tunnel import PayloadType, TunnelPayload, decode_payload


@dataclass(frozen=True)
class Weather:
    """What the network does to payloads; seconds and shares of one.

    ``radio_bytes_per_s``: what a sender's radio takes; the rest of a frame waits in it.
    """

    loss: float = 0.0
    duplicates: float = 0.0
    corrupt: float = 0.0
    delay_s: float = 0.005
    jitter_s: float = 0.0
    radio_bytes_per_s: float = math.inf


CALM = Weather()
DEFAULTS = TransferOptions()


@dataclass
class Network:
    """Some drones, the air between them, and everything that happened.

    Where it ``is_shared``, what is sent to all is sent once and heard by each in its own
    weather; else it is sent to each.
    """

    weather: Weather = CALM
    options: TransferOptions = DEFAULTS
    seed: int = 0
    is_shared: bool = False
    now_s: float = 100.0
    n_bytes: int = 0
    n_payloads: int = 0
    log: list[tuple[float, int, Event]] = field(default_factory=list)
    heard: list[tuple[float, int, TunnelPayload]] = field(default_factory=list)
    drones: dict[int, Transfers] = field(default_factory=dict)
    is_up: Callable[[float], bool] = lambda now_s: True

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)
        self._in_flight: list[tuple[float, int, int, int, bool, PayloadType, bytes]] = []
        self._radio_free_at_s: dict[int, float] = {}
        self._order = itertools.count()

    def add(self, drone: int) -> Transfers:
        """Start a drone, or start it again with nothing remembered."""
        transfers = Transfers(self.options, np.random.default_rng([self.seed, drone]))
        if self.is_shared:
            transfers.reaches_all_with(1)
        self.drones[drone] = transfers
        return transfers

    def run(self, until_s: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Let time pass until ``until_s``, until nothing is left to do, or ``stop``."""
        while not stop():
            polls = [t for d in self.drones.values() if (t := d.next_poll_s()) is not None]
            arrivals = [self._in_flight[0][0]] if self._in_flight else []
            at_s = max(min([*polls, *arrivals], default=until_s), self.now_s)
            if at_s >= until_s:
                self.now_s = max(until_s, self.now_s)
                return
            self.now_s = at_s
            self._deliver()
            for drone, transfers in self.drones.items():
                due_s = transfers.next_poll_s()
                if due_s is not None and due_s <= self.now_s:
                    self._poll(drone, transfers)

    def events(self, drone: int, *kinds: type[Event]) -> list[Event]:
        """Return what happened at a drone, of some kinds."""
        return [event for _, at, event in self.log if at == drone and isinstance(event, kinds)]

    def ends(self) -> list[Event]:
        """Return how outgoing transfers ended, of all drones."""
        kinds = (BlobDelivered, TransferFailed)
        return [event for _, _, event in self.log if isinstance(event, kinds)]

    def blobs(self, drone: int) -> list[bytes]:
        """Return the blobs that a drone was handed."""
        return [e.blob for e in self.events(drone, BlobReceived) if isinstance(e, BlobReceived)]

    def _poll(self, drone: int, transfers: Transfers) -> None:
        outgoing, events = transfers.poll(self.now_s)
        self._note(drone, events)
        for sent in outgoing:
            to_all = sent.peer == 0
            peers = [d for d in self.drones if d != drone] if to_all else [sent.peer]
            for _ in range(1 if self.is_shared else len(peers)):
                self.n_bytes += len(sent.payload)
                self.n_payloads += 1
                sent_at_s = self._through_the_radio(drone, sent)
            for peer in peers:
                self._transmit(drone, peer, to_all, sent, sent_at_s)

    def _through_the_radio(self, drone: int, sent: Outgoing) -> float:
        """Return when a frame has left a drone's radio, behind those that wait there."""
        n_bytes = len(sent.payload) + FRAME_OVERHEAD_BYTES
        begins_s = max(self.now_s, self._radio_free_at_s.get(drone, self.now_s))
        self._radio_free_at_s[drone] = begins_s + n_bytes / self.weather.radio_bytes_per_s
        return self._radio_free_at_s[drone]

    def _transmit(
        self, sender: int, receiver: int, to_all: bool, sent: Outgoing, sent_at_s: float
    ) -> None:
        copies = 1 + int(self._rng.uniform() < self.weather.duplicates)
        for _ in range(copies):
            if self._rng.uniform() < self.weather.loss or not self.is_up(self.now_s):
                continue
            payload = bytearray(sent.payload)
            if self._rng.uniform() < self.weather.corrupt:
                payload[int(self._rng.integers(len(payload)))] ^= int(self._rng.integers(1, 256))
            at_s = sent_at_s + self.weather.delay_s
            at_s += self.weather.jitter_s * float(self._rng.uniform())
            entry = (at_s, next(self._order), sender, receiver, to_all)
            heapq.heappush(self._in_flight, (*entry, sent.payload_type, bytes(payload)))

    def _deliver(self) -> None:
        while self._in_flight and self._in_flight[0][0] <= self.now_s:
            _, _, sender, receiver, to_all, payload_type, payload = heapq.heappop(self._in_flight)
            if receiver not in self.drones:
                continue
            try:
                message = decode_payload(payload_type, payload)
            except WireError:
                continue
            if isinstance(message, Chunk | TransferStatus):
                transfers = self.drones[receiver]
                events = transfers.receive(sender, message, self.now_s, to_all=to_all)
                self._note(receiver, events)
            else:
                self.heard.append((self.now_s, receiver, message))

    def _note(self, drone: int, events: list[Event]) -> None:
        self.log += [(self.now_s, drone, event) for event in events]
