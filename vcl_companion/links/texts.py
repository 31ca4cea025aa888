"""STATUSTEXT: what people read on their ground stations, in chunks of 50 bytes."""

from __future__ import annotations

import enum

from vcl_companion.links.mavlink import Codec
from vcl_companion.links.messages import STATUS_TEXT_BYTES
from vcl_companion.links.transport import Transport

_MAX_TEXT_BYTES = 8 * STATUS_TEXT_BYTES


class Severity(enum.IntEnum):
    """MAV_SEVERITY."""

    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7


class Texts:
    """Says texts over one link.

    Args:
        codec: makes their frames.
        transport: takes them.
    """

    def __init__(self, codec: Codec, transport: Transport) -> None:
        self._codec = codec
        self._transport = transport
        self._said: tuple[Severity, str] | None = None
        self._n_long = 0

    def say(self, severity: Severity, text: str) -> None:
        """Say a text, unless it was the last one said."""
        if self._said == (severity, text):
            return
        self._said = (severity, text)
        self.announce(severity, text)

    def say_again(self) -> None:
        """Say the last one again: nobody may have heard it."""
        if self._said is not None:
            self.announce(*self._said)

    def announce(self, severity: Severity, text: str) -> None:
        """Say something that has happened, whatever was said before."""
        # Ground stations differ in what they make of a character cut in two by a chunk.
        data = text.encode("ascii", "replace")[:_MAX_TEXT_BYTES]
        if len(data) <= STATUS_TEXT_BYTES:
            self._transport.write(self._codec.status_text(severity, data, 0, 0))
            return
        self._n_long += 1
        text_id = (self._n_long - 1) % 65535 + 1
        # A zero byte ends the text: a last chunk that is full needs an empty one after it.
        for chunk in range(len(data) // STATUS_TEXT_BYTES + 1):
            part = data[chunk * STATUS_TEXT_BYTES : (chunk + 1) * STATUS_TEXT_BYTES]
            self._transport.write(self._codec.status_text(severity, part, text_id, chunk))
