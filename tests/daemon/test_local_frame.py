"""Whose north the autopilot is told poses in, as its stream says when it is decoded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.daemon import demo
from tests.daemon.swarm import swarm
from tests.daemon.waiting import run
from vcl_companion.daemon.local_frame import LocalFrame
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array, exp_so3
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.links.autopilot_options import Heading
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.pose_filter import FilterOptions, started

DRONE = 2
NORTH_DEG = 12.0
# A place that the map knows to centimetres, a heading that it knows to tenths of a degree.
OFF_M, OFF_DEG = 0.15, 1.0


def turned(degrees: float) -> Array:
    return exp_so3(np.deg2rad([0.0, 0.0, degrees]))


def state(world_from_body: Pose, ned_from_body: Array | None) -> FilterState:
    fix = Localized(
        world_from_body, 1e-4 * np.eye(6), np.zeros((6, 6)), np.zeros((6, 0)),
        np.zeros((0, 0)), 30, 30, False, 0.5,
    )  # fmt: skip
    return started(fix, 10**9, ned_from_body, FilterOptions())


def test_the_autopilots_north_is_waited_for_and_kept() -> None:
    tilted = exp_so3(np.array([0.3, -0.2, 1.0]))
    there = Pose(tilted, np.array([3.0, -2.0, -1.0]))
    local = LocalFrame("autopilot")
    assert not local.settles(state(there, None))
    assert local.origin_world is None
    # Its roll and pitch err by a degree: that is no turn of north.
    err = exp_so3(np.deg2rad([1.0, -1.0, 0.0]))
    assert local.settles(state(there, turned(50.0) @ err @ tilted))
    np.testing.assert_allclose(local.from_world.rotation, turned(50.0), atol=3e-4)
    assert local.settles(state(there, turned(80.0) @ tilted))  # a later one changes nothing
    np.testing.assert_allclose(local.from_world.rotation, turned(50.0), atol=3e-4)
    assert local.origin_world is not None
    np.testing.assert_allclose(local.origin_world, 0.0)


@pytest.mark.parametrize("heading", ["map", "autopilot"])
def test_another_world_moves_its_origin_in_the_world_and_nothing_else(heading: Heading) -> None:
    was = Pose(turned(10.0), np.array([3.0, -2.0, -1.0]))
    other_from_world = Similarity(turned(-70.0), np.array([100.0, 20.0, 5.0]), 3.0)
    local = LocalFrame(heading)
    assert local.settles(state(was, turned(40.0) @ was.rotation))
    # Where it is, and what a step is to its autopilot, whatever the other map takes for a metre.
    further = Pose(was.rotation, was.translation + np.array([2.0, 0.0, 0.0]))
    before = [local.from_world.of_pose(pose) for pose in (was, further)]
    local.carry(other_from_world)
    for pose, told in zip((was, further), before, strict=True):
        after = local.from_world.of_pose(other_from_world.of_pose(pose))
        np.testing.assert_allclose(told.local(after), 0.0, atol=1e-9)
    assert local.origin_world is not None
    np.testing.assert_allclose(local.origin_world, (100.0, 20.0, 5.0))
    local.leave()
    assert local.is_settled == (heading == "map")
    np.testing.assert_array_equal(local.from_world.difference(Similarity.identity()), 0.0)


@pytest.mark.parametrize("heading", ["map", "autopilot"])
def test_poses_are_told_in_the_north_that_is_asked_for(heading: Heading, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.fly(DRONE, flies_on=(1, 2), north_deg=NORTH_DEG, heading=heading)
            north = Rotation.from_euler("z", NORTH_DEG if heading == "autopilot" else 0.0, True)
            for k in range(3):
                await drone.fly(k)
                told = await drone.autopilot.poses.get()
                truth = demo.world_from_body(DRONE, k)
                off_m = np.array(told[1:4]) - north.as_matrix() @ truth.translation
                assert 1e-5 < np.linalg.norm(off_m) < OFF_M
                attitude = Rotation.from_euler("ZYX", [told[6], told[5], told[4]])
                off = attitude.inv() * north * Rotation.from_matrix(truth.rotation)
                assert np.rad2deg(off.magnitude()) < OFF_DEG

    run(scenario())
