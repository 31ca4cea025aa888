import asyncio
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from vcl_companion.cameras.open import open_camera
from vcl_companion.cameras.recorded import RecordedCamera, read_drone_frames
from vcl_companion.cameras.source import CameraOptions, Frame
from vcl_companion.clock import ManualClock, SystemClock
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.geometry.pose import Pose
from vcl_companion.recording.sensor import Sensor
from vcl_companion.recording.writer import ImageOptions, RecordingWriter

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
SENSOR = Sensor(CAMERA, Pose.identity(), 5.0)
INSTANTS_NS = (1_000_000_000, 1_200_000_000, 1_390_000_000)


def picture(number: int) -> NDArray[np.uint8]:
    return np.random.default_rng(number).integers(0, 256, (24, 32), dtype=np.uint8)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "flight"
    with RecordingWriter(path, images=ImageOptions("png")) as writer:
        for name in ("mav0", "mav1"):
            writer.add_drone(name, SENSOR)
            for number, at_ns in enumerate(INSTANTS_NS):
                writer.add_frame(name, at_ns, picture(number))
    return path


def play(camera: RecordedCamera) -> list[Frame]:
    async def all_frames() -> list[Frame]:
        return [frame async for frame in camera.frames()]

    return asyncio.run(all_frames())


def test_frames_keep_their_time_and_pace(recording: Path) -> None:
    waits_s: list[float] = []
    clock = ManualClock()

    async def waited(wait_s: float) -> None:
        waits_s.append(wait_s)
        assert clock.now_ns() == INSTANTS_NS[len(waits_s) - 1]  # not before it is due

    frames = play(RecordedCamera(read_drone_frames(recording / "mav1"), CAMERA, clock, waited))
    assert [frame.captured_at_ns for frame in frames] == list(INSTANTS_NS)
    assert [frame.sequence for frame in frames] == [0, 1, 2]
    for frame in frames:
        assert np.array_equal(frame.image, picture(frame.sequence))
    # Nobody slept, so each wait is what is left until the frame is due.
    assert len(waits_s) == 2
    assert 0.1 < waits_s[0] <= 0.2
    assert 0.2 < waits_s[1] <= 0.39
    assert clock.now_ns() == INSTANTS_NS[-1]


def test_on_the_system_clock_the_flight_is_now(recording: Path) -> None:
    async def at_once(wait_s: float) -> None:
        pass

    before_ns = SystemClock().now_ns()
    files = read_drone_frames(recording / "mav0")
    frames = play(RecordedCamera(files, CAMERA, SystemClock(), at_once))
    assert before_ns <= frames[0].captured_at_ns <= frames[0].received_at_ns
    spacing_ns = np.diff([frame.captured_at_ns for frame in frames])
    assert spacing_ns.tolist() == np.diff(INSTANTS_NS).tolist()


def test_closing_ends_it_before_the_next_frame(recording: Path) -> None:
    async def scenario() -> int:
        async def close_instead(wait_s: float) -> None:
            await camera.close()

        files = read_drone_frames(recording / "mav0")
        camera = RecordedCamera(files, CAMERA, ManualClock(), close_instead)
        return len([frame async for frame in camera.frames()])

    assert asyncio.run(scenario()) == 1


def test_a_drone_that_is_not_there_is_named(recording: Path) -> None:
    options = CameraOptions(source=f"recording:{recording}/mav7")
    with pytest.raises(RecordingError, match=r"no drone 'mav7' \(there are: mav0, mav1\)"):
        open_camera(options, SENSOR, ManualClock())


def test_what_is_no_drone_s_folder_is_said(recording: Path) -> None:
    options = CameraOptions(source=f"recording:{recording}")
    with pytest.raises(RecordingError, match=rf"^{recording}: is no drone of a recording"):
        open_camera(options, SENSOR, ManualClock())


def test_images_of_another_size_than_the_calibration_are_refused(recording: Path) -> None:
    other = Sensor(Camera(64, 48, 30.0, 30.0, 15.5, 11.5), Pose.identity(), 5.0)
    options = CameraOptions(source=f"recording:{recording}/mav0")
    camera = open_camera(options, other, ManualClock())
    assert isinstance(camera, RecordedCamera)
    with pytest.raises(RecordingError, match="is 32x24, its calibration says 64x48"):
        play(camera)
