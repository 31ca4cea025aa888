"""A fix that puts the drone back where it has just been, against all that it flew since.

The end of an image can be of the one before, where its transfer was cut off or its buffer written
anew, and a stream may repeat an image with other noise. That part is found on the map where it was
taken, as surely as any. Who braked as hard as that is there in the next frame as well: so it is
believed when a second one says the same, and the autopilot is not reset for one image.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.filter_state import GATE_POSE, FilterState
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pose_filter import FilterOptions, predict, update

RECENTLY_NS = 1_000_000_000
"""Images of before are not older."""


class Unwitnessed(NotLocalized):
    """A fix that its own frame alone speaks for: whoever looks at that frame is no witness."""


class JumpWitness:
    """Holds back the first frame of a jump to where the drone was, until the next one.

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
        recent: Sequence[FilterState],
    ) -> FilterState | Unwitnessed:
        """Return what is to be believed after the newest frame's fix that is a jump.

        Args:
            predicted: without the fix.
            jumped: with it, where it says.
            fix: which.
            ned_from_body: (3, 3) attitude of its instant, or None.
            recent: what was believed of the frames ``RECENTLY_NS`` before.

        Returns:
            The state after the jump, or that the next frame has to tell.
        """
        alleged, self._alleged = self._alleged, jumped
        if alleged is not None:
            carried = predict(alleged, jumped.at_ns, ned_from_body, self._options)
            again = carried and update(carried, fix)
            if isinstance(again, FilterState) and again.n_jumps == alleged.n_jumps:
                return again
        return _of_before(predicted, fix, recent) or jumped

    def heard_late(
        self, before: FilterState, fix: Localized, recent: Sequence[FilterState]
    ) -> Unwitnessed | None:
        """Return whether a fix is a jump that the frames which came since have not told of.

        Args:
            before: what was believed at the frame's instant.
            fix: of that frame, found after later ones had been.
            recent: what was believed of the frames ``RECENTLY_NS`` before.
        """
        if before.fixed_at_ns == before.at_ns:
            return None
        jumped = update(before, fix)
        if isinstance(jumped, NotLocalized) or jumped.n_jumps == before.n_jumps:
            return None
        return _of_before(before, fix, recent)

    def forget(self) -> None:
        """Forget what the last frame said: a later one has said otherwise, or all is new."""
        self._alleged = None


def _of_before(
    expected: FilterState, fix: Localized, recent: Sequence[FilterState]
) -> Unwitnessed | None:
    """Return that a fix is where a frame of before was, place and attitude; None if it is not."""
    # Both err by this; what their map is off, alike.
    noise = 2.0 * (fix.noise_covariance + fix.own_map_covariance)
    for state in recent:
        # Before its last jump it was elsewhere, or rather had not been there.
        if state.fixed_at_ns != state.at_ns or state.n_jumps != expected.n_jumps:
            continue
        away = state.world_from_body.local(fix.world_from_body)
        if away @ np.linalg.solve(noise, away) <= GATE_POSE:
            back = expected.world_from_body.translation - fix.world_from_body.translation
            reason = f"{np.linalg.norm(back):.1f} m back, where an earlier frame was"
            return Unwitnessed(reason, fix.n_matched, fix.n_inliers)
    return None
