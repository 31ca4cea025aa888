"""Revisions handed to a group in any order, with any loss, duplication and restarts.

Everybody ends with the newest revision, or it is said why not: the sender has a failure for it.
"""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from tests.swarm.network import Network, Weather
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.transfer import BlobKind, BlobReceived, TransferFailed, TransferOptions
from vcl_companion.wire.map_codec import revision_of
from vcl_companion.wire.messages import MapState

MEMBERS = (1, 2, 3)
OPTIONS = TransferOptions(rate_bytes_per_s=20_000.0, status_interval_s=0.1, give_up_s=5.0)
SETTLES_S = 400.0


class Revisions(RuleBasedStateMachine):
    """Drone 1 makes revisions and hands each to those that lack it, in the place of the last."""

    def __init__(self) -> None:
        super().__init__()
        self.network = Network(options=OPTIONS)
        self.group = Group(SwarmOptions(MEMBERS), 1)
        self.n_made = 0
        self.newest = b""
        self.handed: dict[int, tuple[bytes, int]] = {}
        self.held: dict[int, bytes] = {}
        self.n_read = 0

    @initialize(
        seed=st.integers(0, 2**16),
        loss=st.floats(0.0, 0.6),
        duplicates=st.floats(0.0, 0.5),
        jitter_s=st.floats(0.0, 1.0),
        is_shared=st.booleans(),
    )
    def begins(
        self, seed: int, loss: float, duplicates: float, jitter_s: float, is_shared: bool
    ) -> None:
        weather = Weather(loss=loss, duplicates=duplicates, jitter_s=jitter_s)
        self.network = Network(weather, OPTIONS, seed, is_shared)
        for member in MEMBERS:
            self.network.add(member)

    @precondition(lambda self: self.n_made < 4)
    @rule(n_bytes=st.integers(1, 30_000))
    def a_revision_is_made(self, n_bytes: int) -> None:
        self.n_made += 1
        self.newest = np.random.default_rng([self.n_made, n_bytes]).bytes(n_bytes)
        self.hand_out()

    @rule(seconds=st.floats(0.0, 3.0))
    def time_passes(self, seconds: float) -> None:
        self.network.run(self.network.now_s + seconds)
        self.read()
        self.hand_out()

    @rule(member=st.sampled_from(MEMBERS[1:]))
    def a_receiver_restarts(self, member: int) -> None:
        self.network.add(member)
        self.held.pop(member, None)
        self.tell(member)
        self.hand_out()

    @rule()
    def the_giver_restarts_with_its_map(self) -> None:
        self.network.add(1)
        self.handed.clear()
        self.hand_out()

    def read(self) -> None:
        """Fly on what has come whole, and have the coordinator hear of it."""
        for _, member, event in self.network.log[self.n_read :]:
            if isinstance(event, BlobReceived):
                self.held[member] = event.blob
                self.tell(member)
            if isinstance(event, TransferFailed):
                self.handed.pop(event.peer, None)
        self.n_read = len(self.network.log)

    def tell(self, member: int) -> None:
        blob = self.held.get(member)
        state = MapState(revision_of(blob) if blob else b"", 0, bool(blob))
        self.group.map_state(member, state, self.network.now_s)

    def hand_out(self) -> None:
        """Hand the newest to those that lack it, as ``MapHanding`` does."""
        if not self.newest:
            return
        self.group.set_own_state(MapState(revision_of(self.newest), 0, True))
        giver = self.network.drones[1]
        holders = self.group.maps.holders(revision_of(self.newest))
        for peer in [member for member in MEMBERS if member not in holders]:
            blob, sent_id = self.handed.get(peer, (b"", 0))
            if blob and blob != self.newest:
                giver.cancel(sent_id)
            sent_id = giver.submit(peer, BlobKind.MAP, self.newest, self.network.now_s)
            self.handed[peer] = self.newest, sent_id

    def teardown(self) -> None:
        until_s = self.network.now_s + SETTLES_S
        failed: set[int] = set()
        while self.newest and self.network.now_s < until_s:
            n_read = self.n_read
            self.network.run(self.network.now_s + 1.0)
            self.read()
            ends = [event for _, _, event in self.network.log[n_read:]]
            failed |= {event.peer for event in ends if isinstance(event, TransferFailed)}
            if {self.held.get(member) for member in MEMBERS[1:]} == {self.newest}:
                break
            self.hand_out()
        for member in MEMBERS[1:]:
            assert not self.newest or self.held.get(member) == self.newest or member in failed


TestRevisions = Revisions.TestCase
TestRevisions.settings = settings(max_examples=25, stateful_step_count=12, deadline=None)
