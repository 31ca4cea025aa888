"""What ground stations may ask of this drone: MAV_CMD_USER_1 to 5, addressed to component 197.

    USER_1 (31010)   param1 0: update the map, accepted when a revision made of the one in use is
                     flown on; 1: cancel that
    USER_4 (31013)   relocalize: forget where we are, and look for it anew
    USER_5 (31014)   param1 1: send no poses any more; 0: send them again

An update answers COMMAND_ACK IN_PROGRESS until it is over. A command that is repeated meanwhile is
the same one, whatever its ``confirmation`` (https://mavlink.io/en/services/command.html; its
COMMAND_CANCEL is not in pymavlink's dialects).
"""

from __future__ import annotations

import asyncio
import logging

from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.exchange import Exchange
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.messages import (
    PAUSE_SENDING,
    RELOCALIZE,
    RESULT_ACCEPTED,
    RESULT_CANCELLED,
    RESULT_DENIED,
    RESULT_FAILED,
    RESULT_IN_PROGRESS,
    RESULT_TEMPORARILY_REJECTED,
    RESULT_UNSUPPORTED,
    UPDATE_MAP,
    CommandLong,
)
from vcl_companion.links.texts import Severity

_log = logging.getLogger(__name__)

_TELL_S = 0.5
# A round gathers, builds and hands out; the longest seen took half of it, by radio.
UPDATE_WITHIN_S = 60.0


class Commands:
    """Obeys; everything happens in the event loop's thread.

    Args:
        autopilot: the link that commands come by and answers go.
        exchange: makes maps, with the others.
        maps: what we fly on.
        estimator: where we are.
        log: told of every command.
    """

    def __init__(
        self,
        autopilot: AutopilotLink,
        exchange: Exchange,
        maps: MapStore,
        estimator: Estimator,
        log: FlightLog,
    ) -> None:
        self._autopilot = autopilot
        self._exchange = exchange
        self._maps = maps
        self._estimator = estimator
        self._log = log
        self._updating: asyncio.Task[None] | None = None
        autopilot.on_command = self.take

    def take(self, message: CommandLong) -> None:
        """Obey a command, or say why not."""
        command, first = message.command, message.parameters[0]
        if command in (UPDATE_MAP, PAUSE_SENDING) and first not in (0.0, 1.0):
            self._autopilot.answer(message, RESULT_DENIED)
        elif command == UPDATE_MAP and first == 1.0:
            self._cancel(message)
        elif command == UPDATE_MAP:
            self._update(message)
        elif command == RELOCALIZE:
            self._note(message, "relocalize")
            self._estimator.forget()
            self._autopilot.answer(message, RESULT_ACCEPTED)
        elif command == PAUSE_SENDING:
            self._pause(message, is_paused=first == 1.0)
        else:
            self._autopilot.answer(message, RESULT_UNSUPPORTED)

    def _note(self, message: CommandLong, what: str) -> None:
        self._log.event("command", f"{what}, by system {message.sender_system}")
        _log.info("system %d commands: %s", message.sender_system, what)

    def _pause(self, message: CommandLong, *, is_paused: bool) -> None:
        self._autopilot.is_paused = is_paused
        what = "no poses are sent" if is_paused else "poses are sent again"
        self._note(message, what)
        self._autopilot.announce(Severity.WARNING, f"VCL {what}, as commanded")
        self._autopilot.answer(message, RESULT_ACCEPTED)

    def _update(self, message: CommandLong) -> None:
        if self._updating is not None and not self._updating.done():
            self._autopilot.answer(message, RESULT_IN_PROGRESS, self._exchange.update_progress)
            return
        stored = self._maps.current
        if stored is None:
            self._autopilot.answer(message, RESULT_TEMPORARILY_REJECTED)
            return
        self._note(message, "update the map")
        self._autopilot.answer(message, RESULT_IN_PROGRESS, 0)
        self._updating = asyncio.create_task(self._updated(message, stored))

    async def _updated(self, message: CommandLong, stored: StoredMap) -> None:
        """Want an update until there is one; say how it goes."""
        loop = asyncio.get_running_loop()
        until_s = loop.time() + UPDATE_WITHIN_S
        result = RESULT_CANCELLED
        try:
            self._exchange.want_update(True)
            while self._maps.is_in_use(stored) and loop.time() < until_s:
                self._autopilot.answer(message, RESULT_IN_PROGRESS, self._exchange.update_progress)
                await asyncio.sleep(_TELL_S)
            result = RESULT_FAILED if self._maps.is_in_use(stored) else RESULT_ACCEPTED
        finally:
            self._exchange.want_update(False)
            self._autopilot.answer(message, result, 100 if result == RESULT_ACCEPTED else 255)

    def _cancel(self, message: CommandLong) -> None:
        if self._updating is not None and not self._updating.done():
            self._note(message, "no update of the map")
            self._updating.cancel()  # it says itself that it was
        else:
            self._autopilot.answer(message, RESULT_DENIED)
