"""What pymavlink has decoded, as values of ours, or why it is refused: none of it is trusted."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from vcl_companion.geometry.rotation import Array, matrix_from_euler, matrix_from_quaternion
from vcl_companion.links.messages import (
    COMPONENT_COMPANION,
    MAX_TUNNEL_BYTES,
    AttitudeSample,
    CommandAck,
    CommandLong,
    EstimatorStatus,
    GlobalOrigin,
    Heartbeat,
    LocalPosition,
    Message,
    ParameterList,
    ParameterRead,
    ParameterSet,
    ParameterValue,
    StatusText,
    Timesync,
    Tunnel,
)

_HEAD_2 = 10
_VALUE_BYTES, _NAME_BYTES = 4, 16
# Where the name begins in PARAM_REQUEST_READ, and in PARAM_SET
_NAME_IN_READ, _NAME_IN_SET = 4, 6
_QUATERNION_NORM_TOLERANCE = 0.05
# The same bits in EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS
_POSITION_RELATIVE, _POSITION_ABSOLUTE, _POSITION_CONSTANT = 0x8, 0x10, 0x80

# TIMESYNC with the extension fields that pymavlink's layout ends before
# | 0  | i64 | tc1                                                    |
# | 8  | i64 | ts1                                                    |
# | 16 | u8  | target system: of who is asked, or has asked; 0 for any |
# | 17 | u8  | its component                                          |
TIMESYNC_LAYOUT = struct.Struct("<qqBB")

_Sender = tuple[int, int]


def _heartbeat(m: Any, sender: _Sender) -> Message | str:
    return Heartbeat(*sender, m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status)


def _timesync(m: Any, sender: _Sender) -> Message | str:
    return Timesync(*sender, *TIMESYNC_LAYOUT.unpack(_payload(m, TIMESYNC_LAYOUT.size)))


def _attitude(m: Any, sender: _Sender) -> Message | str:
    angles = (m.roll, m.pitch, m.yaw)
    if not all(map(math.isfinite, angles)):
        return "attitude is no rotation"
    rotation = matrix_from_euler(*angles)
    return AttitudeSample(*sender, m.time_boot_ms, rotation, "euler", _body_rates(m))


def _attitude_quaternion(m: Any, sender: _Sender) -> Message | str:
    quaternion = np.array([m.q1, m.q2, m.q3, m.q4])
    # Not a number fails this comparison as well.
    if not abs(float(np.linalg.norm(quaternion)) - 1.0) < _QUATERNION_NORM_TOLERANCE:
        return "attitude is no rotation"
    rotation = matrix_from_quaternion(quaternion)
    return AttitudeSample(*sender, m.time_boot_ms, rotation, "quaternion", _body_rates(m))


def _body_rates(m: Any) -> Array | None:
    """Return the (3,) body rates of either message, rad/s; None where they are none.

    All zero is what a simulator says that has no gyros: real ones are never that still.
    """
    rates = np.array([m.rollspeed, m.pitchspeed, m.yawspeed])
    return rates if np.all(np.isfinite(rates)) and rates.any() else None


def _ekf_status_report(m: Any, sender: _Sender) -> Message | str:
    if not math.isfinite(m.pos_horiz_variance):
        return "estimator's test ratio is no number"
    has_position = bool(m.flags & (_POSITION_RELATIVE | _POSITION_ABSOLUTE))
    holds_position = bool(m.flags & _POSITION_CONSTANT)
    return EstimatorStatus(*sender, has_position, holds_position, m.pos_horiz_variance)


def _estimator_status(m: Any, sender: _Sender) -> Message | str:
    has_position = bool(m.flags & (_POSITION_RELATIVE | _POSITION_ABSOLUTE))
    # PX4 says so as well while it stands on the ground and fuses; without a position it does not.
    holds_position = bool(m.flags & _POSITION_CONSTANT) and not has_position
    # It sends NaN while it tests none.
    ratio = m.pos_horiz_ratio if math.isfinite(m.pos_horiz_ratio) else None
    return EstimatorStatus(*sender, has_position, holds_position, ratio)


def _local_position(m: Any, sender: _Sender) -> Message | str:
    values = np.array([m.x, m.y, m.z, m.vx, m.vy, m.vz])
    if not np.all(np.isfinite(values)):
        return "local position is no number"
    return LocalPosition(*sender, m.time_boot_ms, values[:3], values[3:])


def _global_origin(m: Any, sender: _Sender) -> Message | str:
    latitude_deg, longitude_deg = m.latitude * 1e-7, m.longitude * 1e-7
    if abs(latitude_deg) > 90.0 or abs(longitude_deg) > 180.0:
        return "global origin is no place"
    return GlobalOrigin(*sender, latitude_deg, longitude_deg, m.altitude * 1e-3)


def _tunnel(m: Any, sender: _Sender) -> Message | str:
    if m.payload_length > MAX_TUNNEL_BYTES:
        return "tunnel length is a lie"
    if m.target_component not in (0, COMPONENT_COMPANION):
        return "tunnel for another component"
    payload = bytes(m.payload[: m.payload_length])
    return Tunnel(*sender, m.target_system, m.payload_type, payload)


def _parameter_value(m: Any, sender: _Sender) -> Message | str:
    name = m.param_id if isinstance(m.param_id, str) else m.param_id.decode("ascii", "replace")
    # The value's bytes are an integer's for some: what they were as a float must not be lost.
    return ParameterValue(*sender, name.rstrip("\0"), _payload(m, _VALUE_BYTES), m.param_type)


def _parameter_list(m: Any, sender: _Sender) -> Message | str:
    return ParameterList(*sender, m.target_system, m.target_component)


def _parameter_read(m: Any, sender: _Sender) -> Message | str:
    name = _name(m, _NAME_IN_READ)
    if name is None:
        return "parameter's name is no text"
    return ParameterRead(*sender, m.target_system, m.target_component, name, m.param_index)


def _parameter_set(m: Any, sender: _Sender) -> Message | str:
    name = _name(m, _NAME_IN_SET)
    if name is None:
        return "parameter's name is no text"
    raw = _payload(m, _VALUE_BYTES)
    return ParameterSet(*sender, m.target_system, m.target_component, name, raw, m.param_type)


def _name(m: Any, at: int) -> str | None:
    """Return a parameter's name: up to 16 characters, or up to a zero; None if that is no ASCII."""
    name = _payload(m, at + _NAME_BYTES)[at:].partition(b"\0")[0]
    return name.decode("ascii") if name.isascii() else None


