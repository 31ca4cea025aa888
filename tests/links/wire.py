"""MAVLink frames made and read by hand, from the published layouts, without pymavlink."""

import struct
from dataclasses import dataclass
from typing import Any

# message id: CRC_EXTRA, https://mavlink.io/en/messages/ardupilotmega.html
HEARTBEAT, ATTITUDE, ATTITUDE_QUATERNION, COMMAND_LONG, COMMAND_ACK = 0, 30, 31, 76, 77
LOCAL_POSITION_NED, SET_GPS_GLOBAL_ORIGIN, GPS_GLOBAL_ORIGIN, COMMAND_INT = 32, 48, 49, 75
PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_VALUE, PARAM_SET = 20, 21, 22, 23
AUTOPILOT_VERSION, MESSAGE_INTERVAL, ONBOARD_COMPUTER_STATUS = 148, 244, 390
VISION_POSITION_ESTIMATE, TIMESYNC, STATUSTEXT, ODOMETRY, TUNNEL = 102, 111, 253, 331, 385
EKF_STATUS_REPORT, ESTIMATOR_STATUS = 193, 230
CRC_EXTRA = {
    HEARTBEAT: 50,
    ATTITUDE: 39,
    ATTITUDE_QUATERNION: 246,
    LOCAL_POSITION_NED: 185,
    SET_GPS_GLOBAL_ORIGIN: 41,
    GPS_GLOBAL_ORIGIN: 39,
    COMMAND_INT: 158,
    COMMAND_LONG: 152,
    PARAM_REQUEST_READ: 214,
    PARAM_REQUEST_LIST: 159,
    PARAM_VALUE: 220,
    PARAM_SET: 168,
    COMMAND_ACK: 143,
    VISION_POSITION_ESTIMATE: 158,
    TIMESYNC: 34,
    EKF_STATUS_REPORT: 71,
    ESTIMATOR_STATUS: 163,
    STATUSTEXT: 83,
    ODOMETRY: 91,
    TUNNEL: 147,
    AUTOPILOT_VERSION: 178,
    MESSAGE_INTERVAL: 95,
    ONBOARD_COMPUTER_STATUS: 156,
}
# Fields on the wire stand by falling size, extensions last.
LAYOUT = {
    HEARTBEAT: struct.Struct("<IBBBBB"),  # custom_mode type autopilot base_mode status version
    ATTITUDE: struct.Struct("<I6f"),
    ATTITUDE_QUATERNION: struct.Struct("<I7f4f"),
    LOCAL_POSITION_NED: struct.Struct("<I6f"),
    SET_GPS_GLOBAL_ORIGIN: struct.Struct("<iiiB"),  # latitude longitude altitude system
    GPS_GLOBAL_ORIGIN: struct.Struct("<iii"),
    # four parameters, x y z, command, its target, frame, current, autocontinue
    COMMAND_INT: struct.Struct("<4fiifHBBBBB"),
    COMMAND_LONG: struct.Struct("<7fHBBB"),
    PARAM_REQUEST_READ: struct.Struct("<hBB16s"),
    PARAM_REQUEST_LIST: struct.Struct("<BB"),
    PARAM_VALUE: struct.Struct("<4sHH16sB"),
    PARAM_SET: struct.Struct("<4sBB16sB"),
    COMMAND_ACK: struct.Struct("<HBBiBB"),
    VISION_POSITION_ESTIMATE: struct.Struct("<Q6f21fB"),
    TIMESYNC: struct.Struct("<qq"),
    # velocity, horizontal position, vertical, compass, terrain; flags
    EKF_STATUS_REPORT: struct.Struct("<5fH"),
    # time_usec; ratios: velocity, horizontal position, vertical, ...; two accuracies; flags
    ESTIMATOR_STATUS: struct.Struct("<Q8fH"),
    STATUSTEXT: struct.Struct("<B50sHB"),
    # usec xyz q v rates 21 of the pose 21 of the twist frame child reset estimator quality
    ODOMETRY: struct.Struct("<Q3f4f3f3f21f21fBBBBb"),
    TUNNEL: struct.Struct("<HBBB128s"),
    # capabilities uid flight middleware os board vendor product, three customs, a longer uid
    AUTOPILOT_VERSION: struct.Struct("<QQIIIIHH8s8s8s18s"),
    MESSAGE_INTERVAL: struct.Struct("<iH"),
    # usec uptime ram(2) storage(4 types, 4 used, 4 in all) links(6 each of type tx rx txmax rxmax)
    # fans(4) type cores(8) combined(10) gpus(4) combined(10) board core(8)
    ONBOARD_COMPUTER_STATUS: struct.Struct("<QI2I12I30I4hB8B10B4B10Bb8b"),
}


