"""Whatever a file holds, a reader gives a value or one RecordingError of one line."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.recording.folders import grey_image, write_small
from tests.recording.test_kitti import CALIB, CAMERA
from tests.recording.test_sensor import EUROC
from vcl_companion.errors import RecordingError
from vcl_companion.geometry.camera import Camera
from vcl_companion.recording import Trajectory, read_recording
from vcl_companion.recording.airsim import import_airsim
from vcl_companion.recording.airsim_settings import read_airsim_settings
from vcl_companion.recording.description import read_description
from vcl_companion.recording.kitti import import_kitti
from vcl_companion.recording.sensor import read_sensor
from vcl_companion.recording.tum import read_tum

# The pieces that these formats are made of, and what people and disks put between them.
PIECES = st.sampled_from(
    [
        *",;:#.-+_ \t\n\r\0[]{}&*!|>'\"%@`=<?",
        *("nan", "inf", "-1", "0", "1e400", "1e-5", "0x1F", "1_0", "9" * 25, "é", "\u0661"),
        *("T_BS", "data", "resolution", "intrinsics", "rate_hz", "reference_axes", "NWU"),
        *("!!int", "!!python/name:os.system", "<<", "---", "%YAML", "&a", "*a", "mav0", "name"),
        *("#timestamp [ns],filename", "1721300000000000000", ".png", "2001-13-45"),
    ]
)
NOISE = st.lists(PIECES, max_size=6).map("".join).map(str.encode) | st.binary(max_size=12)


@st.composite
def edits(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """A change of a good file: noise over a stretch somewhere, or noise alone."""
    start, length = draw(st.floats(0.0, 1.0)), draw(st.integers(0, 40))
    noise, alone = (
        draw(NOISE),
        draw(st.booleans() if draw(st.integers(0, 9)) == 0 else st.just(False)),
    )

    def edit(content: bytes) -> bytes:
        at = int(start * len(content))
        return noise if alone else content[:at] + noise + content[at + length :]

    return edit


def value_or_one_line(read: Callable[[], object]) -> object:
    message = ""
    try:
        return read()
    except RecordingError as error:
        message = str(error)
    assert len(message.splitlines()) == 1
    return None


@pytest.mark.parametrize(
    "name",
    [
        "recording.toml",
        "mav0/cam0/sensor.yaml",
        "mav0/cam0/data.csv",
        "mav0/imu0/data.csv",
        "mav0/state_groundtruth_estimate0/data.csv",
    ],
)
@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edit=edits())
def test_a_recording(tmp_path: Path, name: str, edit: Callable[[bytes], bytes]) -> None:
    folder = tmp_path / "small"
    good = tmp_path / "good"
    if not folder.exists():
        write_small(folder)
        good.write_bytes((folder / name).read_bytes())
    (folder / name).write_bytes(edit(good.read_bytes()))
    recording = value_or_one_line(lambda: read_recording(folder))
    if recording is not None:
        for drone in read_recording(folder).drones:
            assert drone.truth is not None
            assert_plays(drone.truth)


def assert_plays(truth: Trajectory) -> None:
    first, last = int(truth.at_ns[0]), int(truth.at_ns[-1])
    for at_ns in (first, (first + last) // 2, last):
        assert truth.pose_at(at_ns) is not None


@settings(max_examples=300)
@given(edit=edits())
def test_sensor_yaml(
    tmp_path_factory: pytest.TempPathFactory, edit: Callable[[bytes], bytes]
) -> None:
    path = tmp_path_factory.getbasetemp() / "sensor.yaml"
    path.write_bytes(edit(EUROC.encode()))
    value_or_one_line(lambda: read_sensor(path))


@pytest.mark.parametrize(
    "content",
    [
        b"[" * 3000,
        b"a: " + b"{" * 3000,
        b"T_BS: [" + b"[1,2,3,4]," * 2_000 + b"]",
        b"a: &a [x,x]\nb: &b [*a,*a]\ndistortion_model: [*b,*b]\nT_BS: *b\n",
        b"? [1]\n: 2\n",
        b"!!int ''\n",
        b"x" * (1 << 21),
        b"",
    ],
    ids=["deep-list", "deep-map", "long", "aliases", "list-key", "tag", "large", "empty"],
)
def test_hostile_sensor_yaml(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "sensor.yaml"
    path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read_sensor(path)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 300 + len(str(path))


@settings(max_examples=200)
@given(content=st.lists(PIECES, max_size=30).map("".join))
def test_small_text_files(tmp_path_factory: pytest.TempPathFactory, content: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.txt"
    path.write_text(content, encoding="utf-8", newline="")
    value_or_one_line(lambda: read_description(path))
    value_or_one_line(lambda: read_sensor(path))
    value_or_one_line(lambda: read_tum(path))


AIRSIM_KEYS = [
    *("Vehicles", "A", "Cameras", "0", "CaptureSettings", "CameraDefaults", "Gimbal", "a\nb"),
    *("X", "Width", "FOV_Degrees", "ImageType", "Pitch", "ProjectionMode"),
]
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(AIRSIM_KEYS),
            inner,
            max_size=4,
        )
    ),
    max_leaves=20,
)


@settings(max_examples=300)
@given(table=JSON)
def test_airsim_settings(tmp_path_factory: pytest.TempPathFactory, table: object) -> None:
    path = tmp_path_factory.getbasetemp() / "settings.json"
    path.write_text(json.dumps(table))

    def use() -> None:
        airsim = read_airsim_settings(path)
        for vehicle in airsim.vehicle_names() or ("A",):
            airsim.start_ned_m(vehicle)
            airsim.camera(vehicle, "0")

    value_or_one_line(use)


KITTI_FILES = {
    "calib.txt": CALIB,
    "times.txt": "0.0\n",
    "07.txt": "1 0 0 0 0 1 0 0 0 0 1 0\n",
}


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edit=edits(), which=st.sampled_from(sorted(KITTI_FILES)))
def test_kitti(tmp_path: Path, edit: Callable[[bytes], bytes], which: str) -> None:
    (tmp_path / "image_0").mkdir(exist_ok=True)
    image = grey_image(np.random.default_rng(1), CAMERA)
    assert cv2.imwrite(str(tmp_path / "image_0/000000.png"), image)
    for name, text in KITTI_FILES.items():
        content = text.encode()
        (tmp_path / name).write_bytes(edit(content) if name == which else content)
    out = tmp_path / "out"
    value_or_one_line(lambda: import_kitti(tmp_path, tmp_path / "07.txt", out))
    if out.exists():  # what was taken can be played
        assert len(read_recording(out).drones[0].frames) == 1
        shutil.rmtree(out)


AIRSIM_TABLE = (
    "VehicleName\tTimeStamp\tPOS_X\tPOS_Y\tPOS_Z\tQ_W\tQ_X\tQ_Y\tQ_Z\tImageFile\n"
    "A\t1539453811633\t0.0\t0.5\t-2\t1\t0\t0\t0\timg_A_0_1_7.png;img_A_0_0_7.png\n"
    "A\t1539453811733\t0.1\t0.5\t-2\t1\t0\t0\t0\timg_A_0_1_8.png;img_A_0_0_7.png\n"
)


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edit=edits())
def test_airsim(tmp_path: Path, edit: Callable[[bytes], bytes]) -> None:
    (tmp_path / "images").mkdir(exist_ok=True)
    size = Camera(256, 144, 128.0, 128.0, 127.5, 71.5)
    image = grey_image(np.random.default_rng(1), size)
    assert cv2.imwrite(str(tmp_path / "images/img_A_0_0_7.png"), image)
    (tmp_path / "settings.json").write_text("{}")
    (tmp_path / "airsim_rec.txt").write_bytes(edit(AIRSIM_TABLE.encode()))
    out = tmp_path / "out"
    value_or_one_line(lambda: import_airsim(tmp_path, out))
    if out.exists():
        assert read_recording(out).drones[0].truth is not None
        shutil.rmtree(out)
