import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vcl_companion.cameras.source import CameraOptions, Frame
from vcl_companion.cameras.v4l2 import Capture, V4l2Camera, open_capture
from vcl_companion.clock import SystemClock
from vcl_companion.errors import DeviceError

SIZE_PX = (64, 48)
LEVELS = (30, 90, 150, 210)


def video(folder: Path, size_px: tuple[int, int] = SIZE_PX) -> Path:
    """Write a film whose frames are told apart by their grey level."""
    path = folder / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size_px)
    for level in LEVELS:
        writer.write(np.full((*size_px[::-1], 3), level, np.uint8))
    writer.release()
    return path


class Device:
    """A film that behaves like a V4L2 device: stamps on the monotonic clock, a frame when told."""

    def __init__(
        self, path: Path, ages_s: tuple[float, ...], may_read: threading.Semaphore
    ) -> None:
        self._film = cv2.VideoCapture(str(path))
        self._ages_s, self._may_read, self._n_read = ages_s, may_read, 0
        self.released = False

    def read(self) -> tuple[bool, Any]:
        self._may_read.acquire()
        self._n_read += 1
        return self._film.read()

    def get(self, prop: int, /) -> float:
        assert prop == cv2.CAP_PROP_POS_MSEC
        return SystemClock().now_ns() * 1e-6 - 1e3 * self._ages_s[self._n_read - 1]

    def release(self) -> None:
        self.released = True
        self._film.release()


def camera_of(capture: Callable[[], Capture], offset_s: float = 0.0) -> V4l2Camera:
    return V4l2Camera("film", capture, SIZE_PX, offset_s, SystemClock())


def test_frames_carry_the_device_s_time_and_the_offset(tmp_path: Path) -> None:
    may_read = threading.Semaphore(0)
    device = Device(video(tmp_path), (1.0,) * 4, may_read)

    async def scenario() -> list[Frame]:
        camera = camera_of(lambda: device, offset_s=0.1)
        frames, seen = camera.frames(), []
        for _ in LEVELS:
            may_read.release()
            seen.append(await anext(frames))
        may_read.release()
        with pytest.raises(DeviceError, match=r"^camera film: stopped sending frames$"):
            await anext(frames)
        await camera.close()
        return seen

    frames = asyncio.run(scenario())
    assert [frame.sequence for frame in frames] == [0, 1, 2, 3]
    for frame, level in zip(frames, LEVELS, strict=True):
        assert frame.image.shape == SIZE_PX[::-1]
        assert abs(float(frame.image.mean()) - level) < 3.0
        age_s = (frame.received_at_ns - frame.captured_at_ns) * 1e-9
        assert 0.4 < age_s < 0.9 + 1e-6  # the device is asked a moment after the frame came
    assert device.released


def test_the_newest_frame_wins(tmp_path: Path) -> None:
    path = video(tmp_path)

    async def scenario() -> list[int]:
        camera = camera_of(lambda: cv2.VideoCapture(str(path)))
        frames = camera.frames()
        waiting = asyncio.ensure_future(anext(frames))
        await asyncio.sleep(0)  # starts the reader
        for thread in threading.enumerate():
            if thread.name == "camera film":
                thread.join()  # this loop is busy while all four come and the film ends
        seen = [(await waiting).sequence]
        with pytest.raises(DeviceError):
            await anext(frames)
        return seen

    assert asyncio.run(scenario()) == [3]


def test_a_stamp_of_another_clock_is_not_believed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    may_read = threading.Semaphore(4)
    device = Device(video(tmp_path), (-3600.0, 3600.0, 3600.0, 3600.0), may_read)

    async def scenario() -> Frame:
        camera = camera_of(lambda: device)
        frame = await anext(camera.frames())
        may_read.release(10)
        await camera.close()
        return frame

    frame = asyncio.run(scenario())
    assert frame.captured_at_ns == frame.received_at_ns
    assert [record.message for record in caplog.records] == [
        "camera film: no usable timestamps, using arrival"
    ]


def test_a_step_back_of_the_device_s_clock_is_a_dropped_frame(tmp_path: Path) -> None:
    may_read = threading.Semaphore(0)
    device = Device(video(tmp_path), (0.0, 1.0, 0.0, 0.0), may_read)

    async def scenario() -> list[int]:
        frames = camera_of(lambda: device).frames()
        may_read.release()
        first = await anext(frames)
        may_read.release(2)
        return [first.sequence, (await anext(frames)).sequence]

    assert asyncio.run(scenario()) == [0, 2]
    may_read.release(10)


def test_frames_of_another_size_are_refused(tmp_path: Path) -> None:
    path = video(tmp_path, (32, 32))

    async def scenario() -> None:
        await anext(camera_of(lambda: cv2.VideoCapture(str(path))).frames())

    with pytest.raises(DeviceError, match="gives 32x32, the calibration says 64x48"):
        asyncio.run(scenario())


def test_closing_while_a_frame_is_awaited_ends_the_frames(tmp_path: Path) -> None:
    may_read = threading.Semaphore(0)
    device = Device(video(tmp_path), (0.0,) * 4, may_read)

    async def scenario() -> object:
        camera = camera_of(lambda: device)
        waiting = asyncio.ensure_future(anext(camera.frames(), "ended"))
        await asyncio.sleep(0)
        closing = asyncio.ensure_future(camera.close())
        # It has been told to end before its next frame comes, however fast its thread is.
        await asyncio.sleep(0)
        may_read.release()
        await closing
        return await waiting

    ended = asyncio.run(scenario())
    assert ended == "ended" or isinstance(ended, Frame)
    assert device.released


def test_a_missing_device_is_one_line() -> None:
    async def scenario() -> None:
        options = CameraOptions()
        camera = camera_of(lambda: open_capture("/dev/no-such-video", options, SIZE_PX, 5.0))
        await anext(camera.frames())

    with pytest.raises(DeviceError, match=r"^camera /dev/no-such-video: no such device$"):
        asyncio.run(scenario())


def test_a_file_is_no_camera(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="in use, or not a V4L2 camera"):
        open_capture(str(video(tmp_path)), CameraOptions(), SIZE_PX, 5.0)
