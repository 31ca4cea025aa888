"""Rotations: the exponential map of SO(3), quaternions, and Euler angles for the border."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SMALL_RAD = 1e-7


def skew(v: Array) -> Array:
    """Return the (..., 3, 3) matrices of (..., 3) vectors with which ``skew(a) @ b`` is a x b."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def exp_so3(rotation_vector: Array) -> Array:
    """Return the (3, 3) rotation by a (3,) rotation vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(rotation_vector))
    k = skew(np.asarray(rotation_vector, dtype=np.float64))
    if angle < _SMALL_RAD:
        return np.eye(3) + k + 0.5 * k @ k
    return np.asarray(
        np.eye(3) + np.sin(angle) / angle * k + (1.0 - np.cos(angle)) / angle**2 * k @ k
    )


def log_so3(rotation: Array) -> Array:
    """Return the (3,) rotation vector of a (3, 3) rotation, rad, of length at most pi."""
    q = quaternion_from_matrix(rotation)
    sine = float(np.linalg.norm(q[1:]))
    if sine < _SMALL_RAD:
        return 2.0 * q[1:]
    angle = 2.0 * np.arctan2(sine, q[0])
    return np.asarray(angle / sine * q[1:])


def angle_between(one: Array, other: Array) -> float:
    """Return by how much two (3, 3) rotations are turned against each other, rad, 0 to pi."""
    return float(np.linalg.norm(log_so3(one.T @ other)))


def right_jacobian_so3(rotation_vector: Array) -> Array:
    """Return the (3, 3) J with Exp(v + d) ~ Exp(v) Exp(J d)."""
    angle = float(np.linalg.norm(rotation_vector))
    k = skew(np.asarray(rotation_vector, dtype=np.float64))
    if angle < 1e-5:
        return np.eye(3) - 0.5 * k + k @ k / 6.0
    return np.asarray(
        np.eye(3)
        - (1.0 - np.cos(angle)) / angle**2 * k
        + (angle - np.sin(angle)) / angle**3 * k @ k
    )


def about_down(angle_rad: float) -> Array:
    """Return the (3, 3) turn about the down axis of north-east-down."""
    return exp_so3(np.array([0.0, 0.0, angle_rad]))


def heading_of(rotation: Array) -> float:
    """Return the turn about the down axis that is nearest to a (3, 3) rotation, rad.

    Of a rotation between two north-east-downs it is the turn of the heading; what their verticals
    are off each other has no part in it.
    """
    sine, cosine = rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1]
    return float(np.arctan2(sine, cosine))


def orthonormalized(matrix: Array) -> Array:
    """Return the rotation nearest to a (3, 3) matrix that drifted from orthonormality."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def quaternion_from_matrix(rotation: Array) -> Array:
    """Return the (4,) unit quaternion w x y z, w >= 0, of a (3, 3) rotation (Shepperd)."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    candidates = np.array([trace, m[0, 0], m[1, 1], m[2, 2]])
    largest = int(np.argmax(candidates))
    q = np.empty(4)
    if largest == 0:
        q[:] = 1.0 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = m[k, j] - m[j, k]
        q[1 + i] = 1.0 + m[i, i] - m[j, j] - m[k, k]
        q[1 + j] = m[j, i] + m[i, j]
        q[1 + k] = m[k, i] + m[i, k]
    q /= np.linalg.norm(q)
    return q if q[0] >= 0.0 else -q


def matrix_from_quaternion(quaternion: Array) -> Array:
    """Return the (3, 3) rotation of a (4,) quaternion w x y z, normalised on the way.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    q = np.asarray(quaternion, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"not a rotation: quaternion {q.tolist()}")
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return world_from_body (3, 3) of the aerospace angles, Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp, sp = np.cos(pitch_rad), np.sin(pitch_rad)
    cy, sy = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def euler_from_matrix(rotation: Array) -> tuple[float, float, float]:
    """Return (roll, pitch, yaw), rad, of a (3, 3) world_from_body; roll 0 at gimbal lock."""
    pitch = float(np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0)))
    if abs(rotation[2, 0]) > 1.0 - 1e-9:
        yaw = float(np.arctan2(-rotation[0, 1], rotation[1, 1]))
        return 0.0, pitch, yaw
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return roll, pitch, yaw


def euler_jacobian(roll_rad: float, pitch_rad: float) -> Array:
    """Return the (3, 3) d(roll, pitch, yaw) / d(body rotation vector).

    Only used where MAVLink wants Euler angles; grows without bound at pitch 90
    degrees, so the cosine is floored at 1e-3.
    """
    cr, sr = np.cos(roll_rad), np.sin(roll_rad)
    cp = np.cos(pitch_rad)
    cp = np.copysign(max(abs(cp), 1e-3), cp)
    tp = np.sin(pitch_rad) / cp
    return np.array([[1.0, sr * tp, cr * tp], [0.0, cr, -sr], [0.0, sr / cp, cr / cp]])
