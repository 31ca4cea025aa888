"""Scenario files, the motion they describe, and the recordings made of them."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import cv2
import msgspec
import numpy as np
import pytest

from sitl.render import TRUTH_SIGMA_M, render_scenario
from sitl.renderer import Renderer
from sitl.scenario import SCENARIOS, Scenario, load_scenario, scenario_names
from sitl.scenario_ranges import RANGES
from sitl.town import build_town
from sitl.trajectories import Flight, FlightPath, Sway, Wobble
from sitl.world import World
from vcl_companion.errors import ConfigError, RecordingError
from vcl_companion.geometry.rotation import euler_from_matrix
from vcl_companion.recording import Recording, load_image, read_recording

DEMO = SCENARIOS.parent / "recordings" / "demo"

SMALL = """
name = "small"
frame_rate_hz = 4.0
duration_s = 0.75
known_distance = ["mav0", "mav1"]
[camera]
width_px = 96
height_px = 64
focal_px = 60.0
distortion_model = "radial-tangential"
distortion = [-0.1, 0.01, 0.0, 0.0]
position_m = [0.1, 0.02, -0.03]
roll_pitch_yaw_deg = [0.0, -5.0, 2.0]
[image]
format = "png"
[world]
ground_half_m = 20.0
texels_per_m = 10.0
[[world.building]]
x_m = 9.0
y_m = 0.0
facing_deg = 180.0
width_m = 8.0
[[drone]]
name = "mav0"
[drone.flight]
waypoints = [[0.0, 0.0, 0.0, -3.0, 0.0], [2.0, 1.0, 0.5, -3.0, 10.0]]
[[drone]]
name = "mav1"
delay_s = 0.003
[drone.flight]
waypoints = [[0.0, 0.0, 2.0, -3.0, 0.0]]
"""


def load_text(tmp_path: Path, text: str) -> Scenario:
    path = tmp_path / "a scenario.toml"
    path.write_text(text, "utf-8")
    return load_scenario(path)


def test_every_scenario_that_comes_with_the_harness_loads() -> None:
    assert "demo" in scenario_names()
    for name in scenario_names():
        assert load_scenario(name).drone


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("texels_per_m", "texel_per_m", "unknown key 'world.texel_per_m'.*'texels_per_m'"),
        ("facing_deg", "faces_deg", r"'world.building\[0\].faces_deg'.*'facing_deg'"),
        ("waypoints", "waypoint", r"'drone\[0\].flight.waypoint'.*'waypoints'"),
        ("duration_s", "duration", "'duration'.*'duration_s'"),
        ("width_m = 8.0", 'width_m = "wide"', r"float.*str.*world.building\[0\].width_m"),
        ("x_m = 9.0\n", "", "missing required field `x_m`"),
        ("focal_px = 60.0", "focal_px = -1.0", "camera.focal_px is 1 to 100000; got -1"),
        ("0.01, 0.0, 0.0]", "-0.6, 0.0, 0.0]", "camera: its corners look 90 degrees.*camera"),
        ("[-0.1, 0.01, 0.0, 0.0]", "[-0.1]", "coefficients"),
        ('["mav0", "mav1"]', '["mav0", "mav7"]', "no drone 'mav7'"),
        ('name = "mav1"', 'name = "mav0"', "different names"),
        ("[2.0, 1.0, 0.5", "[0.0, 1.0, 0.5", "rising times"),
        ("[world]", "[world", "not TOML"),
    ],
)
def test_a_wrong_scenario_gets_one_line_that_names_the_key(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in SMALL
    with pytest.raises(ConfigError, match=message) as caught:
        load_text(tmp_path, SMALL.replace(old, new, 1))
    assert "a scenario.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("duration_s", "seed = -1\nduration_s", "seed is 0 to 4294967295; got -1"),
        ("focal_px = 60.0", "focal_px = 1e-300", "camera.focal_px is 1 to 100000; got 1e-300"),
        ("[0.1, 0.02", "[nan, 0.02", "camera.position_m[0] is -100 to 100; got nan"),
        ('"png"', '"png"\ngain = 1e300', "image.gain is 0.01 to 100; got 1e+300"),
        ('"png"', '"png"\nblur_px = 1e6', "image.blur_px is 0 to 50; got 1e+06"),
        ("[world]", "[world]\nsun_strength = 1e300", "world.sun_strength is 0 to 10; got 1e+300"),
        ("width_m = 8.0", "width_m = 1e9", "world.building[0].width_m is 2 to 300; got 1e+09"),
        ("180.0", "inf", "world.building[0].facing_deg is -360 to 360; got inf"),
        ("width_m", "bays = 1000000000\nwidth_m", "building[0].bays is 0 to 20; got 1000000000"),
        ("[2.0, 1.0", "[2.0, nan", "flight.waypoints[1][1] is -100000 to 100000; got nan"),
        ("delay_s = 0.003", "delay_s = -1", "drone[1].delay_s is 0 to 10; got -1"),
    ],
)
def test_a_number_out_of_its_range_is_one_line_with_key_and_range(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load_text(tmp_path, SMALL.replace(old, new, 1))
    path = tmp_path / "a scenario.toml"
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).endswith(message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {
                "width_m = 8.0": "width_m = 300.0\nheight_m = 300.0",
                "texels_per_m = 10": "texels_per_m = 100",
            },
            "185400 m2 of walls.*at most 107374 m2",
        ),
        (
            {"width_px = 96": "width_px = 8192", "height_px = 64": "height_px = 4096"},
            "supersampling.2 is at most 67108864; got 134217728",
        ),
    ],
)
def test_what_is_too_much_together_is_refused(
    tmp_path: Path, changes: dict[str, str], message: str
) -> None:
    text = SMALL.replace("focal_px = 60.0", "focal_px = 5000.0").replace("distortion", "#")
    for old, new in changes.items():
        text = text.replace(old, new, 1)
    with pytest.raises(ConfigError, match=message):
        load_text(tmp_path, text)


def test_every_number_of_a_scenario_has_a_range() -> None:
    def numbers(kind: Any, key: str) -> Iterator[str]:
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            for name, inner in get_type_hints(kind).items():
                yield from numbers(inner, f"{key}.{name}".lstrip("."))
        elif kind in (int, float):
            yield key
        elif get_origin(kind) is not Literal:
            for inner in get_args(kind):
                yield from numbers(inner, key)

    assert set(numbers(Scenario, "")) == set(RANGES)


def test_an_unknown_scenario_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no scenario 'nowhere'.*demo"):
        load_scenario("nowhere")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_scenario(tmp_path / "absent.toml")


def test_a_scenario_based_on_another_replaces_top_level_keys_only(tmp_path: Path) -> None:
    base = load_scenario("demo")
    changed = load_text(tmp_path, 'based_on = "demo"\nname = "longer"\nduration_s = 20.0\n')
    assert (changed.name, changed.duration_s) == ("longer", 20.0)
    assert changed.drone == base.drone
    assert changed.world == base.world
    near = load_scenario("forward_back_near")
    darker = load_text(tmp_path, 'based_on = "forward_back_near"\n[image]\ngain = 0.3\n')
    assert (darker.drone, darker.world, darker.image.gain) == (near.drone, near.world, 0.3)
    with pytest.raises(ConfigError, match=r"based_on is one of .*demo.*'nowhere'"):
        load_text(tmp_path, 'based_on = "nowhere"')


def test_a_tilted_camera_looks_higher_than_the_others(tmp_path: Path) -> None:
    text = SMALL.replace('name = "mav1"\n', 'name = "mav1"\ntilt_deg = 20.0\n')
    scenario = load_text(tmp_path, text)
    level, tilted = (scenario.sensor(drone).body_from_cam for drone in scenario.drone)
    axis = np.array([0.0, 0.0, 1.0])
    up = [-np.rad2deg(np.arcsin((pose.rotation @ axis)[2])) for pose in (level, tilted)]
    assert up == pytest.approx([-5.0, 15.0], abs=1e-9)
    assert tilted.translation == pytest.approx(level.translation)


FLIGHT = Flight(
    waypoints=(
        (0.0, 0.0, 0.0, -4.0, 0.0),
        (3.0, 2.0, 1.0, -5.0, 40.0),
        (6.0, 2.0, 4.0, -4.0, 90.0),
    ),
    sway=(Sway("x", 0.2, 2.3, 40.0), Sway("yaw", 3.0, 2.9)),
    wobble=(Wobble("roll", 1.0, 1.7), Wobble("pitch", 0.5, 1.1, 90.0)),
)


def test_velocity_and_acceleration_are_those_of_the_position() -> None:
    path = FlightPath(FLIGHT)
    step = 1e-4
    for at_s in (-1.0, 0.4, 2.9, 3.2, 5.7, 7.0):
        before, now, after = (path.at(at_s + k * step) for k in (-1, 0, 1))
        moved = after.ned_from_body.translation - before.ned_from_body.translation
        assert now.velocity_m_s == pytest.approx(moved / (2 * step), abs=1e-6)
        changed = after.velocity_m_s - before.velocity_m_s
        assert now.acceleration_m_s2 == pytest.approx(changed / (2 * step), abs=1e-5)


def test_the_body_thrusts_against_gravity_and_for_its_acceleration() -> None:
    """An accelerometer of a leaning multirotor feels force along its z axis alone."""
    path = FlightPath(Flight(FLIGHT.waypoints, sway=FLIGHT.sway))
    leans = []
    for at_s in np.linspace(0.0, 6.0, 25).tolist():
        motion = path.at(at_s)
        felt = motion.ned_from_body.rotation.T @ (motion.acceleration_m_s2 - (0.0, 0.0, 9.80665))
        assert np.abs(felt[:2]).max() < 1e-9
        assert felt[2] < -5.0
        leans.append(np.linalg.norm(euler_from_matrix(motion.ned_from_body.rotation)[:2]))
    assert 0.02 < max(leans) < 0.5


def test_waypoints_are_met_and_ends_are_at_rest() -> None:
    path = FlightPath(Flight(FLIGHT.waypoints, lean=0.0))
    for t, x, y, z, yaw in FLIGHT.waypoints:
        motion = path.at(t)
        assert motion.ned_from_body.translation == pytest.approx([x, y, z], abs=1e-9)
        angles = np.rad2deg(euler_from_matrix(motion.ned_from_body.rotation))
        assert angles == pytest.approx([0.0, 0.0, yaw], abs=1e-9)
    assert path.at(0.0).velocity_m_s == pytest.approx(np.zeros(3), abs=1e-9)
    assert np.array_equal(path.at(60.0).velocity_m_s, path.at(6.0).velocity_m_s)
    moving = FlightPath(Flight(FLIGHT.waypoints, ends="moving"))
    assert np.linalg.norm(moving.at(0.0).velocity_m_s) > 0.3


def test_a_rendered_scenario_reads_back_and_is_the_same_every_time(tmp_path: Path) -> None:
    scenario = load_text(tmp_path, SMALL)
    told: list[tuple[int, int]] = []
    for name in ("one", "two"):
        render_scenario(scenario, tmp_path / name, lambda done, total: told.append((done, total)))
    assert told == [(k, 6) for k in range(1, 7)] * 2
    recording = read_recording(tmp_path / "one")
    assert (recording.name, recording.frame_rate_hz, recording.leader) == ("small", 4.0, "mav0")
    assert [(p.a, p.b, p.distance_m) for p in recording.known_distances] == [("mav0", "mav1", None)]
    assert recording.distance_sigma_m == TRUTH_SIGMA_M
    assert recording.calibration_px == 0.0
    for drone, told_by in zip(recording.drones, scenario.drone, strict=True):
        assert drone.sensor.camera == scenario.camera.camera()
        assert drone.sensor.body_from_cam.matrix() == pytest.approx(
            scenario.camera.body_from_cam().matrix(), abs=1e-12
        )
        assert [f.at_ns for f in drone.frames] == [
            scenario.frame_at_ns(told_by, k) for k in range(3)
        ]
        assert drone.truth is not None
        assert len(drone.truth) == 11  # five a frame, 20 Hz, and the last
        for frame in drone.frames:
            motion = told_by.path().at(scenario.flight_s(frame.at_ns))
            pose = drone.truth.pose_at(frame.at_ns)
            assert pose is not None
            assert pose.matrix() == pytest.approx(motion.ned_from_body.matrix(), abs=1e-9)
    files = sorted(p.relative_to(tmp_path / "one") for p in (tmp_path / "one").rglob("*.*"))
    assert len([p for p in files if p.suffix == ".png"]) == 6
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    with pytest.raises(RecordingError, match="already there"):
        render_scenario(scenario, tmp_path / "one")


def test_a_rendering_that_is_ended_leaves_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sitl", "render", "demo", "--out", str(tmp_path / "demo")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as rendering:
        while not list(tmp_path.glob(".demo.*/mav0/cam0/data/*")):
            assert rendering.poll() is None
            time.sleep(0.02)
        rendering.terminate()
        _, errors = rendering.communicate()
    assert rendering.returncode == 128 + signal.SIGTERM
    assert "Traceback" not in errors
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def demo() -> Recording:
    return read_recording(DEMO)


def test_the_committed_recording_is_the_demo_and_small(demo: Recording) -> None:
    scenario = load_scenario("demo")
    assert [len(drone.frames) for drone in demo.drones] == [60, 60, 60]
    assert sum(p.stat().st_size for p in DEMO.rglob("*") if p.is_file()) < 8_000_000
    for drone, told in zip(demo.drones, scenario.drone, strict=True):
        path = told.path()
        assert drone.truth is not None
        for k, (at_ns, pose) in enumerate(drone.truth.stamped_poses()):
            motion = path.at(scenario.flight_s(at_ns))
            assert pose.local(motion.ned_from_body) == pytest.approx(np.zeros(6), abs=1e-9)
            assert drone.truth.velocities_m_s is not None
            assert drone.truth.velocities_m_s[k] == pytest.approx(motion.velocity_m_s, abs=1e-9)
            assert np.linalg.norm(motion.velocity_m_s) < 1.5


def test_neighbours_of_the_demo_are_two_to_four_metres_apart_at_the_start(demo: Recording) -> None:
    starts = []
    for drone in demo.drones:
        assert drone.truth is not None
        starts.append(drone.truth.positions_m[0])
    for other in starts[1:]:
        assert 2.0 < float(np.linalg.norm(other - starts[0])) < 4.0


@pytest.fixture(scope="module")
def demo_world() -> World:
    return build_town(load_scenario("demo").world)


@pytest.mark.parametrize(("a", "b"), [((0, 0), (1, 0)), ((0, 0), (0, 20)), ((2, 35), (0, 50))])
def test_truth_of_the_committed_images_is_right(
    demo: Recording, demo_world: World, a: tuple[int, int], b: tuple[int, int]
) -> None:
    """Image a, carried over to b's view by depth, truth and camera, lies on image b."""
    images, poses = [], []
    for drone_index, k in (a, b):
        drone = demo.drones[drone_index]
        assert drone.truth is not None
        image = load_image(drone.frames[k].path, drone.sensor.camera)
        # The tracker takes equal brightness for granted; the drones' exposures differ.
        gain = load_scenario("demo").drone[drone_index].gain
        images.append(np.clip(np.rint(image / gain), 0, 255).astype(np.uint8))
        pose = drone.truth.pose_at(drone.frames[k].at_ns)
        assert pose is not None
        poses.append(pose @ drone.sensor.body_from_cam)
    camera = demo.drones[0].sensor.camera
    renderer = Renderer(demo_world, camera)
    depth_a, depth = (renderer.depth(pose).depth_m.astype(np.float64) for pose in poses)
    rows, columns = np.indices(depth.shape)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float64)
    rays = np.column_stack([camera.ideal_from_pixels(pixels), np.ones(len(pixels))])
    solid = np.isfinite(depth)
    points = poses[1].apply(rays * np.where(solid, depth, 1e4).reshape(-1, 1))
    points_a = poses[0].inverse().apply(points)
    maps = camera.project(points_a).astype(np.float32).reshape(*depth.shape, 2)
    carried = cv2.remap(images[0], maps[..., 0], maps[..., 1], cv2.INTER_CUBIC)
    # Windows that hold anything hidden from a cannot agree.
    met = cv2.remap(depth_a, maps[..., 0], maps[..., 1], cv2.INTER_NEAREST)
    shared = solid & (np.abs(met - points_a[:, 2].reshape(depth.shape)) < 0.05)
    shared &= np.all((maps > 20) & (maps < (619, 459)), axis=2)
    mask = cv2.erode(shared.astype(np.uint8), np.ones((13, 13)))
    corners = cv2.goodFeaturesToTrack(images[1], 800, 0.02, 8, mask=mask)
    assert corners is not None
    tracked, found, _ = cv2.calcOpticalFlowPyrLK(
        images[1],
        np.asarray(carried, dtype=np.uint8),
        corners,
        corners.copy(),
        winSize=(13, 13),
        maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    error = (np.asarray(tracked) - corners).reshape(-1, 2)[np.asarray(found).ravel() == 1]
    assert len(error) > 300
    assert np.abs(np.median(error, axis=0)).max() < 0.03
    assert float(np.median(np.linalg.norm(error, axis=1))) < 0.1
