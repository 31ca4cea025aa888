"""The other detectors' indexes of a map: made while the next map wants no processor."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from dataclasses import replace
from pathlib import Path

import pytest

from tests.daemon.test_map_work import pair, workplace
from tests.daemon.waiting import beside, run, until
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.daemon.map_use import MapUse
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.passed_frames import PassedFrames
from vcl_companion.daemon.worker import Worker
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.wire.messages import MapState

FEW = MapState(pair().revision, 900, localized=True, wants_update=True)
ENOUGH = replace(FEW, wants_update=False)
LOST = replace(FEW, localized=False)
NOT_HERE = replace(ENOUGH, revision=b"newer123")


class Member:
    """Drone 2, that flies on the map; drone 1 coordinates."""

    def __init__(self, work: MapWork, log: FlightLog, disk: Worker) -> None:
        self.group = Group(SwarmOptions((1, 2)), 2)
        self.maps = MapStore("")
        self.maps.replace(pair().data, pair().index)
        passed = PassedFrames(self.group, lambda *_: 0, lambda _: None, work, lambda: True)
        self.use = MapUse(
            self.group, self.maps, log, work, disk, passed, lambda: None, falls_back=True
        )

    def want_more(self, own: MapState, peer: MapState) -> None:
        """Have its map indexed further, where both say so of themselves."""
        self.group.set_own_state(own)
        self.group.map_state(1, peer, 0.0)
        self.maps.want_more()


@asynccontextmanager
async def indexing(path: Path) -> AsyncIterator[Member]:
    """Yield a drone that indexes its map further when that is wanted."""
    work, disk = MapWork(workplace(), forks=False), Worker("disk")
    with closing(FlightLog(str(path / "flight.jsonl"), ManualClock(0))) as log:
        member = Member(work, log, disk)
        async with beside(member.use.index_more()):
            yield member
    work.end()
    disk.shutdown()


@pytest.mark.parametrize(
    ("own", "peer"),
    [(FEW, ENOUGH), (ENOUGH, FEW), (FEW, FEW), (ENOUGH, replace(NOT_HERE, localized=False))],
    ids=["we", "a peer", "both", "it is there"],
)
def test_a_map_that_is_about_to_be_replaced_is_indexed_when_nobody_wants_that(
    tmp_path: Path, own: MapState, peer: MapState
) -> None:
    async def scenario() -> None:
        async with indexing(tmp_path) as member:
            member.want_more(own, peer)
            await asyncio.sleep(1.0)
            assert not member.maps.is_improved
            member.group.set_own_state(ENOUGH)
            member.group.map_state(1, ENOUGH, 1.0)
            await until(lambda: member.maps.is_improved)
            assert member.maps.current is not None
            assert member.maps.current.index.fallback is not None

    run(scenario())


@pytest.mark.parametrize(("own", "peer"), [(LOST, FEW), (FEW, LOST)], ids=["we", "a peer"])
def test_where_somebody_is_lost_the_map_is_indexed_though_the_next_is_wanted(
    tmp_path: Path, own: MapState, peer: MapState
) -> None:
    async def scenario() -> None:
        async with indexing(tmp_path) as member:
            member.want_more(own, peer)
            await until(lambda: member.maps.is_improved)

    run(scenario())


def test_a_map_that_was_left_meanwhile_is_not_indexed(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with indexing(tmp_path) as member:
            member.group.set_own_state(FEW)
            member.maps.want_more()
            await asyncio.sleep(0.3)
            member.maps.replace(pair().data + b"x", pair().index)
            member.group.set_own_state(ENOUGH)
            await asyncio.sleep(1.0)
            assert not member.maps.is_improved

    run(scenario())
