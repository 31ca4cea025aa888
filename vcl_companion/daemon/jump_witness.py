"""A jump that one frame alone speaks for: believed when a second one says the same.

Half of an image can be of an earlier one, where a transfer was cut off, and a court of windows can
look the same one window on. What such a frame says may be as sure as any other. A drone whose last
fix is fresh need not believe it at once: by the next frame it is the place of both, or of none.
"""

from __future__ import annotations

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.filter_state import FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_filter import FilterOptions, predict, update

# Who has had no fix for longer has flown on as nobody knows, and jumps for that.
_FRESH_NS = 1_000_000_000


class Unwitnessed(NotLocalized):
    """A fix that its own frame alone speaks for: whoever looks at that frame is no witness."""


class JumpWitness:
    """Holds back the first frame of a jump until the next one.

    Args:
        options: of the filter.
    """

    def __init__(self, options: FilterOptions) -> None:
        self._options = options
        self._alleged: FilterState | None = None

    def heard(
        self,
        predicted: FilterState,
        jumped: FilterState,
        fix: Localized,
        ned_from_body: Array | None,
    ) -> FilterState | Unwitnessed:
        """Return what is to be believed after the newest frame's fix that is a jump.

        Args:
            predicted: without the fix.
            jumped: with it, where it says.
            fix: which.
            ned_from_body: (3, 3) attitude of its instant, or None.

        Returns:
            The state after the jump, or that the next frame has to tell.
        """
        alleged, self._alleged = self._alleged, jumped
        if not _is_fresh(predicted):
            return jumped
        if alleged is not None:
            carried = predict(alleged, jumped.at_ns, ned_from_body, self._options)
            again = carried and update(carried, fix)
            if isinstance(again, FilterState) and again.n_jumps == alleged.n_jumps:
                return again
        return _unwitnessed(predicted, fix)

    def heard_late(self, before: FilterState, fix: Localized) -> Unwitnessed | None:
        """Return whether a fix is a jump that the frames which came since have not told of.

        Args:
            before: what was believed at the frame's instant.
            fix: of that frame, found after later ones had been.
        """
        if before.fixed_at_ns == before.at_ns or not _is_fresh(before):
            return None
        jumped = update(before, fix)
        if isinstance(jumped, NotLocalized) or jumped.n_jumps == before.n_jumps:
            return None
        return _unwitnessed(before, fix)

    def forget(self) -> None:
        """Forget what the last frame said: a later one has said otherwise, or all is new."""
        self._alleged = None


def _is_fresh(state: FilterState) -> bool:
    return state.at_ns - state.fixed_at_ns <= _FRESH_NS


def _unwitnessed(expected: FilterState, fix: Localized) -> Unwitnessed:
    away = expected.world_from_body.translation - fix.world_from_body.translation
    reason = f"{np.linalg.norm(away):.1f} m from where it was expected, by one frame alone"
    return Unwitnessed(reason, fix.n_matched, fix.n_inliers)
