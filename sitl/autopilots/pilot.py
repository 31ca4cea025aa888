"""Who flies a mission: what a person at a ground station would command, by MAVLink.

Arm, take off, go to one place after the other, land; each command is given again until the
firmware does as told. Places and headings are those of the firmware's own local frame, as far
from where and how it believed to stand before it was armed as the mission says: where a firmware
has its heading from vision, its north is whatever that calls north.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import ExitStack
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.firmware_options import Orders
from sitl.autopilots.glide import Setpoint
from sitl.mission import COMMANDED_FILE, HOME_ALTITUDE_M, HOME_DEG, LANDED, STANDS
from vcl_companion.geometry.rotation import Array, matrix_from_euler

_SAYS_AGAIN_NS = 500_000_000
THERE_M_S = 0.3
_THERE_M, _THERE_RAD = 0.3, 0.1
# It swings to rest at each place, and longer before it lands where it is.
_RESTS_NS, _RESTS_BEFORE_LANDING_NS = 1_000_000_000, 5_000_000_000
# To whom it takes so much longer than a leg should, something is wrong.
_PATIENCE, _PATIENCE_S = 3.0, 20.0
_ARMS_WITHIN_S = 60.0
_FORCE_NONE = 0.0


class Phase(Enum):
    """How far a mission has come."""

    WAITING = "waits"
    ARMING = "arms"
    CLIMBING = "takes off"
    UNDER_WAY = "under way"
    LANDING = "lands"
    OVER = "over"


class Pilot(ABC):
    """Commands one vehicle, whosever firmware it has.

    Args:
        orders: what it is to do, and when it is to arm.
        system_id: the vehicle's.
        send: takes a message to the firmware.
        out: where every place commanded, and the end, are written down (``sitl.mission``).
        stack: closes that.

    Attributes:
        phase: how far it has come.
        trouble: why it was broken off; empty while it is not.
    """

    def __init__(
        self,
        orders: Orders,
        system_id: int,
        send: Callable[[Any], None],
        out: Path,
        stack: ExitStack,
    ) -> None:
        mission = orders.mission

        self.phase = Phase.WAITING if mission.legs else Phase.OVER
        self.trouble = ""
        self._mission = mission
        self._system_id = system_id
        self._begins_ns = orders.begins_ns
        self._send = send
        self._commanded = stack.enter_context((out / COMMANDED_FILE).open("w", buffering=1))
        self._commanded.write("at_ns,x,y,z,what\n")
        self._places = mission.places() if mission.legs else np.zeros((0, 3))
        self._yaws_rad = [math.radians(leg[3]) for leg in mission.legs]
        self._next = 0
        self._stood: Array = np.full(3, np.nan)
        self._stood_yaw_rad = 0.0
        self._target: Array = np.zeros(3)
        self._position: Array | None = None
        self._speed_m_s = 0.0
        self._yaw_rad = 0.0
        self._mode = -1
        self._is_armed = False
        self._not_there_ns = 0
        self._says_again_ns = 0
        self._gives_up_ns = 0

    @property
    def says(self) -> str:
        """How far it has come, for people."""
        if self.phase is Phase.UNDER_WAY:
            return self._leg()
        return self.trouble or self.phase.value

    def _leg(self) -> str:
        return f"leg {self._next + 1} of {len(self._places)}"

    def hear(self, message: Any) -> None:
        """Take in what the firmware says."""
        match message.get_type():
            case "HEARTBEAT":
                self._mode = message.custom_mode
                self._is_armed = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
                # Once it is armed it may be in the air before the next heartbeat.
                if not self._is_armed and self._position is not None:
                    self._stood, self._stood_yaw_rad = self._position, self._yaw_rad
            case "LOCAL_POSITION_NED":
                self._position = np.array([message.x, message.y, message.z])
                self._speed_m_s = math.hypot(message.vx, message.vy, message.vz)
            case "ATTITUDE_QUATERNION":
                w, x, y, z = message.q1, message.q2, message.q3, message.q4
                self._yaw_rad = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def go_on(self, now_ns: int) -> None:
        """Do what is to be done at an instant."""
        match self.phase:
            case Phase.WAITING:
                if now_ns >= self._begins_ns and np.all(np.isfinite(self._stood)):
                    self._enter(Phase.ARMING, now_ns, _ARMS_WITHIN_S)
            case Phase.ARMING:
                if self._is_armed:
                    self._turn_mission(self._stood_yaw_rad - math.radians(self._mission.stands[2]))
                    self._note(now_ns, self._stood, STANDS)
                    self._to_climb(now_ns)
            case Phase.CLIMBING:
                if self._is_there():
                    self._to_leg(0, now_ns)
            case Phase.UNDER_WAY:
                if not (self._is_there() and self._looks_there()):
                    self._not_there_ns = now_ns
                elif now_ns - self._not_there_ns >= self._rests_ns:
                    self._to_leg(self._next + 1, now_ns)
            case Phase.LANDING:
                if not self._is_armed:
                    self._end(now_ns, self.trouble)
            case Phase.OVER:
                return
        self._mind(now_ns)
        if now_ns >= self._says_again_ns:
            self._says_again_ns = now_ns + _SAYS_AGAIN_NS
            self._say()

    @abstractmethod
    def _say(self) -> None:
        """Command what is to be done now."""

    @abstractmethod
    def _left(self) -> str:
        """Return which mode it has left though it should be in it, and for which; empty: none."""

    def _turn_mission(self, turn_rad: float) -> None:
        self._places = self._places @ matrix_from_euler(0.0, 0.0, turn_rad).T
        self._yaws_rad = [yaw_rad + turn_rad for yaw_rad in self._yaws_rad]

    def _mind(self, now_ns: int) -> None:
        """Break off what the firmware does not do, or does not let be done any more."""
        if self.phase in (Phase.CLIMBING, Phase.UNDER_WAY):
            if not self._is_armed:
                self._end(now_ns, f"disarmed: {self.says}")
            elif left := self._left():
                self._break_off(f"left {left}: {self.says}", now_ns)
            elif now_ns > self._gives_up_ns:
                self._break_off(f"did not arrive: {self.says}", now_ns)
        elif self.phase is not Phase.WAITING and now_ns > self._gives_up_ns:
            self._end(now_ns, self.trouble or f"did not do as told: {self.phase.value}")

    def _end(self, now_ns: int, trouble: str) -> None:
        self.trouble, self.phase = trouble, Phase.OVER
        self._note(now_ns, self._target, trouble or LANDED)

    def _break_off(self, why: str, now_ns: int) -> None:
        self.trouble = why
        self._enter(Phase.LANDING, now_ns, self._patience_s(self._height_m()))

    def _enter(self, phase: Phase, now_ns: int, within_s: float) -> None:
        self.phase = phase
        self._not_there_ns = now_ns
        self._says_again_ns = now_ns
        self._gives_up_ns = now_ns + round(within_s * 1e9)

    def _to_climb(self, now_ns: int) -> None:
        self._target = self._stood - np.array([0.0, 0.0, self._climbs_m])
        self._note(now_ns, self._target, Phase.CLIMBING.value)
        self._enter(Phase.CLIMBING, now_ns, self._patience_s(self._climbs_m))

    def _to_leg(self, number: int, now_ns: int) -> None:
        if number == len(self._places):
            self._target = np.array([*self._target[:2], self._stood[2]])
            self._note(now_ns, self._target, Phase.LANDING.value)
            self._enter(Phase.LANDING, now_ns, self._patience_s(self._height_m()))
            return
        before, self._target = self._target, self._stood + self._places[number]
        self._next = number
        self._note(now_ns, self._target, self._leg())
        way_m = float(np.linalg.norm(self._target - before))
        self._enter(Phase.UNDER_WAY, now_ns, self._patience_s(way_m))

    def _patience_s(self, way_m: float) -> float:
        # It climbs and sinks at its own pace, half a metre a second at the least.
        return _PATIENCE_S + _PATIENCE * way_m / min(0.5, self._mission.speed_m_s)

    @property
    def _climbs_m(self) -> float:
        return -float(self._places[0][2])

    def _height_m(self) -> float:
        return 0.0 if self._position is None else float(self._stood[2] - self._position[2])

    def _is_there(self) -> bool:
        if self._position is None or self._speed_m_s > THERE_M_S:
            return False
        return float(np.linalg.norm(self._position - self._target)) < _THERE_M

    @property
    def _rests_ns(self) -> int:
        is_last = self._next + 1 == len(self._places)
        return _RESTS_BEFORE_LANDING_NS if is_last else _RESTS_NS

    def _looks_there(self) -> bool:
        off_rad = self._yaw_rad - self._yaws_rad[self._next]
        return abs(math.remainder(off_rad, 2 * math.pi)) < _THERE_RAD

    def _say_origin(self) -> None:
        lat_deg, lon_deg = HOME_DEG
        self._send(
            dialect.MAVLink_set_gps_global_origin_message(
                self._system_id, round(lat_deg * 1e7), round(lon_deg * 1e7),
                round(HOME_ALTITUDE_M * 1e3), 0,
            )
        )  # fmt: skip

    def _say_arm(self) -> None:
        self._command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1.0, _FORCE_NONE)

    def _change_mode(self, *mode: int) -> None:
        """Command a mode of the firmware's own, by its number or numbers."""
        custom = float(dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED)
        self._command(dialect.MAV_CMD_DO_SET_MODE, custom, *map(float, mode))

    def _say_setpoint(self, setpoint: Setpoint, type_mask: int) -> None:
        place, velocity, acceleration, yaw_rad = setpoint
        self._send(
            dialect.MAVLink_set_position_target_local_ned_message(
                0, self._system_id, 1, dialect.MAV_FRAME_LOCAL_NED, type_mask,
                *place.tolist(), *velocity.tolist(), *acceleration.tolist(), yaw_rad, 0,
            )
        )  # fmt: skip

    def _command(self, command: int, *parameters: float) -> None:
        seven = [*parameters, *[0.0] * (7 - len(parameters))]
        self._send(dialect.MAVLink_command_long_message(self._system_id, 1, command, 0, *seven))

    def _note(self, at_ns: int, place: Array, what: str) -> None:
        values = ",".join(repr(float(v)) for v in place)
        self._commanded.write(f"{at_ns},{values},{what}\n")
