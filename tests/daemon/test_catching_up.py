"""Who is lost beyond what the map shows: what the next map is made of, and what that finds."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.daemon import demo
from tests.daemon.test_companion import DRONE, Flight, flying
from tests.daemon.waiting import run, until
from vcl_companion.daemon.frame_choice import FrameChoice
from vcl_companion.localization.filter_state import FilterState

FOUND, LOST = (0, 1), (2, 3, 4)
NO_MAP = "no map: none yet"


def at_ns(k: int) -> int:
    return demo.shot(DRONE, k).at_ns


@asynccontextmanager
async def lost(path: Path) -> AsyncIterator[Flight]:
    """A drone that was localized at ``FOUND`` and not at ``LOST``, on a map that shows nothing."""
    async with flying(path) as up:
        for frames, fly, outcome in (
            (FOUND, up.fly_on_a_map, "localized"),
            (LOST, up.fly_on_nothing_known, "refused"),
        ):
            fly()
            for k in frames:
                up.give(k)
                await up.server.answered()
                assert up.server.outcomes[k] == outcome
        yield up


def chosen(up: Flight) -> FrameChoice:
    return FrameChoice(DRONE, up.history, up.maps, up.estimator, up.clock)


def test_what_was_lost_is_followed_on_the_next_map_up_to_the_newest(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with lost(tmp_path) as up:
            n_told = up.autopilot.poses.qsize()
            up.fly_on_a_map()
            await until(lambda: up.estimator.own_fix_at(at_ns(LOST[-1])) is not None)
            for k in LOST:
                state = up.estimator.own_fix_at(at_ns(k))
                assert state is not None
                off = demo.world_from_body(DRONE, k).local(state.world_from_body)
                assert np.linalg.norm(off[:3]) < 0.05
            # Nobody is told where it was.
            assert up.autopilot.poses.qsize() == n_told
            assert [outcome for _, outcome, _ in up.frames()] == (
                ["localized"] * len(FOUND) + ["refused"] * len(LOST)
            )

    run(scenario())


def test_who_had_no_fix_yet_goes_on_from_its_keyframe_where_no_features_are(
    tmp_path: Path,
) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            for k in range(4):
                up.give(k)
                await until(lambda k=k: up.history.has(at_ns(k)))  # type: ignore[misc]
                await until(lambda k=k: len(up.frames()) == k)  # type: ignore[misc]
            assert up.frames() == [(k, "refused", NO_MAP) for k in range(3)]
            up.fly_on_nothing_known(tracked=True)
            await up.server.answered()
            assert up.server.outcomes[3] == "localized"
            for k in (0, 3):
                state = up.estimator.own_fix_at(at_ns(k))
                assert state is not None
                off = demo.world_from_body(DRONE, k).local(state.world_from_body)
                assert np.linalg.norm(off[:3]) < 0.05
            assert up.autopilot.poses.qsize() == 1  # of the newest
            lines = map(json.loads, up.path.read_text().splitlines())
            told = [line["captured_at_ns"] for line in lines if line["kind"] == "estimate"]
            assert sorted(set(told)) == sorted(told)  # each counts once

    run(scenario())


def test_what_was_forgotten_is_not_begun_with(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            for k in range(2):
                up.give(k)
                await up.server.answered()
            up.estimator.forget()
            up.fly_on_nothing_known(tracked=True)
            for k in range(2, 4):
                up.give(k)
                await up.server.answered()
            assert [up.server.outcomes[k] for k in range(4)] == ["localized"] * 2 + ["refused"] * 2
            assert up.estimator.own_fix_at(at_ns(0)) is None

    run(scenario())


def test_a_map_is_extended_by_the_last_frame_that_was_found(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with lost(tmp_path) as up:
            frame = await chosen(up).of(at_ns(LOST[-1]))
            assert frame is not None
            assert frame.captured_at_ns == at_ns(FOUND[-1])
            up.fly_on_a_map()
            await until(lambda: up.estimator.own_fix_at(at_ns(LOST[-1])) is not None)
            for k in (*FOUND, *LOST):
                frame = await chosen(up).of(at_ns(k))
                assert frame is not None
                assert frame.captured_at_ns == at_ns(k)

    run(scenario())


@pytest.mark.parametrize(("n_inliers", "extended_by"), [(30, FOUND[-1]), (60, LOST[0])])
def test_a_map_is_not_extended_by_a_frame_that_shows_little_of_it(
    tmp_path: Path, n_inliers: int, extended_by: int
) -> None:
    async def scenario() -> None:
        async with lost(tmp_path) as up:
            well = up.estimator.fix_at(at_ns(FOUND[-1]))
            assert well is not None
            assert well.shows_well
            there = demo.world_from_body(DRONE, LOST[0])
            fix = replace(well, world_from_body=there, n_inliers=n_inliers)
            taken = up.estimator.take_fix(None, fix, at_ns(LOST[0]), None)
            assert isinstance(taken, FilterState)
            frame = await chosen(up).of(at_ns(LOST[-1]))
            assert frame is not None
            assert frame.captured_at_ns == at_ns(extended_by)

    run(scenario())


def test_a_frame_that_the_map_has_already_is_not_given_again(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            up.fly_on_a_map()
            up.give(0)
            await up.server.answered()
            up.fly_on_nothing_known()
            assert up.maps.current is not None
            known = up.maps.current.index.landmark_map.keyframes
            assert (DRONE, at_ns(0)) in [(k.drone_id, k.captured_at_ns) for k in known]
            up.give(1)
            await up.server.answered()
            frame = await chosen(up).of(at_ns(1))
            assert frame is not None
            assert frame.captured_at_ns == at_ns(1)

    run(scenario())


def test_keyframes_of_before_a_reboot_are_no_newer_than_any_frame(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with lost(tmp_path) as up:
            stored = up.maps.current
            assert stored is not None
            known = stored.index.landmark_map
            old = tuple(
                replace(k, drone_id=DRONE, captured_at_ns=at_ns(LOST[-1]) + 10**12)
                for k in known.keyframes
            )
            index = replace(stored.index, landmark_map=replace(known, keyframes=old))
            up.maps.replace(stored.data, index)
            frame = await chosen(up).of(at_ns(LOST[-1]))
            assert frame is not None
            assert frame.captured_at_ns == at_ns(FOUND[-1])

    run(scenario())


@pytest.mark.parametrize("k", [0, 1])
def test_without_a_map_it_is_the_frame_of_the_instant(tmp_path: Path, k: int) -> None:
    async def scenario() -> None:
        async with flying(tmp_path) as up:
            assert await chosen(up).of(at_ns(k)) is None
            for given in (0, 1):
                up.give(given)
            await until(lambda: up.history.newest is not None and len(up.history.after(0)) == 2)
            frame = await chosen(up).of(at_ns(k))
            assert frame is not None
            assert frame.captured_at_ns == at_ns(k)

    run(scenario())
