"""MAVLink 2 message signing: who has the key has made the frame, and every frame counts once.

After the frame's checksum, little endian (https://mavlink.io/en/guide/message_signing.html):

    0      link id: 0, we have one link
    1..6   timestamp: ticks of 10 us since 1 January 2015, GMT
    7..12  first 6 bytes of SHA-256 of: the key, the frame from its magic number to its
           checksum, link id and timestamp

A frame is taken when, in this order,

1. it is signed (RADIO_STATUS need not be: radios have no key, and it says nothing to us),
2. the signature is right,
3. the timestamp is within the allowed skew of ours (``swarm_time.py``), in both directions,
4. and none with that timestamp has come from the same sender, component and link id, nor
   one that is younger by more than a second, as long as that is what frames overtake each
   other by. (The guide wants them to rise strictly. Datagrams do not always: an access
   point holds broadcasts back for those who sleep, and all would be lost that way.)

Nothing is remembered of a frame before all of that holds: pymavlink's verifier stores the
timestamp before it looks at the signature, so that one forged frame of the far future locks
the true sender out. A stream that has been silent for longer than the skew is forgotten:
what its mark would refuse is refused as too old. So there are as many marks as there are
senders, and no stranger adds any.

This protects against those who do not have the key. Those who have it can say anything in
anybody's name; and nothing is hidden from those who listen.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from vcl_companion.clock import Moment
from vcl_companion.links.swarm_time import TICKS_PER_S, SwarmTime

SIGNED_FLAG = 0x01
TRAILER_BYTES = 13
SECRET_BYTES = 32
AHEAD: Final = "timestamp in the future"
BEHIND: Final = "timestamp too old"
UNSIGNED: Final = "not signed"
FORGED: Final = "wrong signature"
REPLAYED: Final = "replayed"
NO_KEY: Final = "no key to verify with"
NOT_OURS: Final = "of another with our system id"

_SIGNATURE_BYTES = 6
_RADIO_STATUS_ID = 109
_LINK_ID = 0
_MAX_STREAMS = 1024
_MAX_HEARD = 4096  # timestamps remembered of one stream

Stream = tuple[int, int, int]
"""System, component and link id of a sender."""


class SigningKey:
    """The secret that the swarm shares. It cannot be read back, printed or logged.

    Args:
        secret: its 32 bytes.

    Attributes:
        fingerprint: tells keys apart, and tells nothing else of them.
    """

    def __init__(self, secret: bytes) -> None:
        if len(secret) != SECRET_BYTES:
            raise ValueError(f"a key has {SECRET_BYTES} bytes, got {len(secret)}")
        self._begun = hashlib.sha256(secret)
        self.fingerprint = hashlib.sha256(b"vcl key fingerprint\0" + secret).hexdigest()[:16]

    def signature(self, data: bytes) -> bytes:
        """Return the 6 bytes that sign ``data``: a frame with its link id and timestamp."""
        digest = self._begun.copy()
        digest.update(data)
        return digest.digest()[:_SIGNATURE_BYTES]

    def __repr__(self) -> str:
        return f"SigningKey({self.fingerprint})"


@dataclass(frozen=True)
class SigningOptions:
    """How strict frames are judged.

    Attributes:
        allow_unsigned: frames without a signature are taken as well.
        skew_s: how far a frame's timestamp may be off ours, in both directions.
        overtaking_s: how much older than the youngest of its stream a frame may be.
    """

    allow_unsigned: bool = False
    skew_s: float = 60.0
    overtaking_s: float = 1.0


class _Heard:
    """The timestamps that were taken from one stream: all up to ``_floor``, and some above."""

    def __init__(self, latest: int) -> None:
        self.latest = latest
        self._floor = latest
        self._above: set[int] = set()

    def takes(self, timestamp: int, overtaking: int) -> bool:
        """Whether a timestamp is new; then it is not new any more."""
        if timestamp <= self._floor or timestamp in self._above:
            return False
        self._above.add(timestamp)
        self.latest = max(self.latest, timestamp)
        self._floor = max(self._floor, self.latest - overtaking)
        if len(self._above) > _MAX_HEARD:
            above = sorted(at for at in self._above if at > self._floor)
            if len(above) > _MAX_HEARD // 2:
                self._floor = above[-_MAX_HEARD // 2 - 1]
                above = above[-_MAX_HEARD // 2 :]
            self._above = set(above)
        return True


class Signing:
    """Signs what one link sends, and judges what it hears.

    Args:
        key: shared with the other side; None: nothing is signed, and only what
            ``allow_unsigned`` lets through is taken.
        time: the swarm's.
        marks: the latest timestamps of each stream, as the last run has left them.
        options: how strict it is.
    """

    def __init__(
        self,
        key: SigningKey | None,
        time: SwarmTime,
        marks: Mapping[Stream, int] | None = None,
        options: SigningOptions | None = None,
    ) -> None:
        self.time = time
        self._key = key
        self._heard = {stream: _Heard(latest) for stream, latest in (marks or {}).items()}
        self._options = options or SigningOptions()
        self._skew = round(self._options.skew_s * TICKS_PER_S)
        self._overtaking = round(self._options.overtaking_s * TICKS_PER_S)

    @property
    def signs(self) -> bool:
        """Whether there is a key to sign with."""
        return self._key is not None

    def trailer(self, frame: bytes, now: Moment) -> bytes:
        """Return the 13 bytes that follow a frame, which says that it is signed, and its checksum.

        Raises:
            ValueError: there is no key.
        """
        if self._key is None:
            raise ValueError("there is no key to sign with")
        told = bytes([_LINK_ID]) + self.time.next(now).to_bytes(6, "little")
        return told + self._key.signature(frame + told)

    def refusal(self, frame: bytes, now: Moment) -> str | None:
        """Judge a whole MAVLink 2 frame with a right checksum.

        Returns:
            None when it is taken: that very frame is not taken again. Else why not; for
            ``AHEAD`` and ``BEHIND`` the signature is right.
        """
        if not frame[2] & SIGNED_FLAG:
            by_radio = int.from_bytes(frame[7:10], "little") == _RADIO_STATUS_ID
            return None if by_radio or self._options.allow_unsigned else UNSIGNED
        if self._key is None:
            return None if self._options.allow_unsigned else NO_KEY
        signed, signature = frame[:-_SIGNATURE_BYTES], frame[-_SIGNATURE_BYTES:]
        if not hmac.compare_digest(self._key.signature(signed), signature):
            return FORGED
        timestamp, ours = timestamp_of(frame), self.time.at(now)
        if timestamp > ours + self._skew:
            return AHEAD
        if timestamp < ours - self._skew:
            return BEHIND
        stream = (frame[5], frame[6], frame[-TRAILER_BYTES])
        heard = self._heard.get(stream)
        if heard is None:
            if len(self._heard) >= _MAX_STREAMS:
                self._forget(ours)
            if len(self._heard) >= _MAX_STREAMS:
                return "too many streams"
            heard = self._heard[stream] = _Heard(timestamp - self._overtaking)
        return None if heard.takes(timestamp, self._overtaking) else REPLAYED

    def is_of_another(self, frame: bytes) -> bool:
        """Whether a frame that was taken, in our name, is younger than all that we have signed.

        Of two who have one name it is told to the one whose time is behind, sooner or later.
        """
        return bool(frame[2] & SIGNED_FLAG) and timestamp_of(frame) > self.time.latest

    def marks(self, now: Moment) -> dict[Stream, int]:
        """Return the latest timestamp of each stream that is not too old to matter."""
        self._forget(self.time.at(now))
        return {stream: heard.latest for stream, heard in self._heard.items()}

    def _forget(self, ours: int) -> None:
        oldest = ours - self._skew
        self._heard = {k: heard for k, heard in self._heard.items() if heard.latest >= oldest}


def timestamp_of(frame: bytes) -> int:
    """Return what a signed frame was stamped with."""
    return int.from_bytes(frame[-TRAILER_BYTES + 1 : -_SIGNATURE_BYTES], "little")
