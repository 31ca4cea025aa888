"""The host's side of inter-MAV localization (IV-E): where the drone is that took a frame.

The scene does not move, so the host's own frame need not be of the same
instant: it is the one nearest in time whose pose it believes.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.mailbox import PeerMailbox
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.errors import WireError
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.inter import NoProposal, Proposal
from vcl_companion.localization.map_index import MapIndex
from vcl_companion.swarm.pose_requests import MOST_REQUEST_BYTES
from vcl_companion.vision.features import Detector
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.pose_messages import (
    PoseProposal,
    PoseRefused,
    PoseRequest,
    decode_pose_request,
)

_log = logging.getLogger(__name__)

# Our own frame of that moment may be being looked at right now.
_SETTLE_S = 0.5
# Looking costs a fifth of a second of one core: of a peer's requests one in so long is looked at,
# and no more than half of the time goes by with them. Who asks sooner is answered later.
_EVERY_S = 0.5
# Of a request's image. A swarm whose map has larger frames has cameras for it.
_MOST_PX = 1 << 21
# The map may have to be indexed by our detector first, behind an update that is being built.
_INDEX_WAIT_S = 3.0


class InterHost:
    """Answers the targets' requests, one after the other, the newest of each only, now and then.

    Args:
        maps: the current map.
        frames: our own.
        estimator: what we believed when these were taken.
        answer: sends a message to a peer.
        malformed: told of bytes that no drone sends: peer, kind, what is wrong with them.
        why_not: says why nothing is done for a peer; empty if it is.
        clock: time base of frames.
        clocks: whose instants are when.
        work: does the vision, beside our own frames'.
        detector: the paper's way finds peers by it.
        indexed_by: detectors that the daemon indexes its maps by, some only when asked to.
        tries_all: whether every index that there is is tried before the request is refused;
            else only that by ``detector``, which is waited for: the paper's way.
    """

    def __init__(
        self,
        maps: MapStore,
        frames: FrameHistory,
        estimator: Estimator,
        answer: Callable[[PoseProposal | PoseRefused, int], None],
        malformed: Callable[[int, str, WireError], None],
        why_not: Callable[[int], str],
        clock: Clock,
        clocks: PeerClocks,
        work: MapWork,
        detector: Detector,
        indexed_by: tuple[Detector, ...],
        *,
        tries_all: bool,
    ) -> None:
        self._maps = maps
        self._frames = frames
        self._estimator = estimator
        self._answer = answer
        self._malformed = malformed
        self._why_not = why_not
        self._clock = clock
        self._clocks = clocks
        self._work = work
        self._detector: Detector = detector
        self._is_made = detector in indexed_by
        self._tries_all = tries_all
        self._requests: PeerMailbox[tuple[int, bytes]] = PeerMailbox()
        self._next_at_s: dict[int, float] = {}  # of each peer

    def offer(self, peer: int, blob: bytes) -> None:
        """Take a peer's request; looked at when its turn comes, unless a newer one is there."""
        self._requests.put(peer, (self._clock.now_ns(), blob))

    async def run(self) -> None:
        """Answer requests until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            peer, (came_at_ns, blob) = await self._requests.take()
            began_s = loop.time()
            wait_s = self._next_at_s.get(peer, began_s) - began_s
            if wait_s > 0.0:
                self._requests.put_later(peer, (came_at_ns, blob), wait_s)
                continue
            try:
                request = decode_pose_request(blob)
                if request.frame.drone_id != peer:
                    raise WireError(f"the frame of drone {request.frame.drone_id}")
            except WireError as error:
                self._malformed(peer, "pose request", error)
                continue
            self._answer(await self._answer_to(request, came_at_ns), peer)
            now_s = loop.time()
            self._next_at_s[peer] = max(began_s + _EVERY_S, 2.0 * now_s - began_s)

    async def _answer_to(self, request: PoseRequest, came_at_ns: int) -> PoseProposal | PoseRefused:
        request_id = request.frame.request_id
        found = await self._found(request, came_at_ns)
        if isinstance(found, NoProposal):
            return PoseRefused.because(request_id, found.reason)
        try:
            return PoseProposal.of(
                request_id, request.revision, found.world_from_body, found.covariance
            )
        except ValueError as error:
            return PoseRefused.because(request_id, str(error))

    async def _found(self, request: PoseRequest, came_at_ns: int) -> Proposal | NoProposal:
        stored = self._maps.current
        # While an update goes round its first holders are those who see where the target is:
        # a revision and the one that it was made from tell of the same world.
        if stored is None or request.revision not in (stored.revision, stored.parent):
            return NoProposal("the host flies on another map")
        asked = request.frame
        why_not = self._why_not(asked.drone_id) or _too_large(asked, stored)
        if why_not:
            return NoProposal(why_not)
        instant = self._clocks.instant(
            asked.drone_id, asked.captured_at_ns, asked.frame_age_s, came_at_ns
        )
        own = await self._own_near(instant.at_ns)
        if own is None:
            return NoProposal("the host does not know where it was then")
        stored = await self._indexed(stored)
        try:
            said = await self._work.place_of_peer(*own, stored, request.frame)
        except ValueError as error:
            return NoProposal(str(error))
        except Exception as error:
            # Peers' images and numbers went in: none of them may end the flight.
            _log.exception("a pose request cannot be worked on")
            return NoProposal(f"looking failed: {type(error).__name__}")
        if isinstance(said, NoProposal) and _index_by(self._detector, stored) is None:
            self._maps.want_more()  # it will be asked again
        return said

    async def _indexed(self, stored: StoredMap) -> StoredMap:
        """Return the map, with an index by our detector if that is wanted and made in time."""
        if self._tries_all or not self._is_made or _index_by(self._detector, stored) is not None:
            return stored
        self._maps.want_more()
        with suppress(TimeoutError):
            async with asyncio.timeout(_INDEX_WAIT_S):
                await self._maps.newer_than(stored)
        current = self._maps.current
        is_same = current is not None and current.revision == stored.revision
        return current if is_same and current is not None else stored

    async def _own_near(self, at_ns: int) -> tuple[Frame, FilterState] | None:
        """Return our frame nearest to an instant that had a fix, and what we believed then."""
        frames = self._frames.near(at_ns)
        if frames:
            await self._estimator.in_sight.looked_at(frames[0].captured_at_ns, _SETTLE_S)
        for frame in frames:
            state = self._estimator.own_fix_at(frame.captured_at_ns)
            if state is not None:
                return frame, state
        return None


def _too_large(asked: FrameAnswer, stored: StoredMap) -> str:
    """Say why a request's image is not looked at; empty if it is."""
    n_px = asked.camera.width_px * asked.camera.height_px
    cameras = [keyframe.camera for keyframe in stored.index.landmark_map.keyframes]
    most_px = max(_MOST_PX, *(camera.width_px * camera.height_px for camera in cameras))
    if n_px > most_px:
        return f"a frame of {n_px} pixels, at most {most_px}"
    if len(asked.image_bytes) > MOST_REQUEST_BYTES:
        return f"an image of {len(asked.image_bytes)} bytes, at most {MOST_REQUEST_BYTES}"
    return ""


def _index_by(detector: Detector, stored: StoredMap) -> MapIndex | None:
    """Return a map's index by a detector, if there is one."""
    known: MapIndex | None = stored.index
    while known is not None and known.detector != detector:
        known = known.fallback
    return known
