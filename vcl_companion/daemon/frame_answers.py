"""Our frames as peers get them: with attitude and calibration, the same for the same request."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_choice import FrameChoice
from vcl_companion.daemon.mailbox import PeerMailbox
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.own_fixes import ATTITUDE_WAIT_S
from vcl_companion.daemon.peer_clocks import PeerClocks
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.localization.detail import Detail, needed_detail
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.peer_time import Instant
from vcl_companion.wire.frame_codec import FrameAnswer, encode_frame
from vcl_companion.wire.messages import FrameRequest

_log = logging.getLogger(__name__)

# Only a coordinator asks; where not all hear each other, or do not agree yet who that is, there may
# be several. Who is not ours is given a frame now and then: each costs as much as ten seconds of
# all else that is said.
_MAX_ASKERS = 4
_OTHERS_EVERY_S = 10.0


@dataclass(frozen=True)
class _Wanted:
    """What a peer asked for, in our time."""

    request_id: int
    instant: Instant


@dataclass(frozen=True)
class _Given:
    """The last answer to a peer, and of which instant it was."""

    wanted: _Wanted
    blob: bytes

    def answers(self, wanted: _Wanted) -> bool:
        """Whether a request, come again, is about the same frame as far as known.

        One that was found by its age, before the clocks were related, is looked for again.
        """
        was_known, is_known = (w.instant.bound_ns is not None for w in (self.wanted, wanted))
        return self.wanted.request_id == wanted.request_id and (was_known or not is_known)


@dataclass(frozen=True)
class _Over:
    """What became of the transfer of a peer's last answer, and when; to the request of a number."""

    request_id: int
    at_s: float
    delivered: bool


