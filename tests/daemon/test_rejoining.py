"""Drones that flew on maps of their own: what becomes of these, and of where they are."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.bent import bent
from tests.daemon.swarm import Drone, swarm
from tests.daemon.waiting import computed, hurry, passes, passes_until, run, until
from vcl_companion.daemon.feature_memory import FeatureMemory
from vcl_companion.daemon.local_frame import origin_in_leaders_world
from vcl_companion.daemon.map_branches import way_into
from vcl_companion.daemon.map_building import build_map, update_map
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.geometry.pose import Pose
from vcl_companion.geometry.rotation import Array
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.localization.map_index import index_map
from vcl_companion.mapping.keyframe_image import encode_image
from vcl_companion.mapping.landmark_map import JoinedMap, LandmarkMap
from vcl_companion.swarm.transfer import BlobKind
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of

PAIR, ALL = demo.encoded_map(1, 2), demo.encoded_map(1, 2, 3)


def believed(drone: Drone) -> Pose:
    """Where the autopilot is told that a drone is, at the instant of its clock."""
    state = drone.estimator.predicted(drone.clock.now_ns(), None)
    assert state is not None
    return drone.estimator.local.from_world.of_pose(state.world_from_body)


def begins(drone: Drone) -> Array | None:
    """Where the frame begins that its autopilot is told poses in, in the leader's world."""
    return origin_in_leaders_world(drone.estimator.local, drone.group, drone.maps.current)


def told_of(*drones: Drone) -> bool:
    """Whether each knows what the others fly on."""
    return all(
        (state := one.group.state_of(other.system_id)) is not None and state.revision
        for one in drones
        for other in drones
    )


