"""The frames of one round: asked of every member believed, several of those that are lost."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from vcl_companion.clock import Clock
from vcl_companion.daemon.frame_history import FURTHEST_NS
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.swarm.group import Group
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.messages import MAX_AGE_S, FrameRequest

_ASK_AGAIN_S = 1.0
# Earlier frames are a help, not a condition: who has none does not answer, and is not waited for.
_EARLIER_WAIT_S = 2.0
_IDS_A_ROUND = 16
# Who has not answered a whole round at all is given this long in the next ones, when all others
# have answered: it may have no camera, and each round would last for all of its time.
_DUMB_WAIT_S = 1.0
# An answer that comes up to so many rounds late is one as well: a slow link is waited for again.
_ROUNDS_LATE = 64


@dataclass(frozen=True)
class Wanted:
    """Which frames a round wants.

    Attributes:
        at_ns: the instant of every member's first one, our clock.
        members: who is asked.
        earlier: how many more of some members.
        spacing_s: time between a member's frames.
        timeout_s: how long to wait for all of them.
        furthest_ns: from its instant a frame may be, if it says where it was taken.
        needs_others: whether there is nothing to be made of our own frame alone.
    """

    at_ns: int
    members: tuple[int, ...]
    earlier: Mapping[int, int] = field(default_factory=dict)
    spacing_s: float = 1.0
    timeout_s: float = 20.0
    furthest_ns: int = FURTHEST_NS
    needs_others: bool = False

    def instant_ns(self, n: int) -> int:
        """Return the instant of a member's n-th frame, our clock."""
        return self.at_ns - round(n * self.spacing_s * 1e9)


@dataclass
class _FromPeer:
    """What one member has sent of this round; one request is open at a time."""

    frames: list[FrameAnswer] = field(default_factory=list)
    since_s: float = float("-inf")  # the open request's first asking
    asked_at_s: float = float("-inf")


