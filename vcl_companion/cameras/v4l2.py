"""A V4L2 camera (UVC, CSI) by OpenCV: read in a thread of its own, the newest frame wins.

OpenCV hands the driver's buffer timestamp through ``CAP_PROP_POS_MSEC``; V4L2
drivers take it from CLOCK_MONOTONIC (``V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC``), at
the start of the exposure (uvcvideo: ``TSTAMP_SRC_SOE``) or at the end of the
readout (most others); ``CameraOptions.time_offset_s`` takes it from there to
mid-exposure. OpenCV does not tell which clock it was, so a stamp is believed
only when it lies just before the frame's arrival.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Any, Protocol

import cv2
import numpy as np

from vcl_companion.cameras.source import CameraOptions, Frame, Outcome
from vcl_companion.clock import Clock
from vcl_companion.errors import DeviceError

_log = logging.getLogger(__name__)

_STALLED_AFTER_S = 2
# Without a frame, as a multiple of that: before the service's watchdog ends it less cleanly.
_GIVES_UP = 6.0
# A device that is gone says so at once, each time that it is asked. While it is held open it
# comes back under another name.
_MOST_UNREADABLE, _PAUSE_S = 5, 0.02
_OLDEST_STAMP_NS = 2_000_000_000
# Drivers that convert the device's clock into the host's may overshoot a little.
_NEWEST_STAMP_NS = -10_000_000


class Capture(Protocol):
    """What is used of ``cv2.VideoCapture``."""

    def read(self) -> tuple[bool, Any]:
        """Wait for the next frame; False when there is none."""
        ...

    def get(self, prop: int, /) -> float:
        """Return a property of the device or of the last frame."""
        ...

    def release(self) -> None:
        """Close the device."""
        ...


class V4l2Camera:
    """Frames of a ``cv2.VideoCapture``, stamped on the system's monotonic clock."""

    def __init__(
        self,
        name: str,
        open_capture: Callable[[], Capture],
        size_px: tuple[int, int],
        time_offset_s: float,
        clock: Clock,
        patience_s: float = _STALLED_AFTER_S,
    ) -> None:
        """Keep how to open the device; nothing is opened before ``frames``.

        Args:
            name: the device, for messages.
            open_capture: opens it, in the reader's thread, and again whenever it stops; may
                raise DeviceError.
            size_px: the (width, height) that frames must have.
            time_offset_s: device timestamp to mid-exposure, s.
            clock: CLOCK_MONOTONIC.
            patience_s: it is opened again when no frame has come for so long, s, or five reads in
                a row have failed: after a quarter of that, then after twice as long each time,
                until there has been none for six times as long.
        """
        self._name, self._open_capture, self._size_px = name, open_capture, size_px
        self._offset_ns, self._clock = round(time_offset_s * 1e9), clock
        self._patience_s = patience_s
        # Of the reader's thread, however often the device is opened.
        self._sequence, self._last_ns, self._is_stamped = -1, -1, True
        self._came_at_ns = 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._arrived = asyncio.Event()
        self._newest: Frame | None = None
        self._failure: DeviceError | None = None

    async def frames(self) -> AsyncIterator[Frame]:
        """Open the device and yield its newest frame, again and again; see ``CameraSource``."""
        loop = asyncio.get_running_loop()
        self._thread = threading.Thread(
            target=self._read, args=(loop,), name=f"camera {self._name}", daemon=True
        )
        self._thread.start()
        while not self._stop.is_set():
            await self._arrived.wait()
            self._arrived.clear()
            frame, self._newest = self._newest, None
            if frame is not None:
                yield frame
            if self._failure is not None:
                raise self._failure

    def done(self, sequence: int, outcome: Outcome) -> None:
        """Do nothing: a device does not wait for its viewer."""

    async def close(self) -> None:
        """Stop the reader and let go of the device."""
        self._stop.set()
        self._arrived.set()
        if self._thread is not None:
            await asyncio.to_thread(self._thread.join, 2.0 * _STALLED_AFTER_S)

    def _offer(self, frame: Frame | None, failure: DeviceError | None) -> None:
        """Replace what waits; runs in the loop, which alone owns these attributes."""
        self._newest = frame or self._newest
        self._failure = failure
        self._arrived.set()

    def _read(self, loop: asyncio.AbstractEventLoop) -> None:
        """Read until told to stop; everything here runs in the reader's thread."""
        failure: DeviceError | None = None
        try:
            self._read_on(loop)
        except DeviceError as error:
            failure = error
        except cv2.error as error:
            failure = DeviceError(f"camera {self._name}: {_in_one_line(error)}")
        with suppress(RuntimeError):  # the loop may be gone when the process ends
            loop.call_soon_threadsafe(self._offer, None, failure)

    def _read_on(self, loop: asyncio.AbstractEventLoop) -> None:
        """Read, and open the device anew when it stops: a loose plug must not end the flight.

        Raises:
            DeviceError: it never gave a frame, or gives none however often it is opened.
        """
        failures = 0
        while not self._stop.is_set():
            before, why = self._sequence, "stopped sending frames"
            try:
                capture = self._open_capture()
                try:
                    self._read_frames(capture, loop)
                finally:
                    capture.release()
            except _WrongSizeError:
                raise
            except DeviceError as error:
                if self._sequence < 0:
                    raise
                why = str(error).removeprefix(f"camera {self._name}: ")
            failures = 1 if self._sequence > before else failures + 1
            pause_s = self._patience_s * 2.0 ** (failures - 3)
            silent_s = (self._clock.now_ns() - self._came_at_ns) * 1e-9
            if self._stop.is_set():
                return
            if self._sequence < 0 or silent_s + pause_s > _GIVES_UP * self._patience_s:
                raise DeviceError(f"camera {self._name}: {why}")
            _log.warning("camera %s: %s; opening it again", self._name, why)
            self._stop.wait(pause_s)

    def _read_frames(self, capture: Capture, loop: asyncio.AbstractEventLoop) -> None:
        """Read until told to stop, or until nothing has come for too long."""
        since_ns, n_unreadable = self._clock.now_ns(), 0
        while not self._stop.is_set():
            try:
                complete, image = capture.read()
            except cv2.error as error:
                _log.debug("camera %s: %s", self._name, _in_one_line(error))
                complete = False
            received_at_ns = self._clock.now_ns()
            if not complete:
                # An image that cannot be decoded comes as none, and the next may be whole.
                n_unreadable += 1
                is_over = received_at_ns - since_ns >= self._patience_s * 1e9
                if is_over or n_unreadable == _MOST_UNREADABLE:
                    return
                self._stop.wait(_PAUSE_S)
                continue
            since_ns = self._came_at_ns = received_at_ns
            n_unreadable = 0
            self._sequence += 1
            if image.ndim == 3:
                image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
            if image.shape[::-1] != self._size_px:
                raise _WrongSizeError(
                    f"camera {self._name}: gives {image.shape[1]}x{image.shape[0]}, "
                    f"the calibration says {self._size_px[0]}x{self._size_px[1]}"
                )
            stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            if not _NEWEST_STAMP_NS <= received_at_ns - stamp_ns <= _OLDEST_STAMP_NS:
                if self._is_stamped:
                    _log.warning("camera %s: no usable timestamps, using arrival", self._name)
                self._is_stamped, stamp_ns = False, received_at_ns
            captured_at_ns = stamp_ns + self._offset_ns
            if captured_at_ns <= self._last_ns:
                continue  # the same frame again, or a step back: never an older instant
            self._last_ns = captured_at_ns
            pixels = np.asarray(image, dtype=np.uint8)
            frame = Frame(pixels, captured_at_ns, self._sequence, received_at_ns)
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(self._offer, frame, None)


