from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.recording.folders import CAMERA, FORWARD, grey_image, random_trajectory, write_small
from vcl_companion.errors import RecordingError
from vcl_companion.recording import (
    Description,
    ImageOptions,
    InertialSamples,
    KnownPair,
    RecordingWriter,
    ReferenceAxes,
    Sensor,
    load_image,
    read_recording,
)

INSTANTS = st.lists(st.integers(0, 2**63 - 1), min_size=1, max_size=4, unique=True).map(sorted)


@settings(max_examples=40)
@given(
    instants=st.lists(INSTANTS, min_size=1, max_size=3),
    axes=st.sampled_from(["NED", "ENU", "NWU"]),
    velocities=st.booleans(),
    with_truth=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
)
def test_what_is_written_reads_back_the_same(
    tmp_path_factory: pytest.TempPathFactory,
    instants: list[list[int]],
    axes: ReferenceAxes,
    velocities: bool,
    with_truth: bool,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.mktemp("round") / "trip"
    names = [f"mav{k}" for k in range(len(instants))]
    pairs = (KnownPair("mav0", "mav1", 2.5),) if len(names) > 1 else ()
    description = Description("a name", 7.5, names[-1], pairs, 0.03, 0.25)
    sensor = Sensor(CAMERA, FORWARD, 7.5, axes)
    images, truths, imus = {}, {}, {}
    with RecordingWriter(path, description, ImageOptions("png")) as writer:
        for name, at_ns in zip(names, instants, strict=True):
            truths[name] = random_trajectory(rng, at_ns, velocities=velocities)
            imus[name] = InertialSamples(
                np.array(at_ns), rng.normal(size=(len(at_ns), 3)), rng.normal(size=(len(at_ns), 3))
            )
            writer.add_drone(name, sensor, imu=imus[name])
            for instant in at_ns:
                images[name, instant] = grey_image(rng)
                writer.add_frame(name, instant, images[name, instant])
            if with_truth:
                writer.set_truth(name, truths[name])
    recording = read_recording(path)
    assert recording.name == "a name"
    assert recording.frame_rate_hz == 7.5
    assert recording.leader == names[-1]
    assert recording.known_distances == pairs
    assert recording.distance_sigma_m == 0.03
    assert recording.calibration_px == 0.25
    for drone, name, at_ns in zip(recording.drones, names, instants, strict=True):
        assert drone.sensor.camera == CAMERA
        assert drone.sensor.reference_axes == axes
        assert [frame.at_ns for frame in drone.frames] == at_ns
        for frame in drone.frames:
            image = load_image(frame.path, CAMERA)
            np.testing.assert_array_equal(image, images[name, frame.at_ns])
        assert drone.imu is not None
        np.testing.assert_array_equal(
            drone.imu.specific_forces_m_s2, imus[name].specific_forces_m_s2
        )
        assert (drone.truth is None) != with_truth
        if drone.truth is None:
            continue
        expected = truths[name]
        assert drone.truth.at_ns.tolist() == at_ns
        for k in range(len(at_ns)):
            np.testing.assert_allclose(
                drone.truth.pose(k).matrix(), expected.pose(k).matrix(), rtol=0, atol=1e-12
            )
        assert (drone.truth.velocities_m_s is None) != velocities
        if drone.truth.velocities_m_s is not None and expected.velocities_m_s is not None:
            np.testing.assert_array_equal(drone.truth.velocities_m_s, expected.velocities_m_s)


def test_jpg_is_small_and_near(tmp_path: Path) -> None:
    waves = np.outer(np.sin(np.arange(32) / 3.0), np.cos(np.arange(48) / 5.0))
    smooth = (128 + 90 * waves).astype(np.uint8)
    sizes, errors = {}, {}
    for quality in (30, 95):
        path = tmp_path / str(quality)
        with RecordingWriter(path, images=ImageOptions("jpg", quality)) as writer:
            writer.add_drone("mav0", Sensor(CAMERA, FORWARD, 5.0))
            writer.add_frame("mav0", 17, smooth)
        (frame,) = read_recording(path).drones[0].frames
        assert frame.path.name == "17.jpg"
        sizes[quality] = frame.path.stat().st_size
        errors[quality] = np.abs(load_image(frame.path, CAMERA).astype(int) - smooth).max()
    assert 0 < errors[95] <= 4 < errors[30] <= 40
    assert sizes[30] < sizes[95]


def test_nothing_is_seen_before_the_end_and_nothing_left_of_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "flight"
    image = grey_image(np.random.default_rng(1))

    class RendererError(Exception):
        pass

    def fly() -> None:
        with RecordingWriter(path) as writer:
            writer.add_drone("mav0", Sensor(CAMERA, FORWARD, 5.0))
            writer.add_frame("mav0", 1, image)
            assert not path.exists()
            raise RendererError

    with pytest.raises(RendererError):
        fly()
    assert list(path.parent.iterdir()) == []


def test_an_existing_recording_is_not_overwritten(tmp_path: Path) -> None:
    path = write_small(tmp_path / "small", n_frames=1)
    with pytest.raises(RecordingError, match="already there; give a new or empty folder"):
        write_small(path)
    (tmp_path / "empty").mkdir()
    write_small(tmp_path / "empty", n_frames=1)
    assert len(read_recording(tmp_path / "empty").drones) == 2


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot be written"):
        write_small(tmp_path / "file" / "small")


def test_misuse_is_a_value_error(tmp_path: Path) -> None:
    image = grey_image(np.random.default_rng(1))
    sensor = Sensor(CAMERA, FORWARD, 5.0)
    with RecordingWriter(tmp_path / "a") as writer:
        writer.add_drone("mav0", sensor)
        writer.add_frame("mav0", 5, image)
        for at_ns in (5, 4, -1, 2**63):
            with pytest.raises(ValueError, match="does not follow"):
                writer.add_frame("mav0", at_ns, image)
        with pytest.raises(ValueError, match="not grey of its camera"):
            writer.add_frame("mav0", 6, image.T)
        for name in ("mav0", "drone1", "mav", "../mav1"):
            with pytest.raises(ValueError, match="each once"):
                writer.add_drone(name, sensor)
    with (
        pytest.raises(ValueError, match="nothing recorded by any drone"),
        RecordingWriter(tmp_path / "b"),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
