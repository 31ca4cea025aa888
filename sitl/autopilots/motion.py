"""How a body moves along a recorded trajectory: what an ideal IMU and a simulator would say.

Between the recorded poses it is a smooth curve through all of them (natural cubic splines of
position and of rotation), so that what the IMU measures integrates to the truth. Before the
first pose it stands still, and then takes up the speed and the turn that it has there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from vcl_companion.geometry.rotation import Array

GRAVITY_M_S2 = 9.80665
# How long before the first pose a body begins to move, and to turn.
_SPEED_TAKEN_UP_S = 3.0
_TURN_TAKEN_UP_S = 0.5


@dataclass(frozen=True, eq=False)
class Motion:
    """A body's motion at T instants, NED.

    Attributes:
        positions_m: (T, 3).
        velocities_m_s: (T, 3).
        specific_forces_m_s2: (T, 3) along the body's axes: at rest and level (0, 0, -g).
        angular_rates_rad_s: (T, 3) along the body's axes.
        quaternions: (T, 4) w x y z, ned_from_body.
    """

    positions_m: Array
    velocities_m_s: Array
    specific_forces_m_s2: Array
    angular_rates_rad_s: Array
    quaternions: Array


class RecordedMotion:
    """The smooth motion through recorded poses.

    Args:
        at_ns: (T,) rising instants, T >= 2.
        positions_m: (T, 3) NED.
        quaternions: (T, 4) w x y z, ned_from_body.
    """

    def __init__(self, at_ns: NDArray[np.int64], positions_m: Array, quaternions: Array) -> None:
        self.starts_ns = int(at_ns[0])
        since_s = (at_ns - at_ns[0]) * 1e-9
        self._ends_s = float(since_s[-1])
        self._position = CubicSpline(since_s, positions_m, bc_type="natural")
        turned = Rotation.from_quat(np.roll(quaternions, -1, axis=1))
        self._rotation = RotationSpline(since_s, turned)

    def at(self, at_ns: NDArray[np.int64]) -> Motion:
        """Return the motion at some instants; after the last pose it stays where it was there."""
        since_s = np.asarray((at_ns - self.starts_ns) * 1e-9, dtype=np.float64)
        within_s = np.clip(since_s, 0.0, self._ends_s)
        flies = (since_s <= self._ends_s).astype(float)[:, None]
        share, to_come_s, growth = _taken_up(since_s, _SPEED_TAKEN_UP_S)
        speed = self._position(within_s, 1)
        acceleration = flies * (self._position(within_s, 2) * (since_s >= 0.0)[:, None])
        acceleration += flies * growth * speed
        turning, to_turn_s, _ = _taken_up(since_s, _TURN_TAKEN_UP_S)
        rates = self._rotation(within_s, 1)
        rotation = self._rotation(within_s) * Rotation.from_rotvec(-to_turn_s * rates)
        force = acceleration - np.array([0.0, 0.0, GRAVITY_M_S2])
        return Motion(
            self._position(within_s) - to_come_s * speed,
            flies * share * speed,
            rotation.inv().apply(force),
            flies * turning * rates,
            np.roll(rotation.as_quat(), 1, axis=1),
        )


def _taken_up(since_s: Array, within_s: float) -> tuple[Array, Array, Array]:
    """Return how a speed is taken up smoothly until an instant, from rest.

    Args:
        since_s: (T,) time since it is reached.
        within_s: how long that takes.

    Returns:
        (T, 1) share of it that there is; that share's integral from then to the instant, s,
        0 after it; its derivative, 1/s.
    """
    x = np.clip(since_s / within_s + 1.0, 0.0, 1.0)[:, None]
    share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    to_come = within_s * (0.5 - x**4 * (2.5 - 3.0 * x + x**2))
    return share, to_come, 30.0 * x**2 * (1.0 - x) ** 2 / within_s
