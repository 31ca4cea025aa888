import os
import string
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vcl_companion.config import Config, _section, load_config, parse_config, setting_paths
from vcl_companion.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    pairs: tuple[tuple[int, int, float], ...] = ()
    place: Path = Path("a")
    maybe: int | None = None
    mode: Literal["on", "off"] = "on"
    flag: bool = False


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    names: tuple[str, ...] = ("x",)


def test_an_empty_file_is_the_defaults() -> None:
    assert parse_config("", "f") == Config()


def test_what_is_said_replaces_a_default_and_nothing_else() -> None:
    said = parse_config('system_id = 7\n[camera]\nrate_hz = 30\n[log]\nlevel = "debug"\n', "f")
    assert said.system_id == 7
    assert said.camera.rate_hz == 30.0
    assert isinstance(said.camera.rate_hz, float)
    assert said.log.level == "debug"
    assert said.camera.source == Config().camera.source


def test_every_kind_of_value() -> None:
    table = {
        "names": ["a", "b"],
        "inner": {
            "pairs": [[1, 2, 3], [4, 5, 0.5]],
            "place": "/b",
            "maybe": 3,
            "mode": "off",
            "flag": True,
        },
    }
    inner = Inner(((1, 2, 3.0), (4, 5, 0.5)), Path("/b"), 3, "off", True)
    assert _section(Outer, table, ()) == Outer(inner, ("a", "b"))


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"inner": {"pairs": [[1, 2, 3.0], [1, 2]]}}, "inner.pairs[1]: expected an array of 3"),
        (
            {"inner": {"pairs": [[1, True, 3.0]]}},
            "inner.pairs[0][1]: expected an integer, got true",
        ),
        ({"inner": {"pairs": 4}}, "inner.pairs: expected an array, got 4"),
        ({"inner": {"mode": "maybe"}}, 'inner.mode: expected one of "on", "off", got \'maybe\''),
        ({"inner": {"mode": 1}}, 'inner.mode: expected one of "on", "off", got 1'),
        ({"inner": {"maybe": "3"}}, "inner.maybe: expected an integer, got '3'"),
        ({"inner": {"flag": 1}}, "inner.flag: expected true or false, got 1"),
        ({"inner": {"place": 1}}, "inner.place: expected a string, got 1"),
        ({"inner": 3}, "inner: expected a table, got 3"),
        ({"names": {"a": 1}}, "names: expected an array, got a table"),
        ({"names": [["a"]]}, "names[0]: expected a string, got an array of 1"),
    ],
)
def test_a_mistyped_value_names_path_expected_and_got(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        _section(Outer, table, ())
    assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sistem_id = 1", "sistem_id: unknown key; the nearest valid key is system_id"),
        (
            '[camera]\nsorce = "oak"',
            "camera.sorce: unknown key; the nearest valid key is camera.source",
        ),
        ("[kamera]\nrate_hz = 1", "kamera: unknown key; the nearest valid key is camera"),
        ('[camera]\nlevel = "x"', "camera.level: unknown key; the nearest valid key is log.level"),
        ('[log]\n"a b\\u001b" = 1', 'log."a b\\u001b": unknown key; the nearest valid key is log.'),
        ("[camera]\nrate_hz = true", "camera.rate_hz: expected a number, got true"),
        (
            "[camera]\nrate_hz = nan",
            "camera.rate_hz: expected a finite number up to 10000, got nan",
        ),
        ("[camera]\nrate_hz = -1.5", "[camera] rate_hz: must be in 0..240, got -1.5"),
        ('[camera]\nsource = "usb:0"', "[camera] source: expected one of v4l2:DEVICE"),
        ('[camera]\nsource = "stream:h:99999"', "[camera] source: expected HOST:PORT"),
        ("system_id = 4\n[swarm]\nmembers = [1, 2]", "system_id: 4 is not in swarm.members [1, 2]"),
        ("[swarm]\nmembers = [1, 2]", "peers.to: is empty, and swarm.members names [2]"),
        (
            "[peers]\nto = ['10.0.0.2:14650']\nkey_file = '/k'",
            "swarm.members: names no other drone",
        ),
        ("[swarm]\nknown_distances = [[1, 2]]", "swarm.known_distances[0]: expected an array of 3"),
        (
            '[map]\ndetectors = ["akaze", "sift", "akaze"]',
            "[map] detectors: each once, got ['akaze', 'sift', 'akaze']",
        ),
        ("system_id = 256", "system_id: must be in 1..255, got 256"),
        ("system_id = 0x" + "f" * 6000, "system_id: expected an integer up to 1000000, got a huge"),
        (
            "[filter]\nacceleration_m_s2 = 1e299",
            "filter.acceleration_m_s2: expected a finite number up to 1000000, got 1e+299",
        ),
        (
            "[swarm]\nheartbeat_timeout_s = 1e-320",
            "swarm.heartbeat_timeout_s: expected 0 or a number from 1e-09 on, got 1e-320",
        ),
        (
            "[localization]\nmax_tilt_deg = 361",
            "localization.max_tilt_deg: expected a finite number up to 360, got 361",
        ),
        (
            "[camera]\nposition_m = [0, 0, 1e6]",
            "camera.position_m[2]: expected a finite number up to 100000, got 1000000",
        ),
        (
            "[localization]\nmin_inliers = 2000000000",
            "localization.min_inliers: expected an int",
        ),
        ("[inter]\nrequest_bytes = 262145", "[inter] request_bytes must lie in 1000..262144"),
        ("[swarm]\nheartbeat_timeout_s = 1.5", "[swarm] heartbeat_timeout_s: 1.5, and at least"),
        (
            "clock = 0x" + "f" * 6000,
            'clock: expected one of "system", "camera", got a huge integer',
        ),
        ("system_id = " + "1" * 6000, "Exceeds the limit"),
        ("clock = 1979-05-27", 'clock: expected one of "system", "camera", got a date or time'),
        ("system_id =", "Invalid value"),
        ("a = " + "[" * 5000, "nested too deeply"),
    ],
)
def test_a_broken_file_is_one_line_that_says_where(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "drone.toml")
    assert str(caught.value).startswith(f"drone.toml: {message}")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("is_pipe", [False, True])
