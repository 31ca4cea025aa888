"""What ground stations may ask of this drone: MAV_CMD_USER_1 to 5, addressed to component 197.

    USER_1 (31010)   param1 0: update the map, accepted when a revision made of the one in use is
                     flown on; 1: cancel that
    USER_2 (31011)   param1 0: save the map in use, for the next start to begin with; 1: forget
                     the saved one
    USER_3 (31012)   reload: fly on the saved map, and look for where we are in it anew
    USER_4 (31013)   relocalize: forget where we are, look for it anew, and tell the autopilot of it
                     wherever that is ([autopilot] resets)
    USER_5 (31014)   param1 1: send no poses any more; 0: send them again

What takes time answers COMMAND_ACK IN_PROGRESS until it is over. A command that is repeated
meanwhile is the same one, and so is one that is repeated, by its ``confirmation``, because the
answer was lost (https://mavlink.io/en/services/command.html; its COMMAND_CANCEL is not in
pymavlink's dialects). Who asks for messages is answered by ``message_requests``.
"""

from __future__ import annotations

import asyncio
import logging
import struct
from collections.abc import Callable, Coroutine
from dataclasses import dataclass

from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.exchange import Exchange
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.message_requests import MessageRequests
from vcl_companion.daemon.saved_map import SavedMap
from vcl_companion.daemon.teller import Teller
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.messages import (
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
    UPDATE_MAP,
    CommandLong,
)
from vcl_companion.links.texts import Severity

_log = logging.getLogger(__name__)

_TELL_S = 0.5
# A round gathers, builds and hands out; the longest seen took half of it, by radio.
UPDATE_WITHIN_S = 60.0
# Who has not heard an answer asks again within this.
_REPEATED_WITHIN_S = 3.0
_SWITCHES = (UPDATE_MAP, SAVE_MAP, PAUSE_SENDING)


@dataclass(frozen=True)
class _Ended:
    """A command that was obeyed, or was not, and how that was answered."""

    message: CommandLong
    result: int
    progress: int
    at_s: float

    def is_meant_by(self, message: CommandLong, now_s: float) -> bool:
        """Whether somebody asks for it again because the answer was lost."""
        mine, its = self.message, message
        return (
            its.confirmation > 0
            and now_s < self.at_s + _REPEATED_WITHIN_S
            and (mine.sender_system, mine.sender_component)
            == (its.sender_system, its.sender_component)
            and _packed(*mine.parameters) == _packed(*its.parameters)
        )


