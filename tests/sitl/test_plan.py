import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sitl.absences import Absence
from sitl.fly import fly
from sitl.known_distances import parse_known_distance
from sitl.out_folder import prepare_folder
from sitl.plan import FlyOptions, Setting, parse_setting, plan_flight
from tests.sitl.flights import Flight, at_ns, ned_from_body, write_recording
from vcl_companion.errors import ConfigError
from vcl_companion.recording import KnownPair, Recording, read_recording


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    return read_recording(write_recording(tmp_path / "three", Flight(n_frames=2, n_drones=3)))


def without_truth(recording: Recording) -> Recording:
    return replace(recording, drones=tuple(replace(d, truth=None) for d in recording.drones))


def test_all_fly_and_ids_are_their_places(recording: Recording) -> None:
    plan = plan_flight(recording, FlyOptions())
    assert [(d.name, d.system_id) for d in plan.drones] == [("mav0", 1), ("mav1", 2), ("mav2", 3)]
    assert plan.leader == "mav0"
    assert plan.known_distances == ((1, 2, 2.0),)
    assert plan.are_distances_recorded
    assert plan.starts_at_ns == at_ns(0, 0)
    assert plan.ends_at_ns == at_ns(2, 1)


def test_a_subset_keeps_its_ids_and_gets_a_leader(recording: Recording) -> None:
    options = FlyOptions(drones=("mav2", "mav1"), known_distances=(KnownPair("mav1", "mav2", 4.0),))
    plan = plan_flight(recording, options)
    assert [(d.name, d.system_id) for d in plan.drones] == [("mav1", 2), ("mav2", 3)]
    assert plan.leader == "mav1"
    assert plan.known_distances == ((2, 3, 4.0),)
    assert not plan.are_distances_recorded


def test_a_distance_without_metres_is_the_truth_s_at_the_start(recording: Recording) -> None:
    options = FlyOptions(known_distances=(KnownPair("mav0", "mav2"),))
    apart = ned_from_body(2, 0).translation - ned_from_body(0, 0).translation
    plan = plan_flight(recording, options)
    assert plan.are_distances_recorded
    ((a, b, distance_m),) = plan.known_distances
    assert (a, b) == (1, 3)
    assert distance_m == pytest.approx(np.linalg.norm(apart), abs=1e-9)


def apart_m(one: int, k: int, other: int, n: int) -> float:
    """Return how far a drone's k-th frame is from another's n-th."""
    apart = ned_from_body(one, k).translation - ned_from_body(other, n).translation
    return float(np.linalg.norm(apart))


def beginning_late(recording: Recording, name: str) -> Recording:
    return replace(
        recording,
        drones=tuple(
            replace(d, frames=d.frames[1:]) if d.name == name else d for d in recording.drones
        ),
    )


@pytest.mark.parametrize("who", ["mav0", "mav1", "mav2"])
def test_the_truth_s_distance_is_that_of_when_all_are_there(recording: Recording, who: str) -> None:
    options = FlyOptions(known_distances=(KnownPair("mav0", "mav2"),))
    ((_, _, distance_m),) = plan_flight(beginning_late(recording, who), options).known_distances
    first_ns = {"mav0": at_ns(0, 0), "mav1": at_ns(1, 0), "mav2": at_ns(2, 0)}
    second_ns = {"mav0": at_ns(0, 1), "mav1": at_ns(1, 1), "mav2": at_ns(2, 1)}
    all_there_ns = max(*(first_ns[n] for n in first_ns if n != who), second_ns[who])
    newest = {n: 1 if n == who or second_ns[n] <= all_there_ns else 0 for n in ("mav0", "mav2")}
    assert distance_m == pytest.approx(apart_m(0, newest["mav0"], 2, newest["mav2"]), abs=1e-9)


def test_who_comes_late_is_as_far_away_as_it_is_then(tmp_path: Path) -> None:
    recording = read_recording(write_recording(tmp_path / "four", Flight(n_frames=4, n_drones=3)))
    late_s = (at_ns(2, 1) - at_ns(0, 0)) * 1e-9
    options = FlyOptions(
        known_distances=(KnownPair("mav0", "mav2"),), absences=(Absence("mav2", 0.0, late_s),)
    )
    ((_, _, distance_m),) = plan_flight(recording, options).known_distances
    assert distance_m == pytest.approx(apart_m(0, 1, 2, 1), abs=1e-9)


