"""The map that a drone begins with after a restart: saved when the ground says so, and taken again.

It lies beside the revisions that are kept anyway (``map.directory``), and stays until another one
is saved or it is forgotten: a drone that begins with a map makes no first one. Before it goes the
one that the last service died on, where the drone is in the air.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor

from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.flight_log import FlightLog
from vcl_companion.daemon.map_in_flight import MapInFlight
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.links.autopilot import AutopilotLink
from vcl_companion.links.texts import Severity

_log = logging.getLogger(__name__)

# A heartbeat of the autopilot has come by then, if there is one to come.
_HEARD_S = 3.0


class SavedMap:
    """Saves and takes it; everything but the disk's work happens in the event loop's thread.

    Args:
        maps: the map in use, and the file.
        in_flight: the map that the last service was on.
        go_back_to: flies on an encoded map, or returns why not.
        estimator: where we are.
        disk: reads and writes.
        autopilot: says what has become of it, for the ground.
        log: told likewise.
    """

    def __init__(
        self,
        maps: MapStore,
        in_flight: MapInFlight,
        go_back_to: Callable[[bytes], Awaitable[str]],
        estimator: Estimator,
        disk: Executor,
        autopilot: AutopilotLink,
        log: FlightLog,
    ) -> None:
        self._maps = maps
        self._in_flight = in_flight
        self._go_back_to = go_back_to
        self._estimator = estimator
        self._disk = disk
        self._autopilot = autopilot
        self._log = log

    @property
    def has_place(self) -> bool:
        """Whether there is a folder for it."""
        return self._maps.saved_file is not None

    async def save(self, stored: StoredMap) -> bool:
        """Have the next start begin with a map; return whether it is on the disk."""
        try:
            await self._on_disk(self._maps.save, stored)
        except OSError as error:
            return self._failed("map not saved", _why(error))
        return self._done(f"map saved: {stored.n_landmarks} landmarks")

    async def forget(self) -> bool:
        """Have the next start begin without a map; return whether it will."""
        try:
            await self._on_disk(self._maps.forget_saved)
        except OSError as error:
            return self._failed("saved map not removed", _why(error))
        return self._done("next start makes a new map")

    async def reload(self) -> bool:
        """Fly on it, and look for where we are in it anew; return whether we do."""
        refused = await self._taken()
        if refused is None:
            refused = "there is none"
        if refused:
            return self._failed("saved map not taken", refused)
        self._estimator.forget()
        return self._done("back on the saved map")

    async def begin(self) -> None:
        """Begin with it, if there is one; one that cannot be used is told of and left alone."""
        if await self._goes_on():
            return
        refused = await self._taken()
        if refused:
            self._failed("saved map not taken", refused)
        elif refused is not None:
            self._done("begins on the saved map")

    async def _goes_on(self) -> bool:
        """Go on with the map that the last service died on; whether we do."""
        data = await self._on_disk(self._in_flight.left_behind)
        # Armed is in the air; its heartbeats say so, one a second.
        if not (data and await self._autopilot.heard(_HEARD_S) and self._autopilot.mode.is_armed):
            return False
        refused = await self._go_back_to(data)
        if refused:
            return self._failed("map of before not taken", refused)
        return self._done("goes on with the map of before")

    async def _taken(self) -> str | None:
        """Fly on it; return why it cannot be used, or nothing; None where there is none."""
        try:
            data = await self._on_disk(self._maps.saved)
        except FileNotFoundError:
            return None
        except OSError as error:
            return _why(error)
        return await self._go_back_to(data)

    async def _on_disk(self, do: Callable[..., bytes | None], *args: StoredMap) -> bytes:
        return await asyncio.get_running_loop().run_in_executor(self._disk, do, *args) or b""

    def _done(self, what: str) -> bool:
        self._log.event("saved map", what)
        _log.info("%s", what)
        self._autopilot.announce(Severity.INFO, f"VCL {what}")
        return True

    def _failed(self, what: str, why: str) -> bool:
        self._log.event("saved map", f"{what}: {why}")
        _log.warning("%s: %s (%s)", what, why, self._maps.saved_file)
        self._autopilot.announce(Severity.WARNING, f"VCL {what}: {why}")
        return False


def _why(error: OSError) -> str:
    return error.strerror or str(error)
