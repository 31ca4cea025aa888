"""Missions: what a scenario may ask for, how they are judged, and what refuses them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from sitl.__main__ import main
from sitl.flown_mission import read_mission
from sitl.mission import COMMANDED_FILE, Mission
from sitl.processes import FlightError
from sitl.scenario import load_scenario
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import matrix_from_euler
from vcl_companion.recording import Trajectory

NS = 1_000_000_000
STANDS = (2.0, 1.0, 90.0)
LEGS = ((2.0, 1.0, -3.0, 90.0), (12.0, 1.0, -3.0, 90.0))


def test_places_are_told_from_where_the_body_stands() -> None:
    mission = Mission(STANDS, LEGS, gear_m=0.25)
    np.testing.assert_allclose(mission.places(), [[0.0, 0.0, -2.75], [10.0, 0.0, -2.75]])
    nose = mission.ned_from_body.rotation @ np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(nose, [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"legs": ((2.0, 1.0, 3.0, 0.0),)}, "at least 1 m above the ground"),
        ({"legs": ((2.0, float("nan"), -3.0, 0.0),)}, "finite"),
        ({"speed_m_s": 0.0}, "speed_m_s is 0.2 to 10"),
        ({"begins_s": -1.0}, "begins_s"),
    ],
)
def test_a_mission_that_cannot_be_flown_is_refused(change: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        Mission(**{"stands": STANDS, "legs": LEGS, **change})  # type: ignore[arg-type]


def commanded(folder: Path, rows: list[tuple[float, tuple[float, float, float], str]]) -> None:
    lines = ["at_ns,x,y,z,what"]
    lines += [f"{round(t * NS)},{x},{y},{z},{what}" for t, (x, y, z), what in rows]
    (folder / COMMANDED_FILE).write_text("\n".join(lines) + "\n")


def truth(rows: list[tuple[float, tuple[float, float, float]]]) -> Trajectory:
    poses = [Pose(np.eye(3), np.array(place)) for _, place in rows]
    return Trajectory.from_poses([round(t * NS) for t, _ in rows], poses)


ORDERS = [
    (10.0, (0.0, 0.0, 0.0), "stands"),
    (10.0, (0.0, 0.0, -3.0), "takes off"),
    (14.0, (10.0, 0.0, -3.0), "leg 1 of 1"),
    (20.0, (10.0, 0.0, 0.0), "lands"),
    (24.0, (10.0, 0.0, 0.0), "landed"),
]


def test_a_path_is_judged_by_the_part_of_it_that_was_commanded_then(tmp_path: Path) -> None:
    commanded(tmp_path, ORDERS)
    # World is the reference turned by 90 degrees and moved: north of it is the reference's east.
    carry = Pose(matrix_from_euler(0.0, 0.0, np.pi / 2), np.array([5.0, 0.0, -0.2]))
    flew = [
        (9.0, (50.0, 0.0, 0.0)),  # before it was commanded anything
        (10.0, (0.0, 0.0, 0.0)),
        (12.0, (0.3, 0.0, -2.0)),  # 0.3 m off while it climbs
        (17.0, (5.0, 0.4, -3.0)),  # 0.4 m beside the leg
        (20.0, (10.0, 0.0, -3.0)),
        (24.0, (10.1, 0.1, 0.0)),
        (30.0, (90.0, 0.0, 0.0)),  # after it had landed
    ]
    carried = [(t, tuple(carry.apply(np.array(place)).tolist())) for t, place in flew]
    found = read_mission(tmp_path, truth(carried), carry)
    assert found is not None
    assert found.ended == "landed"
    assert found.took_s == pytest.approx(14.0)
    assert found.way_m == pytest.approx(16.0)
    assert found.max_deviation_m == pytest.approx(0.4)
    assert found.landed_off_m == pytest.approx(np.hypot(0.1, 0.1))


def test_a_mission_that_was_broken_off_has_landed_nowhere_in_particular(tmp_path: Path) -> None:
    commanded(tmp_path, [*ORDERS[:3], (16.0, (10.0, 0.0, -3.0), "left GUIDED for mode 9: leg 1")])
    flew = truth([(10.0, (0.0, 0.0, 0.0)), (16.0, (3.0, 0.0, -3.0))])
    found = read_mission(tmp_path, flew, Pose.identity())
    assert found is not None
    assert found.ended.startswith("left GUIDED")
    assert found.landed_off_m is None


def test_there_is_nothing_to_judge_of_what_never_began(tmp_path: Path) -> None:
    flew = truth([(0.0, (0.0, 0.0, 0.0)), (9.0, (0.0, 0.0, 0.0))])
    assert read_mission(tmp_path, flew, Pose.identity()) is None
    commanded(tmp_path, [(5.0, (0.0, 0.0, 0.0), "did not do as told: arms")])
    assert read_mission(tmp_path, flew, Pose.identity()) is None
    (tmp_path / COMMANDED_FILE).write_text("at_ns,x,y,z,what\n1,2\n")
    with pytest.raises(FlightError, match=COMMANDED_FILE):
        read_mission(tmp_path, flew, Pose.identity())


def test_a_scenario_with_missions_is_flown_and_one_with_flights_rendered(tmp_path: Path) -> None:
    program = tmp_path / "arducopter"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    out = str(tmp_path / "out")

    def said(*arguments: str) -> str:
        result = CliRunner().invoke(main, [*arguments, "--out", out])
        assert result.exit_code == 2
        assert not Path(out).exists()
        return result.output

    autopilot = ("--autopilot", f"ardupilot={program}")
    assert "mav0 has a mission: fly it by python -m sitl live" in said("render", "square")
    assert "mav0 has no mission; render it" in said("live", "demo", *autopilot)
    assert "no scenario 'squares'" in said("live", "squares", *autopilot)
    assert "is no program" in said("live", "square", "--autopilot", f"ardupilot={tmp_path}/no")
    assert "has no 'mav9'" in said("live", "square", *autopilot, "--drones", "mav9")
    live = ("live", "square", *autopilot, "--drones", "mav0", "--map", str(tmp_path))
    assert f"{tmp_path}/report.json: No such file" in said(*live)
    (tmp_path / "report.json").write_text('{"options": {"leader": "mav0"}}')
    assert "its report.json tells of no map" in said(*live)


def test_a_drone_has_a_flight_or_a_mission_and_not_both(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    path.write_text('name = "none"\n[[drone]]\nname = "mav0"\n')
    with pytest.raises(ConfigError, match="either a flight or a mission"):
        load_scenario(path)


def test_where_height_is_a_barometer_s_a_path_counts_from_where_it_stood(tmp_path: Path) -> None:
    commanded(tmp_path, [(t, (x, y, z + 7.5), what) for t, (x, y, z), what in ORDERS])
    flew = truth(
        [
            (10.0, (0.0, 0.0, 0.0)),
            (17.0, (5.0, 0.0, -2.8)),  # 0.2 m too low
            (20.0, (10.0, 0.0, -3.0)),
            (24.0, (10.0, 0.0, 0.0)),
        ]
    )
    found = read_mission(tmp_path, flew, Pose.identity(), has_own_height=True)
    assert found is not None
    assert found.max_deviation_m == pytest.approx(0.2)
    elsewhere = read_mission(tmp_path, flew, Pose.identity())
    assert elsewhere is not None
    assert elsewhere.max_deviation_m > 7.0