def test_a_configuration_is_a_file_that_ends(tmp_path: Path, is_pipe: bool) -> None:
    path = Path("/dev/zero")
    if is_pipe:
        path = tmp_path / "pipe.toml"
        os.mkfifo(path)
    with pytest.raises(ConfigError, match=f"^{path}: is no regular file$"):
        load_config(path)


def test_a_configuration_is_of_a_few_megabytes_and_may_have_a_byte_order_mark(
    tmp_path: Path,
) -> None:
    path = tmp_path / "drone.toml"
    path.write_bytes(b"\xef\xbb\xbfsystem_id = 7\n")
    assert load_config(path).system_id == 7
    with path.open("wb") as file:
        file.truncate(3 << 30)
    with pytest.raises(ConfigError, match=r"drone.toml: is longer than 16 MiB$"):
        load_config(path)


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: No such file"):
        load_config(tmp_path / "none.toml")
    (tmp_path / "bytes.toml").write_bytes(b"x = '\xff'")
    with pytest.raises(ConfigError, match=r"bytes\.toml: not UTF-8 text \(byte 5\)"):
        load_config(tmp_path / "bytes.toml")


def test_every_setting_has_a_default_and_a_type_the_walker_knows() -> None:
    for path in setting_paths():
        value: Any = Config()
        for name in path:
            assert is_dataclass(value)
            assert name in {item.name for item in fields(value)}
            value = getattr(value, name)
        assert isinstance(value, (bool, int, float, str, tuple, Path, type(None)))


KEYS = st.one_of(
    st.sampled_from(sorted({name for path in setting_paths() for name in path})),
    st.text(string.ascii_letters + '_-\n"[. \x00é', min_size=0, max_size=8),
)
VALUES = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(),
        st.floats(),
        st.text(max_size=8),
        st.dates(),
        st.sampled_from(["camera", "info", "oak", "stream:h:1", "recording:d/mav0"]),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(KEYS, inner, max_size=3)),
    max_leaves=8,
)


@given(st.dictionaries(KEYS, VALUES, max_size=4))
def test_any_table_is_a_configuration_or_a_config_error(table: dict[str, Any]) -> None:
    with suppress(ConfigError):
        assert isinstance(_section(Config, table, ()), Config)


@given(st.text(max_size=200))
@example("[camera]\r\n[camera]")
def test_any_text_is_a_configuration_or_a_config_error(text: str) -> None:
    with suppress(ConfigError):
        assert isinstance(parse_config(text, "f"), Config)