def _payload(m: Any, n_bytes: int) -> bytes:
    """Return the first bytes of a message's payload, with the zeros that were not sent."""
    frame = m.get_msgbuf()
    return bytes(frame[_HEAD_2 : _HEAD_2 + min(frame[1], n_bytes)]).ljust(n_bytes, b"\0")


def _status_text(m: Any, sender: _Sender) -> Message | str:
    return StatusText(*sender, m.severity, m.text, m.id, m.chunk_seq)


def _command_long(m: Any, sender: _Sender) -> Message | str:
    parameters = (m.param1, m.param2, m.param3, m.param4, m.param5, m.param6, m.param7)
    return CommandLong(
        *sender, m.target_system, m.target_component, m.command, m.confirmation, parameters
    )


def _command_ack(m: Any, sender: _Sender) -> Message | str:
    return CommandAck(*sender, m.command, m.result, m.target_system, m.target_component, m.progress)


# What becomes of each message, by its name: a value, or why it is refused.
READERS: dict[str, Callable[[Any, _Sender], Message | str]] = {
    "HEARTBEAT": _heartbeat,
    "TIMESYNC": _timesync,
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "EKF_STATUS_REPORT": _ekf_status_report,
    "ESTIMATOR_STATUS": _estimator_status,
    "LOCAL_POSITION_NED": _local_position,
    "GPS_GLOBAL_ORIGIN": _global_origin,
    "PARAM_VALUE": _parameter_value,
    "PARAM_REQUEST_LIST": _parameter_list,
    "PARAM_REQUEST_READ": _parameter_read,
    "PARAM_SET": _parameter_set,
    "TUNNEL": _tunnel,
    "STATUSTEXT": _status_text,
    "COMMAND_LONG": _command_long,
    "COMMAND_ACK": _command_ack,
}
