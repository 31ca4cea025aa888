"""Who sees the same place as whom: evidence added up from the signatures that members tell.

Each pair of members has the sum of the log-likelihood ratios of its signatures, never below
zero (Page's test, 1954, as in ``quarantine``): one pair of frames alone says little. A pair
whose sum reaches the threshold overlaps, until it has not been confirmed for a while.

A drone adds up all pairs of members, not its own alone: who parts from the coordinator is
to be seen by all who part with it. A signature is compared with those of all others at once:
of 100 members that tell one in six seconds each that is 2 ms of every second, and 200 kB.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from vcl_companion.vision.signature import (
    POINTS,
    is_signature,
    log_likelihood_ratios,
    words_of,
)

# A signature is told no more often: 48 bytes more each time.
_TOLD_AFTER_S = 2.9
# So often at rest where all are at full pace.
_TOLD_EVERY_S = 4.0


@dataclass(frozen=True)
class OverlapOptions:
    """When two members are held to see the same place.

    Attributes:
        threshold: sum of the log-likelihood ratios at which they are.
        most: a sum grows no further.
        apart_s: what has not been confirmed for so long overlaps no more.
        fresh_s: signatures told so long after each other are of one time.
    """

    threshold: float = 5.0
    most: float = 7.0
    apart_s: float = 20.0
    fresh_s: float = 7.0

    def __post_init__(self) -> None:
        for name in ("threshold", "apart_s", "fresh_s"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        if not self.most >= self.threshold:
            raise ValueError(f"most, {self.most}, is below the threshold, {self.threshold}")

    def stretched(self, by: float) -> OverlapOptions:
        """Return them for members who tell their signatures so many times as rarely, if they do."""
        by = max(1.0, by)
        return replace(self, apart_s=by * self.apart_s, fresh_s=by * self.fresh_s)

    def at_pace(self, stretch: float) -> OverlapOptions:
        """Return them for members who show themselves so many times as rarely (``pace``)."""
        # A signature rides on a state.
        told_s = math.ceil(_TOLD_AFTER_S / stretch) * stretch
        return self.stretched(told_s / _TOLD_EVERY_S)


class OwnSignature:
    """The signature of a drone's newest frame, until it is told."""

    def __init__(self) -> None:
        self._untold = b""
        self._told_at_s = -math.inf

    def note(self, signature: bytes) -> None:
        """Take one in the place of the last."""
        self._untold = signature

    def to_tell(self, now_s: float) -> bytes:
        """Return what the next state is to tell: the newest, once, and not too often."""
        if not self._untold or now_s < self._told_at_s + _TOLD_AFTER_S:
            return b""
        signature, self._untold = self._untold, b""
        self._told_at_s = now_s
        return signature


class OverlapGraph:
    """The pairs of members that see the same place; only signatures and time change it.

    Args:
        members: all there may be.
        options: see there.
    """

    def __init__(self, members: Iterable[int], options: OverlapOptions) -> None:
        self._options = options
        self._members = tuple(members)
        self._place = {member: i for i, member in enumerate(self._members)}
        n = len(self._members)
        self._words = np.full((n, POINTS), -1, dtype=np.int32)
        self._told_at_s = np.full(n, -np.inf)
        self._evidence = np.zeros((n, n))
        self._confirmed_at_s = np.full((n, n), -np.inf)
        self._edges = np.zeros((n, n), dtype=bool)

    def note(self, member: int, signature: bytes, now_s: float) -> None:
        """Take a member's signature; one of no member, or none at all, is passed over."""
        i = self._place.get(member)
        if i is None or not is_signature(signature):
            return
        options = self._options
        self._words[i] = words_of(signature)
        self._told_at_s[i] = now_s
        others = np.flatnonzero(self._told_at_s > now_s - options.fresh_s)
        others = others[others != i]
        if not len(others):
            return
        ratios = log_likelihood_ratios(self._words[i], self._words[others])
        sums = np.clip(self._evidence[i, others] + ratios, 0.0, options.most)
        self._evidence[i, others] = self._evidence[others, i] = sums
        confirmed = others[(sums >= options.threshold) & (ratios > 0)]
        self._confirmed_at_s[i, confirmed] = self._confirmed_at_s[confirmed, i] = now_s
        self._edges[i, confirmed] = self._edges[confirmed, i] = True

    def poll(self, now_s: float) -> None:
        """Let go what has not been confirmed for long."""
        self._edges &= self._confirmed_at_s > now_s - self._options.apart_s

    def forget(self, member: int) -> None:
        """Note that a member is lost: what it saw says nothing of what it will see."""
        i = self._place[member]
        self._told_at_s[i] = -np.inf
        self._evidence[i] = self._evidence[:, i] = 0.0
        self._edges[i] = self._edges[:, i] = False

    def is_told_of(self, member: int, now_s: float) -> bool:
        """Whether a member has told a signature lately: of others nothing is known."""
        return bool(self._told_at_s[self._place[member]] > now_s - self._options.apart_s)

    def overlap(self, some: Iterable[int], others: Iterable[int]) -> bool:
        """Whether any of some members sees the same place as any of others."""
        rows, columns = ([self._place[m] for m in members] for members in (some, others))
        return bool(self._edges[np.ix_(rows, columns)].any())

    def component(self, member: int, members: Iterable[int]) -> frozenset[int]:
        """Return who is linked with a member by overlaps between some members, itself too."""
        there = np.zeros(len(self._members), dtype=bool)
        there[[self._place[m] for m in members]] = True
        found = np.zeros(len(self._members), dtype=bool)
        found[self._place[member]] = True
        newest = found
        while newest.any():
            newest = self._edges[newest].any(axis=0) & there & ~found
            found = found | newest
        return frozenset(self._members[i] for i in np.flatnonzero(found))

    def components(self, members: Iterable[int]) -> tuple[frozenset[int], ...]:
        """Return the parts that some members fall into, by their lowest members."""
        left, parts = sorted(members), []
        everybody = tuple(left)
        while left:
            parts.append(self.component(left[0], everybody))
            left = [member for member in left if member not in parts[-1]]
        return tuple(parts)
