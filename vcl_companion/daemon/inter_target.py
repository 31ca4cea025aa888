"""The target's side of inter-MAV localization (IV-E): whom to ask, and what to make of answers."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.estimator import HISTORY_S
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.worst_sigma import worst_sigma
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.pose_requests import HostChoice, InterMavOptions
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRefused,
    PoseRequest,
    encode_pose_request,
)

_log = logging.getLogger(__name__)

# Requests without an answer, with the host that owes it: to tell late answers from wrong ones.
_N_GIVEN_UP = 64


@dataclass(eq=False)
class Asked:
    """One request, and what has come of it.

    Attributes:
        request_id: of it.
        frame: the one that the pose is wanted of.
        ned_from_body: (3, 3) attitude of its instant, or None.
        revision: of the map that the pose is wanted in.
        sigma_m: what is known of it without; infinite for nothing.
        waiting: hosts that have not answered yet.
        proposals: host and what it said, not yet handed over.
    """

    request_id: int
    frame: Frame
    ned_from_body: Array | None
    revision: bytes
    sigma_m: float
    waiting: set[int]
    proposals: list[tuple[int, PoseProposal]] = field(default_factory=list)
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def handed_over(self) -> list[tuple[int, PoseProposal]]:
        """Take the proposals that have come, the surest first."""
        taken, self.proposals = self.proposals, []
        return sorted(taken, key=lambda said: _sigma_m(said[1]))

    async def all_answered(self, within_s: float) -> None:
        """Wait until no answer is owed any more, or the time is over."""
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self.waiting:
                    self.changed.clear()
                    await self.changed.wait()


class InterTarget:
    """Asks hosts for our pose, one request at a time; all in the event loop's thread.

    Args:
        system_id: this drone.
        hosts: whom to ask.
        sensor: of our camera.
        clock: time base of frames.
        work: does the encoding.
        hand: sends a blob of a request to a peer; returns the transfer's id.
        cancel: ends a transfer, one that is over already too.
        judged: told of every proposal whether it fits what we know ourselves: the peer, and
            how it does not.
        for_peers: how an attitude of an instant is told to peers (``Estimator.for_peers``).
        carried_in_s: how long our link takes to carry so many bytes to one peer.
        options: how often, how many, how long.
        rng: numbers the requests.
        only_the_surer: whether a localized frame asks only while a peer may know better
            than we do; else the paper's way, every so many frames whatever came of it.
    """

    def __init__(
        self,
        system_id: int,
        hosts: HostChoice,
        sensor: Sensor,
        clock: Clock,
        work: MapWork,
        hand: Callable[[int, bytes], int],
        cancel: Callable[[int], None],
        for_peers: Callable[[int, Array | None], tuple[Array | None, bool]],
        carried_in_s: Callable[[int], float],
        judged: Callable[[int, str], None],
        options: InterMavOptions,
        rng: np.random.Generator,
        only_the_surer: bool,
    ) -> None:
        self._system_id = system_id
        self._hosts = hosts
        self._sensor = sensor
        self._clock = clock
        self._work = work
        self._only_the_surer = only_the_surer
        self._hand = hand
        self._cancel = cancel
        self._for_peers = for_peers
        self._carried_in_s = carried_in_s
        self.judged = judged
        self._options = options
        self._request_id = int(rng.integers(1 << 32))
        self._n_since = 0
        self._last_at_ns: int | None = None
        self._was_in_vain = False
        self._is_open = False
        self._asked: dict[int, Asked] = {}
        self._given_up: deque[tuple[int, int]] = deque(maxlen=_N_GIVEN_UP)

    def begin(
        self, frame: Frame, ned_from_body: Array | None, revision: bytes, sigma_m: float
    ) -> Asked | None:
        """Decide whether a frame is asked about; call ``ask`` with what is returned.

        Args:
            frame: the newest.
            ned_from_body: (3, 3) its attitude, or None.
            revision: of our map.
            sigma_m: of our position at it, in its worst direction; infinite when
                the frame was refused.

        Returns:
            The request, or None: not due, one is open, or nobody can be asked.
        """
        self._n_since += math.isfinite(sigma_m)
        every_n = self._options.every_n_frames
        at_ns = frame.captured_at_ns
        is_weak = sigma_m > self._options.weak_sigma_m
        if every_n == 0 or self._is_open or not (is_weak or self._n_since >= every_n):
            return None
        # Where nobody could tell, nobody can a frame later, and hosts that look for it all the
        # time make no map that would help.
        if (self._was_in_vain or not is_weak) and not self._is_long_ago(at_ns):
            return None
        if (
            self._only_the_surer
            and math.isfinite(sigma_m)
            and not self._hosts.may_know_better(revision, at_ns, is_weak=is_weak)
        ):
            return None
        hosts = self._hosts.choose(revision, self._n_hosts())
        if not hosts:
            return None
        self._n_since = 0
        self._last_at_ns = at_ns
        self._is_open = True
        self._request_id = (self._request_id + 1) % (1 << 32)
        asked = Asked(self._request_id, frame, ned_from_body, revision, sigma_m, set(hosts))
        self._asked[asked.request_id] = asked
        return asked

    def _n_hosts(self) -> int:
        """Return how many can be asked so that what they answer is not too old by then."""
        carried_s = self._carried_in_s(self._options.request_bytes)
        return max(min(self._options.max_hosts, int(HISTORY_S / carried_s)), 1)

    def _is_long_ago(self, at_ns: int) -> bool:
        """Whether the last request was made long enough before an instant."""
        if self._last_at_ns is None:
            return True
        return at_ns - self._last_at_ns >= round(1e9 * self._options.least_interval_s)

    async def ask(self, asked: Asked) -> list[tuple[int, PoseProposal]]:
        """Send the request, and wait until all have answered or it has been time to.

        ``wait_s`` is for the answers: how long a link takes to carry the request comes on top,
        as long as what is answered can still be fused.

        Returns:
            Host and proposal, the surest first; what comes later, ``stragglers`` has.
        """
        transfers = []
        try:
            blob = await self._blob(asked)
            transfers = [self._hand(host, blob) for host in sorted(asked.waiting)]
            carried_s = len(transfers) * self._carried_in_s(len(blob))
            most_s = max(self._options.wait_s, HISTORY_S)
            await asked.all_answered(min(self._options.wait_s + carried_s, most_s))
        except ValueError as error:
            asked.waiting.clear()
            _log.warning("no request for a pose: %s", error)
        finally:
            self._is_open = False
            for transfer_id in transfers:
                self._cancel(transfer_id)  # a fresher one is coming
        said = asked.handed_over()
        self._was_in_vain = not said
        return said

    async def stragglers(self, asked: Asked) -> list[tuple[int, PoseProposal]]:
        """Wait for answers as long as they can still be fused, and forget the request."""
        try:
            await asked.all_answered(HISTORY_S)
            return asked.handed_over()
        finally:
            self._asked.pop(asked.request_id, None)
            self._given_up.extend((asked.request_id, host) for host in sorted(asked.waiting))
            for host in asked.waiting:
                self._hosts.unanswered(host, asked.sigma_m, asked.frame.captured_at_ns)

    def take(self, peer: int, answer: PoseProposal | PoseRefused) -> str | None:
        """Take a host's answer.

        Returns:
            None, or why it is refused: the host was not asked, has answered before, or
            took so long that our own history does not reach there any more.
        """
        asked = self._asked.get(answer.request_id)
        if asked is None and (answer.request_id, peer) in self._given_up:
            self._given_up.remove((answer.request_id, peer))
            return "pose that comes too late to be fused"
        if asked is None or peer not in asked.waiting:
            return "pose nobody asked for"
        sigma_m, refusal = math.inf, None
        if isinstance(answer, PoseProposal):
            if answer.revision != asked.revision:
                return "pose nobody asked for"
            sigma_m = _sigma_m(answer)
            if sigma_m <= self._options.max_sigma_m:
                asked.proposals.append((peer, answer))
            else:
                refusal = "pose vaguer than any is proposed"
        else:
            _log.debug("drone %d proposes no pose: %s", peer, answer.reason)
        self._hosts.answered(peer, sigma_m, asked.sigma_m, asked.frame.captured_at_ns)
        self._answered(asked, peer)
        return refusal

    def lost(self, peer: int) -> None:
        """Note that a peer will not answer: it is silent, or the request did not get there."""
        self._hosts.lost(peer)
        for asked in self._asked.values():
            if peer in asked.waiting:
                self._answered(asked, peer)

    def _answered(self, asked: Asked, peer: int) -> None:
        asked.waiting.remove(peer)
        asked.changed.set()

    async def _blob(self, asked: Asked) -> bytes:
        """Return the encoded request.

        Raises:
            ValueError: the frame cannot be encoded, or is larger than peers accept.
        """
        image_bytes = await self._work.encode(
            np.asarray(asked.frame.image),
            self._options.request_quality,
            self._options.request_bytes,
        )
        attitude, has_heading = self._for_peers(asked.frame.captured_at_ns, asked.ned_from_body)
        frame = FrameAnswer(
            drone_id=self._system_id,
            request_id=asked.request_id,
            captured_at_ns=asked.frame.captured_at_ns,
            frame_age_s=max(self._clock.now_ns() - asked.frame.captured_at_ns, 0) * 1e-9,
            ned_from_body=attitude,
            body_from_cam=self._sensor.body_from_cam,
            camera=self._sensor.camera,
            image_bytes=image_bytes,
            has_heading=has_heading,
        )
        return encode_pose_request(PoseRequest(asked.revision, frame))


def _sigma_m(proposal: PoseProposal) -> float:
    """Return the position's 1 sigma in its worst direction, m."""
    return worst_sigma(proposal.covariance[:3, :3])
