"""A map that has been left is not kept in memory: sixty megabytes, sixty times in two minutes."""

from __future__ import annotations

import asyncio
import gc
import weakref
from dataclasses import replace
from pathlib import Path

from tests.daemon import demo
from tests.daemon.swarm import swarm
from tests.daemon.test_companion import flying
from tests.daemon.test_map_work import PAIR, pair, workplace
from tests.daemon.waiting import run, until
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.localization.fix import Localized
from vcl_companion.localization.pipeline import ALL_EFFORT
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.wire.map_codec import revision_of

NEXT = demo.encoded_update()


def is_gone(left: weakref.ref[StoredMap]) -> bool:
    gc.collect()
    return left() is None


def test_who_shares_maps_keeps_none_that_was_left(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2))
            assert await one.exchange.go_back_to(NEXT) == ""
            assert one.maps.current is not None
            left = weakref.ref(one.maps.current)
            one.maps.want_more()
            await asyncio.sleep(0.1)
            assert await one.exchange.go_back_to(PAIR) == ""
            assert one.revision == revision_of(PAIR)
            await asyncio.sleep(0.2)  # rounds look at it every now and then
            assert is_gone(left)

    run(scenario())


def test_who_looked_for_a_frame_in_vain_keeps_no_map_for_that(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_nothing_known(tracked=True)
            assert up.maps.current is not None
            left = weakref.ref(up.maps.current)
            for k in (0, 1):
                up.give(k)
                await up.server.answered()
            assert set(up.server.outcomes.values()) == {"refused"}
            # The workshop, here in this process, has it too.
            for other in (b"one", b"another"):
                up.shop.learn(replace(pair(), revision=other))
            assert not is_gone(left)
            up.fly_on_a_map()
            up.give(2)
            await until(lambda: up.server.outcomes.get(2) == "localized")
            await until(lambda: is_gone(left))

    run(scenario())


def test_maps_but_the_one_that_the_next_is_made_of_are_let_go_before() -> None:
    shop = workplace()
    older = replace(pair(), revision=b"older")
    left = weakref.ref(older)
    shop.learn(older)
    shop.learn(pair())
    del older
    frames = [demo.answer(system_id, 12) for system_id in (1, 2, 3)]
    assert not is_gone(left)
    made = shop.next_revision(revision_of(PAIR), frames, at_once=False)
    assert isinstance(made, LandmarkMap)
    assert is_gone(left)


def test_the_process_that_makes_maps_keeps_the_one_in_use_only() -> None:
    async def scenario() -> None:
        shop = workplace()
        work = MapWork(shop, forks=False)
        older = replace(pair(), revision=b"older")
        left = weakref.ref(older)
        shop.learn(older)
        del older
        stored = pair()
        shop.learn(stored)
        assert not is_gone(left)
        await work.keep_only(stored)
        assert is_gone(left)
        # What is named all the same is handed over, and does not take the other's place.
        other = replace(pair(), revision=b"other")
        shot = demo.shot(2)
        for one in (other, stored):
            fix = await work.find(shot.image, one, None, shot.ned_from_body.rotation, ALL_EFFORT)
            assert isinstance(fix, Localized)
        work.end()

    run(scenario())
