"""An autopilot's parameters, one by one: the PARAM protocol's reading and setting.

An ArduPilot sends every value as a float; a PX4 sends an integer's four bytes in its place
(https://mavlink.io/en/services/parameter.html, "Parameter Encoding").
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable
from contextlib import suppress

from vcl_companion.links.messages import ParameterValue
from vcl_companion.links.vision_pose import Firmware

_FLOAT = struct.Struct("<f")
# By MAV_PARAM_TYPE: UINT32, INT32
_INTEGERS = {5: struct.Struct("<I"), 6: struct.Struct("<i")}
_ANSWER_S = 0.5
_N_ATTEMPTS = 4


def value_of(message: ParameterValue, firmware: Firmware) -> float:
    """Return a parameter's value as its firmware means its bytes."""
    return float(_form(message.kind, firmware).unpack(message.raw)[0])


def raw_of(value: float, kind: int, firmware: Firmware) -> bytes:
    """Return the four bytes of a value for a parameter of a type."""
    form = _form(kind, firmware)
    return form.pack(value if form is _FLOAT else round(value))


def _said(message: ParameterValue, firmware: Firmware) -> float | None:
    """Return a value; None where it is no number, by which nothing is said."""
    value = value_of(message, firmware)
    return value if math.isfinite(value) else None


def _form(kind: int, firmware: Firmware) -> struct.Struct:
    return _INTEGERS.get(kind, _FLOAT) if firmware is Firmware.PX4 else _FLOAT


class Parameters:
    """Asks for parameters and waits for the answers; one question of a name at a time.

    Args:
        read: sends the question for one.
        write: sends a new value: name, its bytes, its type.
    """

    def __init__(
        self, read: Callable[[str], None], write: Callable[[str, bytes, int], None]
    ) -> None:
        self._read = read
        self._write = write
        self._waiting: dict[str, asyncio.Future[ParameterValue]] = {}

    def answered(self, message: ParameterValue) -> None:
        """Take a PARAM_VALUE in, asked for or not."""
        future = self._waiting.pop(message.name, None)
        if future is not None and not future.done():
            future.set_result(message)

    async def value(self, name: str, firmware: Firmware) -> float | None:
        """Return a parameter's value; None when the autopilot has none of the name, or a NaN."""
        message = await self._asked(name, lambda: self._read(name))
        return None if message is None else _said(message, firmware)

    async def set(self, name: str, value: float, firmware: Firmware) -> float | None:
        """Set a parameter; return the value that it has then, None when it does not say."""
        known = await self._asked(name, lambda: self._read(name))
        if known is None:
            return None
        raw = raw_of(value, known.kind, firmware)
        message = await self._asked(name, lambda: self._write(name, raw, known.kind))
        return None if message is None else _said(message, firmware)

    async def _asked(self, name: str, ask: Callable[[], None]) -> ParameterValue | None:
        for _ in range(_N_ATTEMPTS):
            future: asyncio.Future[ParameterValue] = asyncio.get_running_loop().create_future()
            self._waiting[name] = future
            ask()
            with suppress(TimeoutError):
                async with asyncio.timeout(_ANSWER_S):
                    return await future
        self._waiting.pop(name, None)
        return None
