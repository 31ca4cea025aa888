"""What a companion says of itself when it is asked: pymavlink's messages, for ``Codec.frame``.

https://mavlink.io/en/messages/common.html: AUTOPILOT_VERSION, MESSAGE_INTERVAL, PARAM_VALUE,
ONBOARD_COMPUTER_STATUS.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from vcl_companion.links.messages import PARAMETER_REAL32

_UNUSED_8, _UNUSED_I8 = (1 << 8) - 1, (1 << 7) - 1
_UNUSED_I16, _UNUSED_32 = (1 << 15) - 1, (1 << 32) - 1
_N_CORES = 8
_MAX_FLOAT32 = 3.4028234e38
_CAPABILITIES = (
    dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    # Parameters are REAL32, one by one: a value reads the same by either encoding, but one of
    # them has to be named.
    | dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
)


@dataclass(frozen=True)
class ComputerStatus:
    """How a companion computer is; None, or nothing, for what is not known.

    Attributes:
        unix_us: when, since 1970.
        uptime_ms: since the computer was started.
        cores_percent: load of each core since the last time.
        ram_used_mib, ram_mib: memory that is not available, and all of it.
        disk_used_mib, disk_mib: of the file system that the service writes to.
        cores_deg: temperatures, degrees Celsius.
    """

    unix_us: int
    uptime_ms: int
    cores_percent: tuple[int, ...] = ()
    ram_used_mib: int | None = None
    ram_mib: int | None = None
    disk_used_mib: int | None = None
    disk_mib: int | None = None
    cores_deg: tuple[int, ...] = ()


def autopilot_version(version: tuple[int, int, int]) -> Any:
    """Return an AUTOPILOT_VERSION: our version and capabilities; no board, no identity."""
    major, minor, patch = (min(number, _UNUSED_8) for number in version)
    kind = dialect.FIRMWARE_VERSION_TYPE_OFFICIAL if major else dialect.FIRMWARE_VERSION_TYPE_DEV
    software = major << 24 | minor << 16 | patch << 8 | kind
    nothing = [0] * 8
    return dialect.MAVLink_autopilot_version_message(
        _CAPABILITIES, software, 0, 0, 0, nothing, nothing, nothing, 0, 0, 0
    )


def message_interval(message_id: int, interval_us: int) -> Any:
    """Return a MESSAGE_INTERVAL; ``interval_us`` -1: it is not streamed, 0: we have none."""
    return dialect.MAVLink_message_interval_message(message_id, interval_us)


def parameter_value(name: str, value: float, n_parameters: int, index: int) -> Any:
    """Return the PARAM_VALUE of one of our parameters, a REAL32."""
    told = max(-_MAX_FLOAT32, min(value, _MAX_FLOAT32))
    return dialect.MAVLink_param_value_message(
        name.encode("ascii"), told, PARAMETER_REAL32, n_parameters, index
    )


def computer_status(status: ComputerStatus) -> Any:
    """Return an ONBOARD_COMPUTER_STATUS of the primary mission computer."""
    loads = [min(max(load, 0), 100) for load in status.cores_percent[:_N_CORES]]
    degrees = [min(max(deg, -128), _UNUSED_I8 - 1) for deg in status.cores_deg[:_N_CORES]]
    storage = [_UNUSED_32] * 4
    links = [_UNUSED_32] * 6
    return dialect.MAVLink_onboard_computer_status_message(
        status.unix_us,
        min(status.uptime_ms, _UNUSED_32),
        0,
        loads + [_UNUSED_8] * (_N_CORES - len(loads)),
        [_UNUSED_8] * 10,
        [_UNUSED_8] * 4,
        [_UNUSED_8] * 10,
        _UNUSED_I8,
        degrees + [_UNUSED_I8] * (_N_CORES - len(degrees)),
        [_UNUSED_I16] * 4,
        _bounded(status.ram_used_mib),
        _bounded(status.ram_mib),
        storage,
        [_bounded(status.disk_used_mib), *storage[1:]],
        [_bounded(status.disk_mib), *storage[1:]],
        *(links, links, links, links, links),
    )


def _bounded(value: int | None) -> int:
    return _UNUSED_32 if value is None else min(value, _UNUSED_32 - 1)
