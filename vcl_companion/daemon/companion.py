"""From frame to pose: the straight line that everything else only feeds."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass

from vcl_companion.cameras.source import CameraSource, Frame, Outcome
from vcl_companion.clock import Clock, ManualClock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.mailbox import Mailbox
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.localization.intra import (
    LocalizationOptions,
    Localized,
    NotLocalized,
    localize_intra,
)
from vcl_companion.localization.pose_filter import (
    FilterOptions,
    FilterState,
    predict,
    started,
    update,
)
from vcl_companion.recording.sensor import Sensor
from vcl_companion.vision.features import FeatureOptions, detect

_log = logging.getLogger(__name__)

# How long an attitude sample may still be on its way when its frame is here.
ATTITUDE_WAIT_S = 0.1
# So many fixes in a row that contradict the state are right, and the state is wrong.
_MAX_CONTRADICTED = 5
# How long the last frames of a stream may take.
_LAST_FRAMES_S = 5.0
# A fix this old is no more where we are.
_FRESH_NS = 2_000_000_000


@dataclass(frozen=True)
class CompanionOptions:
    """What the steps of the line are tuned by; see each of them."""

    features: FeatureOptions
    localization: LocalizationOptions
    filter: FilterOptions


class Companion:
    """Takes the newest frame, localizes it, sends the pose; one frame at a time.

    Args:
        camera: where frames come from, and where each is answered.
        sensor: the camera's calibration and mounting.
        clock: time base of the frames.
        autopilot: gives attitude, takes poses.
        maps: the current map.
        on_frame: shown every frame as it arrives (the exchange keeps some for peers).
        health: told of every outcome.
        log: told of every frame.
        executor: runs the vision, beside the event loop.
        options: of the steps.
    """

    def __init__(
        self,
        camera: CameraSource,
        sensor: Sensor,
        clock: Clock,
        autopilot: AutopilotLink,
        maps: MapStore,
        on_frame: Callable[[Frame], None],
        health: Health,
        log: FlightLog,
        executor: Executor,
        options: CompanionOptions,
    ) -> None:
        self._camera = camera
        self._sensor = sensor
        self._clock = clock
        self._autopilot = autopilot
        self._maps = maps
        self._on_frame = on_frame
        self._health = health
        self._log = log
        self._executor = executor
        self._options = options
        self._mailbox = Mailbox()
        self._state: FilterState | None = None
        self._tracked = 0
        self._n_resets = 0
        self._n_contradicted = 0
        self._last_sequence: int | None = None
        self._open: list[Frame] = []
        self._over = asyncio.Event()
        self._answered = asyncio.Event()

    @property
    def is_localized(self) -> bool:
        """Whether a frame of the last two seconds gave a pose."""
        state = self._state
        return state is not None and self._clock.now_ns() - state.fixed_at_ns <= _FRESH_NS

    @property
    def tracked(self) -> int:
        """Landmarks that agreed on the last frame's pose; 0 when it gave none."""
        return self._tracked

    async def read_camera(self) -> None:
        """Move frames from the camera to the mailbox until the stream ends and all are answered.

        A frame that still waits for a first map then is answered at once, one
        that is being localized when that is done.
        """
        async for frame in self._camera.frames():
            self._note_gap(frame)
            self._open.append(frame)
            replaced = self._mailbox.put(frame)
            if replaced is not None:
                self._drop(replaced)
            self._on_frame(frame)
        _log.info("the camera's stream is over")
        self._over.set()
        with suppress(TimeoutError):
            async with asyncio.timeout(_LAST_FRAMES_S):
                while self._open:
                    self._answered.clear()
                    await self._answered.wait()

    def end(self) -> None:
        """Answer what is still open as the service ends; nothing else may run any more."""
        for frame in list(self._open):
            self._log_refused(frame, NotLocalized("the service has ended"))

    async def run(self) -> None:
        """Localize frames until cancelled."""
        while True:
            frame = await self._mailbox.take()
            stored = self._maps.current or await self._first_map(frame)
            if stored is not None:
                await self._localize(frame, stored)

    async def _first_map(self, frame: Frame) -> StoredMap | None:
        """Wait for a first map as long as no newer frame comes; answer the frame if none does."""
        decided = asyncio.ensure_future(self._maps.decided())
        newer = asyncio.ensure_future(self._mailbox.filled())
        over = asyncio.ensure_future(self._over.wait())
        try:
            with self._health.waiting_for_map():
                await asyncio.wait({decided, newer, over}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for waiting in (decided, newer, over):
                waiting.cancel()
        if self._maps.current is None:
            self._refuse(frame, self._no_map())
        return self._maps.current

    def _no_map(self) -> NotLocalized:
        ended = "the camera's stream is over" if self._over.is_set() else "none yet"
        return NotLocalized(f"no map: {self._maps.refusal or ended}")

    async def _localize(self, frame: Frame, stored: StoredMap) -> None:
        loop = asyncio.get_running_loop()
        attitude_soon = asyncio.ensure_future(
            self._autopilot.attitude_at(frame.captured_at_ns, ATTITUDE_WAIT_S)
        )
        features = await loop.run_in_executor(
            self._executor, detect, frame.image, stored.index.detector, self._options.features
        )
        attitude = await attitude_soon
        ned_from_body = None if attitude is None else attitude.ned_from_body
        predicted = self._predicted(frame, ned_from_body)
        fix = await loop.run_in_executor(
            self._executor,
            localize_intra,
            features,
            self._sensor.camera,
            self._sensor.body_from_cam,
            stored.index,
            predicted.prior() if predicted else None,
            ned_from_body,
            self._options.localization,
        )
        if isinstance(fix, NotLocalized):
            self._refuse(frame, fix)
            return
        state = self._updated(predicted, fix, frame, ned_from_body)
        if isinstance(state, NotLocalized):
            self._refuse(frame, state)
            return
        self._state = state
        self._send(frame, fix, state)

    def _predicted(self, frame: Frame, ned_from_body: Array | None) -> FilterState | None:
        if self._state is None:
            return None
        return predict(self._state, frame.captured_at_ns, ned_from_body, self._options.filter)

    def _updated(
        self,
        predicted: FilterState | None,
        fix: Localized,
        frame: Frame,
        ned_from_body: Array | None,
    ) -> FilterState | NotLocalized:
        if predicted is not None:
            state = update(predicted, fix)
            if isinstance(state, FilterState):
                self._n_contradicted = 0
                if state.n_jumps > predicted.n_jumps:
                    self._jumped(fix)
                return state
            # One fix against the state is wrong; several in a row say that the state
            # is, or that the autopilot has turned its north.
            self._n_contradicted += 1
            if self._n_contradicted < _MAX_CONTRADICTED:
                return state
            self._n_contradicted = 0
        if self._state is not None:
            self._jumped(fix)
        return started(fix, frame.captured_at_ns, ned_from_body, self._options.filter)

    def _jumped(self, fix: Localized) -> None:
        self._n_resets += 1
        self._log.event("jump", f"relocalized with {fix.n_inliers} landmarks")

    def _send(self, frame: Frame, fix: Localized, state: FilterState) -> None:
        sent = self._autopilot.send_pose(
            state.world_from_body, state.pose_covariance(), frame.captured_at_ns, self._n_resets
        )
        if not sent:
            self._refuse(frame, NotLocalized("the pose's covariance is not finite"))
            return
        self._tracked = fix.n_inliers
        self._health.localized()
        self._log.frame(
            frame.sequence,
            frame.captured_at_ns,
            "localized",
            latency_ms=self._latency_ms(frame),
            matched=fix.n_matched,
            inliers=fix.n_inliers,
        )
        self._answer(frame, "localized")

    def _refuse(self, frame: Frame, why: NotLocalized) -> None:
        """Send nothing, and say why."""
        self._tracked = 0
        self._health.refused(why.reason)
        self._log_refused(frame, why)

    def _log_refused(self, frame: Frame, why: NotLocalized) -> None:
        self._log.frame(
            frame.sequence,
            frame.captured_at_ns,
            "refused",
            reason=why.reason,
            latency_ms=self._latency_ms(frame),
            matched=why.n_matched,
            inliers=why.n_inliers,
        )
        _log.debug("frame %d: %s", frame.sequence, why.reason)
        self._answer(frame, "refused")

    def _drop(self, frame: Frame) -> None:
        """Answer a frame whose place a newer one took before it was looked at."""
        if self._maps.current is None:
            self._refuse(frame, self._no_map())
            return
        self._log.frame(frame.sequence, frame.captured_at_ns, "dropped")
        self._answer(frame, "dropped")

    def _answer(self, frame: Frame, outcome: Outcome) -> None:
        self._open.remove(frame)
        self._answered.set()
        self._camera.done(frame.sequence, outcome)

    def _note_gap(self, frame: Frame) -> None:
        """Count frames that the camera's driver dropped before us."""
        if self._last_sequence is not None and frame.sequence > self._last_sequence + 1:
            self._log.missed(frame.sequence - self._last_sequence - 1)
        self._last_sequence = frame.sequence

    def _latency_ms(self, frame: Frame) -> float:
        """From capture to now; in a replay, where capture was long ago, from arrival."""
        if isinstance(self._clock, ManualClock):
            return (time.monotonic_ns() - frame.received_at_ns) * 1e-6
        return (self._clock.now_ns() - frame.captured_at_ns) * 1e-6
