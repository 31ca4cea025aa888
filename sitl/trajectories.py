"""How drones move: smooth paths with exact velocities, and the tilt that goes with them.

A flight is a spline through waypoints plus sine sways. The body leans into its
acceleration as a multirotor must, so attitude, velocity and position belong
together. NED, metres; yaw from north to east.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import msgspec
import numpy as np
from scipy.interpolate import CubicSpline

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3

_GRAVITY_M_S2 = np.array([0.0, 0.0, 9.80665])
_AXES = ("x", "y", "z", "yaw")


class Sway(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sine added to one coordinate: ``amplitude`` is metres, or degrees for yaw."""

    axis: Literal["x", "y", "z", "yaw"]
    amplitude: float
    period_s: float
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        if not self.period_s > 0.0:
            raise ValueError("sway: period_s must be positive")


class Wobble(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A small rotation about one body axis on top of the lean: gusts and control errors."""

    axis: Literal["roll", "pitch", "yaw"]
    amplitude_deg: float
    period_s: float
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        if not self.period_s > 0.0:
            raise ValueError("wobble: period_s must be positive")


class Flight(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One drone's path.

    Attributes:
        waypoints: rows of t_s, x_m, y_m, z_m, yaw_deg by rising time; one alone
            is a hover. Yaw is taken as it stands: 350 to 370 is a small turn.
        ends: ``rest`` starts and ends standing still; ``moving`` passes through.
        sway: sines on top.
        lean: share of the acceleration that the body leans into; 0 stays level.
        wobble: further small rotations.
    """

    waypoints: tuple[tuple[float, float, float, float, float], ...]
    ends: Literal["rest", "moving"] = "rest"
    sway: tuple[Sway, ...] = ()
    lean: float = 1.0
    wobble: tuple[Wobble, ...] = ()

    def __post_init__(self) -> None:
        times = np.array([row[0] for row in self.waypoints])
        if len(times) == 0 or np.any(np.diff(times) <= 0.0):
            raise ValueError("flight: waypoints must be one or more, with rising times")
        if not np.all(np.isfinite(self.waypoints)):
            raise ValueError("flight: waypoints must be finite")
        if not 0.0 <= self.lean <= 1.0:
            raise ValueError("flight: lean is 0 to 1")


@dataclass(frozen=True, eq=False)
class Motion:
    """Where a body is and how it moves at one instant.

    Attributes:
        ned_from_body: its pose, FRD body.
        velocity_m_s: (3,) of its origin, NED.
        acceleration_m_s2: (3,) of its origin, NED, without gravity.
    """

    ned_from_body: Pose
    velocity_m_s: Array
    acceleration_m_s2: Array


class FlightPath:
    """A flight, ready to be asked for any instant."""

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._times: Array = np.array([row[0] for row in flight.waypoints], dtype=np.float64)
        self._values: Array = np.array([row[1:] for row in flight.waypoints], dtype=np.float64)

    @cached_property
    def _spline(self) -> CubicSpline[np.float64]:
        if self._flight.ends == "rest":
            return CubicSpline(self._times, self._values, bc_type="clamped")
        return CubicSpline(self._times, self._values, bc_type="natural")

    def at(self, at_s: float) -> Motion:
        """Return the motion at an instant of the flight, s.

        Before the first and after the last waypoint the path's speed there goes
        on unchanged, which for ``ends = "rest"`` means it stands.
        """
        coordinates = np.zeros((3, 4))  # value, first and second derivative of x, y, z, yaw
        if len(self._times) == 1:
            coordinates[0] = self._values[0]
        else:
            inside_s = float(np.clip(at_s, self._times[0], self._times[-1]))
            coordinates[0] = self._spline(inside_s)
            coordinates[1] = self._spline(inside_s, 1)
            coordinates[0] += (at_s - inside_s) * coordinates[1]
            if inside_s == at_s:
                coordinates[2] = self._spline(inside_s, 2)
        for sway in self._flight.sway:
            rate = 2.0 * np.pi / sway.period_s
            angle = rate * at_s + np.deg2rad(sway.phase_deg)
            sine, cosine = sway.amplitude * np.sin(angle), sway.amplitude * np.cos(angle)
            coordinates[:, _AXES.index(sway.axis)] += (sine, rate * cosine, -rate * rate * sine)
        position, velocity, acceleration = coordinates[:, :3]
        rotation = self._attitude(at_s, acceleration, float(np.deg2rad(coordinates[0, 3])))
        return Motion(Pose(rotation, position), velocity, acceleration)

    def _attitude(self, at_s: float, acceleration: Array, yaw_rad: float) -> Array:
        """Return ned_from_body (3, 3): thrust along the specific force, heading along yaw."""
        down = _GRAVITY_M_S2 - self._flight.lean * acceleration
        down = down / np.linalg.norm(down)
        heading = np.array([np.cos(yaw_rad), np.sin(yaw_rad), 0.0])
        right = np.cross(down, heading)
        right = right / np.linalg.norm(right)
        rotation = np.stack([np.cross(right, down), right, down], axis=1)
        shake = np.zeros(3)
        for wobble in self._flight.wobble:
            angle = 2.0 * np.pi * at_s / wobble.period_s + np.deg2rad(wobble.phase_deg)
            axis = ("roll", "pitch", "yaw").index(wobble.axis)
            shake[axis] += np.deg2rad(wobble.amplitude_deg) * np.sin(angle)
        return np.asarray(rotation @ exp_so3(shake))
