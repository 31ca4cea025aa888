"""What a running service says of itself, in a file: ``vcl status`` reads what the daemon writes."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec

from vcl_companion.errors import ConfigError, reason_of

# Older than this, whoever wrote it hangs or is gone; it is written every second.
STALE_S = 5.0
_MAX_FILE_BYTES = 1 << 16
# What one drone's measurements of a delay scatter by.
_RIGHT_MS = 5.0


@dataclass(frozen=True)
class AutopilotStatus:
    """The autopilot's side.

    Attributes:
        firmware: ``ardupilot``, ``px4``, ``other``.
        fusion: ``waiting``, ``sending``, ``fused``, ``rejected``, ``lost``.
        reason: why it is not fused.
        ahead_ms: by how much it takes our poses for older than they are: what its parameter of
            their delay is too large by; None before enough was flown.
        round_trip_ms: of TIMESYNC; None without.
    """

    firmware: str
    fusion: str
    reason: str
    ahead_ms: float | None
    round_trip_ms: float | None


@dataclass(frozen=True)
class MapStatus:
    """The map in use: its content hash, and what is in it."""

    revision: str
    landmarks: int
    keyframes: int


@dataclass(frozen=True)
class ServiceStatus:
    """All of it.

    Attributes:
        system_id: whose.
        written_at_s: when, seconds since 1970.
        state: ``starting``, ``standby``, ``active``, ``critical``, ``stalled``.
        text: the same in a line.
        sigma_m: the position's 1 sigma in its worst direction; None without a position.
        autopilot: what it makes of our poses.
        map: None before the first.
        peers: members that are there, this one among them.
        coordinator: who makes the maps.
    """

    system_id: int
    written_at_s: float
    state: str
    text: str
    sigma_m: float | None
    autopilot: AutopilotStatus
    map: MapStatus | None
    peers: tuple[int, ...]
    coordinator: int

    @property
    def age_s(self) -> float:
        """How long ago it was written, s."""
        return time.time() - self.written_at_s

    @property
    def is_of_now(self) -> bool:
        """Whether it has just been written; one of the future is of another run's clock."""
        return abs(self.age_s) < STALE_S

    @property
    def is_good(self) -> bool:
        """Whether it is of now, and the autopilot flies by our poses."""
        return self.is_of_now and self.state == "active" and self.autopilot.fusion == "fused"


def status_json(status: ServiceStatus) -> bytes:
    """Return it as its file has it."""
    return msgspec.json.encode(status) + b"\n"


def write_status(path: Path, status: ServiceStatus) -> None:
    """Write the file in one step: who reads it finds the last one, or this one, whole.

    Raises:
        OSError: it cannot be written.
    """
    fresh = path.with_name(f".{path.name}.new")
    fresh.write_bytes(status_json(status))
    os.replace(fresh, path)


def read_status(path: Path) -> ServiceStatus:
    """Read the file.

    Raises:
        ConfigError: there is none, or something else; one line.
    """
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_FILE_BYTES)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: is not there; is the service running?") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {reason_of(error)}") from error
    try:
        return msgspec.json.decode(data, type=ServiceStatus)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is no status of a service ({error})") from error


def status_lines(status: ServiceStatus) -> list[str]:
    """Return it for people, a line for each thing."""
    autopilot, stored = status.autopilot, status.map
    if status.age_s <= -STALE_S:
        when = f"written {-status.age_s:.0f} s from now, by a clock that was set back since"
        lines = [f"drone {status.system_id}: {when}; it was"]
    elif not status.is_of_now:
        lines = [f"drone {status.system_id}: not heard of for {status.age_s:.0f} s; it was"]
    else:
        lines = [f"drone {status.system_id}"]
    sigma = "" if status.sigma_m is None else f", position within {100.0 * status.sigma_m:.1f} cm"
    lines.append(f"service    {status.state}: {status.text}{sigma}")
    why = f": {autopilot.reason}" if autopilot.reason else ""
    lines.append(f"autopilot  {autopilot.firmware}, our poses {autopilot.fusion}{why}")
    if autopilot.ahead_ms is not None:
        lines.append(f"delay      {_delay(autopilot)}")
    if autopilot.round_trip_ms is not None:
        lines.append(f"time       answered in {autopilot.round_trip_ms:.1f} ms")
    if stored is None:
        lines.append("map        none")
    else:
        what = f"{stored.landmarks} landmarks in {stored.keyframes} keyframes"
        lines.append(f"map        {stored.revision}, {what}")
    peers = ", ".join(map(str, status.peers))
    lines.append(f"swarm      drones {peers}; {status.coordinator} makes the maps")
    return lines


def _delay(autopilot: AutopilotStatus) -> str:
    ahead_ms = autopilot.ahead_ms or 0.0
    name = {"ardupilot": "VISO_DELAY_MS", "px4": "EKF2_EV_DELAY"}.get(autopilot.firmware)
    change = "less" if ahead_ms > 0.0 else "more"
    told = f"{name} should be {abs(ahead_ms):.0f} ms {change}" if name else "its delay is wrong"
    return f"right to {_RIGHT_MS:.0f} ms" if abs(ahead_ms) < _RIGHT_MS else told
