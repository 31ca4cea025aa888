from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcl_companion.cameras.open import open_camera
from vcl_companion.cameras.source import CameraOptions, Frame, parse_host_port, parse_source
from vcl_companion.cameras.stream import StreamCamera
from vcl_companion.cameras.v4l2 import V4l2Camera
from vcl_companion.clock import ManualClock, SystemClock
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.sensor import Sensor

SENSOR = Sensor(Camera(32, 24, 30.0, 30.0, 15.5, 11.5), Pose.identity(), 5.0)


@pytest.mark.parametrize(
    ("source", "parsed"),
    [
        ("v4l2:/dev/v4l/by-id/usb-x:1", ("v4l2", "/dev/v4l/by-id/usb-x:1")),
        ("oak", ("oak", "")),
        ("oak:19443010", ("oak", "19443010")),
        ("stream:127.0.0.1:14000", ("stream", "127.0.0.1:14000")),
        ("recording:a b/mav0", ("recording", "a b/mav0")),
    ],
)
def test_sources(source: str, parsed: tuple[str, str]) -> None:
    assert parse_source(source) == parsed


@pytest.mark.parametrize(
    "source",
    ["", "v4l2", "v4l2:", "usb:0", "stream:host", "stream:h:0", "stream:h:65536", "stream::1"],
)
def test_unusable_sources(source: str) -> None:
    with pytest.raises(ConfigError, match=r"^source: expected "):
        CameraOptions(source=source)


@given(st.text(max_size=30))
def test_any_text_is_a_source_or_a_config_error(source: str) -> None:
    for text in (source, f"stream:{source}"):
        try:
            parse_source(text)
        except ConfigError:
            continue


def test_hosts_and_ports() -> None:
    assert parse_host_port("localhost:1") == ("localhost", 1)
    assert parse_host_port("[::1]:65535") == ("::1", 65535)


@pytest.mark.parametrize(
    "options",
    [
        {"rate_hz": -1.0},
        {"rate_hz": 241.0},
        {"rate_hz": float("nan")},
        {"time_offset_s": float("nan")},
        {"time_offset_s": 1.5},
        {"calibration": ""},
    ],
)
def test_options_out_of_bounds(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=f"^{next(iter(options))}: "):
        CameraOptions(**options)


def test_frames_are_checked_and_read_only() -> None:
    image = np.zeros((4, 5), np.uint8)
    frame = Frame(image, 0, 0, 0)
    with pytest.raises(ValueError, match="read-only"):
        frame.image[0, 0] = 1
    image[0, 0] = 1  # the caller's own array stays writable
    for bad in (np.zeros((4, 5, 3), np.uint8), np.zeros((0, 5), np.uint8)):
        with pytest.raises(ValueError, match=r"Frame\.image"):
            Frame(bad, 0, 0, 0)
    with pytest.raises(ValueError, match=r"Frame\.image"):
        Frame(np.zeros((4, 5), np.float64), 0, 0, 0)


def test_opening() -> None:
    stream = CameraOptions(source="stream:127.0.0.1:1")
    assert isinstance(open_camera(stream, SENSOR, ManualClock()), StreamCamera)
    assert isinstance(open_camera(CameraOptions(), SENSOR, SystemClock()), V4l2Camera)
    with pytest.raises(ConfigError, match='clock = "camera" needs a stream or a recording'):
        open_camera(CameraOptions(), SENSOR, ManualClock())
