"""Whether an autopilot knows its heading by itself, as its parameters say.

One that takes its heading from us has none before: it says 0, however it stands, and keeps to that
north until it turns to ours. Its heading tells how the drone turns, and not where it looks. Read in
the sources, and seen with ArduCopter:

* ArduPilot 4.7.0: ``EK3_SRC1_YAW`` 1 compass, 2 GPS, 3 GPS or compass; 0 none, 6 external
  navigation, 8 what it makes of GPS speeds.
* PX4 1.16.1 begins by its compass, and goes on by ours with bit 3 of ``EKF2_EV_CTRL``; with
  ``EKF2_MAG_TYPE`` 5 or ``SYS_HAS_MAG`` 0 it has no compass.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from vcl_companion.links.vision_pose import Firmware

_log = logging.getLogger(__name__)

# The values of a parameter with which a firmware has a heading of its own, or has none.
_SOURCE, _OWN_SOURCES = "EK3_SRC1_YAW", (1, 2, 3)
_COMPASS_USE, _NO_COMPASS = "EKF2_MAG_TYPE", 5
_HAS_COMPASS = "SYS_HAS_MAG"
_PAUSE_S, _LONGEST_PAUSE_S = 2.0, 60.0


class HeadingSource:
    """Asks one autopilot for these parameters; in the event loop's thread.

    Args:
        parameter: reads one of the autopilot's parameters, None for one that it does not tell.
    """

    def __init__(self, parameter: Callable[[str], Awaitable[float | None]]) -> None:
        self._parameter = parameter
        self._firmware: Firmware | None = None
        self._changed = asyncio.Event()
        self.is_own = False
        """Whether its heading is its own; no, of one that has not said what it takes it from."""
        self.was_own = False
        """The same by what it said last, perhaps before it restarted."""

    def is_of(self, firmware: Firmware) -> None:
        """Note whose software the autopilot runs."""
        if firmware is not self._firmware:
            self._firmware = firmware
            self.forget()
            self.was_own = self.is_own

    def forget(self) -> None:
        """Ask again: the autopilot has restarted, perhaps with other parameters."""
        self.is_own = self._firmware is Firmware.OTHER
        self._changed.set()

    async def run(self) -> None:
        """Ask whenever it may have become another, until cancelled."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            pause_s = _PAUSE_S
            while self._firmware in (Firmware.ARDUPILOT, Firmware.PX4):
                said = await self._asked()
                if said is not None:
                    self.is_own = self.was_own = said
                    what = "its own" if said else "what we tell it"
                    _log.info("the autopilot's heading is %s", what)
                    break
                try:
                    async with asyncio.timeout(pause_s):
                        await self._changed.wait()
                    break
                except TimeoutError:
                    pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)

    async def _asked(self) -> bool | None:
        """Return whether it has a heading of its own; None when it does not say."""
        if self._firmware is Firmware.ARDUPILOT:
            source = await self._parameter(_SOURCE)
            return None if source is None else round(source) in _OWN_SOURCES
        use = await self._parameter(_COMPASS_USE)
        if use is None or round(use) == _NO_COMPASS:
            return None if use is None else False
        has_one = await self._parameter(_HAS_COMPASS)
        return has_one is None or round(has_one) != 0
