"""What a camera gives the daemon, and what the daemon tells it back."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import ConfigError

Outcome = Literal["localized", "refused", "dropped"]
"""What became of a frame; ``dropped``: a newer one took its place before it was looked at."""

PixelFormat = Literal["auto", "GREY", "YUYV", "MJPG"]
OakSocket = Literal["CAM_A", "CAM_B", "CAM_C"]

SourceKind = Literal["v4l2", "oak", "stream", "recording"]

# Who writes millimetres is told.
_MAX_LEVER_ARM_M = 10.0

_FORMS: dict[SourceKind, str] = {
    "v4l2": "v4l2:DEVICE",
    "oak": "oak or oak:DEVICE-ID",
    "stream": "stream:HOST:PORT",
    "recording": "recording:DIRECTORY/mavN",
}


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and when it was taken.

    Attributes:
        image: (H, W) grey levels, read-only.
        captured_at_ns: mid-exposure, on the daemon's clock.
        sequence: counts up by one per captured frame; a gap is a frame dropped
            before it reached us.
        received_at_ns: CLOCK_MONOTONIC when the image was complete in this
            process, from which its latency is measured.
    """

    image: NDArray[np.uint8]
    captured_at_ns: int
    sequence: int
    received_at_ns: int

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.image.dtype != np.uint8 or self.image.size == 0:
            raise ValueError(
                f"Frame.image must be (H, W) uint8: {self.image.shape} {self.image.dtype}"
            )
        if self.sequence < 0:
            raise ValueError(f"Frame.sequence must not be negative: {self.sequence}")
        image = self.image.view()
        image.flags.writeable = False
        object.__setattr__(self, "image", image)


class CameraSource(Protocol):
    """A camera as the daemon sees it; one task iterates, the same task or another answers."""

    def frames(self) -> AsyncIterator[Frame]:
        """Yield frames in the order they were taken, until the stream ends.

        Raises:
            DeviceError: the camera cannot be used (any more), in one clear line.
        """
        ...

    def done(self, sequence: int, outcome: Outcome) -> None:
        """Say what became of a yielded frame; every frame is answered exactly once."""
        ...

    async def close(self) -> None:
        """Let go of the device; may be called at any time, and twice."""
        ...


@dataclass(frozen=True)
class CameraOptions:
    """Which camera, and how it is read; the image size is always the calibration's.

    Attributes:
        source: ``v4l2:DEVICE``, ``oak`` or ``oak:DEVICE-ID``, ``stream:HOST:PORT``
            (simulation), ``recording:DIRECTORY/mavN``.
        calibration: EuRoC ``sensor.yaml`` of this camera, a path.
        rate_hz: frames per second asked of the device; 0 takes the calibration's.
        pixel_format: what to ask a V4L2 device for; ``auto`` leaves its own choice.
        time_offset_s: added to the device's timestamps to make them mid-exposure
            (a calibration tool's camera time offset; V4L2 devices stamp the start
            of the exposure or the end of the readout). Devices only.
        oak_socket: the OAK's sensor: ``CAM_A`` colour, ``CAM_B`` left, ``CAM_C`` right.
        mounting_deg: roll, pitch, yaw of the camera's housing in the body, degrees, instead of
            the rotation in the calibration's ``T_BS``; (0, 0, 0) looks forward, images upright.
        position_m: where the camera is, from the autopilot's IMU, m, forward, right, down,
            instead of the translation in ``T_BS``.
    """

    source: str = "v4l2:/dev/video0"
    calibration: str = "/etc/vcl-companion/camera.yaml"
    rate_hz: float = 0.0
    pixel_format: PixelFormat = "auto"
    time_offset_s: float = 0.0
    oak_socket: OakSocket = "CAM_B"
    mounting_deg: tuple[float, float, float] | None = None
    position_m: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        parse_source(self.source)
        if not self.calibration:
            raise ConfigError("calibration: names no file")
        if not 0.0 <= self.rate_hz <= 240.0:
            raise ConfigError(f"rate_hz: must be in 0..240, got {self.rate_hz}")
        if not (math.isfinite(self.time_offset_s) and abs(self.time_offset_s) <= 1.0):
            raise ConfigError(f"time_offset_s: must be in -1..1, got {self.time_offset_s}")
        if self.mounting_deg and not all(abs(angle) <= 360.0 for angle in self.mounting_deg):
            raise ConfigError(f"mounting_deg: must be in -360..360, got {list(self.mounting_deg)}")
        if self.position_m and not all(abs(m) <= _MAX_LEVER_ARM_M for m in self.position_m):
            raise ConfigError(
                f"position_m: must be in -{_MAX_LEVER_ARM_M:g}..{_MAX_LEVER_ARM_M:g}, metres from "
                f"the autopilot's IMU, got {list(self.position_m)}"
            )


def parse_source(source: str) -> tuple[SourceKind, str]:
    """Split a ``source`` string into its kind and the rest.

    Raises:
        ConfigError: no such kind, or what the kind needs is missing.
    """
    name, _, rest = source.partition(":")
    for kind, form in _FORMS.items():
        if kind != name:
            continue
        if kind != "oak" and not rest:
            raise ConfigError(f"source: expected {form}, got {source!r}")
        if kind == "stream":
            parse_host_port(rest)
        return kind, rest
    raise ConfigError(f"source: expected one of {', '.join(_FORMS.values())}; got {source!r}")


def parse_host_port(address: str) -> tuple[str, int]:
    """Split ``HOST:PORT`` (an IPv6 host in brackets).

    Raises:
        ConfigError: no host, or no port in 1..65535.
    """
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not (port.isascii() and port.isdigit()) or not 1 <= int(port[:6]) <= 65535:
        raise ConfigError(f"source: expected HOST:PORT, got {address!r}")
    return host, int(port)
