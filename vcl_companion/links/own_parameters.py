"""Our own settings as MAVLink parameters, for ground stations to show and to change.

https://mavlink.io/en/services/parameter.html. All are REAL32: ground stations read integers in
the way of the vehicle's firmware, ArduPilot's as floats and PX4's as bytes; floats all read alike.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vcl_companion.errors import ConfigError
from vcl_companion.links.messages import (
    PARAMETER_REAL32,
    ParameterList,
    ParameterOrder,
    ParameterRead,
    ParameterSet,
)

_FLOAT = struct.Struct("<f")
_MAX_NAME = 16
# A list goes out one by one: a telemetry radio, and the autopilot before it, drop what is too much.
_APART_S = 0.02


@dataclass(frozen=True)
class Setting:
    """A setting by its parameter's name.

    Attributes:
        name: of the parameter, up to 16 characters of ASCII.
        read: returns what it is.
        write: changes it; raises ValueError or ConfigError for what it cannot be, in one line.
    """

    name: str
    read: Callable[[], float]
    write: Callable[[float], None]

    def __post_init__(self) -> None:
        if not (self.name.isascii() and 1 <= len(self.name) <= _MAX_NAME):
            raise ValueError(f"a parameter's name has 1 to {_MAX_NAME} characters: {self.name!r}")


class OwnParameters:
    """Answers for some settings.

    Args:
        settings: in the order of their indices.
        tell: sends a PARAM_VALUE: name, value, how many there are, index.
        changed: told of a change: name, value, by which system.
        refused: told of a value that is not taken: name and why.
    """

    def __init__(
        self,
        settings: Sequence[Setting],
        tell: Callable[[str, float, int, int], None],
        changed: Callable[[str, float, int], None],
        refused: Callable[[str, str], None],
    ) -> None:
        self._settings = tuple(settings)
        self._index = {setting.name: i for i, setting in enumerate(self._settings)}
        self._tell_value = tell
        self._changed = changed
        self._refused = refused
        self._next = len(self._settings)
        self._wanted = asyncio.Event()

    def take(self, message: ParameterOrder) -> None:
        """Do what is asked for; what is not ours is for somebody else to answer."""
        match message:
            case ParameterList():
                self._next = 0  # a list that is under way begins anew
                self._wanted.set()
            case ParameterRead(index=index) if index >= 0:
                if index < len(self._settings):
                    self._tell(index)
            case ParameterRead(name=name) if name in self._index:
                self._tell(self._index[name])
            case ParameterSet(name=name) if name in self._index:
                self._set(self._settings[self._index[name]], message)
                self._tell(self._index[name])

    def tell(self, name: str) -> None:
        """Tell one that has been changed by something else than a parameter's message."""
        self._tell(self._index[name])

    async def run(self) -> None:
        """Send the lists that were asked for, until cancelled."""
        while True:
            await self._wanted.wait()
            while self._next < len(self._settings):
                self._next += 1
                self._tell(self._next - 1)
                await asyncio.sleep(_APART_S)
            self._wanted.clear()

    def _set(self, setting: Setting, message: ParameterSet) -> None:
        if message.kind != PARAMETER_REAL32:
            self._refused(setting.name, "must be of the type REAL32")
            return
        (told,) = _FLOAT.unpack(message.raw)
        if not math.isfinite(told):
            self._refused(setting.name, f"must be a finite number, got {told}")
            return
        # 0.1 is meant, not 0.10000000149.
        value = float(str(np.float32(told)))
        before = setting.read()
        try:
            setting.write(value)
        except (ValueError, ConfigError) as error:
            self._refused(setting.name, str(error))
            return
        if setting.read() != before:
            self._changed(setting.name, value, message.sender_system)

    def _tell(self, index: int) -> None:
        setting = self._settings[index]
        self._tell_value(setting.name, setting.read(), len(self._settings), index)
