"""From frame to pose over the simulator's stream: every frame is answered once, and in time."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import weakref
from collections import Counter
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sitl.frame_server import FrameServer
from tests.daemon import demo
from tests.daemon.autopilot import Autopilot, autopilot_and_link
from tests.daemon.waiting import beside, hurry, run, until
from vcl_companion.cameras.source import Frame
from vcl_companion.cameras.stream import StreamCamera
from vcl_companion.clock import ManualClock
from vcl_companion.daemon.catching_up import CatchingUp
from vcl_companion.daemon.companion import Companion
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.frame_outcomes import FrameOutcomes
from vcl_companion.daemon.health import Health
from vcl_companion.daemon.inter_target import Asked, InterTarget
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.odometry import Odometry
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.daemon.peer_poses import AskedPeers, PeerPoses
from vcl_companion.daemon.teller import Teller
from vcl_companion.daemon.workshop import WorkOptions, Workshop
from vcl_companion.geometry.rotation import matrix_from_euler, quaternion_from_matrix
from vcl_companion.geometry.similarity import Similarity
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.localization_options import LocalizationOptions
from vcl_companion.localization.map_index import index_map
from vcl_companion.localization.pipeline import PipelineOptions
from vcl_companion.localization.pose_filter import FilterOptions
from vcl_companion.localization.tracking import TrackingOptions
from vcl_companion.mapping.agreement import moved_to
from vcl_companion.mapping.templates import Templates, prepare_templates
from vcl_companion.swarm.group import Group, SwarmOptions
from vcl_companion.swarm.pose_requests import HostChoice, InterMavOptions
from vcl_companion.wire.map_codec import decode_map, encode_map, revision_of
from vcl_companion.wire.messages import MapState
from vcl_companion.wire.pose_messages import PoseProposal

DRONE = 2
FRAMES_ALONE = AutopilotOptions(min_rate_hz=0.0)
OPTIONS = PipelineOptions(demo.FEATURES, LocalizationOptions(), TrackingOptions())


@dataclass(frozen=True, eq=False)
class Flight:
    """One drone's line from camera to autopilot, its camera and its autopilot."""

    companion: Companion
    executor: ThreadPoolExecutor
    peer_poses: PeerPoses
    estimator: Estimator
    outcomes: FrameOutcomes
    clock: ManualClock
    server: FrameServer
    autopilot: Autopilot
    link: AutopilotLink
    maps: MapStore
    history: FrameHistory
    log: FlightLog
    path: Path
    shop: Shop
    asked: list[int]

    def give(self, k: int, sequence: int | None = None, north_turned_rad: float = 0.0) -> None:
        """Hand out the k-th picture, and its attitude before it."""
        shot = demo.shot(DRONE, k)
        turned = matrix_from_euler(0.0, 0.0, north_turned_rad) @ shot.ned_from_body.rotation
        self.autopilot.measure(shot.at_ns, quaternion_from_matrix(turned))
        self.server.give(k if sequence is None else sequence, shot.at_ns, demo.png(shot.image))

    def give_image(self, k: int, png: bytes) -> None:
        """Hand out another picture in the place of the k-th."""
        shot = demo.shot(DRONE, k)
        self.autopilot.measure(shot.at_ns, shot.ned_from_body.quaternion())
        self.server.give(k, shot.at_ns, png)

    @property
    def is_localized(self) -> bool:
        return self.estimator.is_localized(self.clock.now_ns())

    def fly_on_a_map(self) -> None:
        ids = (1, 2, 3)
        patches = demo.templates(*ids)
        self.maps.replace(demo.encoded_map(*ids), demo.map_index(*ids), templates=patches)

    def fly_on_nothing_known(self, tracked: bool = False) -> None:
        """On a map in which no feature is recognised."""
        index = demo.unrecognisable(demo.map_index(1, 2, 3))
        patches = demo.templates(1, 2, 3) if tracked else None
        self.maps.replace(demo.encoded_map(1, 2), index, templates=patches)

    def end_stream(self, k: int) -> None:
        self.server.say_end(demo.shot(DRONE, k).at_ns)

    def lines(self) -> list[dict[str, Any]]:
        """Every line of a frame."""
        lines: list[dict[str, Any]] = list(map(json.loads, self.path.read_text().splitlines()))
        return [line for line in lines if line["kind"] == "frame"]

    def frames(self) -> list[tuple[int, str, str | None]]:
        """Sequence, outcome and reason of every line of a frame."""
        return [(line["sequence"], line["outcome"], line["reason"]) for line in self.lines()]

    def bases(self) -> list[str | None]:
        """What the pose sent for each frame relies on."""
        return [line["by"] for line in self.lines()]


