"""Attitudes by our clock: whose north after a restart, and how long one is waited for."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from vcl_companion.clock import ManualClock
from vcl_companion.geometry.rotation import about_down, heading_of
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.messages import AttitudeSample
from vcl_companion.links.timed_attitude import TimedAttitude

MS = 1_000_000
STEP_MS = 20


def heading_deg(
    *, restarts_ms: int | None, turns_ms: int, is_told: bool = True, has_own_north: bool = True
) -> float:
    """Return what is told of an autopilot that says 90 degrees, and 150 from an instant on.

    Its clock says 100 s at first; it may begin anew, which takes it 0.
    """

    async def scenario() -> float:
        clock = ManualClock(1)
        timed = TimedAttitude(
            AutopilotOptions(link="udp:127.0.0.1:1"), clock, lambda _: None,
            lambda: is_told, lambda: has_own_north,
        )  # fmt: skip
        for _ in range(10):
            timed._sync.ask(clock.now_ns())  # never answered: by when attitudes arrive
        for passed_ms in range(0, 60_000, STEP_MS):
            boot_ms = 100_000 + passed_ms
            if restarts_ms is not None and passed_ms >= restarts_ms:
                boot_ms = passed_ms - restarts_ms
                if boot_ms == 0:
                    for _ in range(10):
                        timed._sync.ask(clock.now_ns())
            turn = about_down(np.deg2rad(150.0 if passed_ms >= turns_ms else 90.0))
            clock.advance_to((1000 + passed_ms) * MS)
            timed.take(AttitudeSample(1, 1, boot_ms, turn, "quaternion"))
        told = timed.known(clock.now_ns())
        assert told is not None
        return float(np.rad2deg(heading_of(told.ned_from_body)))

    return asyncio.run(scenario())


@pytest.mark.parametrize("has_own_north", [False, True])
def test_a_north_that_is_turned_in_flight_turns_nobody(has_own_north: bool) -> None:
    told = heading_deg(restarts_ms=None, turns_ms=5000, has_own_north=has_own_north)
    assert told == pytest.approx(90.0, abs=0.1)


def test_a_compass_that_is_taken_in_after_a_restart_says_the_north() -> None:
    """Poses were told before, and go on at once: what was said until then was no heading."""
    told = heading_deg(restarts_ms=5000, turns_ms=7000)
    assert told == pytest.approx(150.0, abs=0.1)


def test_one_without_a_compass_has_the_north_of_its_start_after_a_restart() -> None:
    told = heading_deg(restarts_ms=5000, turns_ms=7000, has_own_north=False)
    assert told == pytest.approx(90.0, abs=0.1)


def test_a_north_that_is_turned_long_after_a_restart_turns_nobody() -> None:
    assert heading_deg(restarts_ms=5000, turns_ms=40_000) == pytest.approx(90.0, abs=0.1)


def test_before_the_first_pose_any_north_is_its_own() -> None:
    told = heading_deg(restarts_ms=None, turns_ms=5000, is_told=False, has_own_north=False)
    assert told == pytest.approx(150.0, abs=0.1)


def timed_by_arrival(clock: ManualClock) -> TimedAttitude:
    """One whose autopilot does not answer questions about time."""
    options = AutopilotOptions(link="udp:127.0.0.1:1", attitude_latency_s=0.0)
    timed = TimedAttitude(options, clock, lambda _: None, lambda: True)
    for _ in range(10):
        timed._sync.ask(clock.now_ns())
    return timed


async def waits_s(timed: TimedAttitude, at_ns: int, n: int) -> list[float]:
    """Return how long so many frames of an instant wait for their attitude, s."""
    loop, waited = asyncio.get_running_loop(), []
    for _ in range(n):
        began_s = loop.time()
        await timed.at(at_ns, 0.1)
        waited.append(loop.time() - began_s)
    return waited


@pytest.mark.parametrize("has_spoken", [False, True])
def test_who_says_nothing_is_not_waited_for_by_every_frame(has_spoken: bool) -> None:
    """A camera of 30 Hz had less than 10 poses a second."""

    async def scenario() -> None:
        clock = ManualClock(1)
        timed = timed_by_arrival(clock)
        clock.advance_to(1000 * MS)
        if has_spoken:
            for boot_ms in (0, 20):
                timed.take(AttitudeSample(1, 1, boot_ms, np.eye(3), "quaternion"))
        clock.advance_to(2000 * MS)
        waited = await waits_s(timed, 2000 * MS, 10)
        assert min(waited[:3]) > 0.09
        assert sum(waited[4:]) < 0.09

    asyncio.run(scenario())


def test_who_speaks_again_is_waited_for_again() -> None:
    async def scenario() -> None:
        clock = ManualClock(1)
        timed = timed_by_arrival(clock)
        await waits_s(timed, 2000 * MS, 5)
        clock.advance_to(1980 * MS)
        timed.take(AttitudeSample(1, 1, 1980, about_down(0.1), "quaternion"))
        frame = asyncio.create_task(timed.at(2000 * MS, 5.0))
        await asyncio.sleep(0.01)
        assert not frame.done()
        clock.advance_to(2000 * MS)
        timed.take(AttitudeSample(1, 1, 2000, about_down(0.2), "quaternion"))
        told = await frame
        assert told is not None
        assert heading_of(told.ned_from_body) == pytest.approx(0.2, abs=0.01)

    asyncio.run(scenario())


def test_a_slow_stream_is_not_taken_for_a_silent_one() -> None:
    """At 2 Hz a frame's wait ends before the next attitude, four times of five."""

    async def scenario() -> None:
        clock = ManualClock(1)
        timed = timed_by_arrival(clock)
        for boot_ms in range(0, 3000, 500):
            clock.advance_to((1000 + boot_ms) * MS)
            timed.take(AttitudeSample(1, 1, boot_ms, np.eye(3), "quaternion"))
        assert min(await waits_s(timed, 3900 * MS, 4)) > 0.09

    asyncio.run(scenario())
