"""What pilots command, to a vehicle that does as its firmware would, or does not."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from sitl.autopilots.ardupilot_pilot import ArduCopterPilot
from sitl.autopilots.firmware_options import Orders
from sitl.autopilots.pilot import Phase, Pilot
from sitl.autopilots.px4_pilot import Px4Pilot
from sitl.mission import COMMANDED_FILE, Mission

NS = 1_000_000_000
STEP_NS, BEAT_NS = NS // 50, NS
SYSTEM = 3
STOOD = np.array([5.0, 1.0, 0.7])
# It believes to look elsewhere than it does: its north is what its poses say.
STOOD_YAW_RAD, NORTH_RAD = 0.5, 0.5 - math.radians(90.0)
MISSION = Mission(
    (2.0, 1.0, 90.0), ((2.0, 1.0, -3.25, 90.0), (8.0, 1.0, -3.25, 90.0), (8.0, 3.0, -3.25, 180.0))
)
TURN = np.array([[np.cos(NORTH_RAD), -np.sin(NORTH_RAD)], [np.sin(NORTH_RAD), np.cos(NORTH_RAD)]])
PX4_TAKEOFF, PX4_HOLD, PX4_LAND, PX4_OFFBOARD = 0x2040000, 0x3040000, 0x6040000, 0x60000
GUIDED, LAND = 4, 9


class Vehicle:
    """It flies to what it is told at 1 m/s or less, and beats once a second."""

    def __init__(self) -> None:
        self.place, self.velocity = STOOD.copy(), np.zeros(3)
        self.yaw_rad = STOOD_YAW_RAD
        self.mode, self.is_armed, self.knows_where = 0, False, False
        self.target, self.target_yaw_rad = STOOD.copy(), STOOD_YAW_RAD
        self.setpoint_ns = 0
        self.now_ns = 0
        self.obeys = True
        self.heard: list[tuple[int, Any]] = []

    def take(self, message: Any) -> None:
        """Hear a command."""
        self.heard.append((self.now_ns, message))
        kind = message.get_type()
        if not self.obeys:
            return
        if kind == "SET_GPS_GLOBAL_ORIGIN":
            self.knows_where = True
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            assert message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
            self.setpoint_ns = self.now_ns
            if self.mode in (PX4_OFFBOARD, GUIDED):
                self.target = np.array([message.x, message.y, message.z])
                self.target_yaw_rad = message.yaw
        elif message.command == dialect.MAV_CMD_DO_SET_MODE:
            self.change_mode(round(message.param2), round(message.param3))
        elif message.command == dialect.MAV_CMD_COMPONENT_ARM_DISARM:
            assert message.param2 == 0.0, "a check is not to be passed over"
            self.is_armed = self.mode in (GUIDED, PX4_TAKEOFF)
        elif message.command == dialect.MAV_CMD_NAV_TAKEOFF:
            self.target = STOOD - [0.0, 0.0, message.param7]

    def change_mode(self, main: int, sub: int) -> None:
        """Change to ArduCopter's mode, or to PX4's main and sub mode."""
        raise NotImplementedError

    def move_on(self) -> list[Any]:
        """Fly for a step, and return what is said meanwhile."""
        self.now_ns += STEP_NS
        way = self.target - self.place
        length_m = float(np.linalg.norm(way))
        step_m = min(length_m, 1.0 * STEP_NS * 1e-9)
        before, self.place = self.place, self.place + way * (step_m / max(length_m, 1e-9))
        self.velocity = (self.place - before) / (STEP_NS * 1e-9)
        self.yaw_rad = self.target_yaw_rad
        half_rad = 0.5 * self.yaw_rad
        said = [
            dialect.MAVLink_local_position_ned_message(0, *self.place, *self.velocity),
            dialect.MAVLink_attitude_quaternion_message(
                0, math.cos(half_rad), 0, 0, math.sin(half_rad), 0, 0, 0
            ),
        ]
        if self.knows_where:
            said.append(dialect.MAVLink_global_position_int_message(0, 1, 1, 1, 1, 0, 0, 0, 0))
        if self.now_ns % BEAT_NS == 0:
            armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED if self.is_armed else 0
            said.append(dialect.MAVLink_heartbeat_message(2, 12, 1 | armed, self.mode, 4, 3))
        return said


class Copter(Vehicle):
    """An ArduCopter."""

    def change_mode(self, main: int, sub: int) -> None:
        """Change to its mode of a number."""
        self.mode = main
        if main == LAND:
            self.target = np.array([*self.place[:2], STOOD[2]])

    def move_on(self) -> list[Any]:
        """Disarm once it has landed."""
        if self.mode == LAND and self.place[2] == STOOD[2]:
            self.is_armed = False
        return super().move_on()


class Px4(Vehicle):
    """A PX4."""

    def change_mode(self, main: int, sub: int) -> None:
        """Change to a mode that may be flown now."""
        mode = main << 16 | sub << 24
        assert mode in (PX4_TAKEOFF, PX4_LAND, PX4_OFFBOARD)
        if mode == PX4_OFFBOARD and self.now_ns - self.setpoint_ns > NS // 2:
            return
        assert self.knows_where, "it takes off to a height above its global position"
        self.mode = mode
        if mode == PX4_LAND:
            self.target = np.array([*self.place[:2], STOOD[2]])

    def move_on(self) -> list[Any]:
        """Take off when armed, hold then, and disarm once it has landed."""
        if self.mode == PX4_TAKEOFF and self.is_armed:
            self.target = STOOD - [0.0, 0.0, 3.0]
            if np.allclose(self.place, self.target):
                self.mode = PX4_HOLD
        if self.mode == PX4_LAND and self.place[2] == STOOD[2]:
            self.is_armed = False
        if self.mode == PX4_OFFBOARD:
            assert self.now_ns - self.setpoint_ns <= NS // 2
        return super().move_on()


Kind = tuple[type[Pilot], type[Vehicle]]
KINDS: list[Kind] = [(ArduCopterPilot, Copter), (Px4Pilot, Px4)]


class Flying:
    """A pilot and its vehicle."""

    def __init__(self, kind: Kind, out: Path, stack: ExitStack) -> None:
        self.vehicle = kind[1]()
        self.pilot = kind[0](Orders(MISSION, 2 * NS), SYSTEM, self.vehicle.take, out, stack)
        self.places: list[np.ndarray] = []

    def until(self, phase: Phase, says: str = "") -> None:
        """Fly until the mission has come so far, for two minutes at most."""
        while self.pilot.phase is not phase or says not in self.pilot.says:
            assert self.vehicle.now_ns < 120 * NS, self.pilot.says
            for message in self.vehicle.move_on():
                self.pilot.hear(message)
            self.pilot.go_on(self.vehicle.now_ns)
            self.places.append(self.vehicle.place)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def rows(out: Path) -> list[tuple[np.ndarray, str]]:
    lines = [line.split(",", 4) for line in (out / COMMANDED_FILE).read_text().splitlines()[1:]]
    return [(np.array([float(v) for v in line[1:4]]), line[4]) for line in lines]


@pytest.mark.parametrize("kind", KINDS, ids=["ardupilot", "px4"])
def test_a_mission_is_flown_from_where_and_as_it_believes_to_stand(
    kind: Kind, tmp_path: Path, stack: ExitStack
) -> None:
    flying = Flying(kind, tmp_path, stack)
    flying.until(Phase.OVER)
    assert flying.pilot.trouble == ""
    said = rows(tmp_path)
    assert [what for _, what in said] == [
        "stands", "takes off", "leg 1 of 3", "leg 2 of 3", "leg 3 of 3", "lands", "landed",
    ]  # fmt: skip
    # By the mission's north 6 m east, then 2 m north; its own is some way from that.
    offs = [[0, 0, 0], [0, 0, -3], [0, 0, -3], [6, 0, -3], [6, 2, -3], [6, 2, 0], [6, 2, 0]]
    for (place, what), off in zip(said, np.array(offs, dtype=float), strict=True):
        wanted = STOOD + np.array([*(TURN @ off[:2]), off[2]])
        np.testing.assert_allclose(place, wanted, atol=1e-9, err_msg=what)
    turned_rad = flying.vehicle.yaw_rad - (math.radians(180.0) + NORTH_RAD)
    assert math.remainder(turned_rad, 2 * math.pi) == pytest.approx(0.0, abs=0.1)
    assert np.linalg.norm(flying.vehicle.place - said[-1][0]) < 0.35


def test_a_px4_gets_setpoints_that_glide_from_before_it_is_to_fly_to_them(
    tmp_path: Path, stack: ExitStack
) -> None:
    flying = Flying(KINDS[1], tmp_path, stack)
    flying.until(Phase.OVER)
    told = [(t, m) for t, m in flying.vehicle.heard if m.get_type().startswith("SET_POSITION")]
    places = np.array([[m.x, m.y, m.z] for _, m in told])
    steps_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps_m.max() <= MISSION.speed_m_s * STEP_NS * 1e-9 + 1e-5
    times = np.array([t for t, _ in told])
    assert np.diff(times).max() == STEP_NS
    changes = [
        t
        for t, m in flying.vehicle.heard
        if m.get_type() == "COMMAND_LONG" and m.param2 == 6 and m.command == 176
    ]
    assert times[0] < changes[0] - NS


@pytest.mark.parametrize("kind", KINDS, ids=["ardupilot", "px4"])
def test_who_does_not_do_as_told_is_given_up(kind: Kind, tmp_path: Path, stack: ExitStack) -> None:
    flying = Flying(kind, tmp_path, stack)
    flying.vehicle.obeys = False
    flying.until(Phase.OVER)
    assert flying.pilot.trouble == "did not do as told: arms"
    assert 60 * NS < flying.vehicle.now_ns < 70 * NS


@pytest.mark.parametrize(
    ("kind", "mode", "lands", "trouble"),
    [
        (KINDS[0], LAND, LAND, "left GUIDED for mode 9: leg 2 of 3"),
        (KINDS[1], PX4_LAND, PX4_LAND, "left OFFBOARD for mode LAND: leg 2 of 3"),
        (KINDS[1], 0x5040000, PX4_LAND, "left OFFBOARD for mode (4, 5): leg 2 of 3"),
    ],
)
def test_whose_firmware_flies_it_itself_is_landed(
    kind: Kind, mode: int, lands: int, trouble: str, tmp_path: Path, stack: ExitStack
) -> None:
    flying = Flying(kind, tmp_path, stack)
    flying.until(Phase.UNDER_WAY, "leg 2")
    began_ns = flying.vehicle.now_ns
    while flying.vehicle.now_ns < began_ns + 2 * NS:
        flying.until(Phase.UNDER_WAY)
        for message in flying.vehicle.move_on():
            flying.pilot.hear(message)
        flying.pilot.go_on(flying.vehicle.now_ns)
    flying.vehicle.mode = mode
    flying.until(Phase.OVER)
    assert flying.pilot.trouble == trouble
    assert flying.vehicle.mode == lands
    assert rows(tmp_path)[-1][1] == trouble


def test_a_px4_that_leaves_its_takeoff_is_landed(tmp_path: Path, stack: ExitStack) -> None:
    flying = Flying(KINDS[1], tmp_path, stack)
    flying.until(Phase.CLIMBING)
    flying.vehicle.mode = PX4_LAND
    flying.until(Phase.OVER)
    assert flying.pilot.trouble == "left TAKEOFF for mode LAND: takes off"
