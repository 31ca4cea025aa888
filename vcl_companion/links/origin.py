"""The place on Earth of the autopilot's local frame: set once, and confirmed by what it says.

An estimator without a GPS flies in metres from its own origin; with that origin's latitude,
longitude and altitude it knows global positions as well. Read in the sources:

* ArduPilot 4.7.0 takes MAV_CMD_DO_SET_GLOBAL_ORIGIN (611, COMMAND_INT) and SET_GPS_GLOBAL_ORIGIN
  (48; from 4.8 on with a warning, from 4.10 on not any more), once its estimator has begun, and
  says GPS_GLOBAL_ORIGIN (49). It keeps its first origin and refuses others. While it is not armed
  it begins its height anew at 0 then, and moves the origin up by what that was (AP_Baro.cpp,
  ``update_field_elevation``, unless BARO_FIELD_ELV is set; seen): it is told one while that is
  nothing, before it takes its height from our poses, or once it is armed.
* PX4 1.16.1 takes SET_GPS_GLOBAL_ORIGIN alone, moves its origin whenever it is told another, and
  says 49 once positions are global. With its height by vision (EKF2_HGT_REF 3) a reset then throws
  that by the origin's altitude, and the drone climbs away: it is not told any.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass

from vcl_companion.geometry.rotation import Array
from vcl_companion.links.messages import RESULT_DENIED, RESULT_UNSUPPORTED
from vcl_companion.links.texts import Severity
from vcl_companion.links.vision_pose import Firmware

_log = logging.getLogger(__name__)

HEIGHT_REFERENCE, HEIGHT_BY_VISION = "EKF2_HGT_REF", 3
# The spheres by which firmwares turn metres into degrees: definitions.h LOCATION_SCALING_FACTOR,
# geo.h CONSTANTS_RADIUS_OF_EARTH.
_RADIUS_M = {Firmware.ARDUPILOT: 6_378_100.0, Firmware.PX4: 6_371_000.0}
# Degrees are told in steps of 1 cm; another origin is not as near as this.
_SAME_M = 1.0
_ANSWER_S = 1.0
# What its height may jump by.
_LOW_M = 0.5
_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 8.0


@dataclass(frozen=True)
class GlobalPlace:
    """A place on Earth.

    Attributes:
        latitude_deg: north, -90..90.
        longitude_deg: east, -180..180.
        altitude_m: above mean sea level.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def moved(self, ned_m: Array, firmware: Firmware) -> GlobalPlace:
        """Return the place (3,) metres north, east, down of it, as a firmware reckons."""
        north, east, down = ned_m.tolist()
        metres_per_deg = math.radians(_RADIUS_M[firmware])
        across = max(math.cos(math.radians(self.latitude_deg)), 0.01)
        longitude_deg = self.longitude_deg + east / (metres_per_deg * across)
        return GlobalPlace(
            self.latitude_deg + north / metres_per_deg,
            (longitude_deg + 180.0) % 360.0 - 180.0,
            self.altitude_m - down,
        )

    def distance_m(self, other: GlobalPlace) -> float:
        """Return how far another place is, for those that are near."""
        metres_per_deg = math.radians(_RADIUS_M[Firmware.ARDUPILOT])
        east_deg = (other.longitude_deg - self.longitude_deg + 180.0) % 360.0 - 180.0
        return math.hypot(
            metres_per_deg * (other.latitude_deg - self.latitude_deg),
            metres_per_deg * east_deg * math.cos(math.radians(self.latitude_deg)),
            other.altitude_m - self.altitude_m,
        )


