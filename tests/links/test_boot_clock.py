"""An autopilot's 32 bits of milliseconds, that begin anew after 49.7 days."""

from __future__ import annotations

import asyncio
from typing import Literal

import numpy as np
import pytest

from vcl_companion.clock import ManualClock
from vcl_companion.geometry.rotation import about_down, heading_of
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.boot_clock import BootClock, instant_ns
from vcl_companion.links.messages import AttitudeSample
from vcl_companion.links.timed_attitude import TimedAttitude

MS = 1_000_000
TURN_MS = 1 << 32
DAY_MS = 86_400_000
NOW_NS = 1_400_000_000_000 * MS
RATE_RAD_S = 1.0

Taken = Literal["taken", "overtaken", "rebooted"]


class Flight:
    """An autopilot whose clock says ``began_ms`` in 64 bits as ours says ``NOW_NS``.

    It turns about itself; ATTITUDE follows each ATTITUDE_QUATERNION, stamped 5 ms before it.
    """

    def __init__(self, began_ms: int, *, is_timed: bool) -> None:
        self.clock = ManualClock(NOW_NS)
        self.asked: list[int] = []
        options = AutopilotOptions(link="udp:127.0.0.1:1", attitude_latency_s=0.0)
        self.timed = TimedAttitude(options, self.clock, self.asked.append, lambda: True)
        self.began_ms, self.passed_ms, self.is_timed = began_ms, 0, is_timed
        self.taken: list[Taken] = []

    def restart(self) -> None:
        self.began_ms = 2000 - self.passed_ms

    def flies(self, for_ms: int, step_ms: int = 20) -> None:
        for _ in range(0, for_ms, step_ms):
            self.clock.advance_to(NOW_NS + self.passed_ms * MS)
            self.timed.ask_now()
            if self.is_timed:
                assert self.timed.answered(self.asked[-1], self.boot_ms * MS) is None
            self.say("quaternion", self.passed_ms)
            self.say("euler", self.passed_ms - 5)
            self.passed_ms += step_ms

    def say(self, source: Literal["quaternion", "euler"], at_ms: int) -> None:
        stamp_ms = (self.began_ms + at_ms) % TURN_MS
        turned = about_down(RATE_RAD_S * at_ms * 1e-3)
        self.taken.append(self.timed.take(AttitudeSample(1, 1, stamp_ms, turned, source)))

    @property
    def boot_ms(self) -> int:
        return self.began_ms + self.passed_ms

    def assert_timed(self) -> None:
        """What was said last is known, of its own instants."""
        said_ms = self.passed_ms - 20
        for ago_ms in (0, 10, 25):
            told = self.timed.known(NOW_NS + (said_ms - ago_ms) * MS)
            assert told is not None
            off = heading_of(
                told.ned_from_body @ about_down(-RATE_RAD_S * (said_ms - ago_ms) * 1e-3)
            )
            assert off == pytest.approx(0.0, abs=0.002)
        newest_ns = self.timed.newest_ns()
        assert newest_ns is not None
        assert newest_ns - NOW_NS == pytest.approx(said_ms * MS, abs=MS)
        position_ns = self.timed.instant_ns((self.began_ms + said_ms - 7) % TURN_MS)
        assert position_ns is not None
        assert position_ns - NOW_NS == pytest.approx((said_ms - 7) * MS, abs=MS)


def fly(scenario: Flight, *for_ms: int, restarts: bool = False) -> Flight:
    """Fly, restarting between the parts if it is to; and see that it is timed at each's end."""

    async def flown() -> None:
        for k, part_ms in enumerate(for_ms):
            if restarts and k > 0:
                scenario.restart()
            scenario.flies(part_ms)
            scenario.assert_timed()

    asyncio.run(flown())
    return scenario


@pytest.mark.parametrize("is_timed", [True, False])
def test_stamps_that_begin_anew_are_no_restart(is_timed: bool) -> None:
    flight = Flight(TURN_MS - 3000, is_timed=is_timed)
    taken = fly(flight, 2960, 40, 20, 20, 20, 3000).taken
    assert taken == ["taken"] * len(taken)


@pytest.mark.parametrize("turns", [1, 3])
def test_who_begins_to_listen_after_it_has_the_time_of_timesync(turns: int) -> None:
    """Its answers count on in 64 bits: attitudes had been taken for 49.7 days old."""
    fly(Flight(turns * TURN_MS + 5000, is_timed=True), 2000)


@pytest.mark.parametrize("days", [1, 20, 30, 49, 60])
@pytest.mark.parametrize("is_timed", [True, False])
def test_a_restart_is_one_however_long_it_had_run(days: int, is_timed: bool) -> None:
    flight = fly(Flight(days * DAY_MS, is_timed=is_timed), 1000, 1000, restarts=True)
    assert flight.taken.count("rebooted") == 1


def test_a_restart_after_its_stamps_have_begun_anew_is_one() -> None:
    flight = Flight(TURN_MS - 1000, is_timed=True)
    assert fly(flight, 9000, 1000, restarts=True).taken.count("rebooted") == 1


def test_silence_meanwhile_is_no_restart() -> None:
    flight = Flight(TURN_MS - 3000, is_timed=True)

    async def flown() -> None:
        flight.flies(1000)
        flight.passed_ms += 3_600_000
        flight.flies(1000)
        flight.assert_timed()

    asyncio.run(flown())
    assert "rebooted" not in flight.taken


def test_a_clock_that_is_told_the_time_later_makes_no_turn() -> None:
    """In a replay the first attitude may come before the first instant does."""
    for told_ns in np.linspace(1, 2000 * DAY_MS * MS, 50).astype(np.int64).tolist():
        ours = BootClock()
        assert ours.running_ms(90_000, 0) == 90_000
        assert ours.offset_ns(told_ns - 90_000 * MS, told_ns) == told_ns - 90_000 * MS
        assert ours.running_ms(90_020, told_ns) == 90_020


def test_a_stamp_of_another_message_is_of_about_now() -> None:
    for turns in (-1, 0, 2):
        offset_ns = NOW_NS - 1000 * MS + turns * TURN_MS * MS
        assert instant_ns(980, offset_ns, NOW_NS) == NOW_NS - 20 * MS
        assert instant_ns(TURN_MS - 20, offset_ns, NOW_NS) == NOW_NS - 1020 * MS
