"""When each thing of a recording happens: its instants in order, against the wall clock.

No clock and no sleeping in here: ``Pace`` is told both times.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

ATTITUDE_PERIOD_NS = 20_000_000


@dataclass(frozen=True)
class Due:
    """One frame that is handed out: whose, and its place in that drone's frames."""

    drone: int
    sequence: int


@dataclass(frozen=True)
class Instant:
    """One moment of a recording; without frames it only moves time and attitude on."""

    at_ns: int
    frames: tuple[Due, ...]


def instants(frames_at_ns: Sequence[NDArray[np.int64]], flat_out: bool) -> list[Instant]:
    """Return a recording's moments in time order: frames, and stops between them.

    Against the wall clock there is a stop at every attitude sample from the
    first frame on, as a real autopilot speaks between two frames. Flat out
    there is one after each frame, the sample that a daemon may wait for because
    its autopilot's clock counts in milliseconds.

    Args:
        frames_at_ns: per drone the (F,) instants of its frames, rising; drones
            may differ by jitter and in number.
        flat_out: the daemons set the pace.
    """
    due: dict[int, list[Due]] = {}
    for drone, times in enumerate(frames_at_ns):
        for sequence, at_ns in enumerate(times.tolist()):
            due.setdefault(at_ns, []).append(Due(drone, sequence))
    with_frames = sorted(due)
    if flat_out:
        for k, at_ns in enumerate(with_frames):
            stop_ns = at_ns + ATTITUDE_PERIOD_NS
            if k + 1 == len(with_frames) or stop_ns < with_frames[k + 1]:
                due.setdefault(stop_ns, [])
    elif due:
        for at_ns in range(
            with_frames[0], with_frames[-1] + ATTITUDE_PERIOD_NS + 1, ATTITUDE_PERIOD_NS
        ):
            due.setdefault(at_ns, [])
    return [Instant(at_ns, tuple(due[at_ns])) for at_ns in sorted(due)]


def gate(moments: Sequence[Instant], drones: Collection[int]) -> int:
    """Return the index of the moment after which the recording waits for the first map.

    Every drone of it has been given its first frame by then, and, unless a second one
    is due before, the attitude sample after it.

    Args:
        moments: of the recording.
        drones: those of the first map.
    """
    given: set[int] = set()
    for k, moment in enumerate(moments):
        given.update(due.drone for due in moment.frames)
        if given.issuperset(drones):
            followed = k + 1 < len(moments) and not moments[k + 1].frames
            return k + 1 if followed else k
    raise ValueError("a drone has no frame")


@dataclass(frozen=True)
class Pace:
    """How recording time runs against wall time from an origin.

    Attributes:
        speed: recording seconds per wall second; infinite never waits.
        origin_at_ns: an instant of the recording.
        origin_wall_s: the wall clock at that instant.
    """

    speed: float
    origin_at_ns: int
    origin_wall_s: float

    def held(self, wall_s: float) -> Pace:
        """Return the same after recording time has stood still for so long."""
        return replace(self, origin_wall_s=self.origin_wall_s + wall_s)

    def wait_s(self, at_ns: int, wall_s: float) -> float:
        """Return how long until an instant is due, s; negative when it is late."""
        if math.isinf(self.speed):
            return 0.0
        due_wall_s = self.origin_wall_s + (at_ns - self.origin_at_ns) * 1e-9 / self.speed
        return due_wall_s - wall_s