class FrameAnswers:
    """Answers peers' requests for our frames, one after the other; silent when there is none.

    The last answer to a peer is kept for when it asks again, as often as it likes, while that is on
    its way. One that was delivered is over, and not given again so soon.

    Args:
        system_id: this drone.
        choice: chooses which of ours a request is answered with.
        maps: what they may extend.
        autopilot: for the attitude that goes with a frame.
        estimator: for the pose that goes with it.
        sensor: of our camera.
        clock: time base of frames.
        clocks: whose instants are when.
        log: told of a frame that cannot be sent.
        work: does the encoding.
        hand: sends an answer to a peer, and to whoever may hear it too; returns the transfers' ids.
        cancel: ends a transfer, one that is over already too.
        given: told of every frame that is given to a peer.
        image_bytes: of an image, at most.
    """

    def __init__(
        self,
        system_id: int,
        choice: FrameChoice,
        maps: MapStore,
        autopilot: AutopilotLink,
        estimator: Estimator,
        sensor: Sensor,
        clock: Clock,
        clocks: PeerClocks,
        log: FlightLog,
        work: MapWork,
        hand: Callable[[int, bytes], tuple[int, ...]],
        cancel: Callable[[int], None],
        given: Callable[[FrameAnswer], None],
        image_bytes: int,
    ) -> None:
        self._system_id = system_id
        self._choice = choice
        self._maps = maps
        self._autopilot = autopilot
        self._estimator = estimator
        self._sensor = sensor
        self._clock = clock
        self._clocks = clocks
        self._log = log
        self._work = work
        self._hand = hand
        self._cancel = cancel
        self._note_given = given
        self._image_bytes = image_bytes
        self._wanted: PeerMailbox[_Wanted] = PeerMailbox()
        self._given: dict[int, _Given] = {}
        self._on_its_way: dict[int, tuple[int, ...]] = {}
        self._sent: dict[int, tuple[int, int]] = {}  # request and transfer, to who has asked
        self._over: dict[int, _Over] = {}
        self._of_others: dict[int, tuple[int, float]] = {}  # members' that do not coordinate

    def want(self, peer: int, request: FrameRequest, *, leads: bool) -> bool:
        """Take a peer's request; a newer one of the same peer replaces it.

        Args:
            peer: who asks.
            request: for which frame.
            leads: whether it is our coordinator, as far as we know.

        Returns:
            Whether it was taken: others may ask again, but for another frame not so soon.
        """
        if not leads and not self._is_time_for(peer, request.request_id):
            return False
        instant = self._clocks.instant(
            peer, request.at_ns, request.frame_age_s, self._clock.now_ns()
        )
        self._wanted.put(peer, _Wanted(request.request_id, instant))
        return True

    def _is_time_for(self, peer: int, request_id: int) -> bool:
        """Whether who does not coordinate may ask for this frame now."""
        now_s = asyncio.get_running_loop().time()
        last_id, taken_at_s = self._of_others.get(peer, (None, -math.inf))
        over = self._over.get(peer)
        if request_id == last_id and (over is None or over.request_id != request_id):
            return True
        if now_s < taken_at_s + _OTHERS_EVERY_S:
            return False
        self._of_others[peer] = request_id, now_s
        return True

    async def run(self) -> None:
        """Answer until cancelled."""
        while True:
            peer, wanted = await self._wanted.take()
            try:
                blob = await self._blob_for(peer, wanted)
            except ValueError as error:
                self._log.event("no answer", f"to drone {peer}: {error}")
                _log.warning("no frame for drone %d: %s", peer, error)
                continue
            except Exception:
                # A peer's map went in: it may not end the flight.
                _log.exception("no frame for drone %d", peer)
                continue
            if blob is None:
                continue
            sent = self._hand(peer, blob)
            for before in set(self._on_its_way.get(peer, ())).difference(sent):
                self._cancel(before)  # it wants another one by now
            self._on_its_way[peer] = sent
            self._sent[peer] = wanted.request_id, sent[0]
            self._over.pop(peer, None)

    def ended(self, peer: int, transfer_id: int, *, delivered: bool) -> None:
        """Note that a transfer to a peer is over, one of ours or any other."""
        request_id, own_id = self._sent.get(peer, (0, None))
        if own_id == transfer_id:
            now_s = asyncio.get_running_loop().time()
            self._over[peer] = _Over(request_id, now_s, delivered)

    def _has_it(self, peer: int, request_id: int) -> bool:
        """Whether a peer has just been delivered the answer to a request."""
        over, now_s = self._over.get(peer), asyncio.get_running_loop().time()
        if over is None or not over.delivered or now_s >= over.at_s + _OTHERS_EVERY_S:
            return False
        return over.request_id == request_id

    async def _blob_for(self, peer: int, wanted: _Wanted) -> bytes | None:
        """Return the encoded answer to a request, or None when there is none to be given.

        Asked again, the very same bytes: an answer on its way is not begun anew.

        Raises:
            ValueError: the frame is larger than peers accept.
        """
        given = self._given.get(peer)
        if given is not None and given.answers(wanted):
            return None if self._has_it(peer, wanted.request_id) else given.blob
        frame = await self._choice.of(wanted.instant.at_ns)
        if frame is None:
            return None
        answer = await self.describe(frame, wanted.request_id)
        blob = encode_frame(answer)
        self._note_given(answer)
        self._given.pop(peer, None)
        self._given[peer] = _Given(wanted, blob)
        if len(self._given) > _MAX_ASKERS:
            del self._given[next(iter(self._given))]
        return blob

    async def describe(self, frame: Frame, request_id: int) -> FrameAnswer:
        """Make the answer that shows one of our frames.

        Raises:
            ValueError: the frame is over an hour old, or cannot be encoded.
        """
        at_ns = frame.captured_at_ns
        self._choice.gave(frame)
        attitude = await self._autopilot.attitudes.at(at_ns, ATTITUDE_WAIT_S)
        detail = await self.detail(frame)
        state = self._estimator.own_fix_at(at_ns)
        ned_from_body, has_heading = self._estimator.for_peers(
            at_ns, None if attitude is None else attitude.ned_from_body
        )
        image_bytes = await self._work.encode_keyframe(
            np.asarray(frame.image), self._image_bytes, detail
        )
        stored, seen = self._maps.current, None
        if stored is not None and state is not None and stored.templates is not None:
            seen = await self._work.seen(np.asarray(frame.image), stored, state.prior())
        return FrameAnswer(
            drone_id=self._system_id,
            request_id=request_id,
            captured_at_ns=frame.captured_at_ns,
            frame_age_s=max(self._clock.now_ns() - frame.captured_at_ns, 0) * 1e-9,
            ned_from_body=ned_from_body,
            body_from_cam=self._sensor.body_from_cam,
            camera=self._sensor.camera,
            image_bytes=image_bytes,
            world_from_body=None if state is None else state.world_from_body,
            has_heading=has_heading,
            seen=seen,
        )

    async def detail(self, frame: Frame) -> Detail:
        """Return how much of one of our frames the map in use is extended by."""
        at_ns = frame.captured_at_ns
        await self._estimator.settled(at_ns, self._clock.now_ns())
        stored = self._maps.current
        if stored is None:
            return "all"
        return needed_detail(
            self._estimator.fix_at(at_ns),
            stored.index.landmark_map,
            self._sensor.camera,
            self._sensor.body_from_cam,
        )
