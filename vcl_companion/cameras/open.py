"""From a configuration's ``source`` string to the camera it names."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from vcl_companion.cameras.oak import OakCamera, child_command
from vcl_companion.cameras.recorded import RecordedCamera, read_drone_frames
from vcl_companion.cameras.source import (
    CameraOptions,
    CameraSource,
    parse_host_port,
    parse_source,
)
from vcl_companion.cameras.stream import StreamCamera
from vcl_companion.cameras.v4l2 import V4l2Camera, open_capture
from vcl_companion.clock import Clock, ManualClock
from vcl_companion.errors import ConfigError
from vcl_companion.recording.sensor import Sensor


def open_camera(options: CameraOptions, sensor: Sensor, clock: Clock) -> CameraSource:
    """Return the camera that ``options.source`` names; devices open when frames are asked for.

    Args:
        options: which camera.
        sensor: its calibration; frames of another size are refused.
        clock: the daemon's clock; a ``ManualClock`` is driven by the source.

    Raises:
        ConfigError: the source is unknown, or cannot drive the clock.
        RecordingError: the recording is broken or has no such drone.
    """
    kind, rest = parse_source(options.source)
    if isinstance(clock, ManualClock) and kind not in ("stream", "recording"):
        raise ConfigError(f'clock = "camera" needs a stream or a recording, not {options.source}')
    camera = sensor.camera
    size_px = (camera.width_px, camera.height_px)
    if kind == "stream":
        host, port = parse_host_port(rest)
        return StreamCamera(host, port, size_px, clock)
    if kind == "recording":
        return RecordedCamera(read_drone_frames(Path(rest)), camera, clock)
    rate_hz = options.rate_hz or sensor.rate_hz
    if kind == "oak":
        command = child_command(rest, options.oak_socket, camera, rate_hz)
        return OakCamera(command, camera, options.time_offset_s)
    opened = partial(open_capture, rest, options, size_px, rate_hz)
    return V4l2Camera(rest, opened, size_px, options.time_offset_s, clock)
