"""A Luxonis OAK by depthai 3, read in a child process.

depthai's native code ends the whole process when it fails, and a daemon in
flight must not end with it: this module is both the child, which owns the
device and writes frames in the form of ``stream.py`` to its standard output,
and the parent's side, which reads them, restarts a child that ended or fell
silent, and gives up with one clear line.

Timestamps: ``ImgFrame.getTimestamp(MIDDLE)`` is mid-exposure on
``dai::Clock::now()``, C++'s steady clock, which is CLOCK_MONOTONIC here.
"""

from __future__ import annotations

import asyncio
import datetime
import importlib
import json
import logging
import os
import sys
import time
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from contextlib import aclosing, suppress
from typing import Any, BinaryIO, NoReturn

import numpy as np

from vcl_companion.cameras.source import Frame, OakSocket, Outcome
from vcl_companion.cameras.stream import StreamFrame, decode_image, encode_record, read_record
from vcl_companion.errors import DeviceError, WireError
from vcl_companion.geometry.camera import Camera

_log = logging.getLogger(__name__)

# Exit status of a child whom a restart cannot help.
_UNUSABLE = 3
_MAX_FAILURES = 5
_FIRST_FRAME_WITHIN_S = 30.0
_NEXT_FRAME_WITHIN_S = 3.0
_LONGEST_PAUSE_S = 8.0
_OLDEST_STAMP_NS = 2_000_000_000
# How far the device's own calibration may be from the file's: beyond this the
# file is of another sensor, another resolution or another device.
_INTRINSICS_TOLERANCE = 0.05


class OakCamera:
    """The daemon's end: a child's frames, under one count however often it is restarted."""

    def __init__(
        self,
        command: Sequence[str],
        camera: Camera,
        time_offset_s: float = 0.0,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        """Keep how to start the child (see ``child_command``) and what it must give."""
        self._command, self._sleep = tuple(command), sleep
        self._size_px = (camera.width_px, camera.height_px)
        self._offset_ns = round(time_offset_s * 1e9)
        self._process: asyncio.subprocess.Process | None = None
        self._last_words = ""
        self._closed = False

    async def frames(self) -> AsyncIterator[Frame]:
        """Yield frames until closed; see ``CameraSource``."""
        next_sequence, last_ns, failures = 0, -1, 0
        while not self._closed:
            first: int | None = None
            async with aclosing(self._records()) as records:
                async for record in records:
                    received_at_ns = time.monotonic_ns()
                    if first is None:
                        first, base = record.sequence, next_sequence
                    sequence = base + record.sequence - first
                    captured_at_ns = record.at_ns + self._offset_ns
                    if sequence < next_sequence or captured_at_ns <= last_ns:
                        continue
                    next_sequence, last_ns = sequence + 1, captured_at_ns
                    try:
                        image = await asyncio.to_thread(decode_image, record.encoded)
                    except WireError as error:
                        _log.warning("OAK camera: frame %d is left out: %s", sequence, error)
                        continue
                    if image.shape[::-1] != self._size_px:
                        raise DeviceError(f"OAK camera: gives {image.shape[1]}x{image.shape[0]}")
                    yield Frame(image, captured_at_ns, sequence, received_at_ns)
            if self._closed:
                return
            failures = failures + 1 if first is None else 1
            why = self._last_words or "stopped sending frames"
            status = self._process.returncode if self._process is not None else None
            if status == _UNUSABLE or failures >= _MAX_FAILURES:
                raise DeviceError(f"OAK camera: {why}")
            _log.warning("OAK camera: %s (status %s); starting it again", why, status)
            await self._sleep(min(0.5 * 2.0 ** (failures - 1), _LONGEST_PAUSE_S))

    def done(self, sequence: int, outcome: Outcome) -> None:
        """Do nothing: a device does not wait for its viewer."""

    async def close(self) -> None:
        """End the child, and with it the frames."""
        self._closed = True
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.kill()
            await self._process.wait()

    async def _records(self) -> AsyncGenerator[StreamFrame, None]:
        """Run one child and yield what it writes, until it ends, breaks off or falls silent."""
        self._last_words = ""
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *self._command, stdin=asyncio.subprocess.DEVNULL, stdout=pipe, stderr=pipe
        )
        self._process = process
        assert process.stdout is not None
        assert process.stderr is not None
        listening = asyncio.ensure_future(self._listen(process.stderr))
        patience_s = _FIRST_FRAME_WITHIN_S
        try:
            while True:
                async with asyncio.timeout(patience_s):
                    record = await read_record(process.stdout)
                if not isinstance(record, StreamFrame):
                    return
                yield record
                patience_s = _NEXT_FRAME_WITHIN_S
        except TimeoutError:
            self._last_words = f"no frame for {patience_s:.0f} s"
        except WireError:
            return  # it ended; its last words say why
        finally:
            # A native crash is worth its status; anything still alive is ended.
            with suppress(TimeoutError):
                await asyncio.wait_for(process.wait(), 0.2)
            if process.returncode is None:
                process.kill()
            await process.wait()
            await listening

    async def _listen(self, stream: asyncio.StreamReader) -> None:
        """Keep the last line that the child, or depthai in it, wrote."""
        while data := await stream.read(4096):
            for line in data.decode(errors="replace").splitlines():
                if line.strip():
                    self._last_words = line.strip()[:200]
                    _log.debug("OAK camera: %s", self._last_words)


