"""Every frame is answered exactly once: to the camera, to the log, to whoever asks how we are."""

from __future__ import annotations

import asyncio
import logging
import time
from contextlib import suppress
from dataclasses import dataclass

from vcl_companion.cameras.source import CameraSource, Frame, Outcome
from vcl_companion.clock import Clock, ManualClock
from vcl_companion.daemon.flight_log import Basis, FlightLog, PoseSource
from vcl_companion.daemon.health import Health
from vcl_companion.localization.fix import NotLocalized

_log = logging.getLogger(__name__)

_UNDECODABLE = "undecodable image"


@dataclass(frozen=True)
class _Sent:
    """A frame whose pose is with the autopilot, while its answer still waits."""

    latency_ms: float
    n_matched: int
    n_inliers: int
    source: PoseSource
    by: Basis | None
    held_back: str


class FrameOutcomes:
    """The frames that wait for their answer, and what becomes of them.

    Args:
        camera: where each frame is answered.
        clock: time base of the frames.
        health: told of every outcome.
        log: told of every frame.
    """

    def __init__(self, camera: CameraSource, clock: Clock, health: Health, log: FlightLog) -> None:
        self._camera = camera
        self._clock = clock
        self._health = health
        self._log = log
        self._open: list[Frame] = []
        self._sent: dict[int, _Sent] = {}
        self._answered = asyncio.Event()
        self._last_sequence: int | None = None

    def opened(self, frame: Frame) -> None:
        """Note a frame that has come, and those that the camera's driver dropped before it."""
        self._came(frame.sequence)
        self._open.append(frame)

    def undecodable(self, sequence: int, captured_at_ns: int) -> None:
        """Log a frame that the camera has answered itself, for its image cannot be decoded."""
        self._came(sequence)
        self._health.refused(_UNDECODABLE)
        self._log.frame(sequence, captured_at_ns, "refused", reason=_UNDECODABLE)

    def sent(
        self,
        frame: Frame,
        source: PoseSource,
        by: Basis,
        n_matched: int = 0,
        n_inliers: int = 0,
        held_back: str = "",
    ) -> None:
        """Note that a frame's pose is with the autopilot; ``close`` answers the frame.

        Args:
            frame: which.
            source: whence its pose.
            by: what that relies on.
            n_matched: landmarks that were found.
            n_inliers: landmarks that agree.
            held_back: why the autopilot did not need it; empty when it got it.
        """
        self._health.localized(by_peers=source == "inter")
        latency_ms = self._latency_ms(frame)
        self._sent[frame.sequence] = _Sent(
            latency_ms, n_matched, n_inliers, source, None if held_back else by, held_back
        )

    def close(self, frame: Frame, source: PoseSource | None = None) -> None:
        """Answer a frame whose pose was sent; ``source`` when it is another one by now."""
        sent = self._sent.pop(frame.sequence)
        self._log.frame(
            frame.sequence,
            frame.captured_at_ns,
            "localized",
            reason=sent.held_back,
            latency_ms=sent.latency_ms,
            matched=sent.n_matched,
            inliers=sent.n_inliers,
            source=source or sent.source,
            by=sent.by,
        )
        self._answer(frame, "localized")

    def refuse(self, frame: Frame, why: NotLocalized, coasted: bool = False) -> None:
        """Say that a frame gave no pose, and why.

        Args:
            frame: which.
            why: it gave none.
            coasted: whether the autopilot got one by attitude and motion alone; else nothing.
        """
        self._health.refused(why.reason)
        self._log_refused(frame, why, "motion" if coasted else None)

    def drop(self, frame: Frame) -> None:
        """Answer a frame whose place a newer one took before it was looked at."""
        self._log.frame(frame.sequence, frame.captured_at_ns, "dropped")
        self._answer(frame, "dropped")

    async def all_answered(self, within_s: float) -> None:
        """Wait until no frame is open, or the time is over."""
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self._open:
                    self._answered.clear()
                    await self._answered.wait()

    def end(self) -> None:
        """Answer what is still open as the service ends."""
        for frame in list(self._open):
            if frame.sequence in self._sent:
                self.close(frame)
            else:
                self._log_refused(frame, NotLocalized("the service has ended"))

    def _came(self, sequence: int) -> None:
        if self._last_sequence is not None and sequence > self._last_sequence + 1:
            self._log.missed(sequence - self._last_sequence - 1)
        self._last_sequence = sequence

    def _log_refused(self, frame: Frame, why: NotLocalized, by: Basis | None = None) -> None:
        self._log.frame(
            frame.sequence,
            frame.captured_at_ns,
            "refused",
            reason=why.reason,
            latency_ms=self._latency_ms(frame),
            matched=why.n_matched,
            inliers=why.n_inliers,
            by=by,
        )
        _log.debug("frame %d: %s", frame.sequence, why.reason)
        self._answer(frame, "refused")

    def _answer(self, frame: Frame, outcome: Outcome) -> None:
        self._open.remove(frame)
        self._answered.set()
        self._camera.done(frame.sequence, outcome)

    def _latency_ms(self, frame: Frame) -> float:
        """From capture to now; in a replay, where capture was long ago, from arrival."""
        if isinstance(self._clock, ManualClock):
            return (time.monotonic_ns() - frame.received_at_ns) * 1e-6
        return (self._clock.now_ns() - frame.captured_at_ns) * 1e-6
