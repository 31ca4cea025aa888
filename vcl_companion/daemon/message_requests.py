"""Which of our messages somebody asks for, and how often they are sent.

    REQUEST_MESSAGE (512)        param1: the message, once; for MESSAGE_INTERVAL param2: of which
    SET_MESSAGE_INTERVAL (511)   param1: the message; param2: us, -1: never, 0: as by default
    GET_MESSAGE_INTERVAL (510)   param1: of which message; the older form of asking for that

Only ONBOARD_COMPUTER_STATUS goes at a rate that may be set: who routes messages goes by the
heartbeat, and an autopilot fuses poses at the rate at which frames are seen. A pose that is asked
for is the next frame's: an autopilot would fuse one that is sent again once more.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import re
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress

from vcl_companion.daemon.onboard_computer import OnboardComputer
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.messages import (
    AUTOPILOT_VERSION_ID,
    GET_MESSAGE_INTERVAL,
    HEARTBEAT_ID,
    MESSAGE_INTERVAL_ID,
    ONBOARD_COMPUTER_STATUS_ID,
    REQUEST_MESSAGE,
    RESULT_ACCEPTED,
    RESULT_DENIED,
    RESULT_TEMPORARILY_REJECTED,
    RESULT_UNSUPPORTED,
    SET_MESSAGE_INTERVAL,
    CommandLong,
)
from vcl_companion.links.own_messages import (
    autopilot_version,
    computer_status,
    message_interval,
)

_HEARTBEAT_US = 1_000_000
# 250 bytes each: at 5 s a hundredth of a radio of 57,600 baud, at 1 s a twentieth. Nothing in
# it changes faster than people look.
_DEFAULT_S, _SHORTEST_S, _LONGEST_S = 5.0, 1.0, 3600.0
# Of all, and that MESSAGE_INTERVAL has room for.
_MAX_MESSAGE_ID, _MAX_TOLD_ID = (1 << 24) - 1, (1 << 16) - 1
_NEVER, _BY_DEFAULT = -1.0, 0.0
_NOT_STREAMED_US, _UNKNOWN_US = -1, 0


class MessageRequests:
    """Answers requests, and sends what goes at a rate; all in the event loop's thread.

    Args:
        autopilot: the link.
        computer: what ONBOARD_COMPUTER_STATUS tells.
        disk: looks at it.
    """

    commands = frozenset({REQUEST_MESSAGE, SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL})

    def __init__(self, autopilot: AutopilotLink, computer: OnboardComputer, disk: Executor) -> None:
        self._autopilot = autopilot
        self._computer = computer
        self._disk = disk
        # Looked up on the disk, and so not when somebody asks.
        self._version = autopilot_version(_own_version())
        self._interval_s: float | None = _DEFAULT_S
        self._is_wanted = False
        self._news = asyncio.Event()

    def take(self, message: CommandLong) -> tuple[int, Callable[[], object] | None]:
        """Look at a command; return its result, and what is to be done when that is answered."""
        first, second = message.parameters[:2]
        of_interval = message.command == REQUEST_MESSAGE and first == MESSAGE_INTERVAL_ID
        message_id = _id_of(second if of_interval else first)
        if message_id is None:
            return RESULT_DENIED, None
        if of_interval or message.command == GET_MESSAGE_INTERVAL:
            if message_id > _MAX_TOLD_ID:
                return RESULT_DENIED, None
            return RESULT_ACCEPTED, lambda: self._tell_interval(message_id)
        if message.command == SET_MESSAGE_INTERVAL:
            return self._set_interval(message_id, second), None
        return self._requested(message_id)

    async def run(self) -> None:
        """Send ONBOARD_COMPUTER_STATUS when it is due, until cancelled."""
        loop = asyncio.get_running_loop()
        sent_at_s = loop.time()
        while True:
            interval_s = self._interval_s
            due_at_s = None if interval_s is None else sent_at_s + interval_s
            is_due = False
            try:
                async with asyncio.timeout_at(due_at_s):
                    await self._news.wait()
                self._news.clear()
            except TimeoutError:
                sent_at_s, is_due = loop.time(), True
            if is_due or self._is_wanted:
                self._is_wanted = False
                status = await loop.run_in_executor(self._disk, self._computer.status)
                self._autopilot.send(computer_status(status))

    def _requested(self, message_id: int) -> tuple[int, Callable[[], object] | None]:
        if message_id == HEARTBEAT_ID:
            if self._autopilot.is_silent:
                return RESULT_TEMPORARILY_REJECTED, None
            return RESULT_ACCEPTED, self._autopilot.send_heartbeat
        if message_id == AUTOPILOT_VERSION_ID:
            return RESULT_ACCEPTED, lambda: self._autopilot.send(self._version)
        if message_id == ONBOARD_COMPUTER_STATUS_ID:
            return RESULT_ACCEPTED, self._want_status
        if message_id == self._autopilot.poses.message_id:
            is_sent = self._autopilot.poses.interval_s is not None
            return (RESULT_ACCEPTED if is_sent else RESULT_TEMPORARILY_REJECTED), None
        return RESULT_UNSUPPORTED, None

    def _want_status(self) -> None:
        self._is_wanted = True
        self._news.set()

    def _set_interval(self, message_id: int, interval_us: float) -> int:
        if message_id != ONBOARD_COMPUTER_STATUS_ID:
            ours = (HEARTBEAT_ID, AUTOPILOT_VERSION_ID, self._autopilot.poses.message_id)
            return RESULT_DENIED if message_id in ours else RESULT_UNSUPPORTED
        if interval_us == _NEVER:
            self._interval_s = None
        elif interval_us == _BY_DEFAULT:
            self._interval_s = _DEFAULT_S
        elif _SHORTEST_S <= interval_us * 1e-6 <= _LONGEST_S:
            self._interval_s = interval_us * 1e-6
        else:
            return RESULT_DENIED
        self._news.set()
        return RESULT_ACCEPTED

    def _tell_interval(self, message_id: int) -> None:
        interval_us = _UNKNOWN_US
        if message_id == HEARTBEAT_ID:
            interval_us = _HEARTBEAT_US
        elif message_id == AUTOPILOT_VERSION_ID:
            interval_us = _NOT_STREAMED_US
        elif message_id in (ONBOARD_COMPUTER_STATUS_ID, self._autopilot.poses.message_id):
            is_status = message_id == ONBOARD_COMPUTER_STATUS_ID
            interval_s = self._interval_s if is_status else self._autopilot.poses.interval_s
            # Several frames may be answered at one instant of a recording.
            interval_us = (
                _NOT_STREAMED_US if interval_s is None else max(round(1e6 * interval_s), 1)
            )
        self._autopilot.send(message_interval(message_id, interval_us))


def _id_of(parameter: float) -> int | None:
    """Return the message id that a command's parameter names; None if it names none."""
    if not 0.0 <= parameter <= _MAX_MESSAGE_ID or not parameter.is_integer():
        return None
    return int(parameter)


def _own_version() -> tuple[int, int, int]:
    """Return our version's first three numbers; zeros where we were not installed."""
    text = ""
    with suppress(importlib.metadata.PackageNotFoundError):
        text = importlib.metadata.version("vcl-companion")
    numbers = [int(number) for number in re.findall(r"\d+", text)[:3]] + [0, 0, 0]
    return numbers[0], numbers[1], numbers[2]
