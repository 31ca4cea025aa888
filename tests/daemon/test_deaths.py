"""Members killed at every step of a map's making: the others end on one map, and fly on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.daemon import demo
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import computed, passes, passes_until, run
from vcl_companion.swarm.transfer import TransferOptions
from vcl_companion.swarm.update_options import UpdateOptions
from vcl_companion.wire.map_codec import revision_of

OLD = revision_of(demo.encoded_map(1, 2))
UPDATES = UpdateOptions()
# So slow that a map is on its way for a while.
PACED = TransferOptions(rate_bytes_per_s=60_000.0, status_interval_s=0.05)
FEW = 10

Step = Callable[[Drone], bool]
"""Whether a round has come so far, as its coordinator sees it."""

STEPS: dict[str, Step] = {
    "before it is asked for": lambda one: True,
    "while frames are gathered": lambda one: bool(one.events("update")),
    "when it is ready": lambda one: one.revision != OLD,
    "when one other has it": lambda one: len(one.group.maps.holders(one.revision)) > 1 != (
        one.revision == OLD
    ),
}  # fmt: skip


@pytest.mark.parametrize("step", list(STEPS))
@pytest.mark.parametrize("killed", [1, 2], ids=["its coordinator", "a member"])
def test_whoever_is_killed_the_others_end_on_one_map_and_fly_on(
    tmp_path: Path, step: str, killed: int
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            drones = {
                n: await members.start(n, flies_on=(1, 2), update=UPDATES, transfer=PACED)
                for n in (1, 2, 3)
            }
            one = drones[1]
            for n, drone in drones.items():
                await drone.see(demo.frame(n, 12))
            await passes_until(lambda: one.group.is_complete)
            for drone in drones.values():
                drone.track(FEW)
            deadline_s = asyncio.get_running_loop().time() + 60.0
            while not STEPS[step](one) and asyncio.get_running_loop().time() < deadline_s:
                await passes(0.25)
                await asyncio.sleep(0.05)
            assert STEPS[step](one)
            await members.stop(drones.pop(killed))
            left = list(drones.values())
            await passes_until(lambda: all(killed not in drone.group.alive for drone in left))

            def agree() -> bool:
                return len({drone.revision for drone in left}) == 1

            for _ in range(3):
                for drone in left:
                    drone.track(FEW)
                await passes(2.0)
                await computed(agree)
            assert agree()
            # The last good one, or one that goes on from it.
            for drone in left:
                stored = drone.maps.current
                assert stored is not None
                assert OLD in (stored.revision, stored.parent) or len(drone.lines("map")) > 1
                assert drone.events("jump") == []
                assert drone.estimator.is_localized(drone.clock.now_ns())

    run(scenario())
