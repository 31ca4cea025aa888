"""A late joiner on a slow link: a part of the map first, the rest behind it, over real links."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.daemon import demo
from tests.daemon.swarm import INTER, Drone, Swarm, swarm
from tests.daemon.waiting import computed, passes, run, until
from vcl_companion.daemon.map_offer import HandOut, MapOffer, ready_map
from vcl_companion.daemon.map_parts import MapParts
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.workshop import Workshop
from vcl_companion.mapping.uncertainty import map_uncertainty
from vcl_companion.swarm.group import SwarmOptions
from vcl_companion.swarm.transfer import BlobKind, TransferOptions
from vcl_companion.wire.map_codec import decode_map, revision_of
from vcl_companion.wire.map_part import decode_map_part

WHOLE = demo.encoded_update()
REVISION = revision_of(WHOLE)
# Of five keyframes three are that quick.
QUICK_BYTES = 35_000
SLOW = TransferOptions(rate_bytes_per_s=5e6, status_interval_s=0.05, quick_s=0.0093)


def workshop() -> Workshop:
    """One that has the map."""
    made = demo.workshop(SwarmOptions(), demo.sensor(1), INTER)
    made.learn(StoredMap(REVISION, WHOLE, demo.update_index()))
    return made


async def on_the_map(members: Swarm, *system_ids: int) -> list[Drone]:
    """Start drones that fly on the map."""
    drones = []
    for system_id in system_ids:
        drone = await members.start(system_id, transfer=SLOW)
        drone.maps.replace(WHOLE, demo.update_index())
        drones.append(drone)
    return drones


def test_what_is_quick_is_so_by_the_pace() -> None:
    assert 31_000 < SLOW.pace.quick_bytes < 39_000
    # More takes a second to be made ready, however fast it comes.
    assert 70_000 < TransferOptions().pace.quick_bytes < 90_000
    assert 25_000 < TransferOptions(profile="radio-57k").pace.quick_bytes < 35_000


def test_a_part_is_a_map_of_the_newest_keyframes_in_the_same_frame() -> None:
    blob = workshop().part(REVISION, QUICK_BYTES)
    assert 25_000 < len(blob) <= QUICK_BYTES
    of, data = decode_map_part(blob)
    assert of == REVISION
    whole, part = decode_map(WHOLE), decode_map(data)
    n_gone = len(whole.keyframes) - len(part.keyframes)
    assert 0 < n_gone < len(whole.keyframes) - 1
    for keyframe, same in zip(part.keyframes, whole.keyframes[n_gone:], strict=True):
        assert keyframe.image_bytes == same.image_bytes
        assert np.array_equal(keyframe.world_from_body.matrix(), same.world_from_body.matrix())
    # Where its first keyframes are gone a landmark is told by another one's grid.
    away_m, _ = cKDTree(whole.points_world).query(part.points_world)
    assert np.max(away_m) < 0.02
    # It is no surer of itself than the whole is.
    sigma_m, sure_m = (
        np.sqrt(np.trace(map_uncertainty(m).marginal(), axis1=1, axis2=2)) for m in (part, whole)
    )
    assert 0.9 < np.median(sigma_m) / np.median(sure_m) < 10.0


@pytest.mark.parametrize("most_bytes", [0, 5_000, 15_000])
def test_of_too_little_there_is_no_part(most_bytes: int) -> None:
    assert workshop().part(REVISION, most_bytes) == b""


def test_part_and_rest_are_the_whole_and_no_longer() -> None:
    made = workshop()
    part = made.part(REVISION, QUICK_BYTES)
    rest = made.rest(REVISION, part)
    assert len(part) + len(rest) < 1.05 * len(WHOLE)
    on_part = made.ready(MapOffer.of(BlobKind.MAP_PART, part), b"", {})
    assert on_part.stored().told_revision == b""
    assert on_part.stored().part_of == REVISION
    offer = MapOffer.of(BlobKind.MAP_UPDATE, rest)
    whole = made.ready(offer, on_part.stored().revision, {})
    assert (whole.data, whole.contradicts, whole.part_of) == (WHOLE, "", b"")
    with pytest.raises(ValueError, match="not in use here"):
        ready_map(offer, None, "akaze", demo.FEATURES, made._memory, False, {})


def test_who_is_on_a_part_of_another_is_sent_none_of_ours() -> None:
    work = MapWork(workshop(), forks=False)
    parts = MapParts(MapStore(""), work, lambda *_: 0, QUICK_BYTES)
    ours = HandOut(REVISION, decode_map(WHOLE).parent, WHOLE, b"")
    assert not parts.comes_first(3, ours, is_on_part=True)
    assert parts.rest_for(3, ours, 0.0, is_on_part=True) == b""
    assert parts.comes_first(4, ours, is_on_part=False)
    work.end()


def test_who_comes_late_flies_on_a_part_and_then_on_the_whole(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, _ = await on_the_map(members, 1, 2)
            await until(lambda: one.group.maps.holders(REVISION) == (1, 2))
            three = await members.start(3, transfer=SLOW)
            # The whole may be behind it before anybody looks again.
            first = asyncio.create_task(three.maps.decided())
            await computed(first.done)
            part = first.result()
            assert part is not None
            assert part.part_of == REVISION
            await computed(lambda: three.revision == REVISION)
            assert [line["keyframes"] for line in three.lines("map")] == [3, 5]
            await until(lambda: one.group.maps.holders(REVISION) == (1, 2, 3))
            await passes(5.0)
            for drone in (one, three):
                assert drone.revision == REVISION
                assert {kind for kind in drone.exchange.refused if "map" in kind} == set()
            assert len(three.lines("map")) == 2

    run(scenario())


def test_a_leader_that_is_back_on_a_part_hands_it_to_nobody(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            two, three = await on_the_map(members, 2, 3)
            await until(lambda: two.group.maps.holders(REVISION) == (2, 3))
            one = await members.start(1, transfer=SLOW)
            await one.see(demo.frame(1))
            await computed(lambda: one.revision == REVISION)
            assert [line["keyframes"] for line in one.lines("map")] == [3, 5]
            await passes(5.0)
            assert [len(drone.lines("map")) for drone in (two, three)] == [0, 0]
            assert {drone.revision for drone in (one, two, three)} == {REVISION}

    run(scenario())


def test_a_joiner_whose_giver_dies_after_the_part_gets_the_whole_from_the_next(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, two = await on_the_map(members, 1, 2)
            await until(lambda: two.group.maps.holders(REVISION) == (1, 2))
            three = await members.start(3, transfer=SLOW)
            await computed(lambda: three.maps.current is not None)
            await members.stop(one)
            while three.revision != REVISION:
                await passes(1.0)
                await asyncio.sleep(0.01)
            await until(lambda: 3 in two.group.maps.holders(REVISION))
            assert [line["keyframes"] for line in three.lines("map")] == [3, 5]

    run(scenario())
