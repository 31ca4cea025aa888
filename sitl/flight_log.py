"""What a flight left on disk: the daemons' logs, and what the autopilots heard."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np

from sitl.evaluation import Estimates, covariance_from_upper
from sitl.processes import FlightError
from vcl_companion.errors import reason_of
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler

COMPANION_COMPONENT = 197
_Row = TypeVar("_Row", bound=msgspec.Struct)
# What int64 holds: arrays are made of them.
_Ns = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
_Sequence = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
_Us = Annotated[int, msgspec.Meta(ge=0, le=(2**63 - 1) // 1000)]


class FrameRow(msgspec.Struct, frozen=True):
    """What became of one frame, and how long it took from its arrival to that.

    ``latency_ms`` is None for a frame that was never looked at; ``by`` is what the pose
    sent for it relies on, "patches", "features", "odometry", "peer" or "motion", None when none
    was: a localized frame then has the ``reason`` why the autopilot did not need it.
    """

    sequence: _Sequence
    captured_at_ns: _Ns
    outcome: Literal["localized", "refused", "dropped"]
    reason: str | None = None
    latency_ms: float | None = None
    matched: int = 0
    inliers: int = 0
    source: Literal["intra", "inter", "fused"] | None = None
    by: str | None = None

    @property
    def is_held_back(self) -> bool:
        """Whether it has a pose that was not sent."""
        return self.outcome == "localized" and self.by is None and self.reason is not None


class PropagatedRow(msgspec.Struct, frozen=True):
    """A pose between frames that the autopilot was sent, and how long after the last fix."""

    at_ns: _Ns
    since_fix_s: float


class EstimateRow(msgspec.Struct, frozen=True):
    """What one frame alone, or one peer alone (``host``), said of the pose at a frame.

    ``covariance`` is the upper triangle of (6, 6) as in VISION_POSITION_ESTIMATE.
    """

    captured_at_ns: _Ns
    source: Literal["intra", "inter"]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    covariance: Annotated[list[float], msgspec.Meta(min_length=21, max_length=21)]
    fused: bool
    host: int | None = None
    reason: str | None = None


class EventRow(msgspec.Struct, frozen=True):
    """Something that happened aboard."""

    at_ns: _Ns
    event: str
    reason: str | None = None


class MapRow(msgspec.Struct, frozen=True):
    """A revision of the shared map that came into use."""

    at_ns: _Ns
    revision: str
    landmarks: int
    bytes: int
    keyframes: int
    parent: str = ""


class ClockRow(msgspec.Struct, frozen=True):
    """How a peer's clock went beside ours, and how well that was known.

    ``offset_ns`` is our clock minus the peer's at ``at_ns`` of ours; the truth is no
    further off than the bounds.
    """

    at_ns: _Ns
    peer: int
    offset_ns: int
    bound_ns: int
    drift_ppm: float
    drift_bound_ppm: float


class SummaryRow(msgspec.Struct, frozen=True):
    """What a daemon says of itself at its end; ``resident_mb`` is its peak."""

    frames: dict[str, int]
    refusals: dict[str, int]
    cpu_s: float
    wall_s: float
    resident_mb: float
    peer_bytes_sent: int
    peer_bytes_received: int


@dataclass(frozen=True)
class FlightLog:
    """One daemon's ``flight.jsonl``; ``summary`` is None when it did not end cleanly."""

    frames: tuple[FrameRow, ...]
    estimates: tuple[EstimateRow, ...]
    events: tuple[EventRow, ...]
    maps: tuple[MapRow, ...]
    summary: SummaryRow | None
    clocks: tuple[ClockRow, ...] = ()
    propagated: tuple[PropagatedRow, ...] = ()

    def count(self, outcome: str) -> int:
        """Return how many frames had an outcome."""
        return sum(frame.outcome == outcome for frame in self.frames)

    def share_from(self, source: str) -> float:
        """Return the share of all frames whose pose had a source."""
        return sum(frame.source == source for frame in self.frames) / max(len(self.frames), 1)

    def refusals(self) -> dict[str, int]:
        """Return how often each reason was given for a refused frame, the commonest first."""
        reasons = (f.reason or "no reason given" for f in self.frames if f.outcome == "refused")
        return dict(Counter(reasons).most_common())


