"""What a pilot commands an ArduCopter: GUIDED, arm, take off, one place after the other, LAND."""

from __future__ import annotations

from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.glide import Setpoint
from sitl.autopilots.pilot import THERE_M_S, Phase, Pilot

_GUIDED, _LAND = 4, 9
_SETS_OUT_WITHIN_NS = 2_000_000_000
_PLACE_AND_YAW = 0b100111111000


class ArduCopterPilot(Pilot):
    """Commands one; see ``Pilot``."""

    def _say(self) -> None:
        match self.phase:
            case Phase.ARMING:
                self._say_origin()
                self._change_mode(_GUIDED)
                self._say_arm()
            case Phase.CLIMBING:
                if self._height_m() < 0.3:
                    self._command(dialect.MAV_CMD_NAV_TAKEOFF, *[0.0] * 6, self._climbs_m)
            case Phase.UNDER_WAY:
                # Told again, it would begin its way anew, from rest.
                self._says_again_ns += _SETS_OUT_WITHIN_NS
                if self._speed_m_s > THERE_M_S:
                    return
                there = Setpoint.at_rest(self._target, self._yaws_rad[self._next])
                self._say_setpoint(there, _PLACE_AND_YAW)
            case Phase.LANDING:
                self._change_mode(_LAND)

    def _left(self) -> str:
        return "" if self._mode in (_GUIDED, -1) else f"GUIDED for mode {self._mode}"