def test_no_distance_of_who_comes_late_is_known_while_two_others_are_there(
    tmp_path: Path,
) -> None:
    recording = read_recording(write_recording(tmp_path / "four", Flight(n_frames=4, n_drones=3)))
    plan = plan_flight(recording, FlyOptions(absences=(Absence("mav1", 0.0, 0.2),)))
    ((a, b, distance_m),) = plan.known_distances
    assert (a, b) == (1, 3)
    assert distance_m == pytest.approx(apart_m(0, 0, 2, 0), abs=1e-9)
    assert plan.are_distances_recorded


def test_instants_that_fit_nothing_are_refused(recording: Recording) -> None:
    drone = recording.drones[1]
    day_ns = 86_400 * 1_000_000_000
    other_day = replace(
        drone, frames=tuple(replace(f, at_ns=f.at_ns + day_ns) for f in drone.frames)
    )
    in_microseconds = replace(
        drone, sensor=replace(drone.sensor, rate_hz=drone.sensor.rate_hz / 1000.0)
    )
    for wrong, says in ((other_day, "stamped by one clock"), (in_microseconds, "are nanoseconds")):
        drones = (recording.drones[0], wrong, recording.drones[2])
        with pytest.raises(ConfigError, match=f"^mav1: .*{says}"):
            plan_flight(replace(recording, drones=drones), FlyOptions())


def test_an_earlier_flight_s_attitude_needs_no_truth(recording: Recording, tmp_path: Path) -> None:
    for n in range(3):
        (tmp_path / "earlier" / f"mav{n}").mkdir(parents=True)
        (tmp_path / "earlier" / f"mav{n}" / "attitude.csv").touch()
    options = FlyOptions(attitude=tmp_path / "earlier")
    plan = plan_flight(without_truth(recording), options)
    assert [d.attitude_path for d in plan.drones] == [
        (tmp_path / "earlier" / f"mav{n}" / "attitude.csv").resolve() for n in range(3)
    ]


def test_what_does_not_fit_says_what_would(recording: Recording, tmp_path: Path) -> None:
    def message(options: FlyOptions, flown: Recording = recording) -> str:
        with pytest.raises(ConfigError) as raised:
            plan_flight(flown, options)
        return str(raised.value)

    assert "no 'mav7' (mav0, mav1, mav2)" in message(FlyOptions(drones=("mav7",)))
    assert "mav0 is given twice" in message(FlyOptions(drones=("mav0", "mav1", "mav0")))
    twice = (KnownPair("mav0", "mav1", 1.0), KnownPair("mav1", "mav0", 2.0))
    assert "mav0:mav1: is given twice" in message(FlyOptions(known_distances=twice))
    assert "'mav2' does not fly" in message(
        FlyOptions(drones=("mav0", "mav1"), known_distances=(KnownPair("mav0", "mav2", 1.0),))
    )
    assert "give --known-distance mav0:mav2=METRES" in message(FlyOptions(drones=("mav0", "mav2")))
    assert "give --attitude DIR" in message(FlyOptions(), without_truth(recording))
    assert "no mav0/attitude.csv" in message(FlyOptions(attitude=tmp_path))
    for n in range(3):
        (tmp_path / "earlier" / f"mav{n}").mkdir(parents=True)
        (tmp_path / "earlier" / f"mav{n}" / "attitude.csv").touch()
    options = FlyOptions(
        attitude=tmp_path / "earlier", known_distances=(KnownPair("mav0", "mav1"),)
    )
    assert "give --known-distance mav0:mav1=METRES" in message(options, without_truth(recording))


@pytest.mark.parametrize(
    "options", [{"speed": 0.0}, {"speed": float("nan")}, {"start_timeout_s": 0.0}, {"seed": -1}]
)
def test_options_have_bounds(options: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match="must"):
        FlyOptions(**options)  # type: ignore[arg-type]  # the point of the test


def test_a_known_distance_on_the_command_line() -> None:
    assert parse_known_distance("mav0:mav1=1.63") == KnownPair("mav0", "mav1", 1.63)
    assert parse_known_distance("mav0:mav1") == KnownPair("mav0", "mav1", None)
    for text in ("mav0", "mav0:mav1=far", "mav0:mav0=1", "mav0:mav1=-1", "mav0:mav1=nan", ":=1"):
        with pytest.raises(ConfigError, match="like mav0:mav1"):
            parse_known_distance(text)


