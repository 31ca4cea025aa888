"""What nobody has foreseen: it is said, and the drone flies on."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.flying import flying
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import run
from vcl_companion.daemon.mishaps import survived
from vcl_companion.wire.map_codec import revision_of

PAIR = demo.encoded_map(1, 2)


def fly_on(drone: Drone, *, is_broken: bool) -> None:
    """Fly on the map of the first pictures; a broken one lacks what its landmarks' numbers say."""
    index = demo.map_index(1, 2)
    if is_broken:
        index = replace(index, landmark_map=replace(
            index.landmark_map,
            points_world=index.landmark_map.points_world[:1],
            observed_px=index.landmark_map.observed_px[:1],
        ))  # fmt: skip
    drone.maps.replace(PAIR, index)


def test_a_map_on_which_looking_fails_costs_its_fixes_and_not_the_flight(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            drone = await members.start(2)
            fly_on(drone, is_broken=True)
            async with flying(drone) as two:
                for k in range(3):
                    two.give(k)
                    await two.server.answered()
                fly_on(drone, is_broken=False)
                two.give(3)
                await two.server.answered()
                outcomes = [outcome for _, outcome, _ in two.sources()]
                assert outcomes == ["refused"] * 3 + ["localized"]
            reasons = {line["reason"] for line in drone.lines("frame")[:3]}
            assert reasons == {"looking at it failed: IndexError"}
            assert revision_of(PAIR) == drone.revision

    with caplog.at_level(logging.ERROR):
        run(scenario())
    # The journal has it once, not with every frame.
    assert [r.message for r in caplog.records].count("a frame cannot be looked at") <= 1


def test_what_has_failed_is_said_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    with survived("dealing with peers"):
        np.zeros(3)[4]
    (record,) = caplog.records
    assert record.getMessage() == "dealing with peers failed, and goes on"
    assert record.exc_info is not None
