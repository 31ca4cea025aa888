"""MAVLink 2 frames by hand, right or wrong; shares no code with ``links``.

https://mavlink.io/en/guide/serialization.html
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import fastcrc

from sitl.torture.dice import Dice
from sitl.torture.mutations import mutated

COMPANION = 197
TUNNEL = 385
MAX_TUNNEL_BYTES = 128

# Message id -> one byte that stands for its layout, and the length of its payload.
LAYOUTS = {
    0: (50, 9),  # HEARTBEAT
    30: (39, 28),  # ATTITUDE
    31: (246, 48),  # ATTITUDE_QUATERNION
    76: (152, 33),  # COMMAND_LONG
    77: (143, 10),  # COMMAND_ACK
    111: (34, 18),  # TIMESYNC
    253: (83, 54),  # STATUSTEXT
    TUNNEL: (147, 133),
}
_NOT_TUNNELS = tuple(number for number in LAYOUTS if number != TUNNEL)
_TUNNEL = struct.Struct("<HBBB")
_MAGIC_1, _MAGIC_2 = 0xFE, 0xFD
_SIGNED = 1

Payload = tuple[int, bytes]
"""Payload type of a TUNNEL, and its payload."""


def frame(message_id: int, body: bytes, sender: int, component: int = COMPANION) -> bytes:
    """Return a frame whose checksum is right, the trailing zeros of its payload left out."""
    body = body.rstrip(b"\0") or b"\0"
    head = struct.pack("<BBBBBB", len(body), 0, 0, 0, sender, component)
    covered = head + message_id.to_bytes(3, "little") + body
    crc = fastcrc.crc16.mcrf4xx(covered + bytes([LAYOUTS[message_id][0]]), 0xFFFF)
    return b"\xfd" + covered + struct.pack("<H", crc)


def tunnel(payload: Payload, sender: int, target: int, component: int = COMPANION) -> bytes:
    """Return a TUNNEL to a companion, or to everybody (0)."""
    return frame(TUNNEL, _body(payload, target, len(payload[1])), sender, component)


def hostile(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    """Return the bytes of a datagram in which a frame is wrong, or not alone, or not from there."""
    return dice.pick(_WAYS)(payload, sender, target, dice)


def _body(payload: Payload, target: int, said_bytes: int, component: int = COMPANION) -> bytes:
    head = _TUNNEL.pack(payload[0], target, component if target else 0, said_bytes)
    return head + payload[1].ljust(MAX_TUNNEL_BYTES, b"\0")


def _mutated_frame(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    good = tunnel(payload, sender, target)
    return mutated(good, dice, good)


def _lying_length(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    said = dice.pick((0, 1, 2, 127, 128, 129, 200, 255, dice.below(256)))
    return frame(TUNNEL, _body(payload, target, said), sender)


def _mutated_body(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    body = mutated(_body(payload, target, len(payload[1])), dice, payload[1])
    return frame(TUNNEL, body[:255], sender)


def _other_type(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    other = dice.pick((0, 1, 200, 32_767, 32_768, 33_099, 33_100, 33_101, 33_102, 65_535))
    return tunnel((other, payload[1]), sender, target)


def _other_sender(payload: Payload, _: int, target: int, dice: Dice) -> bytes:
    return tunnel(payload, dice.below(256), target, dice.pick((COMPANION, COMPANION, 0, 1, 255)))


def _other_target(payload: Payload, sender: int, _: int, dice: Dice) -> bytes:
    component = dice.pick((COMPANION, 1, 255))
    return frame(TUNNEL, _body(payload, dice.below(256), len(payload[1]), component), sender)


def _other_message(_: Payload, sender: int, __: int, dice: Dice) -> bytes:
    number = dice.pick(_NOT_TUNNELS)
    return frame(number, dice.rng.bytes(LAYOUTS[number][1]), sender)


def _unknown_message(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    data = bytearray(tunnel(payload, sender, target))
    data[7:10] = dice.word().to_bytes(4, "little")[:3]
    return bytes(data) + tunnel(payload, sender, target) * dice.below(2)


def _among_garbage(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    garbage = dice.rng.bytes(1 + dice.below(60)) + bytes([_MAGIC_2] * dice.below(3))
    good = tunnel(payload, sender, target)
    return garbage + good + dice.rng.bytes(dice.below(60))


def _two_frames(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    good = tunnel(payload, sender, target)
    return good[dice.below(4) * dice.below(40) :] + good


def _flagged(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    data = bytearray(tunnel(payload, sender, target))
    data[2] = dice.pick((_SIGNED, 2, 0x80, 0xFF))
    return bytes(data) + dice.rng.bytes(13 * dice.below(2))


def _old_version(payload: Payload, sender: int, target: int, dice: Dice) -> bytes:
    return bytes([_MAGIC_1]) + tunnel(payload, sender, target)[1:]


def _nothing_but_garbage(_: Payload, __: int, ___: int, dice: Dice) -> bytes:
    return dice.rng.bytes(dice.below(600))


_WAYS: tuple[Callable[[Payload, int, int, Dice], bytes], ...] = (
    _mutated_frame, _mutated_frame, _lying_length, _mutated_body, _mutated_body, _other_type,
    _other_sender, _other_target, _other_message, _unknown_message, _among_garbage, _two_frames,
    _flagged, _old_version, _nothing_but_garbage,
)  # fmt: skip
