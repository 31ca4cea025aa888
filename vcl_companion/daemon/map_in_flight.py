"""The map that a service flew on when it ended without having been asked to.

One that dies in the air is started again within seconds. Without its map it would wait for the
others' to come by radio, and a drone alone for ever. So the revision in use is noted beside the
maps that are kept anyway (``map.directory``); the next service goes on with it where the note is
fresh and of the same run of the computer, once: a map that it dies of is not tried again. Whether
the drone is in the air, and not carried to somewhere else, is not known here.
"""

from __future__ import annotations

import asyncio
import logging
import re
import threading
import time
from concurrent.futures import Executor
from contextlib import suppress
from pathlib import Path

from vcl_companion.daemon.map_store import MapStore
from vcl_companion.errors import reason_of

_log = logging.getLogger(__name__)

NOTE_FILE = "in-flight"
# A note says the revision, the run of the computer, and how long that had been on, s.
_NOTE = re.compile(r"([0-9a-f]{16}) (\S{1,64}) ([0-9]{1,12})\n")
_MOST_BYTES = 128
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
# So often it is noted that a map is still in use; an older note than the second is of no use.
_NOTED_EVERY_S, _FRESH_S = 5.0, 60.0
# Behind what the last service died on none is noted until this one has lived for so long.
_PROVEN_S = 10.0


class MapInFlight:
    """Notes which map is in use, and finds the one that the last service was on.

    Args:
        maps: the map in use, and the folder.
        disk: writes.
    """

    def __init__(self, maps: MapStore, disk: Executor) -> None:
        self._maps = maps
        self._disk = disk
        self._note = None if maps.directory is None else maps.directory / NOTE_FILE
        self._has_failed = False
        self._is_over = False
        self._writing = threading.Lock()
        self._goes_on = False

    async def run(self) -> None:
        """Note it until cancelled."""
        loop = asyncio.get_running_loop()
        await asyncio.sleep(_PROVEN_S if self._goes_on else 0.0)
        while True:
            stored = self._maps.current
            if stored is not None and not stored.part_of:
                await loop.run_in_executor(self._disk, self._write, stored.revision)
            with suppress(TimeoutError):
                async with asyncio.timeout(_NOTED_EVERY_S):
                    await self._maps.newer_than(stored)

    def left_behind(self) -> bytes:
        """Return the encoded map that the last service died on, empty for none; any thread may.

        Nothing is known of its bytes. The next time there is none, until it is noted again.
        """
        if self._note is None:
            return b""
        try:
            with self._note.open("rb") as file:
                said = _NOTE.fullmatch(file.read(_MOST_BYTES).decode("ascii", "replace"))
            self._note.unlink()
            if said is None or said[2] != _boot_id() or not 0 <= _now_s() - int(said[3]) < _FRESH_S:
                return b""
            self._goes_on = True
            return self._maps.kept(bytes.fromhex(said[1]))
        except FileNotFoundError:
            return b""
        except OSError as error:
            _log.warning("the map of before cannot be read: %s (%s)", reason_of(error), self._note)
            return b""

    def ended(self) -> None:
        """Forget it: the end was asked for, and the next service begins anew."""
        if self._note is not None:
            with self._writing:
                self._is_over = True
                with suppress(OSError):
                    self._note.unlink(missing_ok=True)

    def _write(self, revision: bytes) -> None:
        """Note a revision; a power cut ends its use anyway: nothing has to reach the disk."""
        if self._note is None:
            return
        partial = self._note.with_suffix(".partial")
        with self._writing:
            if self._is_over:
                return
            try:
                partial.write_text(f"{revision.hex()} {_boot_id()} {_now_s()}\n", "ascii")
                partial.replace(self._note)
                self._has_failed = False
            except OSError as error:
                if not self._has_failed:
                    _log.error("the map in use cannot be noted: %s", reason_of(error))
                self._has_failed = True


def _boot_id() -> str:
    return _BOOT_ID.read_text("ascii").strip()


def _now_s() -> int:
    """How long the computer has been on; its clock may be set meanwhile, or have no battery."""
    return int(time.clock_gettime(time.CLOCK_BOOTTIME))
