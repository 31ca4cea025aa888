"""Before flight: how the drone is turned by hand, as its camera sees it and its autopilot says."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from vcl_companion.cameras.source import CameraSource, Frame
from vcl_companion.clock import Clock
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.hand_eye import turned_about
from vcl_companion.geometry.rotation import Array, exp_so3, log_so3
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.vision.image_turn import Image, image_turn

# Turns are compared over so long: over less they are no more than their noise.
_WINDOW_NS = 100_000_000
# More frames than this show no more.
_LEAST_STEP_NS = 45_000_000
_ATTITUDE_STEP_NS = 10_000_000
# An attitude may be so long on its way.
_SETTLED_NS = 100_000_000
_GATHER_S = 0.1
# What is enough of turning, for the camera: about a first, a second and a third axis, rad.
ENOUGH_RAD = np.deg2rad([90.0, 60.0, 60.0])


@dataclass
class Motion:
    """What was seen of a motion.

    Attributes:
        seen: start and end of each window, ns, and the turn in it, (3,) rotation vector of
            start_from_end in camera axes, rad; windows follow each other.
        said_ns: rising instants of attitudes.
        said: (3, 3) ned_from_body of each.
        n_unseen: images that told of no turn.
    """

    seen: list[tuple[int, int, Array]] = field(default_factory=list)
    said_ns: list[int] = field(default_factory=list)
    said: list[Array] = field(default_factory=list)
    n_unseen: int = 0

    @property
    def is_enough(self) -> bool:
        """Whether it turned enough about three axes."""
        if len(self.seen) < 3:
            return False
        turns = np.array([turn for *_, turn in self.seen])
        return bool(np.all(turned_about(turns) >= ENOUGH_RAD))

    def said_at(self, at_ns: int) -> Array | None:
        """Return (3, 3) the attitude at an instant, between two that were said; None outside."""
        after = int(np.searchsorted(self.said_ns, at_ns))
        if not 0 < after < len(self.said_ns):
            return None
        start_ns, end_ns = self.said_ns[after - 1], self.said_ns[after]
        if end_ns - start_ns > _SETTLED_NS:
            return None
        start, end = self.said[after - 1], self.said[after]
        share = (at_ns - start_ns) / (end_ns - start_ns)
        return np.asarray(start @ exp_so3(share * log_so3(start.T @ end)))


async def watch_motion(
    camera: CameraSource,
    lens: Camera,
    link: AutopilotLink,
    clock: Clock,
    within_s: float,
) -> Motion:
    """Watch a drone that is turned by hand, until it was enough or the time is over.

    Args:
        camera: its frames.
        lens: intrinsics.
        link: to its autopilot, running.
        clock: what both are stamped with.
        within_s: how long.

    Raises:
        DeviceError: the camera cannot be used.
    """
    motion = Motion()
    listening = asyncio.ensure_future(_listen(motion, link, clock))
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await _look(motion, camera, lens)
        await asyncio.sleep(2.0 * _SETTLED_NS * 1e-9)
    finally:
        listening.cancel()
        with suppress(asyncio.CancelledError):
            await listening
    return motion


async def _look(motion: Motion, camera: CameraSource, lens: Camera) -> None:
    """Follow the camera's turns."""
    rng = np.random.default_rng(0)
    loop = asyncio.get_running_loop()
    last: Frame | None = None
    began_ns, turned = 0, np.eye(3)
    async for frame in camera.frames():
        camera.done(frame.sequence, "dropped")
        if last is None:
            last, began_ns = frame, frame.captured_at_ns
            continue
        if frame.captured_at_ns - last.captured_at_ns < _LEAST_STEP_NS:
            continue
        before: Image = last.image
        step = await loop.run_in_executor(None, image_turn, before, frame.image, lens, rng)
        last = frame
        if step is None:
            motion.n_unseen += 1
            began_ns, turned = frame.captured_at_ns, np.eye(3)
            continue
        turned = turned @ step
        if frame.captured_at_ns - began_ns >= _WINDOW_NS:
            motion.seen.append((began_ns, frame.captured_at_ns, log_so3(turned)))
            began_ns, turned = frame.captured_at_ns, np.eye(3)
            if motion.is_enough:
                return


async def _listen(motion: Motion, link: AutopilotLink, clock: Clock) -> None:
    """Keep the attitudes of evenly spaced instants, until cancelled."""
    next_ns = clock.now_ns()
    while True:
        while next_ns < clock.now_ns() - _SETTLED_NS:
            attitude = await link.attitudes.at(next_ns, 0.0)
            if attitude is not None:
                motion.said_ns.append(next_ns)
                motion.said.append(attitude.ned_from_body)
            next_ns += _ATTITUDE_STEP_NS
        await asyncio.sleep(_GATHER_S)
