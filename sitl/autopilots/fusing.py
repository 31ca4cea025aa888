"""What ArduPilot's estimator makes of our poses, as it was measured: the stand-in's own opinion.

A constant-velocity filter with its readings, gates and timeouts (ArduCopter 4.7.0; numbers in
docs/autopilots.md and the design notes): one error for three axes, a reset by ``reset_counter``,
a step from the origin where the first pose counts none, five seconds of refusal before it
gives in, no position seven seconds after the last pose. It has no inertial sensors, so it
follows a little less closely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vcl_companion.geometry.rotation import Array

# EKF_STATUS_FLAGS as ArduCopter shows them with and without a position.
FUSED_FLAGS, UNFUSED_FLAGS = 0x33F, 0xA7
_ACCELERATION_M_S2 = 3.0
_GATE_SIGMAS = 5.0
_GIVES_IN_NS = 5_000_000_000
_FORGETS_NS = 7_000_000_000
_LEAST_ERROR_M = 0.01
# Seen: 2.7 m to the first pose without a reset made 76 m/s.
_STEP_PER_S = 28.0


@dataclass(frozen=True, eq=False)
class VisionPose:
    """A VISION_POSITION_ESTIMATE, read.

    Attributes:
        at_ns: the instant it is about.
        position: (3,) NED, m.
        upper: 21 values of its covariance.
        reset_counter: 0..255.
    """

    at_ns: int
    position: Array
    upper: Sequence[float]
    reset_counter: int


class Fusing:
    """An estimator that is told poses, and says where it believes to be."""

    def __init__(self) -> None:
        self._at_ns: int | None = None
        self._accepted_ns = 0
        self._heard_ns = 0
        self._position = np.zeros(3)
        self._velocity = np.zeros(3)
        self._covariance = np.zeros((2, 2))  # of position and speed, the same along each axis
        self._resets = 0
        self.test_ratio = 0.0
        self.internal_error = ""

    def take(self, pose: VisionPose) -> bool:
        """Take a pose in, or refuse it; return whether all that was believed gave way to it."""
        error_m = self._error_m(pose.upper)
        if error_m is None:
            return False
        is_reset, self._resets = pose.reset_counter != self._resets, pose.reset_counter
        self._heard_ns = pose.at_ns
        if self._at_ns is None:
            away = np.zeros(3) if is_reset else pose.position
            self._begin(pose, error_m)
            self._position, self._velocity = pose.position - away, _STEP_PER_S * away
            return True
        if is_reset:
            self._begin(pose, error_m)
            return True
        self._predict(max(pose.at_ns - self._at_ns, 0) * 1e-9)
        self._at_ns = max(pose.at_ns, self._at_ns)
        innovation = pose.position - self._position
        variance = self._covariance[0, 0] + error_m**2
        self.test_ratio = float(innovation @ innovation) / (_GATE_SIGMAS**2 * 2.0 * variance)
        if self.test_ratio > 1.0:
            gives_in = pose.at_ns - self._accepted_ns > _GIVES_IN_NS
            if gives_in:
                self._begin(pose, error_m)
            return gives_in
        self._accepted_ns = pose.at_ns
        gain = self._covariance[:, 0] / variance
        self._position = self._position + gain[0] * innovation
        self._velocity = self._velocity + gain[1] * innovation
        self._covariance -= np.outer(gain, self._covariance[0])
        return False

    def flags(self, now_ns: int) -> int:
        """Return EKF_STATUS_FLAGS."""
        has_heard = self._at_ns is not None and now_ns - self._heard_ns < _FORGETS_NS
        return FUSED_FLAGS if has_heard else UNFUSED_FLAGS

    def at(self, now_ns: int) -> tuple[Array, Array] | None:
        """Return (3,) position and velocity, NED, m and m/s; None without a position."""
        if self._at_ns is None:
            return None
        since_s = max(now_ns - self._at_ns, 0) * 1e-9
        return self._position + since_s * self._velocity, self._velocity

    def _error_m(self, upper: Sequence[float]) -> float | None:
        """Return one error of three variances; None for what it takes for an error of its own."""
        if math.isnan(upper[0]):
            return _LEAST_ERROR_M
        variances = [upper[k] for k in (0, 6, 11, 15, 18, 20)]
        if any(not math.isfinite(v) or v < 0.0 for v in variances):
            self.internal_error = "a covariance that is not a number, or negative"
            return None
        return max(math.sqrt(sum(variances[:3])), _LEAST_ERROR_M)

    def _begin(self, pose: VisionPose, error_m: float) -> None:
        self._at_ns = self._accepted_ns = pose.at_ns
        self._position = pose.position
        self._covariance = np.diag([error_m**2, 1.0])
        self.test_ratio = 0.0

    def _predict(self, step_s: float) -> None:
        self._position = self._position + step_s * self._velocity
        moving = np.array([[1.0, step_s], [0.0, 1.0]])
        pushed = np.array([0.5 * step_s**2, step_s])
        self._covariance = moving @ self._covariance @ moving.T
        self._covariance += _ACCELERATION_M_S2**2 * np.outer(pushed, pushed)
