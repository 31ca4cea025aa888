"""What becomes of bytes on their way from a valid message to a wrong one."""

from __future__ import annotations

import struct
from collections.abc import Callable

from sitl.torture.dice import Dice

# Numbers that are on an edge of something, in every width that the protocol has.
EXTREMES: tuple[bytes, ...] = (
    *(struct.pack("<B", value) for value in (0, 1, 2, 7, 8, 127, 128, 254, 255)),
    *(struct.pack("<H", value) for value in (0, 1, 256, 257, 0x7FFF, 0x8000, 0xFFFF)),
    *(
        struct.pack("<I", value)
        for value in (0, 1, 32_768, 32_769, 1 << 20, 8 << 20, 1 << 30, 0x7FFFFFFF, 0xFFFFFFFF)
    ),
    *(struct.pack("<Q", value) for value in (0, 1 << 62, 1 << 63, (1 << 64) - 1)),
    *(
        struct.pack("<d", value)
        for value in (
            float("nan"), float("inf"), float("-inf"), -0.0, -1.0, 0.0, 5e-324, 1e-300,
            1e300, 1e154, 3600.0, 32_000.0, 32_000.1, 1e9,
        )
    ),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), -0.0, -1.0, 3e38, 1e-38)),
)  # fmt: skip

# Where the fields are, in messages and in blobs; behind them images and columns begin.
_HEAD_BYTES = 200
_MOST_ADDED = 40

Mutator = Callable[[bytearray, Dice, bytes], None]


def mutated(data: bytes, dice: Dice, other: bytes) -> bytes:
    """Return bytes with one to three things wrong with them.

    Args:
        data: what was valid, not empty.
        dice: decides.
        other: another valid one, to be spliced with.
    """
    out = bytearray(data)
    for _ in range(1 + dice.below(2) * dice.below(3)):
        if out:
            dice.pick(_MUTATORS)(out, dice, other)
    return bytes(out)


def _place(data: bytearray, dice: Dice) -> int:
    """Return where to change something, every second time among the fields of the head."""
    n = min(len(data), _HEAD_BYTES) if dice.below(2) else len(data)
    return dice.below(n)


def _flip_bits(data: bytearray, dice: Dice, _: bytes) -> None:
    for _n in range(1 + dice.below(4)):
        data[_place(data, dice)] ^= 1 << dice.below(8)


def _change_bytes(data: bytearray, dice: Dice, _: bytes) -> None:
    for _n in range(1 + dice.below(4)):
        data[_place(data, dice)] = dice.below(256)


def _set_extreme(data: bytearray, dice: Dice, _: bytes) -> None:
    value, at = dice.pick(EXTREMES), _place(data, dice)
    data[at : at + len(value)] = value[: len(data) - at]


def _nudge(data: bytearray, dice: Dice, _: bytes) -> None:
    """Lie a little: a length or a count off by one or two."""
    at = _place(data, dice)
    data[at] = (data[at] + dice.pick((-2, -1, 1, 2))) & 0xFF


def _truncate(data: bytearray, dice: Dice, _: bytes) -> None:
    del data[_place(data, dice) :]


def _extend(data: bytearray, dice: Dice, other: bytes) -> None:
    n = 1 + dice.below(_MOST_ADDED)
    data += other[:n] if dice.below(2) else dice.word().to_bytes(4, "little") * (n // 4 + 1)


def _splice(data: bytearray, dice: Dice, other: bytes) -> None:
    at = _place(data, dice)
    data[at:] = other[dice.below(len(other) + 1) if dice.below(2) else at :]


def _drop_piece(data: bytearray, dice: Dice, _: bytes) -> None:
    at = _place(data, dice)
    del data[at : at + 1 + dice.below(8)]


def _repeat_piece(data: bytearray, dice: Dice, _: bytes) -> None:
    at = _place(data, dice)
    data[at:at] = data[at : at + 1 + dice.below(8)]


def _fill(data: bytearray, dice: Dice, _: bytes) -> None:
    at, value = _place(data, dice), dice.pick((0x00, 0xFF, 0x80, 0x7F))
    n = min(1 + dice.below(32), len(data) - at)
    data[at : at + n] = bytes([value]) * n


def _change_version(data: bytearray, dice: Dice, _: bytes) -> None:
    data[0] = dice.pick((0, 2, 3, 255))


def _change_kind(data: bytearray, dice: Dice, _: bytes) -> None:
    if len(data) > 1:
        data[1] = dice.pick((0, 1, 2, 3, 4, 5, 6, 7, 8, 64, 65, 66, 67, 68, 69, 70, 255))


_MUTATORS: tuple[Mutator, ...] = (
    _flip_bits, _flip_bits, _change_bytes, _set_extreme, _set_extreme, _set_extreme, _nudge,
    _nudge, _truncate, _extend, _splice, _drop_piece, _repeat_piece, _fill, _change_version,
    _change_kind,
)  # fmt: skip
