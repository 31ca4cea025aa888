"""Gives drones' companions an order (MAV_CMD_USER_1 to 5), and follows it to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

from vcl_companion.errors import DeviceError
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    COMPONENT_COMPANION,
    PAUSE_SENDING,
    RELOAD_MAP,
    RELOCALIZE,
    RESULT_ACCEPTED,
    RESULT_CANCELLED,
    RESULT_DENIED,
    RESULT_FAILED,
    RESULT_IN_PROGRESS,
    RESULT_TEMPORARILY_REJECTED,
    RESULT_UNSUPPORTED,
    SAVE_MAP,
    STATUS_TEXT_BYTES,
    UPDATE_MAP,
    CommandAck,
    Heartbeat,
    StatusText,
)
from vcl_companion.links.reconnect import Address
from vcl_companion.links.transport import Transport, open_transport

GROUND_SYSTEM, _GROUND_COMPONENT = 255, 190
_HEARTBEAT_S = 1.0
_LISTENS_S = 4.0
_ANSWER_S = 1.0
_N_ATTEMPTS = 5
_REST = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_REFUSED = (RESULT_TEMPORARILY_REJECTED, RESULT_DENIED, RESULT_FAILED)
# MAV_SEVERITY up to a warning: why something is not done.
_WARNING = 4


@dataclass(frozen=True)
class Order:
    """What drones are told to do.

    Attributes:
        command: MAV_CMD.
        parameter: its first.
        done: what is said of a drone that has done it.
        failed: of one that could not.
        not_now: of one that can later.
        cancelled_by: first parameter of the same command that takes it back; None: nothing does.
    """

    command: int
    parameter: float
    done: str
    failed: str = "could not"
    not_now: str = "cannot now"
    cancelled_by: float | None = None


_NO_MAP = "has no map yet, or is at another order"
ORDERS = {
    "update-map": Order(
        UPDATE_MAP, 0.0, "has a new map", "no update came of it", _NO_MAP, cancelled_by=1.0
    ),
    "save-map": Order(SAVE_MAP, 0.0, "has saved its map", "could not save it", _NO_MAP),
    "forget-map": Order(SAVE_MAP, 1.0, "begins without a map next time"),
    "reload-map": Order(RELOAD_MAP, 0.0, "is back on its saved map", "could not take it"),
    "relocalize": Order(RELOCALIZE, 0.0, "looks for where it is"),
    "pause": Order(PAUSE_SENDING, 1.0, "sends no poses"),
    "resume": Order(PAUSE_SENDING, 0.0, "sends poses again"),
}


@dataclass(frozen=True)
class Told:
    """What is told of one drone.

    Attributes:
        system_id: which; 0: none.
        text: what became of it, or how far it is.
        is_over: whether nothing more comes of it.
        is_good: whether it has done it.
    """

    system_id: int
    text: str
    is_over: bool = False
    is_good: bool = False


@dataclass(frozen=True, eq=False)
class _Line:
    """One link, and what reads it."""

    codec: Codec
    transport: Transport


class Ordering:
    """One order to some drones, or to all that are heard; whose answers are followed.

    Args:
        order: what to do.
        links: of the ground station, each as for an autopilot: ``udpin:0.0.0.0:14550``.
        drones: system ids; empty: all whose companions are heard within four seconds.
        within_s: how long they have.
        tell: shown what becomes of it.
    """

    def __init__(
        self,
        order: Order,
        links: Sequence[str],
        drones: Collection[int],
        within_s: float,
        tell: Callable[[Told], None],
    ) -> None:
        tally = LinkTally()
        self._order = order
        self._codec = Codec(GROUND_SYSTEM, _GROUND_COMPONENT, tally)
        self._lines = [_Line(Codec(0, 0, tally), open_transport(link, tally)) for link in links]
        self._wanted = tuple(drones)
        self._within_s = within_s
        self._tell = tell
        self._companions: set[int] = set()
        self._answers: dict[int, CommandAck] = {}
        self._shown: dict[int, str] = {}
        self._texts: dict[int, str] = {}
        self._untold: asyncio.Future[None] | None = None

    async def run(self) -> bool:
        """Have them do it; return whether all of them have done it.

        Raises:
            DeviceError: nobody is heard, or one that was named is not.
        """
        beside = [asyncio.ensure_future(self._beat())]
        for line in self._lines:
            work = line.transport.run(partial(self._receive, line), self._greet)
            beside.append(asyncio.ensure_future(work))
        ordering = asyncio.ensure_future(self._ordered())
        self._untold = asyncio.get_running_loop().create_future()
        try:
            # None of those beside ends by itself: what ends one is not to be waited out.
            endless: list[asyncio.Future[Any]] = [*beside, self._untold]
            await asyncio.wait([ordering, *endless], return_when=asyncio.FIRST_COMPLETED)
            for one in endless:
                if one.done():
                    one.result()
            return await ordering
        finally:
            ordering.cancel()
            await asyncio.gather(ordering, return_exceptions=True)  # it cancels what it has ordered
            for task in beside:
                task.cancel()
            await asyncio.gather(*beside, return_exceptions=True)

    async def _ordered(self) -> bool:
        drones = await self._found()
        order = self._order
        self._texts.clear()
        self._answers.clear()  # to an order before, or of somebody else's
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(self._within_s):
                    for attempt in range(_N_ATTEMPTS):
                        silent = [drone for drone in drones if drone not in self._answers]
                        for drone in silent:
                            self._command(drone, order.parameter, attempt)
                        if not silent:
                            break
                        await asyncio.sleep(_ANSWER_S)
                    while any(self._is_going_on(drone) for drone in drones):
                        await asyncio.sleep(0.05)
        finally:
            late = [drone for drone in drones if self._is_going_on(drone)]
            if order.cancelled_by is not None:
                for drone in late:  # by the time that is over, or by Ctrl-C
                    self._command(drone, order.cancelled_by)
        for drone in drones:
            if drone not in self._answers:
                self._tell(Told(drone, "does not answer", is_over=True))
            elif drone in late:
                cancelled = "" if order.cancelled_by is None else "; cancelled"
                self._tell(Told(drone, f"is not done in time{cancelled}", is_over=True))
        return all(
            drone in self._answers and self._answers[drone].result == RESULT_ACCEPTED
            for drone in drones
        )

    async def _found(self) -> tuple[int, ...]:
        """Return whom to order, once they have been heard."""
        with suppress(TimeoutError):
            async with asyncio.timeout(_LISTENS_S):
                while not (self._wanted and self._companions.issuperset(self._wanted)):
                    await asyncio.sleep(0.05)
        drones = self._wanted or tuple(sorted(self._companions))
        missing = [drone for drone in drones if drone not in self._companions]
        if missing or not drones:
            whom = ", ".join(map(str, missing)) or "any drone"
            raise DeviceError(
                f"the companion of {whom} is not heard (component {COMPONENT_COMPANION}); "
                "does its autopilot forward messages to this link?"
            )
        return drones

    def _is_going_on(self, drone: int) -> bool:
        answer = self._answers.get(drone)
        return answer is not None and answer.result == RESULT_IN_PROGRESS

    def _command(self, drone: int, parameter: float, attempt: int = 0) -> None:
        parameters = (parameter, *_REST)
        self._write(self._codec.command(drone, self._order.command, parameters, attempt))

    def _write(self, frame: bytes) -> None:
        for line in self._lines:
            line.transport.write(frame)

    def _receive(self, line: _Line, data: bytes, _: Address | None) -> bool:
        for message in line.codec.decode(data, is_stream=line.transport.is_stream):
            if message.sender_component != COMPONENT_COMPANION:
                continue
            match message:
                case Heartbeat(sender_system=drone):
                    self._companions.add(drone)
                case StatusText(severity=severity) if severity <= _WARNING:
                    self._hear(message)
                case CommandAck(command=command) if command == self._order.command:
                    self._take(message)
        return True

    def _show(self, told: Told) -> None:
        """Show what has come; what that raises ends the order, and not the link."""
        try:
            self._tell(told)
        except Exception as error:  # as of a pipe that is closed
            if self._untold is not None and not self._untold.done():
                self._untold.set_exception(error)

    def _hear(self, said: StatusText) -> None:
        """Keep a drone's last warning: it says why it does not do what it was told to."""
        before = self._texts.get(said.sender_system, "") if said.chunk > 0 else ""
        text = (before + said.text)[: 8 * STATUS_TEXT_BYTES]
        self._texts[said.sender_system] = "".join(c for c in text if c.isprintable())

    def _take(self, answer: CommandAck) -> None:
        if answer.target_system not in (0, GROUND_SYSTEM):
            return
        drone = answer.sender_system
        before = self._answers.get(drone)
        if before is not None and before.result != RESULT_IN_PROGRESS:
            return  # an answer that was overtaken
        self._answers[drone] = answer
        if answer.result == RESULT_IN_PROGRESS:
            known = answer.progress <= 100
            text = f"is at it, {answer.progress} %" if known else "is at it"
            told = Told(drone, text)
        else:
            text = self._text_of(answer)
            told = Told(drone, text, is_over=True, is_good=answer.result == RESULT_ACCEPTED)
        if self._shown.get(drone) != told.text:
            self._shown[drone] = told.text
            self._show(told)

    def _text_of(self, answer: CommandAck) -> str:
        text = {
            RESULT_ACCEPTED: self._order.done,
            RESULT_TEMPORARILY_REJECTED: self._order.not_now,
            RESULT_DENIED: "refuses",
            RESULT_UNSUPPORTED: "does not know the command",
            RESULT_FAILED: self._order.failed,
            RESULT_CANCELLED: "was cancelled",
        }.get(answer.result, f"answers {answer.result}")
        why = self._texts.get(answer.sender_system)
        return f"{text}; it says: {why}" if why and answer.result in _REFUSED else text

    def _greet(self) -> None:
        self._write(self._codec.ground_heartbeat())

    async def _beat(self) -> None:
        """Say that we are there: autopilots forward only to whom they have heard."""
        while True:
            await asyncio.sleep(_HEARTBEAT_S)
            self._greet()
