import asyncio
import importlib.util
import logging
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from vcl_companion.cameras.oak import OakCamera, check_intrinsics, child_command
from vcl_companion.cameras.open import open_camera
from vcl_companion.cameras.source import CameraOptions, Frame
from vcl_companion.clock import SystemClock
from vcl_companion.errors import DeviceError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.sensor import Sensor

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)

# A child in every respect but the device: it writes the level `20 * sequence`.
GRAB = """
import os, sys, time
import numpy as np
from vcl_companion.cameras.oak import child
from vcl_companion.cameras.stream import StreamFrame, encode_record
def frame(sequence, level):
    pgm = b"P5\\n32 24\\n255\\n" + np.full((24, 32), level, np.uint8).tobytes()
    return encode_record(StreamFrame(sequence, time.monotonic_ns(), pgm))
"""

# The real depthai, a pipeline on the host alone: everything but the camera node.
HOST_PIPELINE = """
import sys, time
import numpy as np
from vcl_companion.cameras.oak import child, load_depthai, send_frames
fx = float(sys.argv[1])
def scene_of(dai):
    class Scene(dai.node.ThreadedHostNode):
        def __init__(self):
            super().__init__()
            self.out = self.createOutput()
        def run(self):
            sequence = 0
            while self.isRunning():
                message = dai.ImgFrame()
                pixels = np.full((24, 32), 20 * (sequence % 10), np.uint8)
                message.setCvFrame(pixels, dai.ImgFrame.Type.GRAY8)
                message.setSequenceNum(sequence)
                message.setTimestamp(dai.Clock.now())
                intrinsics = [[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]]
                message.setTransformation(dai.ImgTransformation(32, 24, intrinsics))
                self.out.send(message)
                sequence += 1
                time.sleep(0.02)  # the scene's own rate
    return Scene
def run(out):
    dai = load_depthai()
    pipeline = dai.Pipeline(False)
    queue = pipeline.create(scene_of(dai)).out.createOutputQueue(maxSize=1, blocking=False)
    pipeline.start()
    send_frames(queue, dai, (fx, fx, 15.5, 11.5), out)
child(run)
"""


def script(folder: Path, text: str) -> list[str]:
    path = folder / "child.py"
    path.write_text(text)
    return [sys.executable, str(path)]


async def first_frames(camera: OakCamera, count: int) -> list[Frame]:
    frames, seen = camera.frames(), []
    try:
        for _ in range(count):
            seen.append(await anext(frames))
    finally:
        await camera.close()
        assert await anext(frames, None) is None
    return seen


async def at_once(_: float) -> None:
    """Restart without a pause."""


def test_a_crashed_child_is_started_again_and_the_count_goes_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    crash = (
        GRAB
        + """
def run(out):
    out.write(frame(70, 20))
    out.write(frame(73, 80))
    out.flush()
    print("depthai's log line")
    print("firmware died", file=sys.stderr, flush=True)
    os.abort()
child(run)
"""
    )
    camera = OakCamera(script(tmp_path, crash), CAMERA, sleep=at_once)
    frames = asyncio.run(first_frames(camera, 4))
    assert [frame.sequence for frame in frames] == [0, 3, 4, 7]
    assert [int(frame.image[0, 0]) for frame in frames] == [20, 80, 20, 80]
    assert all(frame.captured_at_ns <= frame.received_at_ns for frame in frames)
    warnings = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert warnings[0] == "OAK camera: firmware died (status -6); starting it again"


def test_a_device_that_never_works_is_given_up_with_its_last_words(tmp_path: Path) -> None:
    pauses_s: list[float] = []

    async def noted(pause_s: float) -> None:
        pauses_s.append(pause_s)

    command = ["/bin/sh", "-c", "echo No available devices >&2; exit 1"]
    camera = OakCamera(command, CAMERA, sleep=noted)
    with pytest.raises(DeviceError, match=r"^OAK camera: No available devices$"):
        asyncio.run(first_frames(camera, 1))
    assert pauses_s == [0.5, 1.0, 2.0, 4.0]


