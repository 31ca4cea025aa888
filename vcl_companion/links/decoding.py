"""MAVLink 2 from bytes: frames found in them, judged, and read into typed messages.

Frame, little endian (https://mavlink.io/en/guide/serialization.html):

    0      magic 0xFD
    1      payload length n (trailing zeros of a payload are not sent)
    2      incompatibility flags: bit 0 = signed, any other = not for us
    3      compatibility flags
    4      sequence
    5, 6   system id, component id of the sender
    7..9   message id
    10     payload, n bytes
    10+n   CRC-16/MCRF4XX over bytes 1.. and one byte that stands for the message's layout
    12+n   signature, 13 bytes, when signed (signing.py)
"""

from __future__ import annotations

from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from vcl_companion.clock import Moment
from vcl_companion.links.counters import LinkTally
from vcl_companion.links.messages import Message, Timesync, Untimely
from vcl_companion.links.readers import READERS
from vcl_companion.links.signing import (
    AHEAD,
    BEHIND,
    NOT_OURS,
    SIGNED_FLAG,
    TRAILER_BYTES,
    Signing,
    timestamp_of,
)

_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_OVERHEAD_1, _OVERHEAD_2 = 8, 12
# Of a datagram, where a magic number was none. One frame that was damaged on its way has two.
_MOST_TRIED_AGAIN = 32


class Decoder:
    """The receiving side of a link; keeps the rest of a stream.

    Bytes that are not what they should be never raise; they are counted by
    reason in the tally. At most one unfinished frame (280 bytes) is kept.

    Args:
        own_id: our system and component id.
        tally: where it counts.
        signing: judges what comes in; None: signatures are not looked at.
        now: tells the time that timestamps are judged by.
    """

    def __init__(
        self,
        own_id: tuple[int, int],
        tally: LinkTally,
        signing: Signing | None,
        now: Callable[[], Moment],
    ) -> None:
        # It only takes payloads apart, by their layouts.
        self._mav = dialect.MAVLink(None)
        self._own_id = own_id
        self._tally = tally
        self._signing = signing
        self._now = now
        self.unfinished = b""
        """What is kept of a stream: a frame that is not all here."""

    def stream(self, data: bytes) -> list[Message]:
        """Return the messages that ``data`` completes, after what came before it."""
        data = self.unfinished + data
        messages, self.unfinished = self._decode(data, len(data))
        return messages

    def datagram(self, data: bytes) -> list[Message]:
        """Return the messages in one datagram, whatever came before it."""
        messages, rest = self._decode(data, _MOST_TRIED_AGAIN)
        if rest:
            self._tally.refuse("truncated")
        return messages

    def _decode(self, data: bytes, most_tried_again: int) -> tuple[list[Message], bytes]:
        """Return messages and the unfinished frame at the end.

        After a wrong checksum the search goes on at the next byte, so that a
        magic number within garbage cannot swallow true messages; but not for ever, for
        each place costs a checksum before anybody's signature is looked at.
        """
        messages: list[Message] = []
        at = n_tried_again = 0
        while at < len(data):
            if n_tried_again > most_tried_again:
                self._tally.refuse("garbage bytes", len(data) - at)
                break
            magic = data[at]
            if magic not in (_MAGIC_1, _MAGIC_2):
                next_at = _next_magic(data, at)
                self._tally.refuse("garbage bytes", next_at - at)
                at = next_at
                continue
            if len(data) - at < 3:
                return messages, data[at:]
            flags = data[at + 2] if magic == _MAGIC_2 else 0
            if flags & ~SIGNED_FLAG:
                self._tally.refuse("unknown incompatibility flags")
                at += 1
                n_tried_again += 1
                continue
            overhead = _OVERHEAD_2 if magic == _MAGIC_2 else _OVERHEAD_1
            end = at + overhead + data[at + 1] + (TRAILER_BYTES if flags else 0)
            if end > len(data):
                return messages, data[at:]
            message, consumed = self._frame(data[at:end], data[end : end + 1])
            if message is not None:
                messages.append(message)
            at = end if consumed else at + 1
            n_tried_again += not consumed
        return messages, b""

    def _frame(self, frame: bytes, following: bytes) -> tuple[Message | None, bool]:
        """Return a whole frame's message, if wanted, and whether it was a frame at all."""
        old = frame[0] == _MAGIC_1
        message_id = frame[5] if old else int.from_bytes(frame[7:10], "little")
        layout = dialect.mavlink_map.get(message_id)
        if layout is None:
            # Its checksum cannot be judged. Taken as whole when a frame follows, so that
            # nobody can hide a message for us in one that routers do not know either.
            whole = following in (b"", bytes([_MAGIC_1]), bytes([_MAGIC_2]))
            self._tally.refuse("unknown message" if whole else "garbage bytes")
            return None, whole
        signature = TRAILER_BYTES if not old and frame[2] & SIGNED_FLAG else 0
        body_end = len(frame) - 2 - signature
        checksum = dialect.x25crc(frame[1:body_end] + bytes([layout.crc_extra])).crc
        if checksum != int.from_bytes(frame[body_end : body_end + 2], "little"):
            self._tally.refuse("wrong checksum")
            return None, False
        if old:
            self._tally.refuse("MAVLink 1")
            return None, True
        self._tally.messages_in += 1
        if message_id == dialect.MAVLINK_MSG_ID_SETUP_SIGNING:
            # It holds a key. Ours come from a file, and others' are not for anybody to see.
            self._tally.refuse("a key by radio")
            return None, True
        refusal = self._refusal(self._signing, frame) if self._signing else None
        if refusal is not None:
            self._tally.refuse(refusal)
            untimely = refusal in (AHEAD, BEHIND)
            return self._untimely(frame, refusal == AHEAD) if untimely else None, True
        message = self._read(frame, message_id)
        if isinstance(message, str):
            self._tally.refuse(message)
            return None, True
        return message, True

    def _refusal(self, signing: Signing, frame: bytes) -> str | None:
        refusal = signing.refusal(frame, self._now())
        in_our_name = (frame[5], frame[6]) == self._own_id
        if refusal is None and in_our_name and signing.is_of_another(frame):
            return NOT_OURS
        return refusal

    def _read(self, frame: bytes, message_id: int) -> Message | str | None:
        """Return a frame's message, why it is refused, or None when nobody wants it."""
        read = READERS.get(dialect.mavlink_map[message_id].msgname)
        if read is None:
            return None
        # A layout's payload, cut or with unknown extensions, is padded or cut to its size.
        return read(self._mav.decode(bytearray(frame)), (frame[5], frame[6]))

    def _untimely(self, frame: bytes, ahead: bool) -> Untimely:
        message_id = int.from_bytes(frame[7:10], "little")
        is_timesync = message_id == dialect.MAVLINK_MSG_ID_TIMESYNC
        said = self._read(frame, message_id) if is_timesync else None
        timesync = said if isinstance(said, Timesync) else None
        return Untimely(frame[5], frame[6], timestamp_of(frame), ahead, timesync)


def _next_magic(data: bytes, at: int) -> int:
    found = [i for i in (data.find(_MAGIC_1, at), data.find(_MAGIC_2, at)) if i >= 0]
    return min(found, default=len(data))
