import asyncio
import threading
from collections.abc import Callable, Sequence
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


class Shaky:
    """A device that says what it is told to: a grey level, no image, or OpenCV's error."""

    def __init__(self, says: Sequence[int | cv2.error | None]) -> None:
        self._says = iter(says)
        self.released = False

    def read(self) -> tuple[bool, Any]:
        said = next(self._says, None)
        if isinstance(said, cv2.error):
            raise said
        return said is not None, None if said is None else np.full(SIZE_PX[::-1], said, np.uint8)

    def get(self, prop: int, /) -> float:
        return SystemClock().now_ns() * 1e-6

    def release(self) -> None:
        self.released = True


def camera_of(capture: Callable[[], Capture], offset_s: float = 0.0) -> V4l2Camera:
    return V4l2Camera("film", capture, SIZE_PX, offset_s, SystemClock(), patience_s=0.1)


async def two_frames(camera: V4l2Camera, may_read: threading.Semaphore, then: int) -> list[Frame]:
    """Return a camera's frame of its first read, and that of so many more."""
    frames = camera.frames()
    may_read.release()
    first = await anext(frames)
    may_read.release(then)
    second = await anext(frames)
    may_read.release(100)
    await camera.close()
    return [first, second]


async def levels_of(camera: V4l2Camera, n_frames: int) -> list[int]:
    """Return the grey levels of a camera's first frames."""
    out = []
    async for frame in camera.frames():
        out.append(int(frame.image[0, 0]))
        if len(out) == n_frames:
            break
    await camera.close()
    return out


def test_frames_carry_the_device_s_time_and_the_offset(tmp_path: Path) -> None:
    may_read = threading.Semaphore(0)
    device = Device(video(tmp_path), (1.0,) * 4, may_read)

    async def scenario() -> list[Frame]:
        camera = camera_of(lambda: device, offset_s=0.1)
        frames, seen = camera.frames(), []
        for _ in LEVELS:
            may_read.release()
            seen.append(await anext(frames))
        may_read.release(1000)  # however often it is asked again
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


def test_an_image_that_cannot_be_decoded_is_left_out() -> None:
    async def scenario() -> list[int]:
        may_go_on = threading.Semaphore(0)

        class Paced(Shaky):
            def read(self) -> tuple[bool, Any]:
                may_go_on.acquire()
                return super().read()

        device = Paced([30, None, cv2.error("a buffer of no bytes"), 90])
        frames = await two_frames(camera_of(lambda: device), may_go_on, then=3)
        assert [frame.sequence for frame in frames] == [0, 1]
        return [int(frame.image[0, 0]) for frame in frames]

    assert asyncio.run(scenario()) == [30, 90]


def test_a_device_that_stops_is_opened_again(caplog: pytest.LogCaptureFixture) -> None:
    devices = [Shaky([30]), None, Shaky([]), Shaky([90])]
    opened: list[Shaky | None] = []

    def open_next() -> Capture:
        opened.append(devices[len(opened)])
        if opened[-1] is None:
            raise DeviceError("camera film: no such device")
        return opened[-1]

    assert asyncio.run(levels_of(camera_of(open_next), 2)) == [30, 90]
    assert [device.released for device in devices if device is not None] == [True] * 3
    assert [record.message for record in caplog.records] == [
        f"camera film: {why}; opening it again"
        for why in ("stopped sending frames", "no such device", "stopped sending frames")
    ]


def test_a_device_that_is_gone_for_good_ends_the_frames() -> None:
    n_opened = 0

    def open_next() -> Capture:
        nonlocal n_opened
        n_opened += 1
        return Shaky([30] if n_opened == 1 else [])

    with pytest.raises(DeviceError, match=r"^camera film: stopped sending frames$"):
        asyncio.run(levels_of(camera_of(open_next), 2))
    assert 3 <= n_opened <= 6  # 25, 50, 100, 200 ms apart, within 600


def test_a_device_that_never_gives_a_frame_is_opened_once() -> None:
    opened: list[Shaky] = []

    def open_next() -> Capture:
        opened.append(Shaky([]))
        return opened[-1]

    with pytest.raises(DeviceError, match=r"^camera film: stopped sending frames$"):
        asyncio.run(levels_of(camera_of(open_next), 1))
    assert len(opened) == 1


def test_the_newest_frame_wins(tmp_path: Path) -> None:
    film = cv2.VideoCapture(str(video(tmp_path)))

    async def scenario() -> list[int]:
        camera = camera_of(lambda: film)
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
        frames = await two_frames(camera_of(lambda: device), may_read, then=2)
        return [frame.sequence for frame in frames]

    assert asyncio.run(scenario()) == [0, 2]


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
