"""How the autopilot is reached, listened to and told; and what it is told of how we are."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Literal

from vcl_companion.errors import ConfigError
from vcl_companion.links.transport import check_allowed_senders, parse_link

Heading = Literal["map", "autopilot"]


class ServiceState(enum.Enum):
    """What the heartbeat says of us, as MAV_STATE; STALLED says nothing at all."""

    STARTING = 1
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5
    STALLED = 0


@dataclass(frozen=True)
class AutopilotOptions:
    """How the autopilot is reached and listened to.

    Attributes:
        link: serial:DEVICE:BAUD, udp:HOST:PORT, udpin:HOST:PORT or tcp:HOST:PORT.
        allowed_senders: for udpin, addresses or networks that may be the autopilot; empty: any.
        attitude_rate_hz: rate of ATTITUDE_QUATERNION that we ask for.
        attitude_latency_s: from measuring to arriving, for an autopilot without TIMESYNC.
        max_attitude_age_s: how far from a frame's instant an attitude may be that it is told by:
            from both between which it lies, or from the one that is turned on, 0.1 s at most.
        profile: whose reading of a pose's covariance it is made for: ``ardupilot`` or ``px4``;
            ``auto``: whose the autopilot's HEARTBEAT says it is; ``plain``: as it is.
        message: in which poses are sent: ``vision_position_estimate``, or ``odometry``, which
            holds the velocity as well.
        ground_systems: MAVLink systems whose commands are obeyed, and who may change settings:
            ground stations.
        max_pose_age_s: a pose of a frame older than this is not sent.
        time_error_s: how well the autopilot knows the instant of a pose, 1 sigma: what it is
            told is uncertain by so much of the way.
        min_rate_hz: where frames give fewer poses, more are told between them, of where the
            last frame's velocity and the autopilot's attitude put us; 0: none is.
        max_rate_hz: frames beyond it are localized, and not told.
        resets: what is done when what is told jumps by more than its own error while the vehicle
            flies to commanded positions (GUIDED, OFFBOARD), which moves it: ``follow``: the
            autopilot is reset; ``blend``: what is told slides to its new place; ``wait``: nothing
            is told until the ground commands it or the mode changes.
        blend_speed_m_s: of a slide.
        blend_turn_deg_s: of a slide's heading.
        propagate_s: how long after the last frame with a pose one is told between frames.
        heading: whose north poses are told in: ``map``, the leader's at the first map, for an
            autopilot that takes its heading from us; ``autopilot``, its own at the first pose,
            for one that flies by its compass.
        origin: latitude and longitude, degrees, and altitude above mean sea level, m, of the
            world's origin: the leader's body at the first map; the same on every drone.
            None: the autopilot is told no place on Earth.
    """

    link: str = "serial:/dev/serial0:921600"
    allowed_senders: tuple[str, ...] = ()
    attitude_rate_hz: float = 50.0
    attitude_latency_s: float = 0.01
    max_attitude_age_s: float = 0.1
    profile: Literal["auto", "ardupilot", "px4", "plain"] = "auto"
    message: Literal["vision_position_estimate", "odometry"] = "vision_position_estimate"
    ground_systems: tuple[int, ...] = (255,)
    max_pose_age_s: float = 2.0
    time_error_s: float = 0.005
    min_rate_hz: float = 10.0
    max_rate_hz: float = 30.0
    propagate_s: float = 0.5
    resets: Literal["follow", "blend", "wait"] = "follow"
    blend_speed_m_s: float = 0.3
    blend_turn_deg_s: float = 5.0
    heading: Heading = "map"
    origin: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        parse_link(self.link)
        check_allowed_senders(self.allowed_senders)
        if not 1.0 <= self.attitude_rate_hz <= 400.0:
            raise ConfigError(f"attitude_rate_hz: must be in 1..400, got {self.attitude_rate_hz}")
        if not 0.0 <= self.attitude_latency_s <= 1.0:
            raise ConfigError(f"attitude_latency_s: must be in 0..1, got {self.attitude_latency_s}")
        if not 0.0 < self.max_attitude_age_s <= 2.0:
            raise ConfigError(
                f"max_attitude_age_s: must be above 0 up to 2, got {self.max_attitude_age_s}"
            )
        if not all(1 <= system <= 255 for system in self.ground_systems):
            raise ConfigError(f"ground_systems: must be in 1..255, got {self.ground_systems}")
        if not 0.05 <= self.max_pose_age_s <= 10.0:
            raise ConfigError(f"max_pose_age_s: must be in 0.05..10, got {self.max_pose_age_s}")
        if not 0.0 <= self.time_error_s <= 0.1:
            raise ConfigError(f"time_error_s: must be in 0..0.1, got {self.time_error_s}")
        if not 1.0 <= self.max_rate_hz <= 100.0:
            raise ConfigError(f"max_rate_hz: must be in 1..100, got {self.max_rate_hz}")
        if not 0.0 <= self.min_rate_hz <= self.max_rate_hz:
            raise ConfigError(
                f"min_rate_hz: must be in 0..max_rate_hz ({self.max_rate_hz:g}), "
                f"got {self.min_rate_hz}"
            )
        if not 0.0 <= self.propagate_s <= 2.0:
            raise ConfigError(f"propagate_s: must be in 0..2, got {self.propagate_s}")
        if not 0.01 <= self.blend_speed_m_s <= 5.0:
            raise ConfigError(f"blend_speed_m_s: must be in 0.01..5, got {self.blend_speed_m_s}")
        if not 0.1 <= self.blend_turn_deg_s <= 90.0:
            raise ConfigError(f"blend_turn_deg_s: must be in 0.1..90, got {self.blend_turn_deg_s}")
        if self.origin is not None:
            _check_origin(*self.origin)


def _check_origin(latitude_deg: float, longitude_deg: float, altitude_m: float) -> None:
    if not (abs(latitude_deg) <= 89.0 and abs(longitude_deg) <= 180.0):
        raise ConfigError(
            "origin: must be [latitude, longitude, altitude] in -89..89 and -180..180 degrees, got "
            f"[{latitude_deg:g}, {longitude_deg:g}, {altitude_m:g}]"
        )
    if not -500.0 <= altitude_m <= 9000.0:
        raise ConfigError(f"origin: its altitude must be in -500..9000 m, got {altitude_m:g}")
    if latitude_deg == longitude_deg == 0.0:
        raise ConfigError("origin: 0, 0 is what autopilots take for none; leave it out for none")
