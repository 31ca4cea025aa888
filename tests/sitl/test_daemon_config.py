import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.daemon_config import daemon_config, toml_text, with_settings
from sitl.plan import FlyOptions, Setting, plan_flight
from tests.sitl.flights import Flight, write_recording
from vcl_companion.errors import ConfigError
from vcl_companion.recording import KnownPair, read_recording

SCALARS = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8"))
)
VALUES = SCALARS | st.lists(SCALARS, max_size=4) | st.lists(st.lists(st.integers(0, 9)), max_size=3)
TABLES = st.recursive(
    st.dictionaries(st.text(st.characters(codec="utf-8")), VALUES, max_size=4),
    lambda inner: st.dictionaries(
        st.text(st.characters(codec="utf-8"), min_size=1), VALUES | inner, max_size=4
    ),
    max_leaves=8,
)


@given(TABLES)
def test_any_configuration_reads_back(config: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(config)) == config


def test_a_later_setting_wins_and_the_base_is_left_alone() -> None:
    base = {"log": {"level": "info"}}
    settings = [
        Setting(("log", "level"), "debug"),
        Setting(("log", "level"), "error"),
        Setting(("new", "deep", "key"), 1),
    ]
    assert with_settings(base, settings) == {
        "log": {"level": "error"},
        "new": {"deep": {"key": 1}},
    }
    assert base == {"log": {"level": "info"}}
    with pytest.raises(ConfigError, match="level is no section"):
        with_settings(base, [Setting(("log", "level", "deeper"), 1)])


@pytest.mark.parametrize("said_m", [None, 0.03])
@pytest.mark.parametrize(
    "given", [(), (KnownPair("mav0", "mav1"),), (KnownPair("mav0", "mav1", 2.0),)]
)
def test_how_well_its_distances_are_known_is_the_recording_s_to_say(
    tmp_path: Path, given: tuple[KnownPair, ...], said_m: float | None
) -> None:
    recording = read_recording(write_recording(tmp_path / "a", Flight(n_frames=2, n_drones=2)))
    recording = replace(recording, distance_sigma_m=said_m)
    plan = plan_flight(recording, FlyOptions(known_distances=given))
    is_its_own = all(pair.distance_m is None for pair in given)
    told_m = said_m if is_its_own else None
    config = daemon_config(plan, plan.drones[0], tmp_path / "out", 5001, 5002, 5003, [5004])
    assert config["map"].get("distance_sigma_m") == told_m


@pytest.mark.parametrize("said_px", [None, 0.0, 0.25])
def test_what_cameras_may_be_off_is_the_recording_s_to_say(
    tmp_path: Path, said_px: float | None
) -> None:
    recording = read_recording(write_recording(tmp_path / "a", Flight(n_frames=2)))
    plan = plan_flight(replace(recording, calibration_px=said_px), FlyOptions())
    config = daemon_config(plan, plan.drones[0], tmp_path / "out", 5001, 5002, 5003, [])
    assert config["map"].get("calibration_px") == said_px


def test_a_daemon_is_told_where_things_are_and_nothing_of_the_truth(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "a recording", Flight(n_frames=2, n_drones=3))
    options = FlyOptions(settings=(Setting(("log", "level"), "debug"),))
    plan = plan_flight(read_recording(folder), options)
    config = daemon_config(plan, plan.drones[1], tmp_path / "out", 5001, 5002, 5003, [5004, 5005])
    run = tmp_path / "out" / "run" / "mav1"
    assert config == {
        "system_id": 2,
        "clock": "camera",
        "camera": {
            "source": "stream:127.0.0.1:5001",
            "calibration": str(folder / "mav1" / "cam0" / "sensor.yaml"),
        },
        "autopilot": {"link": "udp:127.0.0.1:5002", "time_error_s": 0.003},
        "peers": {
            "listen": "127.0.0.1:5003",
            "to": ["127.0.0.1:5004", "127.0.0.1:5005"],
            "key_file": str(tmp_path / "out" / "run" / "swarm.key"),
            "timestamp_file": str(run / "signing.json"),
        },
        "swarm": {"members": [1, 2, 3], "leader": 1, "known_distances": [[1, 2, 2.0]]},
        "log": {
            "flight_log": str(run / "flight.jsonl"),
            "status_file": str(run / "status.json"),
            "level": "debug",
        },
        "map": {"directory": str(run / "maps")},
    }
    assert tomllib.loads(toml_text(config)) == config
