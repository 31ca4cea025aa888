"""Rigid transforms, named ``a_from_b``, and how their uncertainty is written.

A pose covariance is 6x6, order x y z then a rotation vector, of a **local
(right) perturbation**: the first three are metres along the axes of ``b``, the
last three radians about them (``Pose.retracted``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.rotation import (
    Array,
    euler_from_matrix,
    euler_jacobian,
    exp_so3,
    log_so3,
    matrix_from_quaternion,
    quaternion_from_matrix,
    skew,
)


@dataclass(frozen=True, eq=False)
class Pose:
    """The transform that takes coordinates in frame ``b`` to frame ``a``.

    Attributes:
        rotation: (3, 3) rotation matrix, a_from_b.
        translation: (3,) origin of ``b`` expressed in ``a``, m.
    """

    rotation: Array
    translation: Array

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("translation", (3,))):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"Pose.{name} must be finite with shape {shape}: {value}")
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def identity(cls) -> Pose:
        """Return the transform that changes nothing."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_quaternion(cls, quaternion: Array, translation: Array) -> Pose:
        """Build from a (4,) quaternion w x y z and a (3,) translation, m."""
        return cls(matrix_from_quaternion(quaternion), translation)

    @classmethod
    def from_matrix(cls, matrix: Array) -> Pose:
        """Build from a (4, 4) homogeneous matrix."""
        return cls(matrix[:3, :3], matrix[:3, 3])

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(
            self.rotation @ other.rotation, self.rotation @ other.translation + self.translation
        )

    def inverse(self) -> Pose:
        """Return b_from_a."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def apply(self, points: Array) -> Array:
        """Return (..., 3) points of frame ``b`` in frame ``a``, m."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def quaternion(self) -> Array:
        """Return the (4,) unit quaternion w x y z of the rotation, w >= 0."""
        return quaternion_from_matrix(self.rotation)

    def matrix(self) -> Array:
        """Return the (4, 4) homogeneous matrix."""
        out = np.zeros((4, 4))
        out[:3, :3], out[:3, 3], out[3, 3] = self.rotation, self.translation, 1.0
        return out

    def retracted(self, delta: Array) -> Pose:
        """Return the pose moved by a (6,) local perturbation: metres, then radians, in ``b``."""
        return Pose(
            self.rotation @ exp_so3(delta[3:]), self.translation + self.rotation @ delta[:3]
        )

    def local(self, other: Pose) -> Array:
        """Return the (6,) perturbation that takes this pose to ``other`` (see ``retracted``)."""
        return np.concatenate(
            [
                self.rotation.T @ (other.translation - self.translation),
                log_so3(self.rotation.T @ other.rotation),
            ]
        )


def adjoint(pose: Pose) -> Array:
    """Return the (6, 6) map of a perturbation in ``b`` to the one in ``a`` with equal effect.

    With ``b_from_c`` perturbed locally by ``d``, ``a_from_b @ b_from_c`` is
    perturbed by ``d`` as well; with ``a_from_b`` perturbed by ``d``, it is
    perturbed by ``adjoint(b_from_c.inverse()) @ d``.
    """
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = pose.rotation
    out[:3, 3:] = skew(pose.translation) @ pose.rotation
    return out


def euler_pose_covariance(pose: Pose, covariance: Array) -> Array:
    """Carry a local pose covariance over to x y z in ``a`` and roll pitch yaw, for MAVLink.

    Args:
        pose: world_from_body.
        covariance: (6, 6), local perturbation in the body frame, m and rad.

    Returns:
        (6, 6) covariance of (x, y, z) in the world frame and (roll, pitch,
        yaw), m and rad, symmetric.
    """
    roll, pitch, _ = euler_from_matrix(pose.rotation)
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = pose.rotation
    jacobian[3:, 3:] = euler_jacobian(roll, pitch)
    out = jacobian @ covariance @ jacobian.T
    return np.asarray(0.5 * (out + out.T))
