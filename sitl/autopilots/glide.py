"""A way that is flown straight, at a stated speed: where one is to be along it, and when."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vcl_companion.geometry.rotation import Array

_ACCELERATION_M_S2 = 1.0
_TURNS_RAD_S = math.radians(30.0)


class Setpoint(NamedTuple):
    """Where one is to be, and how to go on from there.

    Attributes:
        place: (3,) m.
        velocity: (3,) m/s.
        acceleration: (3,) m/s^2.
        yaw_rad: heading.
    """

    place: Array
    velocity: Array
    acceleration: Array
    yaw_rad: float

    @classmethod
    def at_rest(cls, place: Array, yaw_rad: float) -> Setpoint:
        """Return one that is to stay."""
        return cls(place, np.zeros(3), np.zeros(3), yaw_rad)


@dataclass(frozen=True, eq=False)
class Glide:
    """From rest to rest, turning meanwhile, the shorter way round.

    Attributes:
        start: (3,) m.
        end: (3,) m.
        start_yaw_rad: heading at the start.
        end_yaw_rad: heading to come to.
        speed_m_s: at most.
        begins_ns: when.
    """

    start: Array
    end: Array
    start_yaw_rad: float
    end_yaw_rad: float
    speed_m_s: float
    begins_ns: int

    def at(self, now_ns: int) -> Setpoint:
        """Return where to be at an instant."""
        since_s = max(now_ns - self.begins_ns, 0) * 1e-9
        way_m = float(np.linalg.norm(self.end - self.start))
        along_m, speed_m_s, push_m_s2 = _along(way_m, self.speed_m_s, since_s)
        ahead = (self.end - self.start) / max(way_m, 1e-9)
        turn_rad = math.remainder(self.end_yaw_rad - self.start_yaw_rad, 2 * math.pi)
        turned_rad = math.copysign(min(_TURNS_RAD_S * since_s, abs(turn_rad)), turn_rad)
        yaw_rad = self.start_yaw_rad + turned_rad
        return Setpoint(self.start + along_m * ahead, speed_m_s * ahead, push_m_s2 * ahead, yaw_rad)


def _along(way_m: float, speed_m_s: float, since_s: float) -> tuple[float, float, float]:
    """Return how far along its way one has come, how fast, and how that grows; m and s."""
    # A short way has no time to become fast.
    top_m_s = min(speed_m_s, math.sqrt(_ACCELERATION_M_S2 * way_m))
    if top_m_s <= 0.0:
        return 0.0, 0.0, 0.0
    push = _ACCELERATION_M_S2
    changes_s = top_m_s / push
    left_s = max(way_m / top_m_s + changes_s - since_s, 0.0)
    if left_s == 0.0:
        return way_m, 0.0, 0.0
    if left_s < changes_s:
        return way_m - 0.5 * push * left_s**2, push * left_s, -push
    if since_s < changes_s:
        return 0.5 * push * since_s**2, push * since_s, push
    return top_m_s * (since_s - 0.5 * changes_s), top_m_s, 0.0
