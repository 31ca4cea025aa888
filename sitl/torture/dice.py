"""Cheap random decisions: drawn by the thousand, spent one by one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeVar

import numpy as np

_T = TypeVar("_T")

_AT_ONCE = 8192
_BITS = 32


class Dice:
    """Random numbers for small decisions; a generator's own call takes ten times as long.

    Args:
        rng: where they come from.

    Attributes:
        rng: for values, of which fewer are needed.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self._words = self._drawn()

    def below(self, n: int) -> int:
        """Return one of 0 to ``n`` - 1, for an n far below 2^32."""
        return next(self._words) * n >> _BITS

    def chance(self, share: float) -> bool:
        """Return whether a thing happens that does so in a share of all cases."""
        return next(self._words) < share * (1 << _BITS)

    def pick(self, things: Sequence[_T]) -> _T:
        """Return one of some things."""
        return things[self.below(len(things))]

    def word(self) -> int:
        """Return 32 random bits."""
        return next(self._words)

    def _drawn(self) -> Iterator[int]:
        while True:
            yield from self.rng.integers(0, 1 << _BITS, _AT_ONCE, dtype=np.uint32).tolist()