class Shop(Workshop):
    """Searches when it is let."""

    def __init__(self) -> None:
        options = WorkOptions(
            (), demo.MAP_OPTIONS, OPTIONS, ("akaze",), InterMavOptions(detector="akaze"), True
        )
        super().__init__(demo.sensor(DRONE), options)
        self.is_open = threading.Event()
        self.is_open.set()

    def find(self, *asked: Any) -> Localized | NotLocalized:
        assert self.is_open.wait(10.0)
        return super().find(*asked)


def target_of(
    peers: tuple[int, ...], asked: list[int], work: MapWork, clock: ManualClock, us: Estimator
) -> InterTarget:
    """The target's side of inter-MAV localization, with peers on the map who never answer."""
    group = Group(SwarmOptions((*peers, DRONE)), DRONE)
    well = MapState(revision_of(demo.encoded_map(1, 2, 3)), 100, True, tracked=80)
    group.set_own_state(well)
    for peer in peers:
        group.map_state(peer, well, 0.0)

    def hand(peer: int, _: bytes) -> int:
        asked.append(peer)
        return 0

    return InterTarget(
        DRONE, HostChoice(group), demo.sensor(DRONE), clock, work, hand, lambda _: None,
        us.for_peers, lambda _: 0.1, lambda _, __: None,
        InterMavOptions(), np.random.default_rng(0), only_the_surer=True,
    )  # fmt: skip


@contextlib.asynccontextmanager
async def flight(
    path: Path,
    frame_wait_s: float = 0.1,
    coast_s: float = 0.0,
    rates: AutopilotOptions = FRAMES_ALONE,
    peers: tuple[int, ...] = (),
) -> AsyncIterator[Flight]:
    """A companion with everything around it; its own two coroutines do not run yet."""
    first = demo.shot(DRONE)
    clock = ManualClock(first.at_ns)
    async with contextlib.AsyncExitStack() as stack:
        server = FrameServer("mav1")
        port = await server.start()
        stack.push_async_callback(server.close)
        sensor = demo.sensor(DRONE)
        size_px = (sensor.camera.width_px, sensor.camera.height_px)
        camera = StreamCamera("127.0.0.1", port, size_px, clock)
        stack.push_async_callback(camera.close)
        autopilot, link = await stack.enter_async_context(
            autopilot_and_link(DRONE, clock, first.at_ns, first.ned_from_body.quaternion())
        )
        log = stack.enter_context(contextlib.closing(FlightLog(str(path / "log"), clock)))
        executor = stack.enter_context(ThreadPoolExecutor(1))
        shop = Shop()
        work = MapWork(shop, forks=False)
        stack.callback(work.end)
        maps, history = MapStore(""), FrameHistory()
        health = Health(link, log)
        outcomes = FrameOutcomes(camera, clock, health, log)
        camera.left_out = outcomes.undecodable
        motion = FilterOptions(coast_s=coast_s)
        estimator = Estimator(motion, OPTIONS.localization, lambda _: None)
        teller = Teller(link, estimator, clock, log, rates)
        asked: list[int] = []
        inter = target_of(peers, asked, work, clock, estimator)
        peer_poses = PeerPoses(inter, maps, estimator, log)
        own_fixes = OwnFixes(
            sensor, link, maps, estimator, log, executor, OPTIONS, Odometry(sensor, DRONE, work)
        )
        estimator.keep_of(history.has)
        companion = Companion(
            camera, outcomes, own_fixes, CatchingUp(DRONE, history, maps, estimator, own_fixes),
            peer_poses, teller, maps, estimator, history.add, health, work, frame_wait_s,
        )  # fmt: skip
        await stack.enter_async_context(beside(link.run()))
        assert await link.attitudes.at(first.at_ns, 5.0) is not None
        yield Flight(
            companion,
            executor,
            peer_poses,
            estimator,
            outcomes,
            clock,
            server,
            autopilot,
            link,
            maps,
            history,
            log,
            path / "log",
            shop,
            asked,
        )