class Commands:
    """Obeys; everything happens in the event loop's thread.

    Args:
        autopilot: the link that commands come by and answers go.
        exchange: makes maps, with the others.
        maps: what we fly on.
        estimator: where we are.
        teller: what the autopilot is told of it.
        saved: the map to begin with.
        requests: answers who asks for messages.
        log: told of every command.
    """

    def __init__(
        self,
        autopilot: AutopilotLink,
        exchange: Exchange,
        maps: MapStore,
        estimator: Estimator,
        teller: Teller,
        saved: SavedMap,
        requests: MessageRequests,
        log: FlightLog,
    ) -> None:
        self._autopilot = autopilot
        self._exchange = exchange
        self._maps = maps
        self._estimator = estimator
        self._teller = teller
        self._saved = saved
        self._requests = requests
        self._log = log
        self._updating: asyncio.Task[None] | None = None
        self._storing: asyncio.Task[None] | None = None
        self._stores = (0, b"")  # the command and the parameter of that
        self._ended: dict[int, _Ended] = {}
        self.on_pause: Callable[[], None] | None = None
        """Called when a command has held poses back, or sent them again."""
        autopilot.on_command = self.take

    def take(self, message: CommandLong) -> None:
        """Obey a command, or say why not."""
        command, first = message.command, message.parameters[0]
        ended = self._ended.get(command)
        if ended is not None and ended.is_meant_by(message, _now_s()):
            self._autopilot.answer(message, ended.result, ended.progress)
        elif command in _SWITCHES and first not in (0.0, 1.0):
            self._answer(message, RESULT_DENIED)
        elif command == UPDATE_MAP and first == 1.0:
            self._cancel(message)
        elif command == UPDATE_MAP:
            self._update(message)
        elif command == SAVE_MAP:
            self._save(message, is_forgotten=first == 1.0)
        elif command == RELOAD_MAP:
            self._reload(message)
        elif command == RELOCALIZE:
            self._note(message, "relocalize")
            self._estimator.forget()
            self._teller.allow_jump()
            self._answer(message, RESULT_ACCEPTED)
        elif command == PAUSE_SENDING:
            self._note(message, "send no poses" if first else "send poses again")
            self.pause(is_paused=first == 1.0)
            if self.on_pause is not None:
                self.on_pause()
            self._answer(message, RESULT_ACCEPTED)
        elif command in self._requests.commands:
            self._request(message)
        else:
            self._cannot(message)

    def pause(self, is_paused: bool) -> None:
        """Hold poses back, or send them again, because the ground wants it."""
        self._autopilot.poses.is_paused = is_paused
        what = "no poses are sent" if is_paused else "poses are sent again"
        self._autopilot.announce(Severity.WARNING, f"VCL {what}, as commanded")

    def _note(self, message: CommandLong, what: str) -> None:
        self._log.event("command", f"{what}, by system {message.sender_system}")
        _log.info("system %d commands: %s", message.sender_system, what)

    def _answer(self, message: CommandLong, result: int, progress: int = 255) -> None:
        self._ended.pop(message.command, None)
        if result not in (RESULT_IN_PROGRESS, RESULT_TEMPORARILY_REJECTED):
            self._ended[message.command] = _Ended(message, result, progress, _now_s())
        self._autopilot.answer(message, result, progress)

    def _cannot(self, message: CommandLong) -> None:
        """Say that we do not know a command, or a message; not where all were asked."""
        if message.target_component != 0:
            self._autopilot.answer(message, RESULT_UNSUPPORTED)

    def _request(self, message: CommandLong) -> None:
        result, then = self._requests.take(message)
        if result == RESULT_UNSUPPORTED:
            self._cannot(message)
            return
        self._autopilot.answer(message, result)
        if then is not None:
            then()

    def _save(self, message: CommandLong, *, is_forgotten: bool) -> None:
        stored = self._maps.current
        if not self._may_store(message, "saved"):
            return
        if is_forgotten:
            self._store(message, "forget the saved map", self._saved.forget())
        elif stored is None or stored.part_of:
            why = "only a part has come" if stored else "there is none"
            self._autopilot.announce(Severity.WARNING, f"VCL map not saved: {why} yet")
            self._answer(message, RESULT_TEMPORARILY_REJECTED)
        else:
            self._store(message, "save the map", self._saved.save(stored))

    def _reload(self, message: CommandLong) -> None:
        if not self._may_store(message, "taken"):
            return
        if _is_going_on(self._updating):
            self._answer(message, RESULT_TEMPORARILY_REJECTED)
        else:
            self._store(message, "reload the map", self._saved.reload())

    def _may_store(self, message: CommandLong, what: str) -> bool:
        """Whether there is a place for a saved map, and nothing under way there; else say so."""
        if not self._saved.has_place:
            text = f"VCL map not {what}: [map] directory is not set"
            self._autopilot.announce(Severity.WARNING, text)
            self._answer(message, RESULT_DENIED)
            return False
        if _is_going_on(self._storing):
            is_same = self._stores == (message.command, _packed(message.parameters[0]))
            self._answer(message, RESULT_IN_PROGRESS if is_same else RESULT_TEMPORARILY_REJECTED)
            return False
        return True

    def _store(self, message: CommandLong, what: str, storing: Coroutine[None, None, bool]) -> None:
        self._note(message, what)
        self._answer(message, RESULT_IN_PROGRESS)
        self._stores = message.command, _packed(message.parameters[0])
        self._storing = asyncio.create_task(self._stored(message, storing))

    async def _stored(self, message: CommandLong, storing: Coroutine[None, None, bool]) -> None:
        result = RESULT_FAILED
        try:
            if await storing:
                result = RESULT_ACCEPTED
        finally:
            self._answer(message, result)

    def _update(self, message: CommandLong) -> None:
        if _is_going_on(self._updating):
            self._answer(message, RESULT_IN_PROGRESS, self._exchange.update_progress)
            return
        stored = self._maps.current
        if stored is None or _is_going_on(self._storing):
            self._answer(message, RESULT_TEMPORARILY_REJECTED)
            return
        self._note(message, "update the map")
        self._answer(message, RESULT_IN_PROGRESS, 0)
        self._updating = asyncio.create_task(self._updated(message, stored))

    async def _updated(self, message: CommandLong, stored: StoredMap) -> None:
        """Want an update until there is one; say how it goes."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + UPDATE_WITHIN_S
        result = RESULT_CANCELLED
        try:
            self._exchange.want_update(True)
            while self._maps.is_in_use(stored) and loop.time() < until_s:
                self._answer(message, RESULT_IN_PROGRESS, self._exchange.update_progress)
                await asyncio.sleep(_TELL_S)
            result = RESULT_FAILED if self._maps.is_in_use(stored) else RESULT_ACCEPTED
        finally:
            self._exchange.want_update(False)
            self._answer(message, result, 100 if result == RESULT_ACCEPTED else 255)

    def _cancel(self, message: CommandLong) -> None:
        updating = self._updating
        if updating is not None and not updating.done():
            self._note(message, "no update of the map")
            updating.cancel()  # it says itself that it was
        else:
            self._answer(message, RESULT_DENIED)


def _packed(*parameters: float) -> bytes:
    """Return parameters to be compared: unused ones may be NaN, which no NaN equals."""
    return struct.pack(f"<{len(parameters)}d", *parameters)


def _is_going_on(task: asyncio.Task[None] | None) -> bool:
    return task is not None and not task.done()


def _now_s() -> float:
    return asyncio.get_running_loop().time()
