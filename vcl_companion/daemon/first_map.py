"""The coordinator's part in a first map: gather one frame of every drone, build, decide.

A round begins with a frame of its own, asks every member for its frame of the
same instant, and ends with a map or with the reason why there is none; the
next one begins with a newer frame.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor
from contextlib import suppress

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.geometry.rotation import matrix_from_quaternion
from vcl_companion.mapping.drone_view import DroneView, decode_image
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.reconstruction import MapOptions, NoMap, reconstruct
from vcl_companion.swarm.group import Group
from vcl_companion.vision.features import FeatureOptions, detect
from vcl_companion.wire.frame_codec import FrameAnswer
from vcl_companion.wire.messages import FrameRequest

_log = logging.getLogger(__name__)

_ASK_AGAIN_S = 1.0
_LOOK_S = 0.1
# A camera that delivers nothing new has nothing for a first map either.
_STALE_NS = 60 * 1_000_000_000

Distances = tuple[tuple[int, int, float], ...]


def build_map(
    frames: list[FrameAnswer],
    leader: int,
    known_distances: Distances,
    map_options: MapOptions,
    features: FeatureOptions,
) -> LandmarkMap | NoMap:
    """Build the first map of a round's frames; takes a second or two, beside the event loop.

    Args:
        frames: one of each drone that answered.
        leader: system id of the drone whose body is the world's origin.
        known_distances: (drone, drone, metres).
        map_options: thresholds.
        features: how they are found.

    Returns:
        A map, or why there is none. A frame whose image cannot be used is left
        out, unless it is the leader's.
    """
    views = []
    for frame in sorted(frames, key=lambda f: f.drone_id):
        try:
            image = decode_image(frame.image_bytes, frame.camera)
        except ValueError as error:
            if frame.drone_id == leader:
                return NoMap(f"the leader's frame: {error}")
            continue
        views.append(
            DroneView(
                frame.drone_id,
                frame.captured_at_ns,
                frame.camera,
                frame.body_from_cam,
                None
                if frame.ned_from_body is None
                else matrix_from_quaternion(frame.ned_from_body),
                frame.image_bytes,
                tuple(detect(image, detector, features) for detector in map_options.detectors),
            )
        )
    return reconstruct(views, leader, list(known_distances), map_options)


class FirstMap:
    """Makes rounds while this drone coordinates and nobody has a map.

    Args:
        system_id: this drone.
        group: who is there.
        frames: our own.
        maps: where the result goes, by ``decide``.
        describe: makes the answer that a peer would give of one of our frames.
        ask: sends a request to a peer.
        decide: takes the map of a round, or the reason why there is none.
        clock: time base of frames.
        executor: runs the building.
        known_distances: (drone, drone, metres).
        map_options: thresholds.
        features: how they are found.
        rng: numbers the requests, so that a restarted coordinator's are not
            taken for those of its earlier life.
    """

    def __init__(
        self,
        system_id: int,
        group: Group,
        frames: FrameHistory,
        maps: MapStore,
        describe: Callable[[Frame, int], Awaitable[FrameAnswer]],
        ask: Callable[[FrameRequest, int], None],
        decide: Callable[[LandmarkMap | NoMap, int], Awaitable[None]],
        clock: Clock,
        executor: Executor,
        known_distances: Distances,
        map_options: MapOptions,
        features: FeatureOptions,
        rng: np.random.Generator,
    ) -> None:
        self._system_id = system_id
        self._group = group
        self._frames = frames
        self._maps = maps
        self._describe = describe
        self._ask = ask
        self._decide = decide
        self._clock = clock
        self._executor = executor
        self._known_distances = known_distances
        self._map_options = map_options
        self._features = features
        self._request_id = int(rng.integers(1 << 32))
        self._gathered: dict[int, FrameAnswer] = {}
        self._came = asyncio.Event()

    def take(self, peer: int, frame: FrameAnswer) -> bool:
        """Take a peer's frame; False when nobody asked for it."""
        wanted = (self._request_id, peer)
        if (frame.request_id, frame.drone_id) != wanted or self._system_id not in self._gathered:
            return False
        self._gathered[peer] = frame
        self._came.set()
        return True

    async def run(self) -> None:
        """Make rounds until cancelled; each needs a frame that was not tried before."""
        began_at_s = asyncio.get_running_loop().time()
        tried: Frame | None = None
        while True:
            frame = self._frames.newest
            if frame is None or frame is tried or not self._is_due(frame, began_at_s):
                await asyncio.sleep(_LOOK_S)
                continue
            tried = frame
            await self._round(frame)

    def _is_due(self, frame: Frame, began_at_s: float) -> bool:
        """Whether a first map is ours to make, and everybody is there or was waited for."""
        if self._has_map() or not self._group.is_coordinator:
            return False
        if self._clock.now_ns() - frame.captured_at_ns > _STALE_NS:
            return False
        waited_s = asyncio.get_running_loop().time() - began_at_s
        if waited_s >= self._map_options.member_wait_s:
            return True
        # Who is heard but has not said yet what it flies on may well have a map.
        told = all(self._group.state_of(peer) is not None for peer in self._group.peers)
        return self._group.is_complete and told

    def _has_map(self) -> bool:
        """Whether there is a map: ours, or of a peer, which will send it (we are late, or back)."""
        states = map(self._group.state_of, self._group.peers)
        return self._maps.current is not None or any(s is not None and s.revision for s in states)

    async def _round(self, frame: Frame) -> None:
        self._request_id = (self._request_id + 1) % (1 << 32)
        built: LandmarkMap | NoMap
        try:
            own = await self._describe(frame, self._request_id)
        except ValueError as error:
            built = NoMap(f"our own frame: {error}")
        else:
            self._gathered = {self._system_id: own}
            await self._gather(frame)
            frames, self._gathered = list(self._gathered.values()), {}
            built = await self._built(frames)
        if not self._has_map():
            await self._decide(built, self._request_id)

    async def _built(self, frames: list[FrameAnswer]) -> LandmarkMap | NoMap:
        loop = asyncio.get_running_loop()
        try:
            return await loop.run_in_executor(
                self._executor,
                build_map,
                frames,
                self._group.leader,
                self._known_distances,
                self._map_options,
                self._features,
            )
        except Exception as error:
            # Peers' images and numbers went in: none of them may end the flight.
            _log.exception("the first map cannot be built")
            return NoMap(f"building failed: {type(error).__name__}")

    async def _gather(self, frame: Frame) -> None:
        """Ask those who have not answered, again and again, until all have or time is up."""
        with suppress(TimeoutError):
            async with asyncio.timeout(self._map_options.gather_timeout_s):
                while self._missing() and not self._has_map():
                    age_s = (self._clock.now_ns() - frame.captured_at_ns) * 1e-9
                    for peer in self._missing():
                        self._ask(FrameRequest(self._request_id, max(age_s, 0.0)), peer)
                    await self._news(_ASK_AGAIN_S)

    def _missing(self) -> list[int]:
        return [peer for peer in self._group.alive if peer not in self._gathered]

    async def _news(self, at_most_s: float) -> None:
        """Wait until every member alive has answered, or it is time to ask again."""
        with suppress(TimeoutError):
            async with asyncio.timeout(at_most_s):
                while self._missing():
                    self._came.clear()
                    await self._came.wait()
