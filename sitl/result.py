"""What a flight came to: what each drone's autopilot was told, when, and how far off it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.evaluation import Estimates, PoseErrors, Scores
from sitl.flight_log import FlightLog, FrameRow, MapRow
from sitl.flown_mission import FlownMission
from sitl.fused import Fused
from sitl.lives import Life
from sitl.network_log import NetworkLog
from sitl.plan import FlightPlan
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.recording import ReferenceAxes


@dataclass(frozen=True)
class Event:
    """Something that happened in a flight; ``at_s`` counts from the first frame."""

    at_s: float
    drone: str
    kind: str
    reason: str


@dataclass(frozen=True, eq=False)
class DroneResult:
    """One drone's flight.

    Attributes:
        name: ``mavN``.
        frames_at_ns: (F,) instants of its frames.
        truth: F true poses in the recording's NED; None where not known.
        estimates: T poses its autopilot received, at their frames' own instants; not those
            between frames.
        frame_of: (T,) the frame each is about, -1 when it fits none.
        log: its daemon's log.
        errors: estimates against truth; None without truth or alignment.
        scores: those errors in numbers.
        n_between: how many poses between frames its autopilot received.
        between: their errors in numbers, the truth interpolated; None like ``errors``.
        alone: the same of what was fused: ``intra``, the frames' own fixes, and
            ``inter``, the peers' proposals, each as it came; only those there were.
        fused: what a real autopilot made of what it was sent; None without one.
        mission: how it was flown; None in a recorded flight.
        given: (G,) which frames a living daemon was given.
        lives: of its daemon, in order.
        waits_for_map: whether the recording stands still, with its first frame, for the first map.
        axes: of the recording's files, along which ``scores`` tell errors; all else is NED.
    """

    name: str
    frames_at_ns: NDArray[np.int64]
    truth: tuple[Pose | None, ...]
    estimates: Estimates
    frame_of: NDArray[np.int64]
    log: FlightLog
    errors: PoseErrors | None
    scores: Scores | None
    n_between: int
    between: Scores | None
    alone: Mapping[str, Scores]
    fused: Fused | None
    mission: FlownMission | None
    given: NDArray[np.int64]
    lives: tuple[Life, ...]
    waits_for_map: bool
    axes: ReferenceAxes

    @property
    def n_frames(self) -> int:
        """Frames of the recording that a living daemon was given."""
        return len(self.given)

    @property
    def n_localized(self) -> int:
        """Frames whose pose reached the autopilot, but for those that nobody had measured."""
        return len(self.localized)

    @property
    def localized(self) -> set[int]:
        """Which frames these are."""
        return self._heard - self._coasted

    @property
    def n_coasted(self) -> int:
        """Frames whose pose reached the autopilot by attitude and motion alone."""
        return len(self._heard & self._coasted)

    @property
    def _heard(self) -> set[int]:
        return set(self.frame_of[self.frame_of >= 0].tolist())

    @property
    def _coasted(self) -> set[int]:
        return {frame.sequence for frame in self.log.frames if frame.by == "motion"}

    @property
    def looked_at(self) -> list[FrameRow]:
        """Frames that were looked at as they came: not dropped, and no wait for the first map."""
        return [
            frame
            for frame in self.log.frames
            if frame.latency_ms is not None
            and frame.outcome != "dropped"
            and not (self.waits_for_map and frame.sequence == 0)
        ]

    @property
    def unaccounted(self) -> int:
        """Frames that the daemon's log says nothing about, or more than one thing."""
        rows = [frame.sequence for frame in self.log.frames]
        twice = len(rows) - len(set(rows))
        return len(set(self.given.tolist()) ^ set(rows)) + twice


@dataclass(frozen=True, eq=False)
class FlightResult:
    """A whole flight.

    Attributes:
        plan: what was to be flown.
        drones: in the plan's order.
        ref_from_world: carries ``world`` into the recording's NED; None when the
            leader has no estimate with a truth.
        maps: the leader's map revisions in the order they came into use; another drone's when
            the leader had none, or was not there at the end.
        points_ref_m: (N, 3) landmarks of the last map, where ``ref_from_world``
            puts them, else in ``world``.
        events: of all drones and the harness, in time order.
        network: what went between the drones; None when it was not counted.
    """

    plan: FlightPlan
    drones: tuple[DroneResult, ...]
    ref_from_world: Pose | None
    maps: tuple[MapRow, ...]
    points_ref_m: Array
    events: tuple[Event, ...]
    network: NetworkLog | None = None

    @property
    def axes(self) -> ReferenceAxes | None:
        """Those of the recording's files; None where they are not the same for all drones."""
        found = {drone.axes for drone in self.drones}
        return found.pop() if len(found) == 1 else None