class OriginSetter:
    """Sets one autopilot's origin until it says that it has one; in the event loop's thread.

    Args:
        world_origin: where the world's origin is; None sets nothing.
        parameter: reads one of the autopilot's parameters, None for one that it does not tell.
        ask: asks it to say its origin.
        command: sends an origin by COMMAND_INT.
        message: sends it by SET_GPS_GLOBAL_ORIGIN.
        announce: tells people.
    """

    def __init__(
        self,
        world_origin: GlobalPlace | None,
        parameter: Callable[[str], Awaitable[float | None]],
        ask: Callable[[], None],
        command: Callable[[GlobalPlace], None],
        message: Callable[[GlobalPlace], None],
        announce: Callable[[Severity, str], None],
    ) -> None:
        self._world_origin = world_origin
        self._parameter = parameter
        self._ask = ask
        self._command = command
        self._message = message
        self._announce = announce
        self._heard = asyncio.Event()
        self.origin_world: Callable[[], Array | None] = lambda: None
        """Where the origin of the autopilot's local frame is in the world, (3,) m; None while that
        is not known."""
        self.firmware = Firmware.OTHER
        self.forget()

    def forget(self) -> None:
        """Begin again: the autopilot has restarted, and knows nothing."""
        self._said: GlobalPlace | None = None
        self.is_armed = False
        self.height_m = 0.0
        """What the autopilot believes its height to be above the origin of its local frame, m."""
        self._told: str | None = None
        self._is_settled = self._knows_no_command = False

    def said(self, place: GlobalPlace) -> None:
        """Note the origin that the autopilot says that it has."""
        self._said = place
        self._heard.set()

    def answered(self, result: int) -> None:
        """Note what became of the command: MAV_RESULT."""
        if result == RESULT_UNSUPPORTED:
            self._knows_no_command = True
        elif result == RESULT_DENIED:
            self._tell(Severity.WARNING, "the autopilot denies autopilot.origin: is it a place?")

    async def run(self) -> None:
        """Set it as soon as it can be, until cancelled."""
        if self._world_origin is None:
            return
        pause_s = _PAUSE_S
        while True:
            await asyncio.sleep(pause_s)
            offset = self.origin_world()
            if self._is_settled or offset is None or self.firmware not in _RADIUS_M:
                continue
            await self._try(self._world_origin.moved(offset, self.firmware))
            pause_s = _PAUSE_S if self._is_settled else min(2.0 * pause_s, _LONGEST_PAUSE_S)

    async def _try(self, wanted: GlobalPlace) -> None:
        """Ask for the origin that it has, and set one where it has none."""
        self._said = None
        await self._answer_to(self._ask)
        if self._said is None and await self._may_have_one():
            by_command = self.firmware is Firmware.ARDUPILOT and not self._knows_no_command
            send = self._command if by_command else self._message
            await self._answer_to(lambda: send(wanted))
        if self._said is None:
            return
        self._is_settled = True
        off_m = wanted.distance_m(self._said)
        if off_m <= _SAME_M:
            self._tell(Severity.INFO, "origin set")
        else:
            self._tell(Severity.WARNING, f"the autopilot's origin is {off_m:.0f} m from ours")

    async def _may_have_one(self) -> bool:
        """Whether an origin is harmless to it."""
        if self.firmware is Firmware.ARDUPILOT:
            is_harmless = self.is_armed or abs(self.height_m) < _LOW_M
            if not is_harmless:
                what = f"origin waits until armed: its height would jump by {self.height_m:.0f} m"
                self._tell(Severity.WARNING, what)
            return is_harmless
        reference = await self._parameter(HEIGHT_REFERENCE)
        if reference is None:
            self._tell(Severity.WARNING, f"no origin is set: {HEIGHT_REFERENCE} is not said")
        elif round(reference) == HEIGHT_BY_VISION:
            self._is_settled = True
            what = f"no origin is set: with {HEIGHT_REFERENCE} 3 it would climb away; set 0"
            self._tell(Severity.ERROR, what)
        else:
            return True
        return False

    async def _answer_to(self, ask: Callable[[], None]) -> None:
        """Ask, and wait until it says its origin, or the time is over."""
        self._heard.clear()
        ask()
        with suppress(TimeoutError):
            async with asyncio.timeout(_ANSWER_S):
                await self._heard.wait()

    def _tell(self, severity: Severity, text: str) -> None:
        if text == self._told:
            return
        self._told = text
        self._announce(severity, f"VCL {text}")
        _log.log(logging.INFO if severity is Severity.INFO else logging.WARNING, text)
