"""What happened to every frame, as JSON lines: for the report and for the day after."""

from __future__ import annotations

import json
import logging
import os
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import IO, Literal

import numpy as np

from vcl_companion.cameras.source import Outcome
from vcl_companion.clock import Clock
from vcl_companion.errors import DISK_IS_FULL, ConfigError, reason_of
from vcl_companion.geometry.pose import Pose, euler_pose_covariance
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.fix import Recognised
from vcl_companion.swarm.peer_time import ClockRelation

_log = logging.getLogger(__name__)

PoseSource = Literal["intra", "inter", "fused"]
"""Whence a localized frame's pose: its own fix, a peer's proposal, or both."""

Basis = Recognised | Literal["peer", "motion"]
"""What a sent pose relies on: the map by patches or by features, our own last frames, a peer's word
alone, or attitude and motion since the last of these. Where there is none, nothing was sent."""

_UPPER = np.triu_indices(6)
# Reasons hold numbers, and some are a peer's words: beyond so many they share one count.
_MAX_REASONS = 200
_OTHER_REASONS = "other reasons"
# Of earlier runs, those that had frames: a service that does not come up is started again and
# again, every second or every twenty, and may not shift out the flight that it was to go on with.
_MOST_KEPT = 20
_FRAME, _LOOKED_THROUGH_BYTES = b'{"kind": "frame"', 1 << 20


class FlightLog:
    """Writes one line per frame, event and map; counts frames even when no file is kept.

    Args:
        path: the file, empty for none. What earlier runs wrote there of frames is kept beside it:
            the last one's as ``path.1``, the one's before as ``path.2``, to ``path.20``.
        clock: stamps events.

    Raises:
        ConfigError: the file cannot be written.
    """

    def __init__(self, path: str, clock: Clock) -> None:
        self._clock = clock
        self._file: IO[str] | None = None
        self.frames: Counter[str] = Counter({"localized": 0, "refused": 0, "dropped": 0})
        self.refusals: Counter[str] = Counter()
        if path:
            try:
                Path(path).parent.mkdir(parents=True, exist_ok=True)
                _keep_earlier(path)
                self._file = open(path, "a", encoding="utf-8", buffering=1)  # noqa: SIM115 kept open
            except (OSError, ValueError) as error:
                why = reason_of(error)
                if getattr(error, "errno", None) not in DISK_IS_FULL:
                    raise ConfigError(f"[log] flight_log {path!r}: {why}") from error
                _log.error("no flight log is kept in %s: %s", path, why)

    def frame(
        self,
        sequence: int,
        captured_at_ns: int,
        outcome: Outcome,
        *,
        reason: str = "",
        latency_ms: float | None = None,
        matched: int = 0,
        inliers: int = 0,
        source: PoseSource | None = None,
        by: Basis | None = None,
    ) -> None:
        """Write what became of a frame; ``by``: what the pose sent for it relies on, if one was.

        A localized frame without ``by`` was held back, for a ``reason``: it was not needed.
        """
        self.frames[outcome] += 1
        if outcome == "refused":
            known = reason in self.refusals or len(self.refusals) < _MAX_REASONS
            self.refusals[reason if known else _OTHER_REASONS] += 1
        self._write(
            kind="frame",
            sequence=sequence,
            captured_at_ns=captured_at_ns,
            outcome=outcome,
            reason=reason or None,
            latency_ms=latency_ms,
            matched=matched,
            inliers=inliers,
            source=source,
            by=by,
        )

    def estimate(
        self,
        captured_at_ns: int,
        world_from_body: Pose,
        covariance: Array,
        *,
        fused: bool,
        host: int | None = None,
        reason: str = "",
    ) -> None:
        """Write what a frame alone, or a peer alone, says of our pose.

        Args:
            captured_at_ns: the frame's instant.
            world_from_body: the pose.
            covariance: (6, 6) local; written as the autopilot gets it.
            fused: whether the filter took it.
            host: the peer that proposed it; None for a fix of our own.
            reason: why the filter did not.
        """
        sent = euler_pose_covariance(world_from_body, covariance)
        self._write(
            kind="estimate",
            captured_at_ns=captured_at_ns,
            source="intra" if host is None else "inter",
            host=host,
            position=world_from_body.translation.tolist(),
            quaternion=world_from_body.quaternion().tolist(),
            covariance=sent[_UPPER].tolist(),
            fused=fused,
            reason=reason or None,
        )

    def propagated(self, at_ns: int, since_fix_s: float) -> None:
        """Write that a pose between frames was sent, so long after the last fix."""
        self._write(kind="propagated", at_ns=at_ns, since_fix_s=since_fix_s)

    def missed(self, n_frames: int) -> None:
        """Count frames that were dropped before they reached us; of these there are no lines."""
        self.frames["dropped"] += n_frames

    def event(self, event: str, reason: str) -> None:
        """Write something that changed."""
        self._write(kind="event", at_ns=self._clock.now_ns(), event=event, reason=reason)

    def map(
        self, revision: bytes, parent: bytes, n_landmarks: int, n_bytes: int, n_keyframes: int
    ) -> None:
        """Write that another map is flown on, and of which one it was made."""
        self._write(
            kind="map",
            at_ns=self._clock.now_ns(),
            revision=revision.hex(),
            parent=parent.hex(),
            landmarks=n_landmarks,
            bytes=n_bytes,
            keyframes=n_keyframes,
        )

    def peer_clock(self, peer: int, relation: ClockRelation) -> None:
        """Write how a peer's clock goes beside ours, and how well that is known."""
        self._write(
            kind="clock",
            at_ns=relation.at_ns,
            peer=peer,
            offset_ns=relation.offset_ns,
            bound_ns=relation.bound_ns,
            drift_ppm=relation.drift * 1e6,
            drift_bound_ppm=relation.drift_bound * 1e6,
        )

    def close(self, **summary: float | Mapping[int, int]) -> None:
        """Write the totals and let go of the file; what comes later is not written."""
        self._write(
            kind="summary", frames=dict(self.frames), refusals=dict(self.refusals), **summary
        )
        self._let_go()

    def _write(self, **record: object) -> None:
        if self._file is None:
            return
        try:
            self._file.write(json.dumps(record) + "\n")
        except OSError as error:  # a full disk must not end the flight
            _log.error("the flight log ends here: %s", error.strerror)
            self._let_go()

    def _let_go(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # it tries once more to write what it could not
                file.close()


def _keep_earlier(path: str) -> None:
    """Move what an earlier run has written aside: after a crash in flight it is what tells why.

    Where it cannot be moved this run's lines follow it: a restart in the air fails by nothing here.
    """
    there = Path(path).resolve()  # not what points to it, perhaps on another disk
    if not there.is_file():
        return
    earlier = RotatingFileHandler(there, backupCount=_MOST_KEPT, delay=True)
    try:
        with there.open("rb") as file:
            has_flown = _FRAME in file.read(_LOOKED_THROUGH_BYTES)
        if has_flown:
            earlier.doRollover()
        else:
            os.truncate(there, 0)
    except OSError as error:
        _log.warning("[log] flight_log %r goes on where it was: %s", path, error.strerror)
    finally:
        earlier.close()
