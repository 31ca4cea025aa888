"""What a drone votes by while a frame is looked for by its features."""

import asyncio
from pathlib import Path

from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import passes, passes_until, run
from vcl_companion.swarm.update_options import UpdateOptions

PLENTY = 500


def seek(drone: Drone) -> None:
    """Have the drone refuse a frame by its patches, and look for it by its features."""
    drone.track(0)
    drone.estimator.in_sight.sought_since_s = asyncio.get_running_loop().time()


def find(drone: Drone) -> None:
    drone.estimator.in_sight.sought_since_s = None
    drone.track(PLENTY)


def test_a_frame_that_is_found_by_its_features_a_moment_later_is_no_reason(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), update=UpdateOptions())
            for _ in range(4):  # half of the time nothing is known
                seek(one)
                await passes(0.25)
                find(one)
                await passes(0.25)
            find(one)
            await passes(1.0)
            assert not one.wants_update
            assert one.events("vote") == []

    run(scenario())


def test_a_frame_that_is_long_looked_for_shows_nothing(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), update=UpdateOptions())
            find(one)
            await passes(2.0)
            assert not one.wants_update
            seek(one)
            await passes_until(lambda: one.wants_update, at_most_s=2.0)

    run(scenario())
