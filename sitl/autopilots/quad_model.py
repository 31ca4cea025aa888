"""A quad that flies: a rigid body with four propellers, in still air, above the ground at z = 0.

Its equations and numbers are those of PX4's own simulation in hardware (src/modules/simulation/
simulator_sih, the defaults of its ``SIH_`` parameters; PX4 1.16.1), for the frame of its airframe
``sihsim_quadx``. The Earth does not turn, and it stands on four springy feet, that rub.
"""

from __future__ import annotations

import numpy as np

from sitl.autopilots.motion import GRAVITY_M_S2, Motion
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3, quaternion_from_matrix

MASS_KG = 1.0
MAX_THRUST_N, MAX_TORQUE_NM = 5.0, 0.1  # of one propeller
_INERTIA_KG_M2 = np.array([0.025, 0.025, 0.030])
_DRAG_N_S_M, _TURN_DRAG_NM_S = 1.0, 0.025
_THRUST_WITHIN_S = 0.05
# Front right, back left, front left, back right; those of one diagonal turn one way.
_ROTORS_M = np.array([[0.2, 0.2, 0.0], [-0.2, -0.2, 0.0], [0.2, -0.2, 0.0], [-0.2, 0.2, 0.0]])
_TURNS = np.array([1.0, 1.0, -1.0, -1.0])
_WEIGHT_M_S2 = np.array([0.0, 0.0, GRAVITY_M_S2])
# Of each foot: its spring gives way by 4 mm under its share of the weight; its friction by what it
# bears, and how soon that stops what slides.
_SPRING_N_M, _DAMPER_N_S_M = 600.0, 17.0
_RUB, _RUBS_PER_S = 0.6, 40.0
_FEET_M = 0.15 * np.sign(_ROTORS_M)
_SINKS_M = MASS_KG * GRAVITY_M_S2 / (4.0 * _SPRING_N_M)


class QuadModel:
    """One that is at rest, until it is commanded to do something else.

    Args:
        begins: its pose; ned_from_body.
        gear_m: how high its body is while it stands.

    Attributes:
        turns: whether its propellers turn.
    """

    def __init__(self, begins: Pose, gear_m: float) -> None:
        self.turns = False
        self._position = begins.translation.copy()
        self._velocity = np.zeros(3)
        self._rotation = begins.rotation.copy()
        self._rates = np.zeros(3)
        self._thrusts = np.zeros(4)  # shares of the full one
        self._feet_m = _FEET_M + np.array([0.0, 0.0, gear_m + _SINKS_M])
        # By how much of the mass a foot is felt that slides.
        slides_kg = 1.0 / (1.0 / MASS_KG + gear_m**2 / _INERTIA_KG_M2[0])
        self._rub_n_s_m = 0.25 * _RUBS_PER_S * slides_kg
        self._force = -_WEIGHT_M_S2

    def step(self, commands: Array, seconds: float) -> None:
        """Move on for a few milliseconds.

        Args:
            commands: (4,) of the propellers, 0 to 1.
            seconds: for how long.
        """
        self.turns = bool(np.any(commands > 0.0))
        share = min(seconds / _THRUST_WITHIN_S, 1.0)
        self._thrusts += share * (np.clip(commands, 0.0, 1.0) - self._thrusts)
        lifts_n = MAX_THRUST_N * self._thrusts
        force = self._rotation @ np.array([0.0, 0.0, -lifts_n.sum()])
        force -= _DRAG_N_S_M * self._velocity
        torque = np.array([-_ROTORS_M[:, 1] @ lifts_n, _ROTORS_M[:, 0] @ lifts_n, 0.0])
        torque[2] = MAX_TORQUE_NM * float(_TURNS @ self._thrusts)
        torque -= _TURN_DRAG_NM_S * self._rates
        pushed, twisted = self._on_feet()
        force += pushed
        torque += twisted - np.cross(self._rates, _INERTIA_KG_M2 * self._rates)
        felt = force / MASS_KG
        before = self._velocity
        self._velocity = before + seconds * (felt + _WEIGHT_M_S2)
        self._position = self._position + 0.5 * seconds * (before + self._velocity)
        self._force = self._rotation.T @ felt
        self._rates = self._rates + seconds * torque / _INERTIA_KG_M2
        self._rotation = self._rotation @ exp_so3(seconds * self._rates)

    def motion(self) -> Motion:
        """Return its motion at this instant, of T = 1; the force is the last step's."""
        return Motion(
            self._position[None],
            self._velocity[None],
            self._force[None],
            self._rates[None],
            quaternion_from_matrix(self._rotation)[None],
        )

    def ned_from_body(self, ahead_s: float = 0.0) -> Pose:
        """Return its pose, or where it will be in less than a step."""
        turned = self._rotation @ exp_so3(ahead_s * self._rates)
        return Pose(turned, self._position + ahead_s * self._velocity)

    def _on_feet(self) -> tuple[Array, Array]:
        """Return the ground's force, NED, N, and its torque along the body's axes, Nm."""
        depths_m = self._position[2] + self._feet_m @ self._rotation[2]
        if not np.any(depths_m > 0.0):
            return np.zeros(3), np.zeros(3)
        slips = self._velocity + np.cross(self._rates, self._feet_m) @ self._rotation.T
        bears_n = np.maximum(_SPRING_N_M * depths_m + _DAMPER_N_S_M * slips[:, 2], 0.0)
        bears_n[depths_m <= 0.0] = 0.0
        rubs_n = self._rub_n_s_m * slips
        rubs_n[:, 2] = 0.0
        lengths_n = np.linalg.norm(rubs_n, axis=1)
        rubs_n *= (np.minimum(lengths_n, _RUB * bears_n) / np.maximum(lengths_n, 1e-9))[:, None]
        forces = -rubs_n
        forces[:, 2] = -bears_n
        return forces.sum(axis=0), np.cross(self._feet_m, forces @ self._rotation).sum(axis=0)