def read_flight_log(path: Path, *, cut_off: bool = False) -> FlightLog:
    """Read a daemon's log; kinds of lines not known here are passed over.

    Args:
        path: the file.
        cut_off: whether its daemon was killed, which may have left half a line at its end.

    Raises:
        FlightError: a line is not what it should be; names file and row.
    """
    frames: list[FrameRow] = []
    estimates: list[EstimateRow] = []
    events: list[EventRow] = []
    maps: list[MapRow] = []
    clocks: list[ClockRow] = []
    propagated: list[PropagatedRow] = []
    summary: SummaryRow | None = None
    for row, line in _json_lines(path, cut_off=cut_off):
        match line.get("kind"):
            case "frame":
                frames.append(_converted(line, FrameRow, path, row))
            case "propagated":
                propagated.append(_converted(line, PropagatedRow, path, row))
            case "estimate":
                estimates.append(_converted(line, EstimateRow, path, row))
            case "event":
                events.append(_converted(line, EventRow, path, row))
            case "map":
                maps.append(_converted(line, MapRow, path, row))
            case "clock":
                clocks.append(_converted(line, ClockRow, path, row))
            case "summary":
                summary = _converted(line, SummaryRow, path, row)
    # A frame that asks peers about itself is answered after younger ones.
    frames.sort(key=lambda frame: frame.sequence)
    return FlightLog(
        tuple(frames),
        tuple(estimates),
        tuple(events),
        tuple(maps),
        summary,
        tuple(clocks),
        tuple(propagated),
    )


def joined(logs: Sequence[FlightLog]) -> FlightLog:
    """Return the logs of one daemon's runs as one; its summary is that of the last run."""
    return FlightLog(
        tuple(frame for log in logs for frame in log.frames),
        tuple(estimate for log in logs for estimate in log.estimates),
        tuple(event for log in logs for event in log.events),
        tuple(row for log in logs for row in log.maps),
        logs[-1].summary if logs else None,
        tuple(clock for log in logs for clock in log.clocks),
        tuple(row for log in logs for row in log.propagated),
    )


def estimates_of(rows: Iterable[EstimateRow]) -> Estimates:
    """Return rows as estimates, their order kept.

    Raises:
        FlightError: one is no pose.
    """
    kept = list(rows)
    try:
        covariances = [covariance_from_upper(np.array(row.covariance, dtype=float)) for row in kept]
        return Estimates(
            np.array([row.captured_at_ns for row in kept], dtype=np.int64),
            tuple(Pose.from_quaternion(np.array(r.quaternion), np.array(r.position)) for r in kept),
            np.array(covariances).reshape(-1, 6, 6),
        )
    except ValueError as error:
        raise FlightError(f"an estimate in the flight log is no pose: {error}") from error


class _VisionPosition(msgspec.Struct, frozen=True):
    usec: _Us
    x: float
    y: float
    z: float
    roll: float
    pitch: float
    yaw: float
    covariance: list[float]
    reset_counter: int = 0


def read_received(path: Path, system_id: int) -> Estimates:
    """Read the poses that an autopilot heard from its companion, in order of arrival.

    ``at_ns`` is what the message says, to its microsecond.

    Raises:
        FlightError: a line is not what it should be; names file and row.
    """
    at_ns, poses, covariances, resets = [], [], [], []
    for row, line in _json_lines(path):
        if (
            line.get("type") != "VISION_POSITION_ESTIMATE"
            or line.get("system") != system_id
            or line.get("component") != COMPANION_COMPONENT
        ):
            continue
        said = _converted(line.get("fields"), _VisionPosition, path, row)
        try:
            rotation = matrix_from_euler(said.roll, said.pitch, said.yaw)
            poses.append(Pose(rotation, np.array([said.x, said.y, said.z])))
            covariances.append(covariance_from_upper(np.array(said.covariance, dtype=float)))
        except ValueError as error:
            raise FlightError(f"{path}, row {row}: {error}") from error
        at_ns.append(said.usec * 1000)
        resets.append(said.reset_counter)
    return Estimates(
        np.array(at_ns, dtype=np.int64),
        tuple(poses),
        np.array(covariances).reshape(-1, 6, 6),
        np.array(resets, dtype=np.int64),
    )


def _json_lines(path: Path, *, cut_off: bool = False) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (row, object) of a file of JSON lines; rows count from 1."""
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise FlightError(f"{path}: {reason_of(error)}") from error
    if cut_off:
        del lines[-1]  # what follows the last line break
    for row, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            # Not msgspec: an autopilot may hear NaN, which strict JSON cannot say.
            value = json.loads(line)
        except ValueError as error:
            raise FlightError(f"{path}, row {row}: not JSON ({error})") from error
        if not isinstance(value, dict):
            raise FlightError(f"{path}, row {row}: not a JSON object")
        yield row, value


def _converted(value: object, kind: type[_Row], path: Path, row: int) -> _Row:
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise FlightError(f"{path}, row {row}: {error}") from error
