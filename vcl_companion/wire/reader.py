"""A cursor over untrusted bytes that cannot run past their end."""

from __future__ import annotations

import struct
from typing import Any

from vcl_companion.errors import WireError


class Reader:
    """Takes bytes from front to back; every shortage is a ``WireError``."""

    def __init__(self, data: bytes, what: str, start: int = 0) -> None:
        self._data = data
        self._at = start
        self._what = what

    def take(self, n_bytes: int) -> bytes:
        """Return the next ``n_bytes``."""
        end = self._at + n_bytes
        if n_bytes < 0 or end > len(self._data):
            raise WireError(f"{self._what} ends early: {n_bytes} bytes wanted at {self._at}")
        out = self._data[self._at : end]
        self._at = end
        return out

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the fields of ``layout`` from the next bytes."""
        return layout.unpack(self.take(layout.size))

    def rest(self) -> bytes:
        """Return all that has not been taken, and leave it."""
        return self._data[self._at :]

    def finish(self) -> None:
        """Raise unless every byte was taken."""
        if self._at != len(self._data):
            raise WireError(f"{self._what} has {len(self._data) - self._at} bytes too many")
