"""The walks over landmarks that write or read them bit by bit, compiled (``landmark_coder``).

A binary range coder (Martin 1979, with the carry of Schindler's) whose models learn while they
code: all in integers, so that the bytes are the same on every machine. Chosen over a general
compressor, which finds nothing to repeat in landmarks and whose bytes change with its version.
One walk over the rows both writes and reads: where it reads, ``_narrowed`` knows the bit and
whatever was in the rows is overwritten. ``docs/protocol.md`` has it field by field.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.compiled import compiled

Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]

# A landmark in a keyframe
NOT_SEEN, SEEN, AS_BEFORE = 0, 1, 2

# Coordinates of what lies nowhere in an image: steps from -2^27 on
_PLACE_BITS = 28
# Largest inverse depth, steps
MAX_DEPTH = 1 << 30
# Earlier landmarks of the same image among which the nearest is looked for
_WINDOW = 200
# Bits of a pixel's u that are learnt; the rest are as good as random
_LEARNT_BITS = 5

# The coder: what the code begins with, how wide the interval is, what is read of the code less
# its beginning, bytes so far, the last byte (a carry may change it), 0xff bytes behind it and it
LOW, RANGE, CODE, AT, _LAST, _PENDING, READS, FAILED = range(8)

# A model: 65536 times the chance of a 0, and how many bits it has seen, up to 48. A number takes
# 125 models: is it longer than k bits (0 to 31), and its two bits after the leading one (from
# 32 on: three for each length from 2 on). The sign and the other bits are as they are.
_NUMBER = 125
_RATES = np.array([655360 // (10 * n + 26) for n in range(49)], dtype=np.int64)
# No bit is ever certain
_LEAST_CHANCE = 32
# Where the models of each part begin
_IS_LISTED, _IS_AWAY, _U = 0, 2, 4
_IS_SEEN = _U + (1 << _LEARNT_BITS)
_STAYS, _MOVED, _IS_NEWLY_SEEN = _IS_SEEN + 54, _IS_SEEN + 57, _IS_SEEN + 58
_COUNTS = _IS_NEWLY_SEEN + 9
_V = _COUNTS + _NUMBER
_DEPTH = _V + _NUMBER
_ASIDE = _DEPTH + 2 * _NUMBER
_RESIDUAL = _ASIDE + 4 * _NUMBER
_DEPTH_MOVED = _RESIDUAL + 4 * _NUMBER
_ASIDE_MOVED = _DEPTH_MOVED + _NUMBER
N_MODELS = _ASIDE_MOVED + _NUMBER


@compiled
def begin(c: Integers, buffer: Bytes) -> None:
    """Make a coder ready."""
    if c[READS]:
        for _ in range(4):
            c[CODE] = (c[CODE] << 8) | _next_byte(c, buffer)
    else:
        c[_PENDING] = 1


@compiled
def end(c: Integers, buffer: Bytes) -> None:
    """Write what is left of the code."""
    for _ in range(5):
        _shift_low(c, buffer)


@compiled
def _next_byte(c: Integers, buffer: Bytes) -> int:
    at = c[AT]
    c[AT] = at + 1
    if at < len(buffer):
        return int(buffer[at])
    c[FAILED] = 1
    return 0


@compiled
def _shift_low(c: Integers, buffer: Bytes) -> None:
    """Write what a carry cannot change any more, and take the next byte of the code."""
    low = c[LOW]
    if low < 0xFF000000 or low >= 1 << 32:
        carry = low >> 32
        byte = c[_LAST] + carry
        while c[_PENDING] > 0:
            if c[AT] < len(buffer):
                buffer[c[AT]] = byte & 0xFF
            else:
                c[FAILED] = 1
            c[AT] += 1
            byte = 0xFF + carry
            c[_PENDING] -= 1
        c[_LAST] = (low >> 24) & 0xFF
    c[_PENDING] += 1
    c[LOW] = (low & 0x00FFFFFF) << 8


@compiled
def _widen(c: Integers, buffer: Bytes) -> None:
    """Go on to the next bytes where the interval has become too narrow for a bit."""
    while c[RANGE] < 1 << 24:
        c[RANGE] <<= 8
        if c[READS]:
            c[CODE] = (c[CODE] << 8) | _next_byte(c, buffer)
        else:
            _shift_low(c, buffer)


@compiled
def _narrowed(c: Integers, buffer: Bytes, bound: int, bit: int) -> int:
    """Code a bit: of the interval a 0 takes what is below the bound."""
    if c[READS]:
        bit = int(c[CODE] >= bound)
    # No branches: nobody could foresee them.
    c[LOW] += bit * bound
    c[CODE] -= bit * bound
    c[RANGE] = bound + bit * (c[RANGE] - 2 * bound)
    if c[RANGE] < 1 << 24:
        _widen(c, buffer)
    return bit


@compiled
def _learn(models: Integers, k: int, bit: int) -> None:
    """Move a model towards a bit: far at first, by a 50th part in the end."""
    towards = (65536 - _LEAST_CHANCE) - bit * (65536 - 2 * _LEAST_CHANCE)
    n = models[k, 1]
    models[k, 0] += ((towards - models[k, 0]) * _RATES[n]) >> 16
    models[k, 1] = min(n + 1, len(_RATES) - 1)


@compiled
def _bit(c: Integers, buffer: Bytes, models: Integers, k: int, bit: int) -> int:
    """Code a bit by a model, which learns it."""
    bit = _narrowed(c, buffer, (c[RANGE] >> 16) * models[k, 0], bit)
    _learn(models, k, bit)
    return bit


@compiled
def _raw(c: Integers, buffer: Bytes, n_bits: int, value: int) -> int:
    """Code the lowest bits of a number, 14 at the most, as they are."""
    last = (1 << n_bits) - 1
    c[RANGE] >>= n_bits
    if c[READS]:
        value = c[CODE] // c[RANGE]
        if value > last:  # no writer leaves that
            c[FAILED] = 1
    value &= last
    c[LOW] += value * c[RANGE]
    c[CODE] -= value * c[RANGE]
    if c[RANGE] < 1 << 24:
        _widen(c, buffer)
    return int(value)


@compiled
def _natural(c: Integers, buffer: Bytes, models: Integers, base: int, value: int) -> int:
    """Code a number from 0 to 2^32 - 1: how long it is, then its bits after the leading one.

    One loop over its bits, the coder in local names: most of the time is spent here.
    """
    low, width, code, reads = c[LOW], c[RANGE], c[CODE], c[READS]
    n, k, out = 0, 0, 0
    while True:
        if out == 0:
            model, bit = base + n, int(value >> n > 0)
        else:
            model, bit = base + 25 + 3 * n + out, (value >> k) & 1
        is_learnt = out == 0 or k > n - 4
        bound = (width >> 16) * models[model, 0] if is_learnt else width >> 1
        if reads:
            bit = int(code >= bound)
        low += bit * bound
        code -= bit * bound
        width = bound + bit * (width - 2 * bound)
        if is_learnt:
            _learn(models, model, bit)
        if width < 1 << 24:
            c[LOW], c[RANGE], c[CODE] = low, width, code
            _widen(c, buffer)
            low, width, code = c[LOW], c[RANGE], c[CODE]
        if out > 0:
            out = (out << 1) | bit
            k -= 1
        else:
            n += bit
            if n < 32 and bit:
                continue
            out, k = min(n, 1), n - 2
        if k < 0:
            break
    c[LOW], c[RANGE], c[CODE] = low, width, code
    return out


@compiled
def _integer(c: Integers, buffer: Bytes, models: Integers, base: int, value: int) -> int:
    """Code a number from 1 - 2^32 to 2^32 - 1."""
    size = _natural(c, buffer, models, base, abs(value))
    if size and _raw(c, buffer, 1, 1 if value < 0 else 0):
        return -size
    return size


@compiled
def code_listed(c: Integers, buffer: Bytes, models: Integers, listed: Integers) -> None:
    """Code flags; see ``Stream``."""
    last = 1
    for j in range(len(listed)):
        last = listed[j] = _bit(c, buffer, models, _IS_LISTED + last, listed[j])


@compiled
def _code_place(
    c: Integers, buffer: Bytes, models: Integers, is_somewhere: bool, away: Integers,
    place: Integers, j: int,
) -> None:  # fmt: skip
    """Code whether a landmark is told by its place, and that."""
    away[j] = _bit(c, buffer, models, _IS_AWAY, away[j]) if is_somewhere else 1
    if away[j]:
        half = 1 << (_PLACE_BITS - 1)
        for axis in range(3):
            value = place[j, axis] + half
            high = _raw(c, buffer, 14, value >> 14)
            place[j, axis] = ((high << 14) | _raw(c, buffer, 14, value)) - half


@compiled
def _code_pixel(c: Integers, buffer: Bytes, models: Integers, base: int, pixel: Integers) -> None:
    for axis in range(2):
        pixel[axis] = _integer(c, buffer, models, base, pixel[axis])


@compiled
def code_seen(c: Integers, buffer: Bytes, models: Integers, aside: Integers) -> None:
    """Code where landmarks of a map are seen; see ``Stream``."""
    for j in range(len(aside)):
        if c[FAILED]:
            return
        _code_pixel(c, buffer, models, _RESIDUAL, aside[j])


@compiled
def code_known(
    c: Integers, buffer: Bytes, models: Integers, there: Integers, state: Integers,
    away: Integers, place: Integers, aside: Integers, depth: Integers, residual: Integers,
) -> None:  # fmt: skip
    """Code landmarks that both sides know; see ``Stream`` and ``Rows``."""
    n, n_keyframes = state.shape
    for j in range(n):
        if c[FAILED]:
            return
        last, before, n_seen = 2, 2, 0
        for i in range(n_keyframes):
            if there[j, i]:
                last = _bit(c, buffer, models, _STAYS + last, 1 if state[j, i] == AS_BEFORE else 0)
                if last:
                    state[j, i] = AS_BEFORE
                else:
                    state[j, i] = _bit(c, buffer, models, _MOVED, state[j, i])
            else:
                above = min(state[j - 1, i], 1) if j > 0 else 2
                model = _IS_NEWLY_SEEN + 3 * before + above
                state[j, i] = _bit(c, buffer, models, model, state[j, i])
            before = min(state[j, i], 1)
            n_seen += before
        _code_place(c, buffer, models, n_seen > 0, away, place, j)
        if not away[j]:
            depth[j] = _integer(c, buffer, models, _DEPTH_MOVED, depth[j])
            _code_pixel(c, buffer, models, _ASIDE_MOVED, aside[j])
        for i in range(n_keyframes):
            if state[j, i] == SEEN:
                model = _RESIDUAL + _NUMBER * (min(n_seen, 4) - 1)
                _code_pixel(c, buffer, models, model, residual[j, i])


@compiled
def _nearest(first: Integers, begin: int, j: int) -> int:
    """Return which landmark from ``begin`` to j is nearest to j in the image of both; -1: none."""
    best, least = -1, 1 << 40
    for k in range(j - 1, max(begin, j - _WINDOW) - 1, -1):
        below = first[j, 1] - first[k, 1]
        if below >= least:
            break
        far = below + abs(first[j, 0] - first[k, 0])
        if far < least:
            best, least = k, far
    return best


@compiled
def _scaled(depth: int, by: int) -> int:
    """Return an inverse depth in steps 2^by times as fine, cut off."""
    if by < 0:
        return depth >> min(-by, 62)
    return min(depth << min(by, 31), MAX_DEPTH)


@compiled
def _code_first(
    c: Integers, buffer: Bytes, models: Integers, last_v: int, n_bits: int, pixel: Integers
) -> None:
    """Code where a landmark's anchor saw it: v from the last one's on, then u."""
    pixel[1] = last_v + _natural(c, buffer, models, _V, pixel[1] - last_v)
    u = 1
    for k in range(n_bits - 1, n_bits - 1 - _LEARNT_BITS, -1):
        u = (u << 1) | _bit(c, buffer, models, _U + u, (pixel[0] >> k) & 1)
    u -= 1 << _LEARNT_BITS
    n_raw = n_bits - _LEARNT_BITS
    pixel[0] = (u << n_raw) | _raw(c, buffer, n_raw, pixel[0])


@compiled
def _code_sightings(
    c: Integers, buffer: Bytes, models: Integers, seen: Integers, j: int, a: int, near: int
) -> int:
    """Code where a landmark is seen after its anchor a, and return in how many in all."""
    n_seen = 1
    seen[j, a] = SEEN
    for i in range(a + 1, seen.shape[1]):
        model = seen[j, i - 1]
        model = 3 * model + (seen[j, i - 2] if i - 2 >= a else 2)
        model = 3 * model + (seen[j, i - 3] if i - 3 >= a else 2)
        model = 3 * model + (seen[near, i] if near >= 0 else 2)
        seen[j, i] = _bit(c, buffer, models, _IS_SEEN + model, seen[j, i])
        n_seen += seen[j, i]
    return n_seen


@compiled
def code_new(
    c: Integers, buffer: Bytes, models: Integers, counts: Integers, exponents: Integers,
    bits: Integers, state: Integers, away: Integers, place: Integers, aside: Integers,
    depth: Integers, residual: Integers, first: Integers,
) -> None:  # fmt: skip
    """Code landmarks that nothing is known of; see ``Stream`` and ``Rows``."""
    n, n_keyframes = state.shape
    scale = np.zeros(n, dtype=np.int64)
    j = 0
    for a in range(n_keyframes):
        counts[a] = _natural(c, buffer, models, _COUNTS, counts[a])
        begin, last_v = j, 0
        if counts[a] > n - j:
            c[FAILED] = 1
        for _ in range(counts[a]):
            if c[FAILED]:
                return
            _code_first(c, buffer, models, last_v, bits[a], first[j])
            last_v = first[j, 1]
            near = _nearest(first, begin, j)
            n_seen = _code_sightings(c, buffer, models, state, j, a, near)
            for i in range(a, n_keyframes):
                if state[j, i]:
                    scale[j] = max(scale[j], exponents[a, i])
            _code_place(c, buffer, models, True, away, place, j)
            few = min(n_seen, 4) - 1
            if not away[j]:
                expected, model = 0, _DEPTH
                if near >= 0:
                    expected, model = _scaled(depth[near], scale[j] - scale[near]), _DEPTH + _NUMBER
                depth[j] = expected + _integer(c, buffer, models, model, depth[j] - expected)
                if not 0 < depth[j] <= MAX_DEPTH:
                    c[FAILED] = 1
                _code_pixel(c, buffer, models, _ASIDE + _NUMBER * few, aside[j])
            for i in range(a + 1, n_keyframes):
                if state[j, i]:
                    model = _RESIDUAL + _NUMBER * few
                    _code_pixel(c, buffer, models, model, residual[j, i])
            j += 1
    while j < n and not c[FAILED]:
        _code_place(c, buffer, models, False, away, place, j)
        j += 1
