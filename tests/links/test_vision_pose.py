"""What each firmware makes of the poses that we send, by its own formulas."""

import asyncio
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tests.links import wire
from tests.links.running import Udp, running, udp
from vcl_companion.clock import ManualClock
from vcl_companion.errors import ConfigError
from vcl_companion.geometry.pose import Pose, euler_pose_covariance
from vcl_companion.geometry.rotation import Array, exp_so3, matrix_from_quaternion
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.vision_pose import (
    Firmware,
    PoseEstimate,
    covariance_for,
    firmware_of,
)

SYSTEM = 7
NOW_NS = 1_000_000_000_000
POSE = Pose(exp_so3(np.array([0.1, -0.2, 1.3])), np.array([3.0, -4.0, -12.0]))
# One bad axis, seen from the body: depth.
COVARIANCE = np.diag([0.09, 0.0004, 0.0016, 1e-5, 4e-5, 9e-5])
SPEED = np.array([6.0, -2.0, 0.5])


def estimate(covariance: Array = COVARIANCE, speed: Array | None = None) -> PoseEstimate:
    at_rest = np.zeros(3) if speed is None else speed
    return PoseEstimate(POSE, covariance, at_rest, 0.04 * np.eye(3), NOW_NS, 3)


def said(firmware: Firmware, of: PoseEstimate, time_error_s: float = 0.0) -> Array:
    covariance = covariance_for(firmware, of, time_error_s)
    assert not isinstance(covariance, str)
    assert np.linalg.eigvalsh(covariance)[0] > -1e-12
    return covariance


def ardupilot_reads(upper: Array) -> tuple[float, float]:
    """GCS_Common.cpp: one error of position, one of angle."""
    assert not math.isnan(upper[0])
    position_m = math.sqrt(upper[0] + upper[6] + upper[11])
    return position_m, math.sqrt(upper[15] + upper[18] + upper[20])


def px4_reads(upper: Array) -> tuple[Array, Array]:
    """mavlink_receiver.cpp: three variances of position, three of orientation."""
    return upper[[0, 6, 11]], upper[[15, 18, 20]]


def test_ardupilot_reads_the_worst_direction() -> None:
    true = euler_pose_covariance(POSE, COVARIANCE)
    upper = said(Firmware.ARDUPILOT, estimate())[np.triu_indices(6)]
    position_m, angle_rad = ardupilot_reads(upper)
    assert math.isclose(position_m, 0.3, rel_tol=1e-9)
    assert math.isclose(angle_rad, math.sqrt(np.trace(true[3:, 3:])), rel_tol=1e-9)
    # Never surer of any axis than we are.
    assert position_m**2 >= np.diag(true)[:3].max()


def test_an_even_error_is_read_as_itself_and_not_as_three_times_its_square() -> None:
    upper = said(Firmware.ARDUPILOT, estimate(1e-4 * np.eye(6)))[np.triu_indices(6)]
    assert math.isclose(ardupilot_reads(upper)[0], 0.01, rel_tol=1e-9)


def test_px4_reads_six_variances_as_they_are() -> None:
    true = np.diag(euler_pose_covariance(POSE, COVARIANCE))
    for firmware in (Firmware.PX4, Firmware.OTHER):
        position, attitude = px4_reads(said(firmware, estimate())[np.triu_indices(6)])
        np.testing.assert_allclose(position, true[:3])
        np.testing.assert_allclose(attitude, true[3:])


def test_who_moves_is_uncertain_along_its_way() -> None:
    along = SPEED / np.linalg.norm(SPEED)
    still = said(Firmware.PX4, estimate(), 0.02)[:3, :3]
    moving = said(Firmware.PX4, estimate(speed=SPEED), 0.02)[:3, :3]
    added = along @ (moving - still) @ along
    assert math.isclose(math.sqrt(added), 0.02 * np.linalg.norm(SPEED), rel_tol=1e-9)
    assert np.linalg.matrix_rank(moving - still, tol=1e-12) == 1


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 1e39])
@pytest.mark.parametrize("firmware", list(Firmware))
def test_what_an_autopilot_takes_for_an_error_of_its_own_is_not_said(
    firmware: Firmware, bad: float
) -> None:
    covariance = COVARIANCE.copy()
    covariance[2, 2] = bad
    assert isinstance(covariance_for(firmware, estimate(covariance), 0.0), str)


