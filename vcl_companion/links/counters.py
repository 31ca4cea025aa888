"""What went over a link, and what was refused, counted by reason."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class LinkCounters:
    """A snapshot of one link's counts since it was made.

    Attributes:
        bytes_in, bytes_out: what the device or socket gave and took.
        messages_in: MAVLink 2 messages with a correct checksum, wanted or not.
        messages_out: messages handed to the transport.
        connects: times the device or socket was opened.
        refused: reason -> times, for everything not accepted or not sent. The
            reason "garbage bytes" counts bytes, all others count messages.
    """

    bytes_in: int
    bytes_out: int
    messages_in: int
    messages_out: int
    connects: int
    refused: Mapping[str, int]


class LinkTally:
    """The running counts of one link, shared by its transport, its codec and its owner."""

    def __init__(self) -> None:
        self.bytes_in = 0
        self.bytes_out = 0
        self.messages_in = 0
        self.messages_out = 0
        self.connects = 0
        self._refused: Counter[str] = Counter()

    def refuse(self, reason: str, times: int = 1) -> None:
        """Count something that was not accepted or not sent."""
        self._refused[reason] += times

    def snapshot(self) -> LinkCounters:
        """Return the counts as they are now."""
        return LinkCounters(
            self.bytes_in,
            self.bytes_out,
            self.messages_in,
            self.messages_out,
            self.connects,
            MappingProxyType(dict(self._refused)),
        )