def test_a_map_of_another_world_is_merged_and_its_drone_goes_on_where_it_was(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, two = [await members.start(s, flies_on=(1, 2)) for s in (1, 2)]
            three = await members.start(3, flies_on=(1, 2, 3))
            three.track(50)
            before = believed(three)
            # Of its own world nobody has said where it is.
            assert begins(three) is None
            await until(lambda: told_of(one, two, three))
            hurry(6.0)  # the coordinator has not sent one of its own by then
            await computed(lambda: one.revision not in (b"", revision_of(PAIR)))
            merged = one.maps.current
            assert merged is not None
            assert merged.has_in_it(revision_of(ALL))
            await computed(lambda: one.revision == two.revision == three.revision)
            assert three.maps.current is not None
            assert three.maps.current.world == merged.world == revision_of(PAIR)
            assert one.events("merged")
            assert three.events("world")
            off = before.local(believed(three))
            assert np.abs(off).max() < 1e-9
            assert three.estimator.n_resets == 0
            # The new world is not where the old one was, or this test shows nothing.
            moved = three.estimator.local.from_world
            assert np.abs(moved.difference(Similarity.identity())).max() > 1e-6
            # Where its autopilot's frame begins in the leader's: a place in the one plus what
            # it is told there is the place in the other.
            assert three.group.leader == 1
            await until(lambda: begins(three) is not None)
            origin = begins(three)
            assert origin is not None
            np.testing.assert_allclose(moved.inverse().apply(np.zeros(3)), origin)
            np.testing.assert_array_equal(begins(one), np.zeros(3))
            np.testing.assert_array_equal(begins(two), np.zeros(3))

    run(scenario())


def branch(k: int) -> bytes:
    """A map that was made from that of drones 1 and 2, with a later frame of each."""
    stored = StoredMap(revision_of(PAIR), PAIR, demo.map_index(1, 2))
    frames = [demo.answer(system_id, k) for system_id in (1, 2, 3)]
    made = update_map(stored, frames, demo.MAP_OPTIONS, FeatureMemory(demo.FEATURES), at_once=False)
    assert isinstance(made, LandmarkMap)
    return encode_map(made)


def test_what_both_parts_of_a_swarm_have_seen_meanwhile_is_kept(tmp_path: Path) -> None:
    ours, theirs = demo.encoded_update(), branch(6)

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, two = [await members.start(s, runs=False) for s in (1, 2)]
            three = await members.start(3, runs=False)
            for drone, data in ((one, ours), (two, ours), (three, theirs)):
                drone.maps.replace(PAIR, demo.map_index(1, 2))
                drone.maps.replace(data, index_map(decode_map(data), "akaze", demo.FEATURES))
                await members.begin(drone)
                drone.track(50)
            await until(lambda: told_of(one, two, three))
            hurry(6.0)
            await computed(lambda: one.revision not in (b"", revision_of(ours)))
            await computed(lambda: one.revision == two.revision == three.revision)
            merged = three.maps.current
            assert merged is not None
            assert merged.has_in_it(revision_of(theirs))
            assert merged.parent == revision_of(ours)
            seen = {(k.drone_id, k.captured_at_ns) for k in merged.index.landmark_map.keyframes}
            assert {(3, demo.shot(3, k).at_ns) for k in (6, 12)} <= seen
            assert not three.events("world")  # it is the same
            stays = three.estimator.local.from_world.difference(Similarity.identity())
            np.testing.assert_array_equal(stays, 0.0)

    run(scenario())


def elsewhere() -> bytes:
    """The map of all three as it would be of another place: other pictures, the same numbers."""
    landmark_map = decode_map(ALL)
    rng = np.random.default_rng(3)
    keyframes = []
    for keyframe in landmark_map.keyframes:
        size = keyframe.camera.height_px, keyframe.camera.width_px
        noise = rng.integers(0, 255, size).astype(np.uint8)
        image_bytes = encode_image(noise, 30)
        keyframes.append(replace(keyframe, image_bytes=image_bytes, captured_at_ns=5))
    return encode_map(replace(landmark_map, keyframes=tuple(keyframes)))


def test_what_cannot_be_merged_stays_in_its_own_world_and_it_is_said_why(tmp_path: Path) -> None:
    data = elsewhere()
    index = index_map(decode_map(data), "akaze", demo.FEATURES)

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, two = [await members.start(s, flies_on=(1, 2)) for s in (1, 2)]
            three = await members.start(3, runs=False)
            three.maps.replace(data, index)
            await members.begin(three)
            three.track(50)
            await until(lambda: told_of(one, two, three))
            hurry(6.0)
            await computed(lambda: bool(one.events("not merged")))
            assert "landmarks" in one.events("not merged")[0]
            # Handed the coordinator's, it does not fly on what it has no way into.
            await computed(lambda: bool(three.exchange.refused["map that is not joined with ours"]))
            assert three.revision == revision_of(data)
            assert one.revision == two.revision == revision_of(PAIR)
            await asyncio.sleep(0.1)
            assert three.estimator.n_resets == 0

    run(scenario())


def of_another_world(landmark_map: LandmarkMap, there: Similarity) -> bytes:
    """A map that says that of all three is joined in it, and has no keyframe of that."""
    name = revision_of(ALL)
    said = replace(
        landmark_map, parent=b"parent!!", world=b"world!!!", joined=(JoinedMap(name, name, there),)
    )
    return encode_map(said)


@pytest.mark.parametrize("sees", [True, False])
def test_what_a_map_says_of_where_our_world_lies_is_taken_if_a_frame_of_ours_shows_it(
    tmp_path: Path, sees: bool
) -> None:
    """It was extended until it had nothing of ours any more; or somebody lies."""
    frames = [demo.answer(system_id, 12) for system_id in (1, 2, 3)]
    distances = demo.known_distances(1, 2)
    later = build_map(frames, 1, distances, demo.MAP_OPTIONS, FeatureMemory(demo.FEATURES))
    assert isinstance(later, LandmarkMap)
    first = later.keyframes[0]
    step = first.world_from_body @ demo.world_from_body(1, 12).inverse()
    there = Similarity(step.rotation, step.translation)
    data = of_another_world(later, there)

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            three, one = await members.start(3, flies_on=(1, 2, 3)), await members.stranger(1)
            await one.meets(3)
            if sees:
                await three.see(demo.frame(3, 12))
            three.track(50, demo.world_from_body(3, 12))
            await until(lambda: bool((own := three.group.state_of(3)) and own.localized))
            before = believed(three)
            one.hand(BlobKind.MAP, data, 3)
            if sees:
                await until(lambda: three.revision == revision_of(data))
                assert np.abs(before.local(believed(three))).max() < 1e-9
                return
            await computed(lambda: bool(three.exchange.refused["map that is not joined with ours"]))
            (why,) = three.events("refused")
            assert "it has 0 of its 3 keyframes" in why
            assert three.revision == revision_of(ALL)
            assert three.events("quarantine") == []

    run(scenario())


def test_keyframes_of_ours_in_a_world_that_ours_is_not_joined_with_speak_against_nobody(
    tmp_path: Path,
) -> None:
    """A third part has brought them, and ours has not been handed over yet: they lie elsewhere."""
    brought = bent(decode_map(ALL), shift_m=(9.0, 0.0, 0.0))

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            three, one = await members.start(3, flies_on=(1, 2, 3)), await members.stranger(1)
            await one.meets(3)
            three.track(50)
            for n, name in enumerate((b"first!!!", b"second!!", b"third!!!")):
                apart = encode_map(replace(brought, parent=name, world=b"world!!!"))
                one.hand(BlobKind.MAP, apart, 3)
                await computed(partial(refused, three, n + 1))
                hurry(1.1)
            assert three.revision == revision_of(ALL)
            assert three.events("quarantine") == []

    run(scenario())


def refused(drone: Drone, times: int) -> bool:
    return sum(drone.exchange.refused.values()) >= times


def in_vain(n: int) -> bytes:
    """Maps that cannot be merged: they have no scale."""
    return encode_map(replace(decode_map(ALL), distances=(), pixel_noise_px=1.0 + n))


def of_nothing_new(n: int) -> bytes:
    """Maps that are worth naming, each of a world of its own."""
    return encode_map(replace(decode_map(PAIR), pixel_noise_px=1.0 + n))


@pytest.mark.parametrize("offered", [in_vain, of_nothing_new])
def test_a_peer_whose_maps_bring_nothing_is_merged_with_ever_more_rarely(
    tmp_path: Path, offered: Callable[[int], bytes]
) -> None:
    """Ours is not extended meanwhile. Of what has come by then only the last is merged."""

    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one, three = await members.start(1, flies_on=(1, 2, 3)), await members.stranger(3)
            await three.meets(1)

            def n_merges() -> int:
                return len(one.events("merge"))

            def n_ended() -> int:
                return len(one.events("merged")) + len(one.events("not merged"))

            three.hand(BlobKind.MAP, offered(0), 1)
            await computed(lambda: n_ended() == 1)
            await passes(0.75)
            for n in (1, 2, 3):
                three.hand(BlobKind.MAP, offered(n), 1)
                await passes(0.25)
            assert n_merges() == 1
            await passes_until(lambda: n_merges() == 2)
            await computed(lambda: n_ended() == 2)
            await passes(0.75)
            three.hand(BlobKind.MAP, offered(4), 1)
            await passes(2.5)
            assert n_merges() == 2
            await passes_until(lambda: n_merges() == 3)
            assert three.system_id in one.group.trusted

    run(scenario())


def test_a_drone_that_is_ended_while_it_merges_ends_at_once(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with swarm(1, 2, 3, path=tmp_path) as members:
            one = await members.start(1, flies_on=(1, 2), runs=False)
            life = asyncio.ensure_future(one.run())
            two = await members.start(2, flies_on=(1, 2))
            three = await members.start(3, flies_on=(1, 2, 3))
            three.track(50)
            await until(lambda: told_of(one, two, three))
            hurry(6.0)
            await until(lambda: bool(one.events("merge")))
            life.cancel()
            for _ in range(100):  # however many turns that takes, and no time
                await asyncio.sleep(0)
            assert life.done()

    run(scenario())


def test_there_is_a_way_within_a_world_and_where_a_map_was_joined() -> None:
    pair = StoredMap(revision_of(PAIR), PAIR, demo.map_index(1, 2))
    child = demo.encoded_update()
    assert way_into(pair, decode_map(child), revision_of(child)) is None
    assert isinstance(way_into(pair, decode_map(ALL), revision_of(ALL)), str)