@contextlib.asynccontextmanager
async def flying(
    path: Path,
    frame_wait_s: float = 0.1,
    coast_s: float = 0.0,
    rates: AutopilotOptions = FRAMES_ALONE,
    peers: tuple[int, ...] = (),
) -> AsyncIterator[Flight]:
    """The same, in flight."""
    async with (
        flight(path, frame_wait_s, coast_s, rates, peers) as up,
        beside(up.companion.read_camera(), up.companion.run()),
    ):
        await up.server.connected()
        yield up


def test_frames_become_poses_near_the_truth(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            assert not up.is_localized
            resets = set()
            for k in range(3):
                up.give(k)
                await up.server.answered()
                pose = await up.autopilot.poses.get()
                usec, sent = pose[0], np.array(pose[1:4])
                assert usec == demo.shot(DRONE, k).at_ns // 1000
                error_m = np.linalg.norm(sent - demo.world_from_body(DRONE, k).translation)
                assert 1e-5 < error_m < 0.15
                resets.add(pose[-1])
            assert len(resets) == 1  # no jump
            assert 0 not in resets
            assert up.is_localized
            assert set(up.server.outcomes.values()) == {"localized"}
            assert up.bases() == ["patches"] * 3
            assert up.frames() == [(k, "localized", None) for k in range(3)]
            newest = up.history.newest
            assert newest is not None
            assert newest.sequence == 2

    run(scenario())


def test_a_frame_whose_image_cannot_be_decoded_is_refused_and_logged(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            for k in range(3):
                if k == 1:
                    up.give_image(k, b"nonsense")
                else:
                    up.give(k)
                await up.server.answered()
            assert up.frames() == [
                (0, "localized", None),
                (1, "refused", "undecodable image"),
                (2, "localized", None),
            ]
            # It was no frame that the camera's driver dropped.
            assert up.log.frames == {"localized": 2, "refused": 1, "dropped": 0}

    run(scenario())


def test_a_camera_that_has_frozen_does_not_hold_the_drone_back(tmp_path: Path) -> None:
    """The image that it gives again is found on the map as surely as when it was taken."""

    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            for k in range(11):
                if k in (7, 8, 9):
                    up.give_image(k, demo.png(demo.shot(DRONE, 6).image))
                else:
                    up.give(k)
                await up.server.answered()
            why = "the camera gives the same image again"
            assert up.frames() == [
                *((k, "localized", None) for k in range(7)),
                *((k, "refused", why) for k in (7, 8, 9)),
                (10, "localized", None),
            ]
            told_us = [(await up.autopilot.poses.get())[0] for _ in range(8)]
            assert told_us == [demo.shot(DRONE, k).at_ns // 1000 for k in (*range(7), 10)]
            assert not any(up.history.has(demo.shot(DRONE, k).at_ns) for k in (7, 8, 9))

    run(scenario())


def test_an_image_of_before_is_not_believed_nor_are_peers_asked(tmp_path: Path) -> None:
    """As the end of a torn one may be; from frame to frame it flies half a metre."""

    async def scenario() -> None:
        async with flying(tmp_path, peers=(1, 3)) as up:
            up.fly_on_a_map()
            shown = [12, 15, 18, 21, 24, 27, 30, 30, 36, 39]
            instants = [demo.shot(DRONE, k).at_ns for k in range(len(shown))]
            for n, (k, at_ns) in enumerate(zip(shown, instants, strict=True)):
                there = demo.shot(DRONE, k)
                image = there.image.copy()
                image[0, 0] = n  # no frozen camera's
                up.autopilot.measure(at_ns, there.ned_from_body.quaternion())
                up.server.give(n, at_ns, demo.png(image))
                await up.server.answered()
            back = "0.6 m back, where an earlier frame was"
            assert up.frames() == [
                *((n, "localized", None) for n in range(7)),
                (7, "refused", back),
                *((n, "localized", None) for n in (8, 9)),
            ]
            assert up.asked == []
            assert up.estimator.n_resets == 0
            told_us = [(await up.autopilot.poses.get())[0] for _ in range(9)]
            assert told_us == [at_ns // 1000 for n, at_ns in enumerate(instants) if n != 7]

    run(scenario())


def test_a_frame_waits_for_the_first_map_and_is_then_localized(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.give(0)
            assert await up.autopilot.texts.get() == "VCL waiting for a map"
            assert up.server.outcomes == {}
            up.fly_on_a_map()
            await up.server.answered()
            assert up.server.outcomes == {0: "localized"}
            assert up.frames() == [(0, "localized", None)]

    run(scenario())


def test_a_newer_frame_takes_the_place_of_the_one_that_waits(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(4):
                up.give(k)
            await until(lambda: len(up.server.outcomes) == 3)
            assert up.server.outcomes == {0: "refused", 1: "refused", 2: "refused"}
            up.fly_on_a_map()
            await up.server.answered()
            assert up.server.outcomes[3] == "localized"
            assert sorted(up.frames()) == [
                *((k, "refused", "no map: none yet") for k in range(3)),
                (3, "localized", None),
            ]

    run(scenario())


def test_a_refused_map_answers_the_frame_with_its_reason(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.give(0)
            assert await up.autopilot.texts.get() == "VCL waiting for a map"
            up.maps.refuse("fog")
            await up.server.answered()
            up.give(1)
            await until(lambda: up.history.newest is not None and up.history.newest.sequence == 1)
            assert up.frames() == [(0, "refused", "no map: fog")]
            up.fly_on_a_map()
            await up.server.answered()
            assert up.server.outcomes == {0: "refused", 1: "localized"}

    run(scenario())


def in_another_world() -> Callable[[Flight], None]:
    """Return what joins a flight's world with one whose origin is 20 m away."""
    other_from_ours = Similarity(np.eye(3), np.array([20.0, -8.0, 0.0]))
    moved = moved_to(decode_map(demo.encoded_map(1, 2, 3)), other_from_ours)
    index = index_map(moved, "akaze", demo.FEATURES)
    patches = prepare_templates(moved, index.uncertainty)

    def join(up: Flight) -> None:
        up.estimator.carry(other_from_ours)
        up.maps.replace(encode_map(moved), index, templates=patches)

    return join


async def told_where_it_is(up: Flight, k: int) -> None:
    """Wait for the k-th frame's answer: whatever its world, the autopilot's is the same."""
    await up.server.answered()
    pose = await up.autopilot.poses.get()
    truth = demo.world_from_body(DRONE, k).translation
    assert np.linalg.norm(np.array(pose[1:4]) - truth) < 0.1


def test_what_was_looked_at_in_a_world_that_was_left_is_looked_at_again(tmp_path: Path) -> None:
    join = in_another_world()

    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            executor = up.executor
            looks = threading.Barrier(2)
            for k in range(6):
                if k == 3:
                    executor.submit(looks.wait, 20.0)
                    await until(lambda: looks.n_waiting == 1)
                up.give(k)
                if k == 3:
                    await until(lambda: executor._work_queue.qsize() == 1)
                    join(up)
                    looks.wait(20.0)
                await told_where_it_is(up, k)
            assert [outcome for _, outcome, _ in up.frames()] == ["localized"] * 6

    run(scenario())


class Doubting(Odometry):
    """Has every frame looked at by our own last ones too, which tell no more."""

    def __init__(self, up: Flight) -> None:
        super().__init__(demo.sensor(DRONE), DRONE, MapWork(up.shop, forks=False))
        self.is_asked: Callable[[], object] = lambda: None

    def templates_in(self, world: tuple[bytes, int]) -> Templates:
        return demo.templates(1, 2, 3)

    def may_tell_more(self, on_map: Localized | NotLocalized) -> bool:
        self.is_asked()
        return True

    def tells_more(self, own: Localized, on_map: Localized | NotLocalized) -> bool:
        return False


def test_a_world_that_is_left_while_own_frames_are_looked_at_is_left(tmp_path: Path) -> None:
    join = in_another_world()

    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.companion._own_fixes._odometry = doubting = Doubting(up)
            executor, looks = up.executor, threading.Barrier(2)
            for k in range(6):
                up.give(k)
                if k == 3:
                    doubting.is_asked = lambda: executor.submit(looks.wait, 20.0)
                    await until(lambda: looks.n_waiting == executor._work_queue.qsize() == 1)
                    doubting.is_asked = lambda: None
                    join(up)
                    looks.wait(20.0)
                await told_where_it_is(up, k)
            assert [outcome for _, outcome, _ in up.frames()] == ["localized"] * 6

    run(scenario())


def test_what_was_searched_in_a_world_that_was_left_is_searched_again(tmp_path: Path) -> None:
    join = in_another_world()

    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.estimator._history.clear()
            up.shop.is_open.clear()
            up.give(0)
            await until(lambda: up.companion._map_search.is_under_way)
            join(up)
            up.shop.is_open.set()
            await up.server.answered()
            state = up.estimator.own_fix_at(demo.shot(DRONE, 0).at_ns)
            assert state is not None
            there = demo.world_from_body(DRONE, 0).translation + np.array([20.0, -8.0, 0.0])
            assert np.linalg.norm(state.world_from_body.translation - there) < 0.1

    run(scenario())


def asked_and_said(
    stored: StoredMap, frame: Frame, refused: NotLocalized | None
) -> tuple[AskedPeers, PoseProposal]:
    """What drone 1 is asked of the first frame, and what it says of it."""
    attitude = demo.shot(DRONE, 0).ned_from_body.rotation
    asked = Asked(1, frame, attitude, stored.revision, np.inf, {1}, [])
    there = demo.world_from_body(DRONE, 0)
    return (
        AskedPeers(asked, weakref.ref(stored), stored.world, np.zeros((1, 3)), refused),
        PoseProposal.of(1, stored.revision, there, 1e-4 * np.eye(6)),
    )


def test_what_peers_said_is_not_told_when_its_world_is_left_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    join = in_another_world()

    async def scenario() -> None:
        async with flight(tmp_path) as up:
            up.fly_on_a_map()
            stored = up.maps.current
            assert stored is not None
            coming = asyncio.ensure_future(anext(up.outcomes._camera.frames()))
            await up.server.connected()
            up.give(0)
            frame = await coming
            up.outcomes.opened(frame)
            before, said = asked_and_said(stored, frame, NotLocalized("fog"))

            async def hear(asked_peers: AskedPeers) -> FilterState | None:
                return up.peer_poses.fuse(1, said, asked_peers)

            monkeypatch.setattr(up.peer_poses, "hear", hear)
            executor, looks = up.executor, threading.Barrier(2)
            executor.submit(looks.wait, 20.0)
            hearing = asyncio.create_task(up.companion._hear_peers(before))
            await until(lambda: looks.n_waiting == executor._work_queue.qsize() == 1)
            join(up)
            looks.wait(20.0)
            await hearing
            told = "peers told a place in a world that was left since"
            assert up.frames() == [(0, "refused", told)]
            assert up.autopilot.poses.empty()

    run(scenario())


def test_what_peers_say_of_a_world_that_was_left_is_not_believed(tmp_path: Path) -> None:
    join = in_another_world()

    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            stored = up.maps.current
            assert stored is not None
            shot = demo.shot(DRONE, 0)
            before, said = asked_and_said(stored, Frame(shot.image, shot.at_ns, 0, 0), None)
            join(up)
            assert up.peer_poses.fuse(1, said, before) is None
            assert up.estimator.sigma_m == np.inf

    run(scenario())


def test_the_end_of_the_stream_answers_all_that_waits(tmp_path: Path) -> None:
    async def scenario() -> None:
        for n_frames in (0, 1, 3):
            async with flight(tmp_path) as up, beside(up.companion.run()):
                reading = asyncio.create_task(up.companion.read_camera())
                await up.server.connected()
                for k in range(n_frames):
                    up.give(k)
                up.end_stream(max(n_frames - 1, 0))
                began_s = asyncio.get_running_loop().time()
                await reading
                assert asyncio.get_running_loop().time() - began_s < 3.0
                await up.server.answered()
                assert [outcome for _, outcome, _ in up.frames()] == ["refused"] * n_frames
                if n_frames:
                    assert up.frames()[-1][2] == "no map: the camera's stream is over"

    run(scenario())


def test_the_end_of_the_stream_leaves_time_for_the_last_frame(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flight(tmp_path) as up, beside(up.companion.run()):
            up.fly_on_a_map()
            reading = asyncio.create_task(up.companion.read_camera())
            await up.server.connected()
            up.give(0)
            up.end_stream(0)
            await reading
            assert up.frames() == [(0, "localized", None)]

    run(scenario())


def test_frames_faster_than_they_can_be_localized_are_dropped_and_counted(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.give(0)
            await up.server.answered()
            for k in range(1, 8):
                up.give(k)
            await up.server.answered()
            counts = Counter(up.server.outcomes.values())
            assert sum(counts.values()) == 8
            # On a machine that is busy one between may be too far from the last for patches.
            looked_at = counts["localized"] + counts["refused"]
            assert 2 <= counts["localized"] <= looked_at <= 7
            assert counts["dropped"] == 8 - looked_at
            assert up.server.outcomes[7] == "localized"  # fresh beats complete
            assert up.log.frames == {"refused": 0, **counts}
            assert sorted(sequence for sequence, _, _ in up.frames()) == list(range(8))

    run(scenario())


def test_frames_that_never_reached_us_are_counted(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.give(0, sequence=3)  # it numbers them with gaps
            await until(lambda: 3 in up.server.outcomes)
            up.give(1, sequence=7)
            await until(lambda: 7 in up.server.outcomes)
            assert up.log.frames == {"localized": 2, "refused": 0, "dropped": 3}

    run(scenario())


def test_a_frame_the_map_does_not_know_is_localized_on_the_next_one(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, frame_wait_s=60.0) as up:
            up.fly_on_nothing_known()
            up.give(0)
            await until(lambda: up.estimator.in_sight.tracked == 0 and up.maps.current is not None)
            up.fly_on_a_map()
            await up.server.answered()
            assert up.frames() == [(0, "localized", None)]

    run(scenario())


def test_a_newer_frame_ends_the_wait_for_the_next_map(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, frame_wait_s=60.0) as up:
            up.fly_on_nothing_known()
            up.give(0)
            up.give(1)
            await until(lambda: 0 in up.server.outcomes)
            up.fly_on_a_map()
            await up.server.answered()
            (first, outcome, _), second = up.frames()
            assert first == 0
            assert outcome in ("refused", "dropped")
            assert second == (1, "localized", None)

    run(scenario())


def test_a_frame_that_is_looked_for_leads_those_that_came_meanwhile(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.shop.is_open.clear()
            for k, shot in enumerate(demo.shot(DRONE, k) for k in range(4)):
                up.give(k)
                await until(partial(up.estimator.in_sight.has_looked_at, shot.at_ns))
            assert up.frames() == []
            assert up.estimator.in_sight.seen_on == b""  # what the map lacks cannot be said yet
            assert up.estimator.in_sight.sought_since_s is not None
            up.shop.is_open.set()
            await up.server.answered()
            assert sorted(up.frames()) == [(k, "localized", None) for k in range(4)]
            assert up.estimator.in_sight.seen_on != b""
            assert up.estimator.in_sight.sought_since_s is None
            # Which speed that is nobody knew before; the next one is found at once.
            up.shop.is_open.clear()
            up.give(4)
            await up.server.answered()
            assert up.frames()[-1] == (4, "localized", None)

    run(scenario())


def test_peers_are_asked_where_a_search_takes_long_and_not_before(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path, peers=(1,)) as up:
            up.fly_on_a_map()
            up.shop.is_open.clear()
            for k, shot in enumerate(demo.shot(DRONE, k) for k in range(3)):
                up.give(k)
                await until(partial(up.estimator.in_sight.has_looked_at, shot.at_ns))
            assert up.asked == []
            hurry(0.6)
            up.give(3)
            await until(lambda: up.asked == [1])
            up.shop.is_open.set()
            await up.server.answered()
            assert [up.server.outcomes[k] for k in (0, 1, 3)] == ["localized"] * 3

    run(scenario())


def test_of_many_frames_that_came_during_a_search_every_second_is_let_go(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.shop.is_open.clear()
            for k, shot in enumerate(demo.shot(DRONE, k) for k in range(20)):
                up.give(k)
                await until(partial(up.estimator.in_sight.has_looked_at, shot.at_ns))
            await until(lambda: len(up.frames()) == 8)
            reason = "lost, and not looked for again yet"
            assert up.frames() == [(k, "refused", reason) for k in range(2, 18, 2)]
            up.shop.is_open.set()
            await up.server.answered()
            assert [up.server.outcomes[k] for k in (0, 1, 3, 17, 18, 19)] == ["localized"] * 6

    run(scenario())


def test_a_search_in_vain_that_others_overtook_leaves_time_for_them(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_nothing_known(tracked=True)
            up.shop.is_open.clear()
            up.give(0)
            await until(lambda: up.estimator.in_sight.has_looked_at(demo.shot(DRONE, 0).at_ns))
            up.give(1)
            await until(lambda: up.estimator.in_sight.has_looked_at(demo.shot(DRONE, 1).at_ns))
            await asyncio.sleep(0.3)  # so long it takes, and so long is not looked again
            up.shop.is_open.set()
            await up.server.answered()
            reasons = {sequence: reason for sequence, _, reason in up.frames()}
            assert reasons[1] == "lost, and not looked for again yet"
            assert reasons[0]
            assert reasons[0] != reasons[1]
            # Another map is searched at once.
            up.fly_on_a_map()
            up.give(2)
            await up.server.answered()
            assert up.frames()[-1] == (2, "localized", None)

    run(scenario())


def test_a_picture_without_anything_in_it_is_refused_with_a_reason(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.server.give(0, demo.shot(DRONE).at_ns, demo.png(demo.blank(DRONE)))
            await up.server.answered()
            ((sequence, outcome, reason),) = up.frames()
            assert (sequence, outcome) == (0, "refused")
            assert reason
            assert up.autopilot.poses.empty()
            assert not up.is_localized
            assert (await up.autopilot.texts.get()) == f"VCL waiting: {reason}"

    run(scenario())


def test_frames_that_show_nothing_are_bridged_by_attitude_and_motion_for_a_while(
    tmp_path: Path,
) -> None:
    """Less and less certain; then nothing is sent, then a fix again."""

    async def scenario() -> None:
        async with flying(tmp_path, coast_s=1.0) as up:
            up.fly_on_a_map()
            fog, shows = demo.png(demo.blank(DRONE)), [*range(6), 11]
            for k in range(12):
                if k in shows:
                    up.give(k)
                else:
                    up.give_image(k, fog)
                await up.server.answered()
            outcomes = [outcome for _, outcome, _ in up.frames()]
            assert outcomes == ["localized"] * 6 + ["refused"] * 5 + ["localized"]
            bases = up.bases()
            n_bridged = bases.count("motion")
            assert bases[6 : 6 + n_bridged] == ["motion"] * n_bridged
            assert 2 <= n_bridged <= 4
            assert bases[6 + n_bridged : 11] == [None] * (5 - n_bridged)
            sigmas = []
            for k in range(6 + n_bridged):
                usec, *sent = await up.autopilot.poses.get()
                assert usec == demo.shot(DRONE, k).at_ns // 1000
                variances = np.array(sent[6:27])[[0, 6, 11]]
                off_m = np.array(sent[:3]) - demo.world_from_body(DRONE, k).translation
                sigmas.append(float(np.sqrt(variances.max())))
                assert np.all(np.abs(off_m) < 4.0 * np.sqrt(variances))
            assert np.all(np.diff(sigmas[5:]) > 0.03)
            assert sigmas[-1] < LocalizationOptions().max_sigma_m
            assert (await up.autopilot.poses.get())[0] == demo.shot(DRONE, 11).at_ns // 1000
            assert bases[11] == "patches"

    run(scenario())


def test_what_nobody_has_measured_is_not_sent_unless_that_is_wanted(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            fog = demo.png(demo.blank(DRONE))
            for k in range(6):
                if k == 4:
                    up.give_image(k, fog)
                else:
                    up.give(k)
                await up.server.answered()
            assert up.bases() == ["patches"] * 4 + [None, "patches"]
            times = [(await up.autopilot.poses.get())[0] for _ in range(5)]
            assert times == [demo.shot(DRONE, k).at_ns // 1000 for k in (0, 1, 2, 3, 5)]

    run(scenario())


def test_an_autopilot_that_turns_its_north_is_followed_after_a_few_frames(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            for k in range(8):
                up.give(k, north_turned_rad=0.0 if k < 2 else np.deg2rad(22.0))
                await up.server.answered()
            outcomes = [outcome for _, outcome, _ in up.frames()]
            assert outcomes == ["localized"] * 2 + ["refused"] * 4 + ["localized"] * 2
            assert "against the autopilot's attitude" in str(up.frames()[2][2])
            resets = [(await up.autopilot.poses.get())[-1] for _ in range(4)]
            assert [after - resets[0] for after in resets] == [0, 0, 1, 1]
            # Frames that contradict the state: it is not sent on its own word.
            assert up.bases() == ["patches"] * 2 + [None] * 4 + ["patches"] * 2

    run(scenario())


def test_an_autopilot_whose_attitude_errs_for_a_moment_costs_no_frame(tmp_path: Path) -> None:
    """Nearly all patches of the map agree on where it is: the autopilot errs, and then does not."""

    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            for k in range(8):
                up.give(k, north_turned_rad=np.deg2rad(12.0) if 2 <= k < 5 else 0.0)
                await up.server.answered()
            assert [outcome for _, outcome, _ in up.frames()] == ["localized"] * 8
            assert up.bases() == ["patches"] * 8
            resets = [(await up.autopilot.poses.get())[-1] for _ in range(8)]
            assert len(set(resets)) == 1

    run(scenario())


def test_a_fix_of_long_ago_is_no_place_any_more(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.give(0)
            await up.server.answered()
            assert up.is_localized
            up.server.tell_time(demo.shot(DRONE).at_ns + 2_100_000_000)
            await until(lambda: not up.is_localized)

    run(scenario())


def test_what_is_open_when_the_service_ends_is_answered_then(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flight(tmp_path) as up:
            async with beside(up.companion.read_camera(), up.companion.run()):
                await up.server.connected()
                up.give(0)
                assert await up.autopilot.texts.get() == "VCL waiting for a map"
            assert up.frames() == []
            up.outcomes.end()
            await up.server.answered()
            assert up.frames() == [(0, "refused", "the service has ended")]
            up.outcomes.end()
            assert len(up.frames()) == 1

    run(scenario())
