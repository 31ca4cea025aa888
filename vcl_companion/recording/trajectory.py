"""Timestamped poses and inertial samples of one drone, as the recording holds them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import (
    Array,
    exp_so3,
    log_so3,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

_END_TOLERANCE_NS = 1_000
# Quaternions come printed with a few decimals; further off is not a rounding.
QUATERNION_TOLERANCE = 1e-2


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a body over time, in NED.

    Attributes:
        at_ns: (T,) int64 instants, strictly increasing, T >= 1.
        positions_m: (T, 3) of the body, NED, m.
        quaternions: (T, 4) w x y z, ned_from_body, normalised when made.
        velocities_m_s: (T, 3) of the body, NED, m/s; None when not known.
    """

    at_ns: NDArray[np.int64]
    positions_m: Array
    quaternions: Array
    velocities_m_s: Array | None = None

    def __post_init__(self) -> None:
        at_ns = _instants(self.at_ns)
        quaternions = _frozen(self.quaternions, (len(at_ns), 4))
        norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
        if np.abs(norms - 1.0).max() > QUATERNION_TOLERANCE:
            raise ValueError("Trajectory.quaternions must have unit length")
        quaternions = quaternions / norms
        quaternions.flags.writeable = False
        object.__setattr__(self, "at_ns", at_ns)
        object.__setattr__(self, "positions_m", _frozen(self.positions_m, (len(at_ns), 3)))
        object.__setattr__(self, "quaternions", quaternions)
        if self.velocities_m_s is not None:
            velocities = _frozen(self.velocities_m_s, (len(at_ns), 3))
            object.__setattr__(self, "velocities_m_s", velocities)

    @classmethod
    def from_poses(cls, at_ns: Sequence[int], ned_from_body: Sequence[Pose]) -> Trajectory:
        """Build from one pose per instant."""
        return cls(
            np.array(at_ns, dtype=np.int64),
            np.array([pose.translation for pose in ned_from_body]),
            np.array([pose.quaternion() for pose in ned_from_body]),
        )

    def __len__(self) -> int:
        return len(self.at_ns)

    def pose(self, k: int) -> Pose:
        """Return ned_from_body at row ``k``."""
        return Pose.from_quaternion(self.quaternions[k], self.positions_m[k])

    def stamped_poses(self) -> Iterator[tuple[int, Pose]]:
        """Yield (at_ns, ned_from_body) row by row."""
        for k, at_ns in enumerate(self.at_ns):
            yield int(at_ns), self.pose(k)

    def turned(self, rotation: Array) -> Trajectory:
        """Return the same motion seen in other axes.

        Args:
            rotation: (3, 3) new_from_ned, to leave NED at the border of a file; its
                inverse on the way in. The body's axes stay.
        """
        if np.array_equal(rotation, np.eye(3)):
            return self
        quaternions = [
            quaternion_from_matrix(rotation @ matrix_from_quaternion(q)) for q in self.quaternions
        ]
        velocities = self.velocities_m_s
        return Trajectory(
            self.at_ns,
            self.positions_m @ rotation.T,
            np.array(quaternions),
            None if velocities is None else velocities @ rotation.T,
        )

    def pose_at(self, at_ns: int) -> Pose | None:
        """Return ned_from_body at an instant.

        Linear in position and of constant angular velocity (slerp) between the
        two rows around it. None outside the rows, but for 1 us at either end.
        """
        first, last = int(self.at_ns[0]), int(self.at_ns[-1])
        if not first - _END_TOLERANCE_NS <= at_ns <= last + _END_TOLERANCE_NS:
            return None
        clamped = min(max(int(at_ns), first), last)
        after = int(np.searchsorted(self.at_ns, clamped))
        if int(self.at_ns[after]) == clamped:
            return self.pose(after)
        k = after - 1
        before_ns = int(self.at_ns[k])
        share = (clamped - before_ns) / (int(self.at_ns[after]) - before_ns)
        start = matrix_from_quaternion(self.quaternions[k])
        turn = log_so3(start.T @ matrix_from_quaternion(self.quaternions[after]))
        position = (1.0 - share) * self.positions_m[k] + share * self.positions_m[after]
        return Pose(start @ exp_so3(share * turn), position)


@dataclass(frozen=True, eq=False)
class InertialSamples:
    """What the IMU measured.

    Attributes:
        at_ns: (T,) int64 instants, strictly increasing.
        angular_rates_rad_s: (T, 3) along the body's axes, rad/s.
        specific_forces_m_s2: (T, 3) along the body's axes, m/s^2.
    """

    at_ns: NDArray[np.int64]
    angular_rates_rad_s: Array
    specific_forces_m_s2: Array

    def __post_init__(self) -> None:
        at_ns = _instants(self.at_ns)
        object.__setattr__(self, "at_ns", at_ns)
        for name in ("angular_rates_rad_s", "specific_forces_m_s2"):
            object.__setattr__(self, name, _frozen(getattr(self, name), (len(at_ns), 3)))


def _instants(at_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    out = np.array(at_ns, dtype=np.int64)
    if out.ndim != 1 or out.size == 0 or np.any(out[1:] <= out[:-1]):
        raise ValueError("at_ns must be (T,) instants, at least one, strictly increasing")
    out.flags.writeable = False
    return out


def _frozen(values: Array, shape: tuple[int, int]) -> Array:
    out = np.array(values, dtype=np.float64)
    if out.shape != shape or not np.all(np.isfinite(out)):
        raise ValueError(f"expected finite numbers of shape {shape}, got shape {out.shape}")
    out.flags.writeable = False
    return out