def child_command(device_id: str, socket: OakSocket, camera: Camera, rate_hz: float) -> list[str]:
    """Return how to start the child for a device (empty: any) and one of its sensors."""
    expected = {
        "device_id": device_id,
        "socket": socket,
        "size_px": [camera.width_px, camera.height_px],
        "intrinsics_px": [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        "rate_hz": rate_hz,
    }
    return [sys.executable, "-m", "vcl_companion.cameras.oak", json.dumps(expected)]


def load_depthai() -> Any:
    """Import depthai, which must not report home nor change a calibration by itself.

    Raises:
        DeviceError: it is not installed.
    """
    os.environ["DEPTHAI_TELEMETRY"] = "0"
    os.environ["DEPTHAI_AUTOCALIBRATION"] = "OFF"
    try:
        return importlib.import_module("depthai")
    except ImportError as error:
        raise DeviceError("depthai is not installed (pip install '.[oak]')") from error


def send_frames(queue: Any, dai: Any, intrinsics_px: Sequence[float], out: BinaryIO) -> None:
    """Write every ``ImgFrame`` of an output queue to ``out``, until nothing comes any more.

    Args:
        queue: a ``dai.MessageQueue`` of GRAY8 images.
        dai: the module depthai.
        intrinsics_px: (fx, fy, cx, cy) that the device must agree with.
        out: where records go; blocking, so that the queue drops what is late.

    Raises:
        DeviceError: the device's calibration is not the file's.
    """
    patience = datetime.timedelta(seconds=_FIRST_FRAME_WITHIN_S)
    while (message := queue.get(patience)) is not None:
        if patience.total_seconds() > _NEXT_FRAME_WITHIN_S:
            matrix = np.array(message.getTransformation().getIntrinsicMatrix())
            check_intrinsics(matrix, intrinsics_px)
            patience = datetime.timedelta(seconds=_NEXT_FRAME_WITHIN_S)
        stamp = message.getTimestamp(dai.CameraExposureOffset.MIDDLE)
        at_ns = stamp // datetime.timedelta(microseconds=1) * 1000
        if not 0 <= time.monotonic_ns() - at_ns <= _OLDEST_STAMP_NS:
            print(f"frame {message.getSequenceNum()}: stamp is not of this clock", file=sys.stderr)
            continue
        image = np.ascontiguousarray(message.getCvFrame(), dtype=np.uint8)
        header = b"P5\n%d %d\n255\n" % image.shape[::-1]  # PGM: no compression to wait for
        encoded = header + image.tobytes()
        out.write(encode_record(StreamFrame(message.getSequenceNum(), at_ns, encoded)))
        out.flush()


def check_intrinsics(matrix: np.ndarray, expected_px: Sequence[float]) -> None:
    """Compare a device's (3, 3) camera matrix, px, with (fx, fy, cx, cy) of the calibration file.

    Raises:
        DeviceError: they differ so much that they are not of one camera.
    """
    given_px = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    tolerance_px = _INTRINSICS_TOLERANCE * expected_px[0]
    if not np.allclose(given_px, expected_px, rtol=0.0, atol=tolerance_px):
        given, expected = (
            ", ".join(f"{value:.0f}" for value in values) for values in (given_px, expected_px)
        )
        raise DeviceError(
            f"the device says fx, fy, cx, cy = {given} px, the calibration file says {expected}"
        )


def _run_child(settings: dict[str, Any], out: BinaryIO) -> None:
    """Open the device and send its frames."""
    dai = load_depthai()
    device_id = settings["device_id"]
    device = dai.Device(device_id) if device_id else dai.Device()
    # Not as a context: leaving one takes ten seconds, for threads that `child` ends anyway.
    pipeline = dai.Pipeline(device)
    if hasattr(dai.Pipeline, "AutoCalibrationMode"):  # depthai >= 3.6
        pipeline.setAutoCalibrationMode(dai.Pipeline.AutoCalibrationMode.OFF)
    socket = getattr(dai.CameraBoardSocket, settings["socket"])
    sensor = pipeline.create(dai.node.Camera).build(socket)
    output = sensor.requestOutput(
        tuple(settings["size_px"]),
        dai.ImgFrame.Type.GRAY8,
        fps=settings["rate_hz"],
        enableUndistortion=False,
    )
    queue = output.createOutputQueue(maxSize=1, blocking=False)
    pipeline.start()
    send_frames(queue, dai, settings["intrinsics_px"], out)


def child(run: Callable[[BinaryIO], None]) -> NoReturn:
    """Give ``run`` the frames' stream, print why it ended, and end the process at once.

    depthai logs to standard output: that becomes standard error, and the
    frames get the descriptor that was standard output. An OAK whose host is
    gone resets itself, so nothing is lost by not winding depthai down.
    """
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        run(out)
        out.flush()
        _end(1, "no frame from the device")
    except DeviceError as error:
        _end(_UNUSABLE, str(error))
    except BrokenPipeError:
        _end(0, "the daemon is gone")
    except RuntimeError as error:  # what depthai's errors arrive as
        _end(1, str(error))


def _end(status: int, last_words: str) -> NoReturn:
    """End the process from where an error is still held, and with it the pipeline's threads."""
    print(" ".join(last_words.split()), file=sys.stderr, flush=True)
    os._exit(status)


if __name__ == "__main__":
    child(lambda out: _run_child(json.loads(sys.argv[1]), out))
