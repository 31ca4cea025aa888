"""Whether a vehicle flies to commanded positions, by its heartbeat."""

import pytest

from vcl_companion.links.messages import Heartbeat
from vcl_companion.links.vehicle_mode import VehicleMode, mode_of

GENERIC, ARDUPILOT, PX4 = 0, 3, 12
PLANE, QUADROTOR, ROVER = 1, 2, 10
ARMED, CUSTOM = 128, 1
# px4_custom_mode.h: main mode in the third byte, sub mode in the fourth
OFFBOARD, POSCTL, HOLD = 6 << 16, 3 << 16, 4 << 16 | 3 << 24


@pytest.mark.parametrize(
    ("vehicle", "autopilot", "base_mode", "custom_mode", "expected"),
    [
        (QUADROTOR, ARDUPILOT, ARMED | CUSTOM, 4, VehicleMode(True, True)),
        (QUADROTOR, ARDUPILOT, CUSTOM, 4, VehicleMode(False, True)),
        (QUADROTOR, ARDUPILOT, ARMED | CUSTOM, 5, VehicleMode(True, False)),
        (QUADROTOR, ARDUPILOT, ARMED | CUSTOM, 15, VehicleMode(True, False)),
        (PLANE, ARDUPILOT, ARMED | CUSTOM, 15, VehicleMode(True, True)),
        (ROVER, ARDUPILOT, ARMED | CUSTOM, 4, VehicleMode(True, False)),
        (QUADROTOR, PX4, ARMED | CUSTOM, OFFBOARD, VehicleMode(True, True)),
        (QUADROTOR, PX4, ARMED | CUSTOM, POSCTL, VehicleMode(True, False)),
        (QUADROTOR, PX4, ARMED | CUSTOM, HOLD, VehicleMode(True, False)),
        (QUADROTOR, PX4, ARMED, OFFBOARD, VehicleMode(True, False)),
        (QUADROTOR, GENERIC, ARMED | CUSTOM, 4, VehicleMode(True, False)),
    ],
)
def test_modes(
    vehicle: int, autopilot: int, base_mode: int, custom_mode: int, expected: VehicleMode
) -> None:
    heartbeat = Heartbeat(1, 1, vehicle, autopilot, base_mode, custom_mode, 4)
    assert mode_of(heartbeat) == expected
    assert expected.is_steered_by_positions is (expected.is_armed and expected.follows_positions)
