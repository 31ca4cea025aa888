"""The autopilot's attitudes by our clock: what has come of them, and whose time is whose.

By TIMESYNC, asked often until its offset is known well; where nobody answers, by when attitudes
arrive.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from vcl_companion.clock import Clock
from vcl_companion.links.attitude import Attitude, AttitudeHistory
from vcl_companion.links.autopilot_options import AutopilotOptions
from vcl_companion.links.boot_clock import BootClock, instant_ns
from vcl_companion.links.messages import AttitudeSample
from vcl_companion.links.timesync import TimesyncEstimator

_log = logging.getLogger(__name__)

# Questions come quickly until the estimate has enough to choose from.
_SYNC_FAST_S, _SYNC_SLOW_S = 0.1, 1.0
_SYNC_ENOUGH = 8
# After this many unanswered questions (1 s) the autopilot does without TIMESYNC.
_SYNC_GIVEN_UP = 10
# After so many usual periods of waiting in vain, and within these bounds, s, attitudes are silent.
_SILENT_PERIODS = 3.0
_SILENT_S, _LONGEST_SILENT_S = 0.3, 1.0
# A compass is taken in some seconds after the start.
_FINDS_NORTH_MS = 20_000


class TimedAttitude:
    """Attitudes at instants of our clock; everything happens in the event loop's thread.

    Args:
        options: how late and how old samples may be.
        clock: ours.
        ask: sends a TIMESYNC question, ns by our clock.
        is_told: whether the autopilot has been told poses: what it turns its north by before is
            its own.
        has_own_north: whether, as far as is known, its heading is by a compass: one that has
            restarted finds that anew soon, told poses or not, and what it said before was none.
    """

    def __init__(
        self,
        options: AutopilotOptions,
        clock: Clock,
        ask: Callable[[int], None],
        is_told: Callable[[], bool],
        has_own_north: Callable[[], bool] = lambda: False,
    ) -> None:
        latency_ns = round(options.attitude_latency_s * 1e9)
        max_age_ns = round(options.max_attitude_age_s * 1e9)
        self._by_quaternion = AttitudeHistory(latency_ns, max_age_ns)
        self._by_euler = AttitudeHistory(latency_ns, max_age_ns)
        self._clock = clock
        self._ask = ask
        self._is_told = is_told
        self._has_own_north = has_own_north
        self._has_restarted = False
        self._boot_clock = BootClock()
        self._sync = TimesyncEstimator()
        self._asked_at_s = -math.inf
        self._news = asyncio.Event()
        self._in_vain_s = 0.0

    @property
    def round_trip_s(self) -> float | None:
        """Shortest recent TIMESYNC round trip, s; None without one."""
        return self._sync.round_trip_s

    @property
    def rate_hz(self) -> float:
        """How often ATTITUDE_QUATERNION came in the last seconds, Hz."""
        return self._by_quaternion.rate_hz

    async def run(self) -> None:
        """Ask what time it is until cancelled."""
        while True:
            await asyncio.sleep(_SYNC_FAST_S)
            settled = self._sync.n_exchanges >= _SYNC_ENOUGH
            hopeless = self._sync.unanswered >= _SYNC_GIVEN_UP
            self._ask_if_due(_SYNC_SLOW_S if settled or hopeless else _SYNC_FAST_S)

    async def at(self, at_ns: int, wait_s: float) -> Attitude | None:
        """Return the attitude at an instant of our clock.

        Waits until a sample at or after the instant has come, ``wait_s`` at most,
        then takes what there is: None when nothing lies within the option
        ``max_attitude_age_s``, or while it is not known yet whose time is whose.
        Who has waited in vain for a while waits no more until one comes: a camera's
        rate must not fall to what an autopilot that says nothing leaves of it.
        """
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + (0.0 if self._is_silent else wait_s)
        while True:
            offset_ns = self.offset_ns(at_ns)
            if offset_ns is not None and self._history(at_ns, offset_ns).covers(at_ns, offset_ns):
                break
            if offset_ns is None:
                self._ask_if_due(_SYNC_FAST_S)
            remaining_s = deadline_s - loop.time()
            if remaining_s <= 0.0:
                break
            try:
                async with asyncio.timeout(remaining_s):
                    await self._news.wait()
            except TimeoutError:
                self._in_vain_s += remaining_s
                break
        # A good moment to ask: in a replay the clocks of all processes stand together now.
        self._ask_if_due(_SYNC_SLOW_S)
        return self.known(at_ns)

    def known(self, at_ns: int) -> Attitude | None:
        """Return the attitude at an instant of our clock by what has come; see ``at``."""
        offset_ns = self.offset_ns(at_ns)
        if offset_ns is None:
            return None
        return self._history(at_ns, offset_ns).at(at_ns, offset_ns)

    async def news(self) -> None:
        """Wait until the autopilot says how it is turned, or what time it is."""
        await self._news.wait()

    def newest_ns(self) -> int | None:
        """Return the instant of the newest attitude, our clock; None while it is not known."""
        now_ns = self._clock.now_ns()
        offset_ns = self.offset_ns(now_ns)
        return None if offset_ns is None else self._history(now_ns, offset_ns).newest_ns(offset_ns)

    def offset_ns(self, at_ns: int) -> int | None:
        """Return our clock minus that of attitudes; None while an answer may still come."""
        offset_ns = self._sync.offset_ns(at_ns)
        if offset_ns is not None:
            return self._boot_clock.offset_ns(offset_ns, self._clock.now_ns())
        if self._sync.unanswered >= _SYNC_GIVEN_UP:
            offset_ns = self._by_quaternion.offset_by_arrival_ns()
            if offset_ns is None:
                offset_ns = self._by_euler.offset_by_arrival_ns()
        return offset_ns

    def instant_ns(self, time_boot_ms: int) -> int | None:
        """Return when another message that has just come was stamped; None: not known yet."""
        now_ns = self._clock.now_ns()
        offset_ns = self.offset_ns(now_ns)
        return None if offset_ns is None else instant_ns(time_boot_ms, offset_ns, now_ns)

    def answered(self, asked_ns: int, theirs_ns: int) -> str | None:
        """Take the answer to a question in; return why it is refused, if it is."""
        refusal = self._sync.answered(asked_ns, theirs_ns, self._clock.now_ns())
        self._wake()
        return refusal

    def take(self, sample: AttitudeSample) -> Literal["taken", "overtaken", "rebooted"]:
        """Take a sample in; say when it came late, or tells that the autopilot has restarted.

        What was known of one before its restart is forgotten.
        """
        self._in_vain_s = 0.0
        now_ns = self._clock.now_ns()
        is_young = sample.time_boot_ms < _FINDS_NORTH_MS
        self._has_restarted = self._has_restarted and is_young
        running_ms = self._boot_clock.running_ms(sample.time_boot_ms, now_ns)
        sample = replace(sample, time_boot_ms=running_ms)
        quaternion = sample.source == "quaternion"
        history = self._by_quaternion if quaternion else self._by_euler
        taken = history.add(sample, now_ns)
        if taken == "turned":
            degrees = math.degrees(history.north_rad)
            is_new = self._has_restarted and self._has_own_north()
            if self._is_told() and not is_new:
                _log.info("the autopilot has turned its north, by %.1f degrees so far", degrees)
            else:
                history.take_its_north()
                _log.info("the autopilot has found its north, by %.1f degrees", degrees)
        elif taken == "rebooted":
            self._has_restarted = is_young
            self._sync.reset()
            (self._by_euler if quaternion else self._by_quaternion).clear()
        self._wake()
        return "taken" if taken == "turned" else taken

    def ask_now(self) -> None:
        """Ask what time it is: a link has just come up."""
        self._ask_if_due(0.0)

    @property
    def _is_silent(self) -> bool:
        # By the time waited: in a replay the clock leaps, and what it brings is still on its way.
        rate_hz = max(self._by_quaternion.rate_hz, self._by_euler.rate_hz)
        usual_s = _SILENT_PERIODS / rate_hz if rate_hz > 0.0 else 0.0
        return self._in_vain_s >= min(max(usual_s, _SILENT_S), _LONGEST_SILENT_S)

    def _history(self, at_ns: int, offset_ns: int) -> AttitudeHistory:
        if self._by_quaternion.is_near(at_ns, offset_ns):
            return self._by_quaternion
        return self._by_euler

    def _wake(self) -> None:
        self._news.set()
        self._news.clear()

    def _ask_if_due(self, every_s: float) -> None:
        now_s = asyncio.get_running_loop().time()
        now_ns = self._clock.now_ns()
        # A clock that has not been told the time yet has nothing to compare.
        if now_ns <= 0 or now_s - self._asked_at_s < every_s:
            return
        self._asked_at_s = now_s
        self._ask(self._sync.ask(now_ns))
