"""Signed frames made by hand, and clocks to make them by."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from tests.links import wire
from vcl_companion.clock import Moment
from vcl_companion.links.signing import Signing, SigningKey, SigningOptions, Stream
from vcl_companion.links.swarm_time import SwarmTime

SECRET = bytes(range(32))
S_NS = 1_000_000_000
# 1 June of 2027, 12:00 GMT, and the same as MAVLink counts: from 1 January of 2015.
NOON_S = 1_811_851_200
NOON = (NOON_S - 1_420_070_400) * 100_000


class Clocks:
    """A host's clocks, which stand still until they are moved."""

    def __init__(self, wall_s: float = NOON_S, running_s: float = 1000.0) -> None:
        self.wall_s = wall_s
        self.running_s = running_s

    def now(self) -> Moment:
        return Moment(round(self.wall_s * S_NS), round(self.running_s * S_NS))

    def pass_s(self, seconds: float) -> Moment:
        self.wall_s += seconds
        self.running_s += seconds
        return self.now()


def trailer(frame: bytes, timestamp: int, secret: bytes = SECRET, link_id: int = 0) -> bytes:
    """What the guide says follows a frame that has bit 0 of its flags set."""
    told = bytes([link_id]) + timestamp.to_bytes(6, "little")
    return told + hashlib.sha256(secret + frame + told).digest()[:6]


def frame(
    timestamp: int,
    message_id: int = wire.HEARTBEAT,
    payload: bytes | None = None,
    *,
    secret: bytes = SECRET,
    system: int = 2,
    component: int = 197,
    link_id: int = 0,
) -> bytes:
    """A signed frame, a heartbeat if nothing else is wanted."""
    if payload is None:
        payload = wire.LAYOUT[wire.HEARTBEAT].pack(0, 18, 8, 0, 4, 3)
    unsigned = wire.frame(message_id, payload, system=system, component=component, flags=1)[:-13]
    return unsigned + trailer(unsigned, timestamp, secret, link_id)


def tunnel(payload: bytes, timestamp: int, system: int = 2) -> bytes:
    fields = wire.LAYOUT[wire.TUNNEL].pack(40000, 0, 0, len(payload), payload)
    return frame(timestamp, wire.TUNNEL, fields, system=system)


def signing(
    clocks: Clocks,
    *,
    reserved: int = 0,
    marks: dict[Stream, int] | None = None,
    secret: bytes | None = SECRET,
    allow_unsigned: bool = False,
) -> Signing:
    """Signing with the tests' key."""
    key = None if secret is None else SigningKey(secret)
    time = SwarmTime(reserved, clocks.now())
    return Signing(key, time, marks, SigningOptions(allow_unsigned=allow_unsigned))


def judge(
    clocks: Clocks,
    *,
    marks: dict[Stream, int] | None = None,
    secret: bytes | None = SECRET,
    allow_unsigned: bool = False,
) -> Callable[[bytes], str | None]:
    """What ``signing`` says of frames."""
    ours = signing(clocks, marks=marks, secret=secret, allow_unsigned=allow_unsigned)
    return lambda data: ours.refusal(data, clocks.now())


def key_file(path: Path) -> Path:
    """A key file by hand."""
    path.write_text("0f" * 32 + "\n", encoding="ascii")
    path.chmod(0o600)
    return path
