"""What comes over a MAVLink link, decoded: one value per message that anybody here wants."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vcl_companion.geometry.rotation import Array

COMPONENT_AUTOPILOT = 1
COMPONENT_COMPANION = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
MAX_TUNNEL_BYTES = 128
STATUS_TEXT_BYTES = 50
GET_MESSAGE_INTERVAL, SET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 510, 511, 512
SET_GLOBAL_ORIGIN = 611
HEARTBEAT_ID = 0
ATTITUDE_QUATERNION_ID = 31
LOCAL_POSITION_ID = 32
GLOBAL_ORIGIN_ID = 49
VISION_POSITION_ESTIMATE_ID = 102
AUTOPILOT_VERSION_ID = 148
EKF_STATUS_REPORT_ID = 193
ESTIMATOR_STATUS_ID = 230
MESSAGE_INTERVAL_ID = 244
ODOMETRY_ID = 331
ONBOARD_COMPUTER_STATUS_ID = 390
RESULT_ACCEPTED, RESULT_TEMPORARILY_REJECTED, RESULT_DENIED, RESULT_UNSUPPORTED = 0, 1, 2, 3
RESULT_FAILED, RESULT_IN_PROGRESS, RESULT_CANCELLED = 4, 5, 6
UPDATE_MAP, SAVE_MAP, RELOAD_MAP = 31010, 31011, 31012  # MAV_CMD_USER_1, 2, 3
RELOCALIZE, PAUSE_SENDING = 31013, 31014  # MAV_CMD_USER_4, 5
PARAMETER_REAL32 = 9  # MAV_PARAM_TYPE
FRAME_LOCAL_NED, FRAME_LOCAL_FRD = 1, 20


@dataclass(frozen=True, eq=False)
class Message:
    """A message with its sender."""

    sender_system: int
    sender_component: int


@dataclass(frozen=True)
class Heartbeat(Message):
    """Somebody is there: ``vehicle_type`` MAV_TYPE, ``autopilot`` MAV_AUTOPILOT, MAV_STATE."""

    vehicle_type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    system_status: int


@dataclass(frozen=True, eq=False)
class AttitudeSample(Message):
    """An attitude by the autopilot's own clock.

    Attributes:
        time_boot_ms: milliseconds since the autopilot's start, cut off, not rounded; 32 bits as
            they come, more where ``BootClock`` has made them run on.
        ned_from_body: (3, 3) rotation.
        source: the message that it came in.
        body_rates_rad_s: (3,) how fast its gyros say that it turns about the body's axes;
            None for unknown.
    """

    time_boot_ms: int
    ned_from_body: Array
    source: Literal["quaternion", "euler"]
    body_rates_rad_s: Array | None = None

    def __post_init__(self) -> None:
        if self.ned_from_body.shape != (3, 3):
            raise ValueError(f"an attitude is (3, 3), got {self.ned_from_body.shape}")
        self.ned_from_body.flags.writeable = False
        if self.body_rates_rad_s is not None:
            self.body_rates_rad_s.flags.writeable = False

    @property
    def heading_rate_rad_s(self) -> float | None:
        """How fast its gyros say that it turns about down, rad/s; None for unknown."""
        rates = self.body_rates_rad_s
        return None if rates is None else float(self.ned_from_body[2] @ rates)


@dataclass(frozen=True)
class Timesync(Message):
    """A question (``tc1_ns`` 0) or the answer to the one that was asked at ``ts1_ns``.

    ``target_system`` and ``target_component`` 0 are everybody.
    """

    tc1_ns: int
    ts1_ns: int
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True)
class Untimely(Message):
    """A frame with a right signature and a wrong time: good for telling the time, no more.

    Attributes:
        timestamp: what it was signed with.
        ahead: whether that is later than it may be, else earlier.
        timesync: what it says, if it is a TIMESYNC.
    """

    timestamp: int
    ahead: bool
    timesync: Timesync | None


@dataclass(frozen=True)
class Tunnel(Message):
    """An opaque payload of at most 128 bytes; ``target_system`` 0 is everybody."""

    target_system: int
    payload_type: int
    payload: bytes


@dataclass(frozen=True)
class StatusText(Message):
    """One chunk of a text; ``text_id`` 0 means it is the only one."""

    severity: int
    text: str
    text_id: int
    chunk: int


@dataclass(frozen=True)
class CommandLong(Message):
    """A command with its seven parameters."""

    target_system: int
    target_component: int
    command: int
    confirmation: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class CommandAck(Message):
    """What became of a command: ``result`` MAV_RESULT, ``progress`` in percent, 255: unknown."""

    command: int
    result: int
    target_system: int
    target_component: int
    progress: int = 255


@dataclass(frozen=True)
class EstimatorStatus(Message):
    """What an autopilot says of its estimator: EKF_STATUS_REPORT or ESTIMATOR_STATUS.

    Attributes:
        has_position: whether it has a horizontal position, relative or absolute.
        holds_position: whether it holds that for constant, having nothing to tell it by.
        position_test_ratio: innovation of horizontal position by what may be; above 1 refused;
            None: none was tested.
    """

    has_position: bool
    holds_position: bool
    position_test_ratio: float | None


@dataclass(frozen=True, eq=False)
class LocalPosition(Message):
    """Where an autopilot believes to be by its own clock: (3,) NED from its origin, m and m/s."""

    time_boot_ms: int
    position: Array
    velocity: Array


@dataclass(frozen=True)
class GlobalOrigin(Message):
    """Where on Earth an autopilot's local frame begins: degrees, m above mean sea level."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


@dataclass(frozen=True)
class ParameterValue(Message):
    """One of an autopilot's parameters.

    Attributes:
        name: up to 16 characters.
        raw: the four bytes of its value, as they came.
        kind: MAV_PARAM_TYPE.
    """

    name: str
    raw: bytes
    kind: int


@dataclass(frozen=True)
class ParameterList(Message):
    """Asks for all of our parameters; ``target_system`` and ``target_component`` 0 are all."""

    target_system: int
    target_component: int


@dataclass(frozen=True)
class ParameterRead(Message):
    """Asks for one of them: by its name, or where ``index`` is not negative, by that."""

    target_system: int
    target_component: int
    name: str
    index: int


@dataclass(frozen=True)
class ParameterSet(Message):
    """Sets one of them; the value is that of ``ParameterValue``."""

    target_system: int
    target_component: int
    name: str
    raw: bytes
    kind: int


ParameterOrder = ParameterList | ParameterRead | ParameterSet