class Gathering:
    """Asks peers for frames and takes in what was asked for; one round after the other.

    Args:
        group: whom to ask.
        ask: sends a request to a peer.
        clock: time base of frames.
        clocks: whose instants are when.
        rng: numbers the requests, so that a restarted coordinator's are not
            taken for those of its earlier life.
    """

    def __init__(
        self,
        group: Group,
        ask: Callable[[FrameRequest, int], None],
        clock: Clock,
        clocks: PeerClocks,
        rng: np.random.Generator,
    ) -> None:
        self._group = group
        self._ask = ask
        self._clock = clock
        self._clocks = clocks
        self._first_id = int(rng.integers(1 << 32))
        self._peers: dict[int, _FromPeer] | None = None  # None between rounds
        self._wanted: Wanted | None = None  # None until they are asked
        self._dumb: set[int] = set()  # who has answered nothing since a round waited for it in vain
        self._came = asyncio.Event()

    @property
    def request_id(self) -> int:
        """Of the round's first frames."""
        return self._first_id

    def take(self, peer: int, frame: FrameAnswer) -> str | None:
        """Take a peer's frame; return why it is refused, if it is."""
        if 0 < (self._first_id - frame.request_id) % (1 << 32) <= _ROUNDS_LATE * _IDS_A_ROUND:
            self._dumb.discard(peer)
        if self._peers is None or frame.drone_id != peer or peer not in self._peers:
            return "frame nobody asked for"
        sent = self._peers[peer]
        is_asked = sent.asked_at_s != float("-inf")  # the numbers of more can be guessed
        if not is_asked or frame.request_id != self._id_of(len(sent.frames)):
            return "frame nobody asked for"
        if self._is_of_another_instant(peer, frame, len(sent.frames)):
            return "frame of another instant than the one asked for"
        self._dumb.discard(peer)
        sent.frames.append(frame)
        sent.asked_at_s = sent.since_s = float("-inf")
        self._came.set()
        return None

    def begin(self) -> int:
        """Begin a round and return its request id; what is still open of the last one is not."""
        self._first_id = (self._first_id + _IDS_A_ROUND) % (1 << 32)
        self._peers = {}
        self._wanted = None
        return self._first_id

    async def gather(self, wanted: Wanted, is_over: Callable[[], bool]) -> list[FrameAnswer]:
        """Ask, again and again, until all asked have answered, time is up, or ``is_over``.

        Returns:
            What has come, of each member the latest frame first.
        """
        assert self._peers is not None, "a round has not begun"
        self._wanted = wanted
        self._dumb.intersection_update(self._group.alive)  # who comes back begins anew
        began_at_s = self._now_s()
        open_: list[int] = []
        try:
            async with asyncio.timeout(wanted.timeout_s):
                while not is_over():
                    open_ = self._awaited(wanted)
                    has_waited = self._now_s() >= began_at_s + _DUMB_WAIT_S
                    if not open_ or (has_waited and self._is_enough(open_, wanted)):
                        break
                    for peer in open_:
                        self._ask_for_next(peer, wanted)
                    await self._news()
        except TimeoutError:
            self._dumb.update(peer for peer in open_ if not self._peers[peer].frames)
        came = [frame for sent in self._peers.values() for frame in sent.frames]
        self._peers = None
        # Who is lost may have one frame for several instants: the last that had a fix.
        return list({(f.drone_id, f.captured_at_ns): f for f in came}.values())

    def _is_of_another_instant(self, peer: int, frame: FrameAnswer, n: int) -> bool:
        """Whether a frame is surely not the n-th one that was asked for.

        A peer that did not know our clock yet may have been misled by the way that the
        request took; it is asked again.
        """
        taken = self._clocks.instant(
            peer, frame.captured_at_ns, frame.frame_age_s, self._clock.now_ns()
        )
        if self._wanted is None or taken.bound_ns is None:
            return False
        # The peer knew our clock no better than we know its.
        off_ns = abs(taken.at_ns - self._wanted.instant_ns(n)) - 2 * taken.bound_ns
        is_placed = frame.world_from_body is not None
        return off_ns > (self._wanted.furthest_ns if is_placed else FURTHEST_NS)

    def _awaited(self, wanted: Wanted) -> list[int]:
        """Return whom to wait for: who is believed and has something still to come, ascending.

        An update is not held up until who has gone silent is lost: whoever is left flies on, and
        out of what the map shows. A first map waits for whoever may be there.
        """
        believed = set(self._group.trusted).intersection(wanted.members)
        return [
            member
            for member in sorted(believed)
            if (wanted.needs_others or not self._group.is_silent(member))
            and self._is_open(member, wanted)
        ]

    def _is_open(self, member: int, wanted: Wanted) -> bool:
        """Whether something of a member is still to come."""
        if member == self._group.own_id or self._peers is None:
            return False
        sent = self._peers.setdefault(member, _FromPeer())
        if not sent.frames:
            return True
        if len(sent.frames) > wanted.earlier.get(member, 0):
            return False
        return sent.since_s == float("-inf") or self._now_s() < sent.since_s + _EARLIER_WAIT_S

    def _is_enough(self, open_: list[int], wanted: Wanted) -> bool:
        """Whether what has come is worth a round without those who do not answer."""
        assert self._peers is not None
        has_others = any(sent.frames for sent in self._peers.values())
        return self._dumb.issuperset(open_) and (has_others or not wanted.needs_others)

    def _ask_for_next(self, peer: int, wanted: Wanted) -> None:
        assert self._peers is not None
        sent = self._peers[peer]
        now_s = self._now_s()
        if now_s < sent.asked_at_s + _ASK_AGAIN_S:
            return
        if sent.since_s == float("-inf"):
            sent.since_s = now_s
        sent.asked_at_s = now_s
        n = len(sent.frames)
        at_ns = wanted.instant_ns(n)
        age_s = min(max((self._clock.now_ns() - at_ns) * 1e-9, 0.0), MAX_AGE_S)
        self._ask(FrameRequest(self._id_of(n), at_ns, age_s), peer)

    async def _news(self) -> None:
        """Wait until something has come, or it is time to look again."""
        with suppress(TimeoutError):
            async with asyncio.timeout(_ASK_AGAIN_S / 4):
                self._came.clear()
                await self._came.wait()

    def _id_of(self, n: int) -> int:
        return (self._first_id + n) % (1 << 32)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