class _WrongSizeError(DeviceError):
    """No opening it again helps."""


def _in_one_line(error: cv2.error) -> str:
    return str(error).strip().splitlines()[0]


def open_capture(
    device: str, options: CameraOptions, size_px: tuple[int, int], rate_hz: float
) -> cv2.VideoCapture:
    """Open a V4L2 device node and ask it for a size, rate and pixel format.

    Raises:
        DeviceError: no such device, no permission, in use, or not a camera.
    """
    if not os.path.exists(device):
        raise DeviceError(f"camera {device}: no such device")
    if not os.access(device, os.R_OK | os.W_OK):
        raise DeviceError(f"camera {device}: no permission (is this user in group video?)")
    # OpenCV waits 10 s for a stalled device by default, and reads this once.
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(_STALLED_AFTER_S))
    capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
    if not capture.isOpened():
        raise DeviceError(f"camera {device}: in use, or not a V4L2 camera")
    if options.pixel_format != "auto":
        # Before the size: a driver offers sizes per format.
        code = cv2.VideoWriter.fourcc(*options.pixel_format)
        if not capture.set(cv2.CAP_PROP_FOURCC, code):
            raise DeviceError(f"camera {device}: does not offer {options.pixel_format}")
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
    capture.set(cv2.CAP_PROP_FPS, rate_hz)
    given_hz = capture.get(cv2.CAP_PROP_FPS)
    if given_hz > 0.0 and abs(given_hz - rate_hz) > 0.5:
        _log.warning("camera %s: gives %.1f Hz, asked for %.1f Hz", device, given_hz, rate_hz)
    return capture
