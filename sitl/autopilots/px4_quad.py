"""A PX4 that flies a model of a quad (``quad_model``), in lockstep: at its commands it moves.

Not PX4's own simulation in hardware, whose equations these are: that says its true place
(HIL_STATE_QUATERNION) without an instant and in whole centimetres, and goes by its own clock.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

import numpy as np

from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.hil_sensors import hil_sensors
from sitl.autopilots.px4_pilot import Px4Pilot
from sitl.autopilots.px4_process import STEP_NS, Px4Process
from sitl.autopilots.quad_model import QuadModel
from sitl.autopilots.wire import Wire
from sitl.mission import Mission
from vcl_companion.geometry.pose import Pose

_MODEL = "sihsim_quadx"


class Px4Quad(Px4Process):
    """One that flies; see ``flown.FlyingFirmware``.

    Args:
        options: what it is.
        mission: where it stands at the start.
        wire: where it talks to.
        stack: ends the process.
    """

    pilot = Px4Pilot

    def __init__(
        self, options: FirmwareOptions, mission: Mission, wire: Wire, stack: ExitStack
    ) -> None:
        self._quad = QuadModel(mission.ned_from_body, mission.gear_m)
        super().__init__(options, _MODEL, wire, stack)

    def ned_from_body(self, at_ns: int) -> Pose:
        """Return where it truly is at an instant of its last step."""
        return self._quad.ned_from_body((at_ns - self.now_ns) * 1e-9)

    def _reading(self) -> Any:
        self._quad.step(self._controls, STEP_NS * 1e-9)
        since_us = (self.now_ns + STEP_NS - self._boot_ns) // 1000
        return hil_sensors(
            self._quad.motion(), np.array([since_us]), np.array([self._quad.turns]), self._rng
        )[0]
