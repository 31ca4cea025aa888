"""What the ground may change in flight, over the autopilot's link of a drone."""

import struct
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import passes, passes_until, run, until
from tests.links import wire
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.swarm.update_options import UpdateOptions

REAL32 = 9
DEFAULTS = {
    "VCL_PAUSED": 0.0,
    "VCL_POSE_AGE": 10.0,  # of the tests' drones
    "VCL_TIME_ERR": AutopilotOptions().time_error_s,
    "VCL_UPD_TRACKED": UpdateOptions().tracked,
    "VCL_UPD_SHARE": UpdateOptions().share,
    "VCL_UPD_COVERED": UpdateOptions().covered,
    "VCL_UPD_NOVELTY": UpdateOptions().novelty_deg,
    "VCL_UPD_SIGMA": UpdateOptions().sigma_m,
    "VCL_UPD_GROWTH": UpdateOptions().sigma_growth,
}


async def told(drone: Drone) -> tuple[str, float]:
    """Wait for the next parameter's value."""
    while True:
        seen = await drone.autopilot.others.get()
        if seen.message_id == wire.PARAM_VALUE:
            raw, _, _, name, _ = seen.fields
            return name.rstrip(b"\0").decode(), struct.unpack("<f", raw)[0]


async def set_to(drone: Drone, name: str, value: float) -> float:
    """Set a parameter; return what it is then."""
    raw = struct.pack("<f", value)
    drone.autopilot.hand_on(wire.PARAM_SET, raw, drone.system_id, 197, name.encode(), REAL32)
    of, now = await told(drone)
    assert of == name
    return now


def test_all_settings_are_told_as_they_are(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, update=UpdateOptions())
            await one.see(demo.frame(1, 0))
            one.autopilot.hand_on(wire.PARAM_REQUEST_LIST, 1, 0)
            listed = dict([await told(one) for _ in DEFAULTS])
            assert list(listed) == list(DEFAULTS)
            assert listed == pytest.approx(DEFAULTS)

    run(scenario())


def test_poses_are_paused_and_judged_by_what_was_set(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1)
            await one.see(demo.frame(1, 0))
            assert await set_to(one, "VCL_PAUSED", 1.0) == 1.0
            assert one.autopilot_link.poses.is_paused
            assert await set_to(one, "VCL_PAUSED", 1.0) == 1.0
            assert await set_to(one, "VCL_PAUSED", 0.5) == 1.0
            assert await set_to(one, "VCL_PAUSED", 0.0) == 0.0
            assert not one.autopilot_link.poses.is_paused
            assert one.autopilot.said_texts() == [
                "VCL no poses are sent, as commanded",
                "VCL_PAUSED: must be 0 or 1, got 0.5",
                "VCL poses are sent again, as commanded",
            ]
            for paused in (1.0, 0.0):  # by MAV_CMD_USER_5
                one.autopilot.forward(31014, paused)
                assert await told(one) == ("VCL_PAUSED", paused)
            one.autopilot.said_texts()
            assert await set_to(one, "VCL_TIME_ERR", 0.1) == pytest.approx(0.1)
            assert await set_to(one, "VCL_POSE_AGE", 0.05) == pytest.approx(0.05)
            assert await set_to(one, "VCL_POSE_AGE", 10.5) == pytest.approx(0.05)
            options = one.autopilot_link.options
            assert (options.time_error_s, options.max_pose_age_s) == (0.1, 0.05)
            assert one.events("setting") == [
                "VCL_PAUSED 1, by system 255", "VCL_PAUSED 0, by system 255",
                "VCL_TIME_ERR 0.1, by system 255", "VCL_POSE_AGE 0.05, by system 255",
            ]  # fmt: skip
            assert one.autopilot.said_texts() == [
                "VCL_POSE_AGE: max_pose_age_s: must be in 0.05..10, got 10.5",
            ]

    run(scenario())


def test_a_drone_votes_by_what_was_set(tmp_path: Path) -> None:
    frozen = UpdateOptions(tracked=0, share=0.0, covered=0.5)

    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), update=frozen)
            await one.see(demo.frame(1, 12))
            one.track(400)
            await passes(3.0)
            assert not one.wants_update
            assert await set_to(one, "VCL_UPD_TRACKED", 500.0) == 500.0
            await passes_until(lambda: one.wants_update)
            assert await set_to(one, "VCL_UPD_TRACKED", 99.5) == 500.0
            assert await set_to(one, "VCL_UPD_TRACKED", 0.0) == 0.0
            await passes_until(lambda: not one.wants_update)

    run(scenario())


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("VCL_UPD_TRACKED", -1.0), ("VCL_UPD_SHARE", 1.0), ("VCL_UPD_COVERED", -0.1),
        ("VCL_UPD_NOVELTY", 0.0), ("VCL_UPD_SIGMA", -1.0), ("VCL_UPD_GROWTH", 1.0),
        ("VCL_TIME_ERR", 0.2), ("VCL_POSE_AGE", 0.0), ("VCL_PAUSED", 2.0),
    ],
)  # fmt: skip
def test_bounds_are_those_of_the_configuration(tmp_path: Path, name: str, wrong: float) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, update=UpdateOptions())
            await one.see(demo.frame(1, 0))
            for value in (wrong, float("nan"), float("inf"), -float("inf")):
                assert await set_to(one, name, value) == pytest.approx(DEFAULTS[name])
            assert one.events("setting") == []
            await until(lambda: one.autopilot.texts.qsize() == 4)

    run(scenario())
