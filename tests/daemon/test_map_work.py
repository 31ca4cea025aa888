"""The workshop in a process of its own, in threads, and when that process is lost."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.waiting import run
from vcl_companion.daemon import feature_memory
from vcl_companion.daemon.map_offer import MapOffer
from vcl_companion.daemon.map_store import StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.errors import WireError
from vcl_companion.geometry.pose import Pose
from vcl_companion.localization.fix import Localized, Prior
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.pipeline import ALL_EFFORT, PipelineOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.mapping.options import NoMap
from vcl_companion.swarm.pose_requests import InterMavOptions
from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of
from vcl_companion.wire.map_update import encode_map_update, without_images

PAIR = demo.encoded_map(1, 2)


class Workplace(Workshop):
    """Knows where it is."""

    def learn(self, stored: StoredMap) -> None:
        if stored.data == b"where?":
            raise ValueError(os.getpid())
        super().learn(stored)


def workplace() -> Workplace:
    pipeline = PipelineOptions(demo.FEATURES, LocalizationOptions(), TrackingOptions())
    options = WorkOptions(
        demo.known_distances(1, 2), demo.MAP_OPTIONS, pipeline, ("akaze", "orb"),
        InterMavOptions(detector="akaze"), tracked=True,
    )  # fmt: skip
    return Workplace(demo.sensor(1), options)


@pytest.fixture(params=[True, False], ids=["process", "threads"])
def work(request: pytest.FixtureRequest) -> Iterator[MapWork]:
    made = MapWork(workplace(), forks=request.param)
    yield made
    made.end()


def pair() -> StoredMap:
    return StoredMap(revision_of(PAIR), PAIR, demo.map_index(1, 2))


def test_a_first_map_is_made_and_made_ready(work: MapWork) -> None:
    async def check() -> None:
        frames = [demo.answer(1), demo.answer(2)]
        await work.look_at(frames[0])
        built = await work.first_map(frames, demo.LEADER)
        assert isinstance(built, LandmarkMap)
        handed = await work.encoded(built, None)
        assert handed.data == encode_map(built)
        for offer in (
            MapOffer.of(BlobKind.MAP, handed.data),
            MapOffer.of(BlobKind.MAP_UPDATE, handed.update),
        ):
            assert (await work.ready(offer, None, {})).data == handed.data
        ready = await work.ready(MapOffer.of(BlobKind.MAP, handed.data), None, {})
        assert ready.stored().revision == handed.revision
        assert ready.templates is not None
        assert len(ready.templates.anchors.pixels) > 100

    run(check())


def test_a_map_that_it_has_not_seen_is_handed_over_and_extended(work: MapWork) -> None:
    async def check() -> None:
        frames = [demo.answer(system_id, 12) for system_id in (1, 2, 3)]
        built = await work.next_revision(pair(), frames, at_once=False)
        assert isinstance(built, LandmarkMap)
        assert built.parent == revision_of(PAIR)
        handed = await work.encoded(built, pair())
        assert 0 < len(handed.update) < len(handed.data)

    run(check())


def test_what_a_frame_shows_of_a_map_is_told_of_that_map(work: MapWork) -> None:
    async def check() -> None:
        stored = replace(pair(), templates=demo.templates(1, 2))
        where = Prior(demo.world_from_body(2, 6), np.diag(np.repeat([0.02, 0.002], 3) ** 2))
        seen = await work.seen(demo.shot(2, 6).image, stored, where)
        assert seen is not None
        assert seen.revision == stored.revision
        assert len(seen.landmarks) > 50
        assert np.median(np.abs(seen.aside_px)) < 1.0
        away = replace(where, world_from_body=Pose(np.eye(3), np.array([900.0, 0.0, 0.0])))
        assert await work.seen(demo.shot(2, 6).image, stored, away) is None
        untracked = replace(pair(), revision=b"untracke")
        assert await work.seen(demo.shot(2, 6).image, untracked, where) is None

    run(check())


def test_an_image_takes_fewer_bytes_where_less_of_it_is_needed(work: MapWork) -> None:
    async def check() -> None:
        image = demo.shot(1).image
        sizes = [
            len(await work.encode_keyframe(image, 60_000, detail))
            for detail in ("all", "fine", "coarse")
        ]
        assert sizes[0] > 1.02 * sizes[1] > 1.02 * 1.5 * sizes[2]
        assert len(await work.encode_keyframe(image, sizes[2] // 2, "coarse")) <= sizes[2] // 2

    run(check())


def test_another_map_is_merged_into_the_one_in_use(work: MapWork) -> None:
    other = demo.encoded_map(1, 2, 3)
    offer = MapOffer.of(BlobKind.MAP, other)

    async def check() -> None:
        built = await work.merged(pair(), offer, {})
        # Drones 1 and 2 are in both, at one instant.
        assert isinstance(built, LandmarkMap), built
        assert built.parent == built.world == revision_of(PAIR)
        assert [k.drone_id for k in built.keyframes] == [1, 2, 3]
        assert [j.revision for j in built.joined] == [revision_of(other)]
        handed = await work.encoded(built, pair())
        assert 0 < len(handed.update) < len(handed.data)
        with pytest.raises(WireError):
            await work.merged(pair(), replace(offer, blob=other[:-7]), {})
        itself = await work.merged(pair(), MapOffer.of(BlobKind.MAP, PAIR), {})
        assert isinstance(itself, NoMap)
        # Images of its own need not come once more.
        trio = replace(
            pair(), revision=revision_of(other), data=other, index=demo.map_index(1, 2, 3)
        )
        standalone = await work.standalone(trio)
        shorter = MapOffer.of(
            BlobKind.MAP_UPDATE,
            without_images(standalone, MapOffer.of(BlobKind.MAP, PAIR).images()),
        )
        assert len(shorter.blob) < 0.5 * len(other)
        assert (shorter.revision, shorter.parent) == (offer.revision, offer.parent)
        assert shorter.images() == offer.images()
        same = await work.merged(pair(), shorter, shorter.images_here({}, pair()))
        assert isinstance(same, LandmarkMap)
        assert encode_map(same) == encode_map(built)
        with pytest.raises(WireError, match="not here"):
            await work.merged(pair(), shorter, {})

    run(check())


def test_a_map_is_read_without_the_images_of_another_one_in_use(work: MapWork) -> None:
    other = demo.encoded_map(1, 2, 3)
    trio = replace(pair(), revision=revision_of(other), data=other, index=demo.map_index(1, 2, 3))

    async def check() -> None:
        standalone = MapOffer.of(BlobKind.MAP_UPDATE, await work.standalone(trio))
        shorter = without_images(standalone.blob, MapOffer.of(BlobKind.MAP, PAIR).images())
        offer = MapOffer.of(BlobKind.MAP_UPDATE, shorter)
        ready = await work.ready(offer, pair(), offer.images_here({}, pair()))
        assert ready.data == other
        assert not ready.contradicts
        with pytest.raises(WireError, match="not here"):
            await work.ready(offer, pair(), {})
        of_it = MapOffer.of(BlobKind.MAP_UPDATE, encode_map_update(other, decode_map(PAIR)))
        assert of_it.needs_parent
        with pytest.raises(ValueError, match="not in use here"):
            await work.ready(of_it, trio, {})

    run(check())


def test_a_frame_is_found_in_a_map_that_was_made_there_or_not(work: MapWork) -> None:
    async def check() -> None:
        shot = demo.shot(2)
        ready = await work.ready(MapOffer.of(BlobKind.MAP, PAIR), None, {})
        for stored in (ready.stored(), replace(pair(), revision=b"another")):
            fix = await work.find(shot.image, stored, None, shot.ned_from_body.rotation, ALL_EFFORT)
            assert isinstance(fix, Localized)
            off = demo.world_from_body(2, 0).local(fix.world_from_body)
            assert np.linalg.norm(off[:3]) < 0.2

    run(check())


def test_further_indexes_share_the_map_that_is_in_use(work: MapWork) -> None:
    async def check() -> None:
        stored = pair()
        index = await work.more_indexed(stored)
        assert index.detector == "akaze"
        assert index.fallback is not None
        assert index.fallback.detector == "orb"
        for one in (index, index.fallback):
            assert one.landmark_map is stored.index.landmark_map
            assert one.uncertainty is stored.index.uncertainty
        np.testing.assert_array_equal(index.owner, stored.index.owner)

    run(check())


def test_images_that_were_looked_at_further_are_not_again(monkeypatch: pytest.MonkeyPatch) -> None:
    shop, stored = workplace(), pair()
    shop.learn(stored)
    whole = workplace()
    whole.learn(stored)
    for number in range(len(stored.index.landmark_map.keyframes)):
        shop.look_further(stored.revision, number)
    monkeypatch.setattr(feature_memory, "detect", None)
    made = shop.more_indexed(stored.revision).fallback
    monkeypatch.undo()
    expected = whole.more_indexed(stored.revision).fallback
    assert made is not None
    assert expected is not None
    np.testing.assert_array_equal(made.entries.descriptors, expected.entries.descriptors)


def test_bad_bytes_are_told_as_such(work: MapWork) -> None:
    async def check() -> None:
        broken = PAIR[:-7]
        with pytest.raises(WireError):
            await work.ready(MapOffer(BlobKind.MAP, broken, b"x" * 8, b""), None, {})
        assert await work.ready(MapOffer.of(BlobKind.MAP, PAIR), None, {})

    run(check())


def test_a_map_of_more_keyframes_than_are_flown_on_is_refused(work: MapWork) -> None:
    made = decode_map(PAIR)
    n = 64 // len(made.keyframes) + 1
    many = replace(
        made,
        keyframes=made.keyframes * n,
        observed_px=np.tile(made.observed_px, (1, n, 1)),
    )

    async def check() -> None:
        with pytest.raises(ValueError, match=r"a map of \d+ keyframes, at most 64"):
            await work.ready(MapOffer.of(BlobKind.MAP, encode_map(many)), None, {})

    run(check())


def test_a_lost_process_is_replaced_by_threads() -> None:
    async def where(work: MapWork) -> int:
        with pytest.raises(ValueError, match=r"^[0-9]+") as told:
            await work._do("maps", "learn", StoredMap(b"", b"where?", demo.map_index(1, 2)))
        return int(str(told.value))

    async def check() -> None:
        work = MapWork(workplace(), forks=True)
        pid = await where(work)
        assert pid != os.getpid()
        await work.ready(MapOffer.of(BlobKind.MAP, PAIR), None, {})
        os.kill(pid, signal.SIGKILL)
        frames = [demo.answer(system_id, 12) for system_id in (1, 2, 3)]
        # It knew this map, its successor does not.
        built = await work.next_revision(pair(), frames, at_once=False)
        assert isinstance(built, LandmarkMap)
        assert await where(work) == os.getpid()
        assert work.pid() is None
        assert work.end() == 0.0

    run(check())
