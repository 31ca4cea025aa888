"""Before flight: the board's own side of it, its calibration, key, disk, clock and camera."""

from __future__ import annotations

import asyncio
import os
import shutil
import stat
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from vcl_companion.cameras.mounting import mounting_text, read_calibration
from vcl_companion.cameras.open import open_camera
from vcl_companion.cameras.source import CameraOptions
from vcl_companion.clock import Clock
from vcl_companion.config import Config
from vcl_companion.errors import VclError
from vcl_companion.links.key_file import read_key_file

Grade = Literal["ok", "warning", "failure"]

_CAMERA_S = 4.0
_LEAST_FRAMES = 4
# ArduPilot wants 4 Hz, a PX4 samples less than 200 ms apart.
_LEAST_RATE_HZ, _GOOD_RATE_HZ = 5.0, 10.0
_LEAST_FREE_BYTES, _GOOD_FREE_BYTES = 50e6, 500e6
_YEAR_S = 365.25 * 86400.0
# When this was written: a clock before it was never set.
_WRITTEN_S = 1.79e9


@dataclass(frozen=True)
class Check:
    """One thing that was looked at.

    Attributes:
        name: of it.
        grade: how it is.
        what: what was found.
        advice: what to do about it; empty where nothing.
    """

    name: str
    grade: Grade
    what: str
    advice: str = ""


def of_files(config: Config) -> Iterable[Check]:
    """Look at calibration, key, known distance, disk, and where files are to be."""
    yield _of_calibration(config.camera)
    if config.peers.key_file:
        try:
            key = read_key_file(Path(config.peers.key_file))
            yield Check("key", "ok", f"{key.fingerprint}, the same on every drone")
        except VclError as error:
            yield Check("key", "failure", str(error), "make one: vcl keys new; vcl keys install")
    elif len(config.swarm.members) > 1:
        grade: Grade = "warning" if config.peers.allow_unsigned else "failure"
        yield Check("key", grade, "there are other drones, and no key", "set peers.key_file")
    if len(config.swarm.members) > 1 and not config.swarm.known_distances:
        what = "no distance between two drones is known: no first map has a scale"
        yield Check("swarm", "warning", what, "swarm.known_distances, the same on every drone")
    folder = config.map.directory
    if folder:
        free = shutil.disk_usage(_there_of(Path(folder))).free
        grade = "ok" if free > _GOOD_FREE_BYTES else "warning"
        grade = "failure" if free < _LEAST_FREE_BYTES else grade
        advice = "" if grade == "ok" else "make room: maps and logs are kept there"
        yield Check("disk", grade, f"{free / 1e6:.0f} MB free for {folder}", advice)
    yield from _of_places(config)


def _of_places(config: Config) -> Iterable[Check]:
    """Look at whether what is written in flight can be: only what is wrong is said."""
    files = {
        "peers.timestamp_file": config.peers.timestamp_file,
        "log.flight_log": config.log.flight_log,
        "log.status_file": config.log.status_file,
    }
    for setting, text in files.items():
        path = Path(text)
        if text and path.is_absolute():  # others lie in the service's own folder, not in ours
            if path.is_dir():
                yield Check(setting, "failure", f"{path} is a folder", "name a file in it")
            else:
                yield from _of_folder(setting, path.parent)
    if config.map.directory:
        yield from _of_folder("map.directory", Path(config.map.directory))


def _of_folder(setting: str, folder: Path) -> Iterable[Check]:
    there = _there_of(folder)
    if not there.is_dir():
        yield Check(setting, "failure", f"{there} is no folder", f"make {folder} one")
    elif not os.access(there, os.W_OK | os.X_OK):
        who = "whoever runs this check"
        yield Check(setting, "warning", f"{who} cannot write in {there}", "can the service?")


def _there_of(path: Path) -> Path:
    """Return the path, or the nearest above it that is there."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return path


def _of_calibration(options: CameraOptions) -> Check:
    try:
        sensor = read_calibration(options)
        age_s = time.time() - os.stat(options.calibration)[stat.ST_MTIME]
    except (VclError, OSError) as error:
        return Check("calibration", "failure", str(error), "camera.calibration names a sensor.yaml")
    camera = sensor.camera
    what = f"{camera.width_px}x{camera.height_px}, {age_s / 86400.0:.0f} days old, "
    what += mounting_text(sensor.body_from_cam.rotation)
    if age_s > _YEAR_S:
        return Check("calibration", "warning", what, "lenses move: calibrate anew")
    return Check("calibration", "ok", what)


def of_wall_clock() -> Check:
    """Look at whether the board knows the date."""
    now_s = time.time()
    if now_s < _WRITTEN_S:
        date = time.strftime("%Y-%m-%d", time.gmtime(now_s))
        return Check("clock", "warning", f"it says {date}", "no clock battery? peers tell the time")
    return Check("clock", "ok", time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now_s)))


async def of_camera(config: Config, clock: Clock) -> Check:
    """Look at what the camera gives for a few seconds."""
    times: list[int] = []
    means: list[float] = []
    try:
        camera = open_camera(config.camera, read_calibration(config.camera), clock)
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(_CAMERA_S):
                    async for frame in camera.frames():
                        times.append(frame.captured_at_ns)
                        means.append(float(frame.image.mean()))
        finally:
            await camera.close()
    except (VclError, OSError) as error:
        return Check("camera", "failure", str(error), "is the service still running?")
    return judge_frames(times, means)


def judge_frames(times_ns: list[int], means: list[float]) -> Check:
    """Judge a camera by when its frames were taken, and by how bright they are (0..255)."""
    if len(times_ns) < _LEAST_FRAMES:
        what = f"{len(times_ns)} frames in {_CAMERA_S:.0f} s"
        return Check("camera", "failure", what, "at least 5 Hz are needed")
    rate_hz = (len(times_ns) - 1) / ((times_ns[-1] - times_ns[0]) * 1e-9)
    mean = sum(means) / len(means)
    what = f"{rate_hz:.1f} Hz, mean grey level {mean:.0f}"
    if rate_hz < _LEAST_RATE_HZ:
        return Check("camera", "failure", what, "autopilots want at least 5 Hz")
    if not 25.0 < mean < 230.0:
        return Check("camera", "warning", what, "set the exposure: too dark or too bright")
    if rate_hz < _GOOD_RATE_HZ:
        return Check(
            "camera", "warning", what, "10 Hz or more are better: PX4 does not begin with 5"
        )
    return Check("camera", "ok", what)
