"""Whether an autopilot flies to positions that somebody commands: what its HEARTBEAT says of it.

Its target stays where it is in the frame that it knows: when what it is told of its own place
jumps, the drone flies that way.
"""

from __future__ import annotations

from dataclasses import dataclass

from vcl_companion.links.messages import Heartbeat
from vcl_companion.links.vision_pose import Firmware, firmware_of

# MAV_MODE_FLAG
_ARMED, _CUSTOM = 128, 1
# GUIDED of ArduCopter (and of ArduSub); of ArduPlane and Rover, by MAV_TYPE.
_GUIDED = 4
_GUIDED_OF = {1: 15, 10: 15, 11: 15}
# px4_custom_mode.h: PX4_CUSTOM_MAIN_MODE_OFFBOARD, the third byte
_OFFBOARD = 6


@dataclass(frozen=True)
class VehicleMode:
    """How a vehicle is flown.

    Attributes:
        is_armed: whether its motors may turn.
        follows_positions: whether it flies to commanded positions (GUIDED, OFFBOARD).
    """

    is_armed: bool = False
    follows_positions: bool = False

    @property
    def is_steered_by_positions(self) -> bool:
        """Whether a jump of what it is told moves it."""
        return self.is_armed and self.follows_positions


def mode_of(heartbeat: Heartbeat) -> VehicleMode:
    """Return what a heartbeat says; of firmware that is not known, that it follows nothing."""
    if not heartbeat.base_mode & _CUSTOM:
        return VehicleMode(bool(heartbeat.base_mode & _ARMED))
    follows = False
    match firmware_of(heartbeat.autopilot):
        case Firmware.ARDUPILOT:
            guided = _GUIDED_OF.get(heartbeat.vehicle_type, _GUIDED)
            follows = heartbeat.custom_mode == guided
        case Firmware.PX4:
            follows = (heartbeat.custom_mode >> 16) & 0xFF == _OFFBOARD
    return VehicleMode(bool(heartbeat.base_mode & _ARMED), follows)
