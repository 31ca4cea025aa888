"""What a drone of a live flight is to do: take off, fly from place to place, land."""

from __future__ import annotations

import msgspec
import numpy as np

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, matrix_from_euler

COMMANDED_FILE = "commanded.csv"
"""Where a pilot has sent its drone, in the firmware's local frame: ``at_ns,x,y,z,what``.

The first row is where it stood, the last one how it ended: ``LANDED``, or what went wrong.
"""
STANDS, LANDED = "stands", "landed"

# Where on earth firmware takes itself to be; nobody tells it, but for its origin.
HOME_DEG = (47.0, 8.0)
HOME_ALTITUDE_M = 500.0

Leg = tuple[float, float, float, float]


class Mission(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One drone's orders, in the scenario's NED; yaw from north to east.

    Attributes:
        stands: x_m, y_m, yaw_deg on the ground at the start.
        legs: places it goes to one after the other: rows of x_m, y_m, z_m (down), yaw_deg. It
            climbs straight to the height of the first one, and lands under the last one. None:
            it stays where it stands.
        speed_m_s: on the way.
        gear_m: how high its body is while it stands.
        begins_s: how long after the first frame it is to take off.
    """

    stands: tuple[float, float, float]
    legs: tuple[Leg, ...]
    speed_m_s: float = 2.0
    gear_m: float = 0.25
    begins_s: float = 5.0

    def __post_init__(self) -> None:
        if not np.all(np.isfinite([*self.stands, *sum(self.legs, ())])):
            raise ValueError("mission: stands and legs are finite")
        if any(z > -self.gear_m - 1.0 for _, _, z, _ in self.legs):
            raise ValueError("mission: legs are at least 1 m above the ground; z_m points down")
        if not 0.2 <= self.speed_m_s <= 10.0 or not 0.0 < self.gear_m <= 2.0:
            raise ValueError("mission: speed_m_s is 0.2 to 10, gear_m is above 0 up to 2")
        if not 0.0 <= self.begins_s <= 600.0:
            raise ValueError("mission: begins_s is 0 to 600")

    @property
    def ned_from_body(self) -> Pose:
        """The body's pose while it stands."""
        x_m, y_m, yaw_deg = self.stands
        turn = matrix_from_euler(0.0, 0.0, float(np.deg2rad(yaw_deg)))
        return Pose(turn, np.array([x_m, y_m, -self.gear_m]))

    def places(self) -> Array:
        """Return the (K, 3) places of its legs, m from where its body stands."""
        return np.array([leg[:3] for leg in self.legs]) - self.ned_from_body.translation
