"""What becomes of a jump of what the autopilot is told."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from vcl_companion.daemon.resets import ResetMode, Resets
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import (
    angle_between,
    euler_from_matrix,
    exp_so3,
    matrix_from_euler,
)
from vcl_companion.links.vehicle_mode import VehicleMode

S = 1_000_000_000
START_NS = 1_760_000_000 * S
COVARIANCE = np.diag([0.02**2] * 3 + [0.005**2] * 3)
LANDED, LOITER, GUIDED = VehicleMode(), VehicleMode(True, False), VehicleMode(True, True)


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, yaw_deg: float = 0.0) -> Pose:
    return Pose(matrix_from_euler(0.03, -0.02, math.radians(yaw_deg)), np.array([x, y, z]))


@dataclass
class Drone:
    """A drone whose frames come five times a second."""

    mode: ResetMode = "follow"
    vehicle: VehicleMode = GUIDED
    n_jumps: int = 0
    now_ns: int = START_NS
    said: list[tuple[str, bool]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.resets = Resets(
            self.mode, 0.5, math.radians(10.0), lambda *said: self.said.append(said)
        )

    def tells(
        self, there: Pose, expected: Pose | None = None, *, was_silent: bool = False
    ) -> Pose | None:
        """Tell where it is; None where nothing is told."""
        self.now_ns += S // 5
        why_not = self.resets.decide(
            there, COVARIANCE, self.now_ns, self.n_jumps, expected, self.vehicle,
            was_silent=was_silent,
        )  # fmt: skip
        return None if why_not else self.resets.told(there, self.now_ns)[0]

    def jumps(self, there: Pose, expected: Pose | None = None) -> Pose | None:
        self.n_jumps += 1
        return self.tells(there, expected)


def assert_at(told: Pose | None, there: Pose) -> None:
    assert told is not None
    assert np.allclose(told.translation, there.translation, atol=1e-9)
    assert np.allclose(told.rotation, there.rotation, atol=1e-9)


@pytest.mark.parametrize("mode", ["follow", "blend", "wait"])
def test_a_jump_within_the_poses_own_error_is_made_nothing_of(mode: ResetMode) -> None:
    drone = Drone(mode)
    drone.tells(pose())
    assert_at(drone.jumps(pose(0.1), pose()), pose(0.1))
    assert drone.resets.n_resets == 0
    assert drone.said == [("a jump within the pose's own error: nothing is made of it", False)]


def test_a_jump_back_during_a_slide_ends_it() -> None:
    drone = Drone("blend")
    drone.tells(pose())
    drone.jumps(pose(5.0), pose())  # a false place
    told = pose()
    for _ in range(10):
        slid = drone.tells(pose(5.0))
        assert slid is not None
        told = slid
    assert told.translation[0] < 1.0
    assert_at(drone.jumps(pose(0.1), told), pose(0.1))  # where the autopilot takes it to be
    assert_at(drone.tells(pose(0.1)), pose(0.1))
    assert drone.resets.n_resets == 0


@pytest.mark.parametrize("vehicle", [LANDED, LOITER])
@pytest.mark.parametrize("mode", ["follow", "blend", "wait"])
def test_a_larger_one_is_a_reset_where_nothing_flies_to_positions(
    mode: ResetMode, vehicle: VehicleMode
) -> None:
    drone = Drone(mode, vehicle)
    drone.tells(pose())
    assert_at(drone.jumps(pose(3.0, 4.0), pose()), pose(3.0, 4.0))
    assert drone.resets.n_resets == 1
    assert drone.said == [("relocalized 5.0 m away: the autopilot is reset", vehicle.is_armed)]


def test_one_is_followed_in_guided_mode_where_that_is_asked_for() -> None:
    drone = Drone("follow")
    drone.tells(pose())
    assert_at(drone.jumps(pose(5.0), pose()), pose(5.0))
    assert drone.resets.n_resets == 1


def test_a_turned_heading_is_a_jump_as_well() -> None:
    drone = Drone("follow")
    drone.tells(pose())
    drone.jumps(pose(yaw_deg=20.0), pose())
    assert drone.resets.n_resets == 1


def test_what_is_told_slides_to_the_new_place_while_the_drone_flies_on() -> None:
    drone = Drone("blend")
    drone.tells(pose())
    there, expected = pose(3.0, 4.0, yaw_deg=25.0), pose()
    told = [drone.jumps(there, expected)]
    assert_at(told[0], expected)
    truth = [there]
    for k in range(1, 120):
        truth.append(pose(3.0, 4.0 + 0.1 * k, yaw_deg=25.0))
        told.append(drone.tells(truth[-1]))
    assert drone.resets.n_resets == 0
    moved = zip(itertools.pairwise(told), itertools.pairwise(truth), strict=True)
    for (before, after), (was, now) in moved:
        assert before is not None
        assert after is not None
        flown = float(np.linalg.norm(now.translation - was.translation))
        step = float(np.linalg.norm(after.translation - before.translation))
        assert step <= flown + 0.5 / 5 + 1e-9
        roll, pitch, yaw = euler_from_matrix(after.rotation)
        assert (roll, pitch) == pytest.approx((0.03, -0.02))
        turned = yaw - euler_from_matrix(before.rotation)[2]
        assert -1e-9 <= turned <= math.radians(10.0) / 5 + 1e-9
    assert_at(told[-1], truth[-1])
    assert [what for what, _ in drone.said] == [
        "relocalized 5.0 m away: told poses slide there", "told poses are where they should be",
    ]  # fmt: skip
    # 5 m at 0.5 m/s, six seconds more to begin and end, and a turned heading carries it away
    arrived = next(k for k, (a, b) in enumerate(zip(told, truth, strict=True))
                   if a is not None and np.allclose(a.translation, b.translation))  # fmt: skip
    assert 75 <= arrived <= 90


@pytest.mark.parametrize("pitch_deg", [20.0, 60.0, 80.0, 88.0, 89.9])
def test_a_drone_that_dives_is_not_turned_by_a_slide(pitch_deg: float) -> None:
    """It is found turned by 1.5 degrees, which are 30 of yaw at a pitch of 88."""
    drone = Drone("blend")
    steep = matrix_from_euler(0.02, math.radians(pitch_deg), 0.3)
    there = Pose(steep, np.array([5.0, 0.0, 0.0]))
    expected = Pose(steep @ exp_so3(np.deg2rad([1.0, 0.5, 1.0])), np.zeros(3))
    drone.tells(expected)
    told = drone.jumps(there, expected)
    assert told is not None
    assert np.linalg.norm(told.translation - expected.translation) < 0.1
    assert angle_between(told.rotation, steep) < math.radians(1.5)
    assert angle_between(told.rotation, expected.rotation) < math.radians(1.6)


def test_a_slide_begins_and_ends_slowly_and_its_speed_is_told() -> None:
    drone = Drone("blend")
    drone.tells(pose())
    drone.jumps(pose(4.0), pose())
    told, speeds = pose(), [0.0]
    while not np.allclose(told.translation, [4.0, 0.0, 0.0]):
        drone.now_ns += S // 5
        before = told
        told, speed = drone.resets.told(pose(4.0), drone.now_ns)
        assert np.allclose(speed, 5.0 * (told.translation - before.translation))
        speeds.append(float(speed[0]))
    assert max(speeds) == pytest.approx(0.5)
    # Half a metre a second in six.
    assert np.abs(np.diff([*speeds, 0.0])).max() < 1.01 * 0.5 / 6 / 5
    assert len(speeds) * 0.2 == pytest.approx(4.0 / 0.5 + 6.0, abs=1.0)


def test_a_second_jump_in_a_slide_starts_from_where_it_has_come() -> None:
    drone = Drone("blend")
    drone.tells(pose())
    drone.jumps(pose(2.0), pose())
    for _ in range(20):
        told = drone.tells(pose(2.0))
    assert told is not None
    assert 0.5 < told.translation[0] < 1.0
    assert_at(drone.jumps(pose(-3.0), told), told)
    after = drone.tells(pose(-3.0))
    assert after is not None
    assert told.translation[0] - 0.01 < after.translation[0] < told.translation[0]


def test_nothing_is_told_until_the_ground_has_it_told() -> None:
    drone = Drone("wait")
    drone.tells(pose())
    assert drone.jumps(pose(5.0), pose()) is None
    assert drone.tells(pose(5.1), pose(0.1)) is None
    assert drone.said == [
        ("no poses are sent: relocalized 5.0 m away: MAV_CMD_USER_4, or another flight mode", True)
    ]
    drone.resets.allow()
    assert_at(drone.tells(pose(5.2), pose(0.1)), pose(5.2))
    assert drone.resets.n_resets == 1
    # It was one order, not one for ever.
    assert drone.jumps(pose(9.0), pose(5.2)) is None


@pytest.mark.parametrize("vehicle", [LOITER, LANDED])
def test_nothing_is_told_until_the_mode_is_another(vehicle: VehicleMode) -> None:
    drone = Drone("wait")
    drone.tells(pose())
    assert drone.jumps(pose(5.0), pose()) is None
    drone.vehicle = vehicle
    assert_at(drone.tells(pose(5.0), pose()), pose(5.0))
    assert drone.resets.n_resets == 1


def test_who_is_found_again_where_the_autopilot_takes_it_to_be_need_not_wait() -> None:
    drone = Drone("wait")
    drone.tells(pose())
    assert drone.jumps(pose(5.0), pose()) is None
    assert_at(drone.jumps(pose(0.05), pose()), pose(0.05))
    assert drone.resets.n_resets == 0


@pytest.mark.parametrize(("mode", "n_resets"), [("follow", 0), ("blend", 0), ("wait", 0)])
def test_after_silence_an_autopilot_that_went_astray_moves_nobody(
    mode: ResetMode, n_resets: int
) -> None:
    drone = Drone(mode)
    drone.tells(pose())
    told = drone.tells(pose(2.0), pose(0.5), was_silent=True)
    assert drone.resets.n_resets == n_resets
    if mode == "wait":
        assert told is None
    else:
        assert_at(told, pose(2.0) if mode == "follow" else pose(0.5))


def test_a_daemon_that_is_started_again_in_flight_slides_to_where_it_is() -> None:
    drone = Drone("blend")
    assert_at(drone.tells(pose(2.0), pose()), pose())
    assert Drone("wait").tells(pose(2.0), pose()) is None
    for drone in (Drone("follow"), Drone("wait", LANDED), Drone("blend", LANDED)):
        assert_at(drone.tells(pose(2.0), pose()), pose(2.0))
        assert drone.resets.n_resets == 0


def test_no_more_resets_than_five_a_minute_in_the_air() -> None:
    drone = Drone("follow")
    drone.tells(pose())
    for k in range(1, 6):
        assert drone.jumps(pose(3.0 * (k % 2)), pose(3.0 * ((k + 1) % 2))) is not None
    assert drone.jumps(pose(9.0), pose(3.0)) is None
    assert drone.resets.n_resets == 5
    assert drone.said[-1] == ("no poses are sent: the 6th jump in a minute: MAV_CMD_USER_4", True)
    drone.now_ns += 58 * S
    assert drone.tells(pose(9.0), pose(3.0)) is None
    drone.now_ns += S
    assert_at(drone.tells(pose(9.0), pose(3.0)), pose(9.0))
    assert drone.resets.n_resets == 6


def test_on_the_ground_resets_cost_nothing() -> None:
    drone = Drone("follow", LANDED)
    drone.tells(pose())
    for k in range(1, 20):
        assert drone.jumps(pose(3.0 * k), pose(3.0 * (k - 1))) is not None
    assert drone.resets.n_resets == 19
