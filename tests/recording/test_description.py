from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.recording.folders import write_small
from vcl_companion.errors import RecordingError
from vcl_companion.recording import Description, KnownPair, read_recording
from vcl_companion.recording.description import format_description, read_description

NAMES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1).filter(str.strip)
PAIRS = st.builds(
    KnownPair,
    st.just("mav0"),
    st.sampled_from(["mav1", "mav2"]),
    st.none() | st.floats(1e-3, 1e5),
)
DESCRIPTIONS = st.builds(
    Description,
    st.none() | NAMES,
    st.none() | st.floats(1e-3, 1e5),
    st.none() | NAMES,
    st.lists(PAIRS, max_size=3).map(tuple),
    st.none() | st.floats(1e-3, 1e5),
    st.none() | st.floats(0.0, 10.0),
)


@given(DESCRIPTIONS)
def test_what_is_written_reads_back_the_same(
    tmp_path_factory: pytest.TempPathFactory, description: Description
) -> None:
    path = tmp_path_factory.mktemp("description") / "recording.toml"
    path.write_text(format_description(description), encoding="utf-8", newline="")
    assert read_description(path) == description


@pytest.mark.parametrize(
    ("text", "pairs"),
    [
        ('["mav0", "mav1"]', [KnownPair("mav0", "mav1")]),
        ('["mav0", "mav1", 2.5]', [KnownPair("mav0", "mav1", 2.5)]),
        ('["mav0", "mav1", 2]', [KnownPair("mav0", "mav1", 2.0)]),
        (
            '[["mav0", "mav1"], ["mav1", "mav2", 3.0]]',
            [KnownPair("mav0", "mav1"), KnownPair("mav1", "mav2", 3.0)],
        ),
        ("[]", []),
    ],
)
def test_forms_of_the_known_distance(tmp_path: Path, text: str, pairs: list[KnownPair]) -> None:
    path = tmp_path / "recording.toml"
    path.write_text(f"known_distance = {text}\n")
    assert list(read_description(path).known_distances) == pairs


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('nmae = "x"', "unknown key 'nmae'; the nearest is 'name'"),
        ('known_distances = ["mav0", "mav1"]', "the nearest is 'known_distance'"),
        ("frame_rate = 5", "the nearest is 'frame_rate_hz'"),
        ("frame_rate_hz = 0", "frame_rate_hz must be a positive number"),
        ("frame_rate_hz = nan", "frame_rate_hz must be a positive number"),
        ("frame_rate_hz = true", "frame_rate_hz must be a positive number"),
        (f"frame_rate_hz = 0x{'f' * 5000}", "frame_rate_hz must be a positive number"),
        ('frame_rate_hz = "5"', "frame_rate_hz must be a positive number"),
        ("distance_sigma_m = 0", "distance_sigma_m must be above 0 and below 1e6 metres"),
        ("distance_sigma_m = nan", "distance_sigma_m must be above 0 and below 1e6 metres"),
        ("distance_sigma_m = true", "distance_sigma_m must be above 0 and below 1e6 metres"),
        ("calibration_px = -0.1", "calibration_px must lie in 0..10"),
        ("calibration_px = 11", "calibration_px must lie in 0..10"),
        ("calibration_px = nan", "calibration_px must lie in 0..10"),
        ("calibration_px = false", "calibration_px must lie in 0..10"),
        ("leader = 0", "leader must be a text"),
        ('name = ""', "name must be a text"),
        ('known_distance = "mav0"', "known_distance must be"),
        ('known_distance = ["mav0"]', "known_distance must be"),
        ('known_distance = ["mav0", 1, 2]', "known_distance must be"),
        ('known_distance = ["mav0", "mav1", "2"]', "known_distance must be"),
        ('known_distance = ["mav0", "mav1", -2.0]', "above 0 and below 1e6 metres"),
        ('known_distance = ["mav0", "mav1", inf]', "above 0 and below 1e6 metres"),
        (f'known_distance = ["mav0", "mav1", 0x{"f" * 5000}]', "above 0 and below 1e6 metres"),
        ('known_distance = ["mav0", "mav0"]', "names 'mav0' twice"),
        ('known_distance = ["mav0", "mav7"]', "no drone 'mav7' (mav0, mav1)"),
        ('leader = "mav2"', "no drone 'mav2' (mav0, mav1)"),
        ("name = ", "not TOML (Invalid value (at end of document))"),
    ],
)
def test_a_wrong_key_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    folder = write_small(tmp_path / "small", n_frames=1)
    (folder / "recording.toml").write_text(text)
    with pytest.raises(RecordingError) as caught:
        read_recording(folder)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'recording.toml'}: ")
    assert says in message
    assert "\n" not in message


def test_a_byte_order_mark_before_it_is_nothing(tmp_path: Path) -> None:
    path = tmp_path / "recording.toml"
    path.write_bytes(b"\xef\xbb\xbfname = 'as Notepad saves it'\r\n")
    assert read_description(path).name == "as Notepad saves it"
