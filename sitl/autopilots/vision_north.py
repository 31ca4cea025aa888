"""The north of an ArduPilot that takes its heading from our poses (``EK3_SRC1_YAW`` 6), as seen.

It has none before: it says 0, however it stands, and from then on how it turns. With the first
pose, and with every reset, it turns its north to ours at once.
"""

from __future__ import annotations

from collections import deque

from vcl_companion.geometry.rotation import (
    Array,
    about_down,
    euler_from_matrix,
    matrix_from_quaternion,
    quaternion_from_matrix,
)

# Poses are told of instants that lie up to seconds back.
_KEPT = 1024


class VisionNorth:
    """Turns measured attitudes to the north that its estimator believes in."""

    def __init__(self) -> None:
        self._headings: deque[tuple[int, float]] = deque(maxlen=_KEPT)
        self._north_rad: float | None = None

    def of(self, at_ns: int, quaternion: Array) -> Array:
        """Return the (4,) attitude that it believes in, of the one by the true north."""
        measured = matrix_from_quaternion(quaternion)
        heading_rad = euler_from_matrix(measured)[2]
        self._headings.append((at_ns, heading_rad))
        if self._north_rad is None:
            self._north_rad = -heading_rad
        return quaternion_from_matrix(about_down(self._north_rad) @ measured)

    def reset(self, at_ns: int, heading_rad: float) -> None:
        """Turn to the north of a pose, by its heading at an instant."""
        if self._headings:
            _, measured_rad = min(self._headings, key=lambda known: abs(known[0] - at_ns))
            self._north_rad = float(heading_rad - measured_rad)