def test_nothing_known_of_the_error_is_no_division_by_nothing() -> None:
    np.testing.assert_array_equal(said(Firmware.ARDUPILOT, estimate(np.zeros((6, 6)))), 0.0)


def test_the_heartbeat_says_whose_it_is() -> None:
    assert [firmware_of(n) for n in (3, 12, 8, 0)] == [
        Firmware.ARDUPILOT, Firmware.PX4, Firmware.OTHER, Firmware.OTHER,
    ]  # fmt: skip


async def next_of(
    side: Udp, message_id: int, wanted: Callable[[tuple[Any, ...]], bool]
) -> wire.Seen:
    while True:
        for seen in wire.read((await side.got.get())[0]):
            if seen.message_id == message_id and wanted(seen.fields):
                return seen


def sent(options: dict[str, Any], autopilot: int, message_id: int) -> tuple[Any, ...]:
    """Return the fields of a pose's message as our link sends it to an autopilot."""

    async def scenario() -> wire.Seen:
        async with udp() as side:
            link = AutopilotLink(
                AutopilotOptions(link=f"udp:127.0.0.1:{side.port}", **options),
                SYSTEM,
                ManualClock(NOW_NS),
            )
            async with running(link.run()):
                _, where = await side.got.get()
                beat = wire.packed(wire.HEARTBEAT, 4, 2, autopilot, 1, 4, 3, system=SYSTEM)
                question = wire.packed(wire.TIMESYNC, 0, 1, system=SYSTEM)
                side.transport.sendto(beat + question, where)
                await next_of(side, wire.TIMESYNC, lambda fields: fields[0] != 0)
                assert link.poses.send(estimate(speed=SPEED)) is None
                return await next_of(side, message_id, lambda _: True)

    return asyncio.run(scenario()).fields


@pytest.mark.parametrize(
    ("profile", "autopilot", "firmware"),
    [
        ("auto", 3, Firmware.ARDUPILOT),
        ("auto", 12, Firmware.PX4),
        ("px4", 3, Firmware.PX4),
        ("plain", 3, Firmware.OTHER),
    ],
)
def test_the_profile_is_the_heartbeat_s_unless_it_is_configured(
    profile: str, autopilot: int, firmware: Firmware
) -> None:
    fields = sent({"profile": profile}, autopilot, wire.VISION_POSITION_ESTIMATE)
    expected = said(firmware, estimate(speed=SPEED), 0.005)[np.triu_indices(6)]
    np.testing.assert_allclose(np.array(fields[7:28], dtype=float), expected, rtol=1e-5)


@pytest.mark.parametrize(("profile", "frame"), [("ardupilot", 20), ("px4", 1)])
def test_odometry_is_in_the_frames_that_each_firmware_takes(profile: str, frame: int) -> None:
    fields = sent({"profile": profile, "message": "odometry"}, 0, wire.ODOMETRY)
    assert fields[0] == NOW_NS // 1000
    position, quaternion, speed, rates = fields[1:4], fields[4:8], fields[8:11], fields[11:14]
    np.testing.assert_allclose(np.array(position, dtype=float), POSE.translation, rtol=1e-6)
    rotation = matrix_from_quaternion(np.array(quaternion, dtype=float))
    np.testing.assert_allclose(rotation, POSE.rotation, atol=1e-6)
    # BODY_FRD: both firmwares turn it by the quaternion.
    np.testing.assert_allclose(rotation @ np.array(speed, dtype=float), SPEED, rtol=1e-5)
    assert all(math.isnan(float(str(rate))) for rate in rates)
    expected = said(Firmware(profile), estimate(speed=SPEED), 0.005)[np.triu_indices(6)]
    np.testing.assert_allclose(np.array(fields[14:35], dtype=float), expected, rtol=1e-5)
    twist = np.array(fields[35:56], dtype=float)
    np.testing.assert_allclose(twist[[0, 6, 11]], 0.04, rtol=1e-5)
    # BODY_FRD; MAV_ESTIMATOR_TYPE_VISION, quality not known
    assert fields[56:58] == (frame, 12)
    assert fields[59:] == (2, 0)


def test_a_time_error_out_of_bounds_is_refused() -> None:
    with pytest.raises(ConfigError, match="time_error_s"):
        AutopilotOptions(time_error_s=0.5)
