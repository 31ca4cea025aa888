"""What goes first when not everything can: a pose that is flown on before any map.

Strictly by urgency nothing of little urgency would ever go while there is much of
the others; so who has been passed over for long gets one turn.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from enum import IntEnum
from types import MappingProxyType

from vcl_companion.wire.header import BlobKind
from vcl_companion.wire.messages import FrameRequest, MapRefused, MapState
from vcl_companion.wire.pose_messages import PoseProposal, PoseRefused

# With all kinds waiting the least of them still gets a tenth.
_PATIENCE = 8

Message = FrameRequest | MapState | MapRefused | PoseProposal | PoseRefused


class Urgency(IntEnum):
    """The order in which payloads go."""

    POSE_ANSWER = 0
    STATUS = 1  # short, and without it a peer sends in vain
    POSE_REQUEST = 2
    REQUEST = 3
    FRAME = 4
    MAP = 5


URGENCY_OF_BLOB: Mapping[BlobKind, Urgency] = MappingProxyType(
    {
        BlobKind.POSE_REQUEST: Urgency.POSE_REQUEST,
        BlobKind.FRAME_ANSWER: Urgency.FRAME,
        BlobKind.MAP: Urgency.MAP,
        BlobKind.MAP_UPDATE: Urgency.MAP,
        BlobKind.MAP_PART: Urgency.MAP,
        BlobKind.PASSED_FRAME: Urgency.MAP,
    }
)


def urgency_of(message: Message) -> Urgency:
    """Return how urgent a message is that is no part of a transfer."""
    if isinstance(message, PoseProposal | PoseRefused):
        return Urgency.POSE_ANSWER
    return Urgency.REQUEST


class Turns:
    """Whose turn it is, one payload after the other."""

    def __init__(self) -> None:
        self._passed_over = dict.fromkeys(Urgency, 0)

    def next(self, ready: Collection[Urgency]) -> Urgency:
        """Return the most urgent of those that are ready, or one that has waited for long."""
        chosen = min(ready, key=lambda u: (self._passed_over[u] < _PATIENCE, u))
        for urgency in ready:
            self._passed_over[urgency] += 1
        self._passed_over[chosen] = 0
        return chosen