def test_a_child_that_falls_silent_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("vcl_companion.cameras.oak._NEXT_FRAME_WITHIN_S", 0.05)
    silent = GRAB + "child(lambda out: (out.write(frame(0, 20)), out.flush(), time.sleep(600)))"
    camera = OakCamera(script(tmp_path, silent), CAMERA, sleep=at_once)
    frames = asyncio.run(first_frames(camera, 2))
    assert [frame.sequence for frame in frames] == [0, 1]
    assert "no frame for 0 s (status -9)" in caplog.text


def test_a_frame_of_another_size_is_refused(tmp_path: Path) -> None:
    command = script(tmp_path, GRAB + "child(lambda out: out.write(frame(0, 20)))")
    camera = OakCamera(command, Camera(64, 48, 30.0, 30.0, 15.5, 11.5), sleep=at_once)
    with pytest.raises(DeviceError, match="gives 32x24"):
        asyncio.run(first_frames(camera, 1))


def test_the_offset_moves_the_timestamps(tmp_path: Path) -> None:
    command = script(tmp_path, GRAB + "child(lambda out: out.write(frame(0, 20)))")
    before_ns = time.monotonic_ns()
    (frame,) = asyncio.run(first_frames(OakCamera(command, CAMERA, time_offset_s=-1.0), 1))
    assert before_ns - 1_000_000_000 < frame.captured_at_ns < frame.received_at_ns - 999_000_000


def test_without_depthai_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "depthai.py").write_text("raise ImportError('none')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    camera = OakCamera(child_command("", "CAM_B", CAMERA, 5.0), CAMERA)
    with pytest.raises(DeviceError, match=r"OAK camera: depthai is not installed \(pip install"):
        asyncio.run(first_frames(camera, 1))


def test_intrinsics_of_another_camera_are_refused() -> None:
    matrix = np.array([[800.0, 0.0, 320.0], [0.0, 800.0, 240.0], [0.0, 0.0, 1.0]])
    check_intrinsics(matrix, (790.0, 805.0, 325.0, 236.0))
    with pytest.raises(DeviceError, match="800, 800, 320, 240 px, the calibration file says 400"):
        check_intrinsics(matrix, (400.0, 400.0, 320.0, 240.0))


def test_opening() -> None:
    sensor = Sensor(CAMERA, Pose.identity(), 5.0)
    options = CameraOptions(source="oak:19443010")
    assert isinstance(open_camera(options, sensor, SystemClock()), OakCamera)


needs_depthai = pytest.mark.skipif(
    importlib.util.find_spec("depthai") is None, reason="the extra `oak` is not installed"
)


@needs_depthai
def test_depthai_s_own_messages_arrive(tmp_path: Path) -> None:
    camera = OakCamera([*script(tmp_path, HOST_PIPELINE), "30"], CAMERA)
    frames = asyncio.run(first_frames(camera, 5))
    for frame in frames:
        assert 0 <= frame.received_at_ns - frame.captured_at_ns < 2_000_000_000
    steps = np.diff([frame.sequence for frame in frames])
    assert np.all(steps >= 1)
    levels = np.array([int(frame.image[3, 3]) for frame in frames])
    numbers = np.array([frame.sequence for frame in frames])
    assert np.all((levels // 20 - levels[0] // 20 - numbers + numbers[0]) % 10 == 0)


@needs_depthai
def test_depthai_s_intrinsics_are_compared_with_the_file(tmp_path: Path) -> None:
    camera = OakCamera([*script(tmp_path, HOST_PIPELINE), "60"], CAMERA)
    with pytest.raises(DeviceError, match="says fx, fy, cx, cy = 30, 30, 16, 12 px"):
        asyncio.run(first_frames(camera, 1))
