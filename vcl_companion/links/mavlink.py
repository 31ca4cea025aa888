"""MAVLink 2: typed messages to bytes by pymavlink, and back (``decoding``).

The dialect is ``ardupilotmega``: it contains ``common``, and the EKF_STATUS_REPORT
of ArduPilot that ``common`` has not.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from vcl_companion.clock import Moment, system_moment
from vcl_companion.geometry.rotation import Array
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.decoding import Decoder
from vcl_companion.links.messages import (
    COMPONENT_AUTOPILOT,
    COMPONENT_COMPANION,
    MAX_TUNNEL_BYTES,
    REQUEST_MESSAGE,
    SET_GLOBAL_ORIGIN,
    SET_MESSAGE_INTERVAL,
    Message,
)
from vcl_companion.links.readers import TIMESYNC_LAYOUT
from vcl_companion.links.signing import SIGNED_FLAG, Signing

_CHECKSUM_BYTES = 2

# PARAM_SET, its value as bytes: an integer's may be a float that is not a number
# | 0  | 4s  | value            |
# | 4  | u8  | target system    |
# | 5  | u8  | its component    |
# | 6  | 16s | name             |
# | 22 | u8  | MAV_PARAM_TYPE   |
_PARAMETER_SET = struct.Struct("<4sBB16sB")


class Codec:
    """One link's side of MAVLink: counts its own frames, and reads what others' bytes say.

    Bytes that are not what they should be never raise (``Decoder``).

    Args:
        system_id: ours.
        component_id: ours.
        tally: where it counts.
        signing: signs what goes out and judges what comes in; None: nothing is signed, and
            signatures are not looked at.
        now: tells the time that frames are signed with.
    """

    def __init__(
        self,
        system_id: int,
        component_id: int,
        tally: LinkTally,
        signing: Signing | None = None,
        now: Callable[[], Moment] = system_moment,
    ) -> None:
        self._mav = dialect.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._tally = tally
        self._signing = signing
        self._now = now
        self._decoder = Decoder((system_id, component_id), tally, signing, now)

    def decode(self, data: bytes, *, is_stream: bool) -> list[Message]:
        """Return the messages that have come over a stream, or in one datagram."""
        return self.decode_stream(data) if is_stream else self.decode_datagram(data)

    def decode_stream(self, data: bytes) -> list[Message]:
        """Return the messages that ``data`` completes, after what came before it."""
        return self._decoder.stream(data)

    def decode_datagram(self, data: bytes) -> list[Message]:
        """Return the messages in one datagram, whatever came before it."""
        return self._decoder.datagram(data)

    def _pack(self, message: Any) -> bytes:
        frame = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        self._tally.messages_out += 1
        if self._signing is None or not self._signing.signs:
            return frame
        return self._signed(self._signing, frame, message.crc_extra)

    def _signed(self, signing: Signing, frame: bytes, crc_extra: int) -> bytes:
        """Return a frame that says that it is signed, and is."""
        body = frame[1:2] + bytes([SIGNED_FLAG]) + frame[3:-_CHECKSUM_BYTES]
        checksum = int(dialect.x25crc(body + bytes([crc_extra])).crc)
        whole = frame[:1] + body + checksum.to_bytes(_CHECKSUM_BYTES, "little")
        return whole + signing.trailer(whole, self._now())

    def frame(self, message: Any) -> bytes:
        """Return the frame of a message that was made elsewhere (``own_messages``)."""
        return self._pack(message)

    def heartbeat(self, system_status: int) -> bytes:
        """Return a companion's HEARTBEAT with a MAV_STATE."""
        return self._heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER, system_status)

    def ground_heartbeat(self) -> bytes:
        """Return a ground station's HEARTBEAT."""
        return self._heartbeat(dialect.MAV_TYPE_GCS, dialect.MAV_STATE_UNINIT)

    def _heartbeat(self, vehicle_type: int, system_status: int) -> bytes:
        return self._pack(
            dialect.MAVLink_heartbeat_message(
                vehicle_type, dialect.MAV_AUTOPILOT_INVALID, 0, 0, system_status, 3
            )
        )

    def timesync(self, tc1_ns: int, ts1_ns: int, target_system: int = 0) -> bytes:
        """Return a TIMESYNC, a question when ``tc1_ns`` is 0; to another companion, or to any."""
        if target_system:
            return self._pack(_AddressedTimesync(tc1_ns, ts1_ns, target_system))
        return self._pack(dialect.MAVLink_timesync_message(tc1_ns, ts1_ns))

    def tunnel(self, target_system: int, payload_type: int, payload: bytes) -> bytes:
        """Return a TUNNEL to another companion, or to all (0).

        Raises:
            ValueError: the payload is longer than 128 bytes.
        """
        if len(payload) > MAX_TUNNEL_BYTES:
            raise ValueError(f"a TUNNEL takes {MAX_TUNNEL_BYTES} bytes, got {len(payload)}")
        return self._pack(
            dialect.MAVLink_tunnel_message(
                target_system,
                COMPONENT_COMPANION if target_system else 0,
                payload_type,
                len(payload),
                payload.ljust(MAX_TUNNEL_BYTES, b"\0"),
            )
        )

    def status_text(self, severity: int, text: bytes, text_id: int, chunk: int) -> bytes:
        """Return one chunk of at most 50 bytes of a STATUSTEXT."""
        return self._pack(dialect.MAVLink_statustext_message(severity, text, text_id, chunk))

    def set_message_interval(self, target_system: int, message_id: int, interval_us: int) -> bytes:
        """Return the command that asks the autopilot to stream a message."""
        parameters = (float(message_id), float(interval_us), 0.0, 0.0, 0.0, 0.0, 0.0)
        return self._pack(
            dialect.MAVLink_command_long_message(
                target_system, COMPONENT_AUTOPILOT, SET_MESSAGE_INTERVAL, 0, *parameters
            )
        )

    def request_message(self, target_system: int, message_id: int) -> bytes:
        """Return the command that asks the autopilot for one message, once."""
        parameters = (float(message_id), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        return self._pack(
            dialect.MAVLink_command_long_message(
                target_system, COMPONENT_AUTOPILOT, REQUEST_MESSAGE, 0, *parameters
            )
        )

    def command_global_origin(
        self, target_system: int, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> bytes:
        """Return the COMMAND_INT that sets the origin of the autopilot's local frame (611)."""
        return self._pack(
            dialect.MAVLink_command_int_message(
                target_system, COMPONENT_AUTOPILOT, dialect.MAV_FRAME_GLOBAL, SET_GLOBAL_ORIGIN,
                0, 0, 0.0, 0.0, 0.0, 0.0,
                round(1e7 * latitude_deg), round(1e7 * longitude_deg), altitude_m,
            )
        )  # fmt: skip

    def set_global_origin(
        self, target_system: int, latitude_deg: float, longitude_deg: float, altitude_m: float
    ) -> bytes:
        """Return the SET_GPS_GLOBAL_ORIGIN that does the same; it has no answer of its own."""
        return self._pack(
            dialect.MAVLink_set_gps_global_origin_message(
                target_system, round(1e7 * latitude_deg), round(1e7 * longitude_deg),
                round(1e3 * altitude_m),
            )
        )  # fmt: skip

    def command(
        self,
        target_system: int,
        command: int,
        parameters: tuple[float, float, float, float, float, float, float],
        confirmation: int = 0,
    ) -> bytes:
        """Return a COMMAND_LONG to another companion."""
        return self._pack(
            dialect.MAVLink_command_long_message(
                target_system, COMPONENT_COMPANION, command, confirmation, *parameters
            )
        )

    def command_ack(
        self, command: int, result: int, progress: int, target_system: int, target_component: int
    ) -> bytes:
        """Return the COMMAND_ACK of a command, to who gave it."""
        return self._pack(
            dialect.MAVLink_command_ack_message(
                command, result, progress, 0, target_system, target_component
            )
        )

    def read_parameter(self, target_system: int, name: str) -> bytes:
        """Return the PARAM_REQUEST_READ of an autopilot's parameter."""
        return self._pack(
            dialect.MAVLink_param_request_read_message(
                target_system, COMPONENT_AUTOPILOT, name.encode("ascii"), -1
            )
        )

    def set_parameter(self, target_system: int, name: str, raw: bytes, kind: int) -> bytes:
        """Return the PARAM_SET of an autopilot's parameter: its value's four bytes and its type."""
        return self._pack(_RawParameterSet(target_system, name.encode("ascii"), raw, kind))

    def vision_position_estimate(
        self,
        usec: int,
        position_m: tuple[float, float, float],
        euler_rad: tuple[float, float, float],
        covariance: Array,
        reset_counter: int,
    ) -> bytes:
        """Return a VISION_POSITION_ESTIMATE.

        Args:
            usec: instant of the measurement, us of the clock that answers TIMESYNC.
            position_m: x y z, NED-like.
            euler_rad: roll pitch yaw.
            covariance: (6, 6) of both, m and rad.
            reset_counter: 0..255.
        """
        upper = [float(value) for value in covariance[np.triu_indices(6)]]
        return self._pack(
            dialect.MAVLink_vision_position_estimate_message(
                usec, *position_m, *euler_rad, upper, reset_counter
            )
        )

    def odometry(
        self,
        usec: int,
        frame: int,
        position_m: tuple[float, float, float],
        quaternion: tuple[float, float, float, float],
        velocity_body_m_s: tuple[float, float, float],
        covariance: Array,
        velocity_covariance: Array,
        reset_counter: int,
    ) -> bytes:
        """Return an ODOMETRY of a vision estimator, velocities in BODY_FRD; no angular rates.

        Args:
            usec: instant of the measurement, us of the clock that answers TIMESYNC.
            frame: MAV_FRAME of the pose.
            position_m: x y z, NED-like.
            quaternion: w x y z, local_from_body.
            velocity_body_m_s: forward, right, down.
            covariance: (6, 6) of position and roll pitch yaw, m and rad.
            velocity_covariance: (3, 3) of the velocity, m^2/s^2.
            reset_counter: 0..255.
        """
        rates = np.full((6, 6), np.nan)
        rates[:3, :3] = velocity_covariance
        upper = np.triu_indices(6)
        return self._pack(
            dialect.MAVLink_odometry_message(
                usec, frame, dialect.MAV_FRAME_BODY_FRD, *position_m, quaternion,
                *velocity_body_m_s, math.nan, math.nan, math.nan,
                covariance[upper].tolist(), rates[upper].tolist(), reset_counter,
                dialect.MAV_ESTIMATOR_TYPE_VISION, 0,
            )
        )  # fmt: skip


class _AddressedTimesync(dialect.MAVLink_timesync_message):  # type: ignore[misc]  # untyped
    """A TIMESYNC for one companion."""

    def __init__(self, tc1_ns: int, ts1_ns: int, target_system: int) -> None:
        super().__init__(tc1_ns, ts1_ns)
        self._target_system = target_system

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        payload = TIMESYNC_LAYOUT.pack(self.tc1, self.ts1, self._target_system, COMPONENT_COMPANION)
        return bytes(self._pack(mav, self.crc_extra, payload, force_mavlink1=force_mavlink1))


class _RawParameterSet(dialect.MAVLink_param_set_message):  # type: ignore[misc]  # untyped
    """A PARAM_SET whose value is four bytes."""

    def __init__(self, target_system: int, name: bytes, raw: bytes, kind: int) -> None:
        super().__init__(target_system, COMPONENT_AUTOPILOT, name, 0.0, kind)
        self._body = _PARAMETER_SET.pack(raw, target_system, COMPONENT_AUTOPILOT, name, kind)

    def pack(self, mav: Any, force_mavlink1: bool = False) -> bytes:
        return bytes(self._pack(mav, self.crc_extra, self._body, force_mavlink1=force_mavlink1))
