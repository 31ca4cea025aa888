"""What will be seen when an update that is begun now is there, if a flight goes on as it goes.

An update takes a while, so a map is judged by what will be seen of it then: by what the last
second's course leads to, as far ahead as the last update took.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence

# A course is one of nearly all of the window, not of the little that a new map was seen for.
_FOLLOWED_SHARE = 0.85
# So many times as far as at least, at most: what is further ahead is not foreseen by a second's
# course.
_FURTHEST = 2.0


class UpdateTime:
    """How long updates of the map take, and so how far ahead of one has to look."""

    def __init__(self) -> None:
        self._revision = b""
        self._wanted_since_s: float | None = None
        self._took_s = 0.0

    def follow(self, revision: bytes, is_wanted: bool, is_coming: bool, now_s: float) -> None:
        """Take note of how it goes with the next update.

        Args:
            revision: of the map in use; empty for none.
            is_wanted: whether the majority wants it updated. From that on, not from our own vote:
                one that is alone waits for the others, and would look ahead the further for it.
            is_coming: whether others fly on a newer one, and so want no update any more.
            now_s: not before the last call's.
        """
        if revision != self._revision:
            if self._revision and self._wanted_since_s is not None:
                self._took_s = now_s - self._wanted_since_s
            self._revision, self._wanted_since_s = revision, None
        elif is_wanted and self._wanted_since_s is None:
            self._wanted_since_s = now_s
        elif not (is_wanted or is_coming):
            self._wanted_since_s = None

    def ahead_s(self, least_s: float) -> float:
        """Return how far ahead an update that is begun now has to look, no less than so far."""
        return min(max(least_s, self._took_s), _FURTHEST * least_s)


def foreseen(
    values: Sequence[tuple[float, float]], now_s: float, window_s: float, ahead_s: float
) -> float | None:
    """Return what a quantity will be if it goes on as it does; None where it goes nowhere.

    By the medians of the window's thirds, and no faster than between any two of them:
    neither a bad frame nor a step is a course.

    Args:
        values: instants, s, and what it was then, in the order of time; one at least, and none
            from before the window.
        now_s: where the window ends.
        window_s: its length.
        ahead_s: how far ahead to look.
    """
    oldest_at_s, _ = values[0]
    if oldest_at_s > now_s - _FOLLOWED_SHARE * window_s:
        return None
    third_s = window_s / 3.0
    thirds: tuple[list[float], ...] = ([], [], [])
    for at_s, value in values:
        thirds[min(int((now_s - at_s) / third_s), 2)].append(value)
    if not all(thirds):
        return None
    newest, between, oldest = map(statistics.median_low, thirds)
    steps = newest - between, between - oldest
    if steps[0] * steps[1] <= 0.0:
        return None
    return newest + min(steps, key=abs) * ahead_s / third_s
