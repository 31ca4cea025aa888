"""One drone of a recording, played in real time: a flight on the bench without a camera."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

from vcl_companion.cameras.source import Frame, Outcome
from vcl_companion.clock import Clock, ManualClock
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.recording.images import load_image
from vcl_companion.recording.recording import FrameFile, read_recording


class RecordedCamera:
    """Plays a drone's frames at the pace they were taken, then ends.

    With a ``ManualClock`` frames keep the recording's own time and move the
    clock; with another clock the first frame is taken "now" and the others
    follow at their distance from it.
    """

    def __init__(
        self,
        files: tuple[FrameFile, ...],
        camera: Camera,
        clock: Clock,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        """Keep what to play; ``camera`` says which size the images must have."""
        self._files, self._camera, self._clock, self._sleep = files, camera, clock, sleep
        self._closed = False

    async def frames(self) -> AsyncIterator[Frame]:
        """Yield the recording's frames, each when it is due; see ``CameraSource``.

        Raises:
            RecordingError: an image cannot be read or has the wrong size.
        """
        if not self._files:
            return
        first_ns = self._files[0].at_ns
        manual = self._clock if isinstance(self._clock, ManualClock) else None
        shift_ns = 0 if manual else self._clock.now_ns() - first_ns
        started_ns = time.monotonic_ns()
        for sequence, file in enumerate(self._files):
            image = await asyncio.to_thread(load_image, file.path, self._camera)
            due_ns = started_ns + file.at_ns - first_ns
            wait_s = (due_ns - time.monotonic_ns()) * 1e-9
            if wait_s > 0.0:
                await self._sleep(wait_s)
            if self._closed:
                return
            if manual:
                manual.advance_to(file.at_ns)
            yield Frame(image, file.at_ns + shift_ns, sequence, time.monotonic_ns())

    def done(self, sequence: int, outcome: Outcome) -> None:
        """Do nothing: a recording does not wait for its viewer."""

    async def close(self) -> None:
        """End the frames before the next one."""
        self._closed = True


def read_drone_frames(folder: Path) -> tuple[FrameFile, ...]:
    """Return the frames of the drone that is recorded in ``folder``, DIRECTORY/mavN.

    Raises:
        RecordingError: the recording is broken or has no such drone.
    """
    if not folder.name.startswith("mav"):
        raise RecordingError(f"{folder}: is no drone of a recording; give DIRECTORY/mavN")
    recording = read_recording(folder.parent)
    try:
        return recording.drone(folder.name).frames
    except KeyError:
        names = ", ".join(drone.name for drone in recording.drones)
        raise RecordingError(
            f"{folder.parent}: no drone {folder.name!r} (there are: {names})"
        ) from None
