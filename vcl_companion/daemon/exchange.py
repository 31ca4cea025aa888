"""What peers say, and what is said to them: frames for a first map, and maps.

What comes from peers enters here only, bounded and checked by ``wire`` and
``swarm``; it can replace the map and nothing else.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.companion import ATTITUDE_WAIT_S
from vcl_companion.daemon.first_map import FirstMap
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.errors import WireError
from vcl_companion.geometry.rotation import quaternion_from_matrix
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.mavlink import Tunnel
from vcl_companion.links.peers import PeerLink
from vcl_companion.localization.map_index import MapIndex, index_map
from vcl_companion.mapping.drone_view import encode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import MapOptions, NoMap
from vcl_companion.recording.sensor import Sensor
from vcl_companion.swarm.group import Group, PeerJoined, PeerLost, SwarmOptions
from vcl_companion.swarm.transfer import (
    BlobKind,
    BlobReceived,
    Event,
    TransferFailed,
    Transfers,
)
from vcl_companion.vision.features import Detector, FeatureOptions
from vcl_companion.wire.chunks import Chunk, TransferStatus
from vcl_companion.wire.frame_codec import FrameAnswer, decode_frame, encode_frame
from vcl_companion.wire.map_codec import decode_map, encode_map
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.tunnel import TunnelPayload, decode_payload, encode_payload, is_ours

_log = logging.getLogger(__name__)

_STATE_INTERVAL_S = 1.0
_STEP_S = 0.1
# A peer needs this long to take a map in and to say so; a failed transfer begins anew.
_HAND_AGAIN_S = 10.0


@dataclass(frozen=True)
class ExchangeOptions:
    """What the exchange is tuned by; see each of them."""

    swarm: SwarmOptions
    map: MapOptions
    features: FeatureOptions
    detector: Detector


class Exchange:
    """One drone's dealings with its peers; everything happens in the event loop's thread.

    Args:
        system_id: this drone.
        group: who is there.
        transfers: blobs on their way.
        maps: the current map.
        autopilot: for the attitude that goes with a frame.
        sensor: of our camera.
        clock: time base of frames.
        log: told of maps and peers.
        executor: runs map building and indexing.
        is_localized: whether this drone flies on its map right now.
        options: of the steps.
    """

    def __init__(
        self,
        system_id: int,
        group: Group,
        transfers: Transfers,
        maps: MapStore,
        autopilot: AutopilotLink,
        sensor: Sensor,
        clock: Clock,
        log: FlightLog,
        executor: Executor,
        is_localized: Callable[[], bool],
        options: ExchangeOptions,
    ) -> None:
        self._system_id = system_id
        self._group = group
        self._transfers = transfers
        self._maps = maps
        self._autopilot = autopilot
        self._sensor = sensor
        self._clock = clock
        self._log = log
        self._executor = executor
        self._is_localized = is_localized
        self._options = options
        self._link: PeerLink | None = None
        self._frames = FrameHistory()
        self._first_map = FirstMap(
            system_id,
            group,
            self._frames,
            maps,
            self._described,
            self._send,
            self._decide,
            clock,
            executor,
            options.swarm.known_distances,
            options.map,
            options.features,
        )
        self._jobs: asyncio.TaskGroup | None = None
        self._wake = asyncio.Event()
        self._refused: Counter[str] = Counter()
        self._answered: tuple[int, int, bytes] = (0, 0, b"")
        self._handed_at_s: dict[tuple[int, bytes], float] = {}

    def attach(self, link: PeerLink) -> None:
        """Give the link to speak on; the link calls ``on_tunnel`` and ``on_heartbeat``."""
        self._link = link

    def on_frame(self, frame: Frame) -> None:
        """Keep a frame of our own for peers, and for a first map."""
        self._frames.add(frame)

    def on_heartbeat(self, peer: int) -> None:
        """Note a sign of life."""
        self._note(self._group.heartbeat(peer, self._now_s()))

    def on_tunnel(self, tunnel: Tunnel) -> None:
        """Take one payload of a peer; whatever is wrong with it is counted, never raised."""
        if not is_ours(tunnel.payload_type):
            return
        try:
            message = decode_payload(tunnel.payload_type, tunnel.payload)
        except WireError as error:
            self._count(tunnel.sender_system, str(error))
            return
        self._accept(tunnel.sender_system, message)
        self._wake.set()

    async def run(self) -> None:
        """Keep transfers, states and rounds going until cancelled."""
        async with asyncio.TaskGroup() as self._jobs:
            self._jobs.create_task(self._first_map.run())
            told_at_s = float("-inf")
            while True:
                now_s = self._now_s()
                self._note(self._group.poll(now_s))
                if now_s - told_at_s >= _STATE_INTERVAL_S:
                    told_at_s = now_s
                    self._tell_state()
                self._hand_out_map()
                self._poll_transfers()
                due_s = self._transfers.next_poll_s()
                pause_s = _STEP_S if due_s is None else min(max(due_s - now_s, 0.001), _STEP_S)
                self._wake.clear()
                with suppress(TimeoutError):
                    async with asyncio.timeout(pause_s):
                        await self._wake.wait()

    def _accept(self, peer: int, message: TunnelPayload) -> None:
        now_s = self._now_s()
        match message:
            case Chunk() | TransferStatus():
                self._take_events(self._transfers.receive(peer, message, now_s))
            case MapState():
                self._note(self._group.map_state(peer, message, now_s))
            case FrameRequest():
                self._start(self._answer(peer, message))
            case MapRefused():
                if peer == self._group.coordinator:
                    self._maps.refuse(message.reason)

    def _take_events(self, events: list[Event]) -> None:
        for event in events:
            match event:
                case BlobReceived(peer=peer, kind=BlobKind.FRAME_ANSWER, blob=blob):
                    self._take_frame(peer, blob)
                case BlobReceived(peer=peer, kind=BlobKind.MAP, blob=blob):
                    self._start(self._take_map(peer, blob))
                case TransferFailed(peer=peer, reason=reason):
                    self._log.event("transfer", f"to drone {peer}: {reason}")
                    _log.warning("transfer to drone %d failed: %s", peer, reason)

    def _take_frame(self, peer: int, blob: bytes) -> None:
        try:
            frame = decode_frame(blob)
        except WireError as error:
            self._count(peer, str(error))
            return
        if not self._first_map.take(peer, frame):
            self._count(peer, "a frame nobody asked for")

    async def _take_map(self, peer: int, blob: bytes) -> None:
        """Fly on a peer's map: the coordinator's, or anybody's while we have none."""
        if peer != self._group.coordinator and self._maps.current is not None:
            self._count(peer, "a map, but not from the coordinator")
            return
        try:
            await self._install(blob)
        except (WireError, ValueError) as error:
            self._count(peer, f"map: {error}")

    async def _install(self, data: bytes) -> None:
        def prepare(encoded: bytes) -> MapIndex:
            return index_map(decode_map(encoded), self._options.detector, self._options.features)

        loop = asyncio.get_running_loop()
        index = await loop.run_in_executor(self._executor, prepare, data)
        stored = self._maps.replace(data, index)
        n_keyframes = len(index.landmark_map.keyframes)
        self._log.map(stored.revision, stored.n_landmarks, len(data), n_keyframes)
        self._log.event("map", f"{stored.n_landmarks} landmarks in {n_keyframes} keyframes")
        _log.info("map %s: %d landmarks", stored.revision.hex(), stored.n_landmarks)
        self._tell_state()

    async def _answer(self, peer: int, request: FrameRequest) -> None:
        """Send the frame of the instant that a peer asks for; silence when there is none."""
        at_ns = self._clock.now_ns() - round(request.frame_age_s * 1e9)
        frame = self._frames.nearest(at_ns)
        if frame is None:
            return
        if self._answered[:2] != (peer, request.request_id):
            answer = await self._described(frame, request.request_id)
            self._answered = (peer, request.request_id, encode_frame(answer))
        # Asked again, the very same bytes: an answer on its way is not begun anew.
        self._transfers.submit(peer, BlobKind.FRAME_ANSWER, self._answered[2], self._now_s())
        self._wake.set()

    async def _described(self, frame: Frame, request_id: int) -> FrameAnswer:
        attitude = await self._autopilot.attitude_at(frame.captured_at_ns, ATTITUDE_WAIT_S)
        loop = asyncio.get_running_loop()
        image_bytes = await loop.run_in_executor(
            self._executor, encode_image, frame.image, self._options.map.keyframe_quality
        )
        return FrameAnswer(
            drone_id=self._system_id,
            request_id=request_id,
            captured_at_ns=frame.captured_at_ns,
            frame_age_s=max(self._clock.now_ns() - frame.captured_at_ns, 0) * 1e-9,
            ned_from_body=None
            if attitude is None
            else quaternion_from_matrix(attitude.ned_from_body),
            body_from_cam=self._sensor.body_from_cam,
            camera=self._sensor.camera,
            image_bytes=image_bytes,
        )

    def _hand_out_map(self) -> None:
        """Send the map to those who lack it: as coordinator, or to a coordinator without one."""
        stored = self._maps.current
        if stored is None:
            return
        lacking: tuple[int, ...] = ()
        if self._group.is_coordinator:
            lacking = self._group.lacking()
        elif not self._group.newest_revision and self._is_first_holder(stored.revision):
            state = self._group.state_of(self._group.coordinator)
            lacking = (self._group.coordinator,) if state is not None else ()
        now_s = self._now_s()
        for peer in lacking:
            last_s = self._handed_at_s.get((peer, stored.revision), float("-inf"))
            if peer != self._system_id and now_s - last_s >= _HAND_AGAIN_S:
                self._handed_at_s[peer, stored.revision] = now_s
                self._transfers.submit(peer, BlobKind.MAP, stored.data, now_s)

    def _is_first_holder(self, revision: bytes) -> bool:
        return self._group.holders(revision)[:1] == (self._system_id,)

    async def _decide(self, built: LandmarkMap | NoMap, request_id: int) -> None:
        """Fly on the map that we have built, or tell everybody why there is none."""
        if isinstance(built, LandmarkMap):
            await self._install(encode_map(built))
            return
        refusal = MapRefused.because(request_id, built.reason)
        for peer in self._group.peers:
            self._send(refusal, peer)
        self._log.event("no map", built.reason)
        _log.warning("no map: %s", built.reason)
        self._maps.refuse(built.reason)

    def _tell_state(self) -> None:
        stored = self._maps.current
        state = MapState(
            stored.revision if stored else b"",
            stored.n_landmarks if stored else 0,
            self._is_localized(),
        )
        self._group.set_own_state(state)
        self._send(state, 0)

    def _poll_transfers(self) -> None:
        outgoing, events = self._transfers.poll(self._now_s())
        for payload in outgoing:
            if self._link is not None:
                self._link.send(payload.payload_type, payload.payload, payload.peer)
        self._take_events(events)

    def _send(self, message: TunnelPayload, peer: int) -> None:
        if self._link is not None:
            self._link.send(*encode_payload(message), peer)

    def _note(self, events: list[PeerJoined | PeerLost]) -> None:
        for event in events:
            joined = isinstance(event, PeerJoined)
            self._log.event("peer", f"drone {event.peer} {'joined' if joined else 'lost'}")
            _log.info("drone %d %s", event.peer, "joined" if joined else "is silent")

    def _count(self, peer: int, reason: str) -> None:
        """Count what was refused, and tell the log once of each kind."""
        self._refused[reason] += 1
        if self._refused[reason] == 1:
            self._log.event("refused", f"from drone {peer}: {reason}")
            _log.warning("refused from drone %d: %s", peer, reason)

    def _start(self, job: Coroutine[None, None, None]) -> None:
        """Run something beside; an unexpected failure in it ends the daemon."""
        if self._jobs is None:
            job.close()  # heard before we run: it will be said again
            return
        self._jobs.create_task(job)

    def _now_s(self) -> float:
        return asyncio.get_running_loop().time()