def test_a_setting_on_the_command_line() -> None:
    assert parse_setting("log.level='debug'") == Setting(("log", "level"), "debug")
    assert parse_setting("a.b.c = [1, 2.5]") == Setting(("a", "b", "c"), [1, 2.5])
    for text in ("log.level", "log.level=debug", "=1", "a..b=1", "a=1\nb=2", "a b=1"):
        with pytest.raises(ConfigError, match="--set"):
            parse_setting(text)


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        (Setting(("foo",), 1), "--set: foo: unknown key"),
        (Setting(("localization", "foo"), 1), "--set: localization.foo: unknown key"),
        (Setting(("swarm", "members"), [1]), "--set: [swarm] known_distances"),
        (Setting(("transfer", "profile"), "x"), "--set: transfer.profile"),
    ],
)
def test_a_setting_that_no_daemon_takes_leaves_a_finished_flight_as_it_is(
    recording: Recording, tmp_path: Path, setting: Setting, says: str
) -> None:
    out = tmp_path / "out"
    prepare_folder(out, plan_flight(recording, FlyOptions()))
    (out / "report.json").touch()
    with pytest.raises(ConfigError) as raised:
        fly(recording.path, out, FlyOptions(settings=(setting,)), lambda *_: None)
    assert says in str(raised.value)
    assert (out / "report.json").exists()


@pytest.mark.parametrize("name", ["recording", "run/mine"])
def test_a_recording_is_not_removed_to_make_room_for_its_flight(
    recording: Recording, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "out"
    (out / name).parent.mkdir(parents=True)
    shutil.copytree(recording.path, out / name)
    (out / "run").mkdir(exist_ok=True)
    (out / "run" / "flight.json").write_text("{}")
    with pytest.raises(ConfigError, match="holds the recording to be flown"):
        prepare_folder(out, plan_flight(read_recording(out / name), FlyOptions()))
    assert (out / name / "recording.toml").exists()


def test_a_live_flight_records_in_its_folder(recording: Recording, tmp_path: Path) -> None:
    """Whatever an earlier one has left there is not the recording to be flown."""
    out = tmp_path / "out"
    shutil.copytree(recording.path, out / "recording")
    plan = plan_flight(read_recording(out / "recording"), FlyOptions())
    (out / "run").mkdir()
    (out / "run" / "flight.json").write_text("{}")
    prepare_folder(out, plan, records=True)
    assert not (out / "recording").exists()


def test_the_output_folder_is_cleared_of_flights_and_of_nothing_else(
    recording: Recording, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    prepare_folder(out, plan_flight(recording, FlyOptions()))
    for name in ("estimate.tum", "notes.txt"):
        (out / "mav2" / name).touch()
    for name in ("report.json", "mine.txt", "run/mav1/daemon.stderr"):
        (out / name).touch()
    fewer = FlyOptions(drones=("mav0", "mav1"))
    prepare_folder(out, plan_flight(recording, fewer))
    left = sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file())
    assert left == ["mav2/notes.txt", "mine.txt", "run/flight.json"]
    assert (out / "run" / "mav1" / "maps").is_dir()
    assert not (out / "run" / "mav2").exists()


def test_a_folder_of_something_else_is_not_touched(recording: Recording, tmp_path: Path) -> None:
    plan = plan_flight(recording, FlyOptions())
    (tmp_path / "home" / "run").mkdir(parents=True)
    with pytest.raises(ConfigError, match="something other than a flight"):
        prepare_folder(tmp_path / "home", plan)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="is a file"):
        prepare_folder(tmp_path / "file", plan)
    with pytest.raises(ConfigError, match="cannot be written"):
        prepare_folder(tmp_path / "file" / "below", plan)


def test_results_do_not_overwrite_the_attitude_they_are_made_of(
    recording: Recording, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    prepare_folder(out, plan_flight(recording, FlyOptions()))
    for n in range(3):
        (out / f"mav{n}" / "attitude.csv").touch()
    plan = plan_flight(recording, FlyOptions(attitude=out))
    with pytest.raises(ConfigError, match="the same folder"):
        prepare_folder(out, plan)
    assert (out / "mav0" / "attitude.csv").exists()
