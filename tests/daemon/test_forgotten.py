"""What is under way when all is to be forgotten: it was led by that, and does not bring it back."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.swarm import Drone, Swarm, swarm
from tests.daemon.waiting import run, until
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.mailbox import Mailbox
from vcl_companion.daemon.map_search import MapSearch
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.geometry.rotation import exp_so3
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions


async def placed(members: Swarm) -> tuple[Drone, StoredMap]:
    """Start a drone that knows where it took its first picture; return also its map."""
    drone = await members.start(2, (1, 2))
    await until(lambda: drone.autopilot_link.is_heard)
    await drone.see(demo.frame(2))
    drone.track(50)
    assert drone.maps.current is not None
    return drone, drone.maps.current


def own_fixes_of(drone: Drone, executor: ThreadPoolExecutor) -> OwnFixes:
    sensor = demo.sensor(drone.system_id)
    options = PipelineOptions(demo.FEATURES, LocalizationOptions(), TrackingOptions())
    odometry = Odometry(sensor, drone.system_id, drone.work)
    return OwnFixes(
        sensor, drone.autopilot_link, drone.maps, drone.estimator, drone.log, executor, options,
        odometry,
    )  # fmt: skip


def test_a_frame_that_is_being_looked_at_is_looked_at_again(tmp_path: Path) -> None:
    async def scenario(executor: ThreadPoolExecutor) -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone, stored = await placed(members)
            own_fixes = own_fixes_of(drone, executor)
            for forgets in (False, True):
                may_begin = threading.Event()
                executor.submit(may_begin.wait)
                look = asyncio.create_task(own_fixes.look(demo.frame(2), stored))
                while executor._work_queue.empty():
                    await asyncio.sleep(0.001)
                if forgets:
                    drone.estimator.forget()
                may_begin.set()
                fix = (await look).fix
                # Patches are followed from somewhere, or not at all.
                assert isinstance(fix, NotLocalized if forgets else Localized)

    with ThreadPoolExecutor(1) as executor:
        run(scenario(executor))


def test_a_frame_that_is_being_searched_for_is_searched_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone, stored = await placed(members)
            search = MapSearch(Mailbox(), drone.maps, drone.estimator, drone.work)
            priors: list[object] = []
            find = drone.work.find

            async def noted(*args: Any) -> Localized | NotLocalized:
                priors.append(args[2])
                return await find(*args)

            monkeypatch.setattr(drone.work, "find", noted)
            for forgets in (False, True):
                priors.clear()
                sought = search.begin(demo.frame(2), None, stored, 0.0)
                finding = asyncio.create_task(search.found(sought))
                await asyncio.sleep(0)  # it has begun
                if forgets:
                    drone.estimator.forget()
                _, fix = await finding
                search.end()
                assert isinstance(fix, Localized)
                assert [prior is not None for prior in priors] == [True, False][: 1 + forgets]

    run(scenario())


@pytest.mark.parametrize(("compass_deg", "counts"), [(0.0, True), (9.0, True), (20.0, False)])
def test_a_compass_that_our_fixes_have_shown_to_be_drawn_aside_counts_no_more(
    compass_deg: float, counts: bool
) -> None:
    estimator = Estimator(FilterOptions(), LocalizationOptions(), lambda _: None)
    assert estimator.has_heading
    pose = demo.world_from_body(2, 0)
    fix = Localized(
        pose, 1e-6 * np.eye(6), 1e-6 * np.eye(6), np.zeros((6, 0)), np.zeros((0, 0)), 50, 50,
        False, 0.5,
    )  # fmt: skip
    drawn = exp_so3(np.deg2rad([0.0, 0.0, compass_deg])) @ pose.rotation
    estimator.take_fix(None, fix, 0, drawn)
    assert estimator.has_heading == counts