@dataclass(frozen=True)
class Seen:
    """A frame that was read."""

    sequence: int
    system: int
    component: int
    message_id: int
    fields: tuple[Any, ...]


def crc(data: bytes) -> int:
    """CRC-16/MCRF4XX."""
    value = 0xFFFF
    for byte in data:
        low = (byte ^ value) & 0xFF
        low = (low ^ (low << 4)) & 0xFF
        value = (value >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
    return value & 0xFFFF


def frame(
    message_id: int,
    payload: bytes,
    *,
    system: int = 1,
    component: int = 1,
    sequence: int = 0,
    flags: int = 0,
    crc_extra: int | None = None,
) -> bytes:
    """A MAVLink 2 frame, its payload cut at trailing zeros."""
    payload = payload.rstrip(b"\0") or payload[:1]
    head = bytes([len(payload), flags, 0, sequence, system, component])
    body = head + message_id.to_bytes(3, "little") + payload
    extra = CRC_EXTRA[message_id] if crc_extra is None else crc_extra
    signature = bytes(13) if flags & 1 else b""
    return b"\xfd" + body + crc(body + bytes([extra])).to_bytes(2, "little") + signature


def frame_1(message_id: int, payload: bytes, system: int = 1, component: int = 1) -> bytes:
    """A MAVLink 1 frame."""
    body = bytes([len(payload), 0, system, component, message_id]) + payload
    checksum = crc(body + bytes([CRC_EXTRA[message_id]]))
    return b"\xfe" + body + checksum.to_bytes(2, "little")


def packed(
    message_id: int, *fields: int | float | bytes, system: int = 1, component: int = 1
) -> bytes:
    """A MAVLink 2 frame of a message's fields in wire order."""
    payload = LAYOUT[message_id].pack(*fields)
    return frame(message_id, payload, system=system, component=component)


def heartbeat(system: int = 1, component: int = 1) -> bytes:
    return packed(HEARTBEAT, 4, 2, 3, 1, 4, 3, system=system, component=component)


def attitude_quaternion(time_boot_ms: int, quaternion: tuple[float, float, float, float]) -> bytes:
    return packed(ATTITUDE_QUATERNION, time_boot_ms, *quaternion, 0, 0, 0, 0, 0, 0, 0)


def tunnel(
    payload: bytes,
    *,
    system: int,
    component: int = 197,
    target: int = 0,
    target_component: int = 0,
    length: int | None = None,
    payload_type: int = 40000,
) -> bytes:
    n = len(payload) if length is None else length
    return packed(
        TUNNEL, payload_type, target, target_component, n, payload, system=system,
        component=component,
    )  # fmt: skip


def read(data: bytes) -> list[Seen]:
    """Read whole, correct MAVLink 2 frames; anything else is an assertion error."""
    out = []
    while data:
        assert data[0] == 0xFD
        n = data[1]
        assert data[2] == 0
        body, checksum = data[1 : 10 + n], data[10 + n : 12 + n]
        message_id = int.from_bytes(data[7:10], "little")
        expected = crc(body + bytes([CRC_EXTRA[message_id]]))
        assert int.from_bytes(checksum, "little") == expected
        layout = LAYOUT[message_id]
        # Extension fields that are not in the layout are passed over.
        payload = data[10 : 10 + n][: layout.size].ljust(layout.size, b"\0")
        out.append(Seen(data[4], data[5], data[6], message_id, layout.unpack(payload)))
        data = data[12 + n :]
    return out
