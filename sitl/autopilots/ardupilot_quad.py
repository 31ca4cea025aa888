"""An ArduCopter whose own model of a quad flies: it says its true state after each step.

It takes us for a second firmware that rides along (``--slave``, SIM_JSON_Master.cpp): it waits for
our word before each step. The port is always the same one, so each is to be in a network of its
own. Its steps are 0.8 to 2.5 ms.
"""

from __future__ import annotations

import json
import math
import struct
import time
from contextlib import ExitStack

import numpy as np

from sitl.autopilots.ardupilot_pilot import ArduCopterPilot
from sitl.autopilots.ardupilot_process import ArduCopterProcess
from sitl.autopilots.firmware_options import FirmwareOptions
from sitl.autopilots.wire import Wire
from sitl.mission import Mission
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import euler_from_matrix

_KNOCK_S = 0.1
_MAX_STATE_BYTES = 4096
# Where it expects who rides along, and what that would have its servos do, which it ignores:
# magic, frame rate, frame count, pwm.
_RIDES_AT = ("127.0.0.1", 9012)
_RIDE_ALONG = struct.Struct("<HHI16H").pack(18458, 400, 0, *([0] * 16))


class ArduCopterQuad(ArduCopterProcess):
    """One that flies; see ``flown.FlyingFirmware``.

    Args:
        options: what it is.
        mission: where it stands at the start.
        wire: where it talks to.
        stack: ends the process.
    """

    pilot = ArduCopterPilot

    def __init__(
        self, options: FirmwareOptions, mission: Mission, wire: Wire, stack: ExitStack
    ) -> None:
        super().__init__(options, wire, stack)
        stands = mission.ned_from_body
        yaw_deg = math.degrees(euler_from_matrix(stands.rotation)[2])
        self._start(("--model", "quad", "--slave", "1"), yaw_deg)
        self._before = self._after = self._first_state()
        self.now_ns, first = self._after
        self._offset_m = stands.translation - first.translation

    def is_due(self, until_ns: int) -> bool:
        """Return whether it has not come to an instant yet."""
        return self.now_ns < until_ns

    def step(self) -> None:
        """Move it on by one step of its clock; it does what is due in it until the next one."""
        self._sim.sendto(_RIDE_ALONG, _RIDES_AT)
        self._before, self._after = self._after, self._state(self._heard(time.monotonic())[0])
        self.now_ns = self._after[0]

    def ned_from_body(self, at_ns: int) -> Pose:
        """Return where it truly is at an instant of its last step."""
        (from_ns, start), (to_ns, end) = self._before, self._after
        share = (at_ns - from_ns) / (to_ns - from_ns) if to_ns > from_ns else 1.0
        pose = start.retracted(share * start.local(end))
        return Pose(pose.rotation, pose.translation + self._offset_m)

    def _state(self, data: bytes) -> tuple[int, Pose]:
        try:
            said = json.loads(data)
            pose = Pose.from_quaternion(np.array(said["quaternion"]), np.array(said["position"]))
            return self._options.boot_offset_ns + round(said["timestamp"] * 1e9), pose
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"the firmware says no state that is one: {error}") from error

    def _first_state(self) -> tuple[int, Pose]:
        """Knock until it opens; it says a state for each knock that came through."""
        within_s = self._sim.gettimeout()
        self._sim.settimeout(_KNOCK_S)
        knocked_at_s = time.monotonic()
        state = None
        while True:
            try:
                state = self._state(self._sim.recv(_MAX_STATE_BYTES))
            except TimeoutError:
                if state is not None:
                    self._sim.settimeout(within_s)
                    return state
                self._process.still_there(knocked_at_s)
                self._sim.sendto(_RIDE_ALONG, _RIDES_AT)
