"""What fits one payload: requests and states between peers."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import NAME_BYTES, NO_NAME
from vcl_companion.vision.signature import SIGNATURE_BYTES
from vcl_companion.wire.map_codec import MAX_LANDMARKS, REVISION_BYTES
from vcl_companion.wire.reader import Reader

MAX_AGE_S = 3600.0
MAX_REASON_BYTES = 90
MAX_TRACKED = (1 << 16) - 1
MAX_TEAM = (1 << 8) - 1
MAX_EPOCH = (1 << 32) - 1

# FrameRequest body
# | 0  | u32 | request id                                             |
# | 4  | i64 | the wanted instant, ns, the asker's own clock          |
# | 12 | f64 | age of the wanted instant when the request was sent, s |
_FRAME_REQUEST = struct.Struct("<Iqd")

# MapState body
# | 0 | u8      | bytes of the revision: 0 (no map) or 8   |
# | 1 | 8 bytes | revision, zeros when there is none       |
# | 9 | u32     | landmarks of that map                    |
# | 13 | u8     | 1: localized in it now, 0: not           |
# | 14 | u8     | 1: wants it updated, 0: not              |
# | 15 | u16    | landmarks that agreed in the last frame  |
# | 17 | u8     | team                                     |
# | 18 | u32    | epoch: the highest known of that team    |
# | 22 | 8 bytes | world of that map, zeros when unknown   |
# | 30 | u8     | bytes of the signature, at most 48       |
# | 31 | rest   | signature of a frame                     |
_MAP_STATE = struct.Struct("<B8sIBBHBI8sB")

# MapRefused body
# | 0 | u32  | request id                                |
# | 4 | rest | reason, printable UTF-8, 1 to 90 bytes    |
_MAP_REFUSED = struct.Struct("<I")


@dataclass(frozen=True)
class FrameRequest:
    """Asks a peer for its frame of one instant.

    Attributes:
        request_id: chosen by who asks, echoed in the answer.
        at_ns: the instant, on the asker's own clock; who knows that clock goes by this.
        frame_age_s: how long before the sending of this request the instant was, for
            who does not know it.
    """

    request_id: int
    at_ns: int
    frame_age_s: float

    def __post_init__(self) -> None:
        check_request_id(self.request_id)
        if not -(1 << 63) <= self.at_ns < 1 << 63:
            raise ValueError(f"an instant has 64 bits: {self.at_ns}")
        check_age(self.frame_age_s)


@dataclass(frozen=True)
class MapState:
    """Which map a drone flies on.

    Attributes:
        revision: 8 bytes (``revision_of``), or empty without a map.
        n_landmarks: of that map.
        localized: whether it localizes in it now.
        tracked: landmarks that agreed on the pose of its last frame; 0 when there is none.
        wants_update: its vote: it sees too few of them (IV-G).
        team: who it flies with, named by a system id; 0 from the start (``swarm/teams.py``).
        epoch: the highest that it knows of that team.
        world: 8 bytes, the first map of the line that its map is of; empty without a map, or
            where that is not known.
        signature: of a frame of the last seconds (``vision/signature.py``); empty most times.
    """

    revision: bytes
    n_landmarks: int
    localized: bool
    tracked: int = 0
    wants_update: bool = False
    team: int = 0
    epoch: int = 0
    world: bytes = b""
    signature: bytes = b""

    def __post_init__(self) -> None:
        if len(self.revision) not in (0, REVISION_BYTES):
            raise ValueError(f"a revision has 0 or {REVISION_BYTES} bytes: {self.revision!r}")
        if not 0 <= self.n_landmarks <= MAX_LANDMARKS:
            raise ValueError(f"a map of {self.n_landmarks} landmarks, at most {MAX_LANDMARKS}")
        if not 0 <= self.tracked <= MAX_TRACKED:
            raise ValueError(f"tracked landmarks have 16 bits: {self.tracked}")
        if not 0 <= self.team <= MAX_TEAM:
            raise ValueError(f"a team has 8 bits: {self.team}")
        if not 0 <= self.epoch <= MAX_EPOCH:
            raise ValueError(f"an epoch has 32 bits: {self.epoch}")
        if len(self.world) not in (0, NAME_BYTES) or self.world == NO_NAME:
            raise ValueError(f"a world has 0 or {NAME_BYTES} bytes, not all 0: {self.world!r}")
        if len(self.signature) > SIGNATURE_BYTES:
            raise ValueError(
                f"a signature of {len(self.signature)} bytes, at most {SIGNATURE_BYTES}"
            )

    def is_news_after(self, before: MapState) -> bool:
        """Return whether it says more than how much is seen of the same map, and of what place."""
        return self._course() != before._course()

    def _course(self) -> tuple[object, ...]:
        return (
            self.revision, self.localized, self.wants_update, self.team, self.epoch, self.world
        )  # fmt: skip


@dataclass(frozen=True)
class MapRefused:
    """Why no map came of a request.

    Attributes:
        request_id: of the request.
        reason: one printable line of at most 90 bytes; ``because`` makes any text one.
    """

    request_id: int
    reason: str

    def __post_init__(self) -> None:
        check_request_id(self.request_id)
        check_reason(self.reason)

    @classmethod
    def because(cls, request_id: int, reason: str) -> MapRefused:
        """Make the message of any text: shortened to fit, what cannot be printed replaced."""
        return cls(request_id, fitting_reason(reason))


def encode_frame_request(message: FrameRequest) -> bytes:
    """Return the body of a frame request."""
    return _FRAME_REQUEST.pack(message.request_id, message.at_ns, message.frame_age_s)


def decode_frame_request(body: bytes) -> FrameRequest:
    """Return the frame request of a body, or raise WireError."""
    reader = Reader(body, "frame request")
    request_id, at_ns, frame_age_s = reader.unpack(_FRAME_REQUEST)
    reader.finish()
    try:
        return FrameRequest(request_id, at_ns, frame_age_s)
    except ValueError as error:
        raise WireError(f"frame request: {error}") from None


def encode_map_state(message: MapState) -> bytes:
    """Return the body of a map state."""
    head = _MAP_STATE.pack(
        len(message.revision),
        message.revision,
        message.n_landmarks,
        message.localized,
        message.wants_update,
        message.tracked,
        message.team,
        message.epoch,
        message.world or NO_NAME,
        len(message.signature),
    )
    return head + message.signature


def decode_map_state(body: bytes) -> MapState:
    """Return the map state of a body, or raise WireError."""
    reader = Reader(body, "map state")
    fields = reader.unpack(_MAP_STATE)
    n_revision, revision, n_landmarks, localized, wants, tracked = fields[:6]
    team, epoch, world, n_signature = fields[6:]
    signature = reader.take(n_signature)
    reader.finish()
    if n_revision > REVISION_BYTES or revision[n_revision:].strip(b"\0"):
        raise WireError("map state: malformed")
    if localized > 1 or wants > 1:
        raise WireError("map state: neither yes nor no")
    try:
        return MapState(
            revision[:n_revision],
            n_landmarks,
            bool(localized),
            tracked,
            bool(wants),
            team,
            epoch,
            b"" if world == NO_NAME else world,
            signature,
        )
    except ValueError as error:
        raise WireError(f"map state: {error}") from None


def encode_map_refused(message: MapRefused) -> bytes:
    """Return the body of a refusal."""
    return _MAP_REFUSED.pack(message.request_id) + message.reason.encode("utf-8")


def decode_map_refused(body: bytes) -> MapRefused:
    """Return the refusal of a body, or raise WireError."""
    (request_id,) = Reader(body, "map refused").unpack(_MAP_REFUSED)
    try:
        return MapRefused(request_id, body[_MAP_REFUSED.size :].decode("utf-8"))
    except ValueError as error:  # UnicodeDecodeError is one
        raise WireError(f"map refused: {error}") from None


def check_request_id(request_id: int) -> None:
    """Raise ValueError unless the id fits its 32 bits."""
    if not 0 <= request_id < 1 << 32:
        raise ValueError(f"a request id has 32 bits: {request_id}")


def check_age(age_s: float) -> None:
    """Raise ValueError unless an age is one: finite, not negative, at most an hour."""
    if not 0.0 <= age_s <= MAX_AGE_S:
        raise ValueError(f"an age of 0 to {MAX_AGE_S:.0f} s: {age_s}")


def check_reason(reason: str) -> None:
    """Raise ValueError unless a reason is one printable line of 1 to 90 bytes."""
    if not reason.isprintable():
        raise ValueError("a reason must be printable")
    if not 1 <= len(reason.encode("utf-8")) <= MAX_REASON_BYTES:
        raise ValueError(f"a reason has 1 to {MAX_REASON_BYTES} bytes: {reason!r}")


def fitting_reason(text: str) -> str:
    """Return any text as a reason: shortened to fit, what cannot be printed replaced."""
    printable = "".join(c if c.isprintable() else " " for c in text).strip() or "no reason given"
    return printable.encode("utf-8")[:MAX_REASON_BYTES].decode("utf-8", errors="ignore")
