"""What a pilot commands a PX4: its own modes to take off and to land, OFFBOARD between.

In OFFBOARD it flies to setpoints that have to come all the time (SET_POSITION_TARGET_LOCAL_NED;
its documentation, "Offboard Mode"): they glide along each leg.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sitl.autopilots.glide import Glide, Setpoint
from sitl.autopilots.pilot import Phase, Pilot

# px4_custom_mode.h: main mode and sub mode, the third and the fourth byte of custom_mode
_TAKEOFF, _HOLD, _LAND, _OFFBOARD = (4, 2), (4, 3), (4, 6), (6, 0)
_NAMES = {_TAKEOFF: "TAKEOFF", _HOLD: "HOLD", _LAND: "LAND", _OFFBOARD: "OFFBOARD"}
_ALL_BUT_YAW_RATE = 0b100000000000


class Px4Pilot(Pilot):
    """Commands one; see ``Pilot``."""

    _knows_where = False
    _was_in: tuple[int, int] | None = None
    _glide: Glide | None = None
    _setpoint = Setpoint.at_rest(np.zeros(3), 0.0)

    def hear(self, message: Any) -> None:
        """Take in what the firmware says."""
        super().hear(message)
        if message.get_type() == "GLOBAL_POSITION_INT":
            self._knows_where = True

    def go_on(self, now_ns: int) -> None:
        """Do what is to be done at an instant."""
        super().go_on(now_ns)
        self._steer(now_ns)

    @property
    def _is_in(self) -> tuple[int, int]:
        return self._mode >> 16 & 0xFF, self._mode >> 24 & 0xFF

    def _say(self) -> None:
        match self.phase:
            case Phase.ARMING:
                # It takes off to a height above that of its global position.
                if not self._knows_where:
                    self._say_origin()
                elif self._is_in != _TAKEOFF:
                    self._change_mode(*_TAKEOFF)
                else:
                    self._say_arm()
            case Phase.UNDER_WAY:
                if self._is_in != _OFFBOARD:
                    self._change_mode(*_OFFBOARD)
            case Phase.LANDING:
                self._change_mode(*_LAND)

    def _steer(self, now_ns: int) -> None:
        if self.phase is Phase.CLIMBING:
            # It changes to OFFBOARD only when setpoints come already.
            self._setpoint = Setpoint.at_rest(self._target, self._stood_yaw_rad)
        elif self.phase is not Phase.UNDER_WAY:
            return
        elif self._is_in == _OFFBOARD:
            if self._glide is None or self._glide.end is not self._target:
                self._glide = Glide(
                    self._setpoint.place, self._target,
                    self._setpoint.yaw_rad, self._yaws_rad[self._next],
                    self._mission.speed_m_s, now_ns,
                )  # fmt: skip
            self._setpoint = self._glide.at(now_ns)
        self._say_setpoint(self._setpoint, _ALL_BUT_YAW_RATE)

    def _left(self) -> str:
        should_be_in = _OFFBOARD if self.phase is Phase.UNDER_WAY else _TAKEOFF
        if self._is_in == should_be_in:
            self._was_in = should_be_in
        # Once it has taken off it holds its place by itself.
        holds = self.phase is Phase.CLIMBING and self._is_in == _HOLD
        if self._was_in != should_be_in or self._is_in == should_be_in or holds:
            return ""
        return f"{_NAMES[should_be_in]} for mode {_NAMES.get(self._is_in, self._is_in)}"
