"""Asks drones for a map update (MAV_CMD_USER_1), and follows it to its end."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from vcl_companion.errors import DeviceError
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import (
    COMPONENT_COMPANION,
    RESULT_ACCEPTED,
    RESULT_CANCELLED,
    RESULT_DENIED,
    RESULT_FAILED,
    RESULT_IN_PROGRESS,
    RESULT_TEMPORARILY_REJECTED,
    RESULT_UNSUPPORTED,
    UPDATE_MAP,
    CommandAck,
    Heartbeat,
)
from vcl_companion.links.reconnect import Address
from vcl_companion.links.transport import Transport, open_transport

GROUND_SYSTEM, _GROUND_COMPONENT = 255, 190
_HEARTBEAT_S = 1.0
_LISTENS_S = 4.0
_ANSWER_S = 1.0
_N_ATTEMPTS = 5
_BEGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_CANCEL = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

_RESULTS = {
    RESULT_ACCEPTED: "has a new map",
    RESULT_TEMPORARILY_REJECTED: "has no map yet",
    RESULT_DENIED: "refuses",
    RESULT_UNSUPPORTED: "does not know the command",
    RESULT_FAILED: "no update came of it",
    RESULT_CANCELLED: "was cancelled",
}


@dataclass(frozen=True)
class Told:
    """What is told of one drone.

    Attributes:
        system_id: which; 0: none.
        text: what became of it, or how far it is.
        is_over: whether nothing more comes of it.
        is_good: whether it has a new map.
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


class MapUpdate:
    """One order to some drones, or to all that are heard; whose answers are followed.

    Args:
        links: of the ground station, each as for an autopilot: ``udpin:0.0.0.0:14550``.
        drones: system ids; empty: all whose companions are heard within four seconds.
        within_s: how long they have.
        tell: shown what becomes of it.
    """

    def __init__(
        self,
        links: Sequence[str],
        drones: Collection[int],
        within_s: float,
        tell: Callable[[Told], None],
    ) -> None:
        tally = LinkTally()
        self._codec = Codec(GROUND_SYSTEM, _GROUND_COMPONENT, tally)
        self._lines = [_Line(Codec(0, 0, tally), open_transport(link, tally)) for link in links]
        self._wanted = tuple(drones)
        self._within_s = within_s
        self._tell = tell
        self._companions: set[int] = set()
        self._answers: dict[int, CommandAck] = {}
        self._shown: dict[int, str] = {}

    async def run(self) -> bool:
        """Have them do it; return whether all of them have a new map.

        Raises:
            DeviceError: nobody is heard, or one that was named is not.
        """
        beside = [asyncio.ensure_future(self._beat())]
        for line in self._lines:
            work = line.transport.run(partial(self._receive, line), self._greet)
            beside.append(asyncio.ensure_future(work))
        try:
            return await self._ordered()
        finally:
            for task in beside:
                task.cancel()
            await asyncio.gather(*beside, return_exceptions=True)

    async def _ordered(self) -> bool:
        drones = await self._found()
        order = self._codec.command
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(self._within_s):
                    for attempt in range(_N_ATTEMPTS):
                        silent = [drone for drone in drones if drone not in self._answers]
                        for drone in silent:
                            self._write(order(drone, UPDATE_MAP, _BEGIN, attempt))
                        if not silent:
                            break
                        await asyncio.sleep(_ANSWER_S)
                    while any(self._is_going_on(drone) for drone in drones):
                        await asyncio.sleep(0.05)
        finally:
            late = [drone for drone in drones if self._is_going_on(drone)]
            for drone in late:  # by the time that is over, or by Ctrl-C
                self._write(order(drone, UPDATE_MAP, _CANCEL))
        for drone in drones:
            if drone not in self._answers:
                self._tell(Told(drone, "does not answer", is_over=True))
            elif drone in late:
                self._tell(Told(drone, "is not done in time; cancelled", is_over=True))
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
                case CommandAck(command=command) if command == UPDATE_MAP:
                    self._take(message)
        return True

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
            text = _RESULTS.get(answer.result, f"answers {answer.result}")
            told = Told(drone, text, is_over=True, is_good=answer.result == RESULT_ACCEPTED)
        if self._shown.get(drone) != told.text:
            self._shown[drone] = told.text
            self._tell(told)

    def _greet(self) -> None:
        self._write(self._codec.ground_heartbeat())

    async def _beat(self) -> None:
        """Say that we are there: autopilots forward only to whom they have heard."""
        while True:
            await asyncio.sleep(_HEARTBEAT_S)
            self._greet()
