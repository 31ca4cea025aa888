"""A camera that gives its last image again and again, each time as a new one.

A driver whose sensor hangs does so, and whatever fills up a frame rate. Its frames are found on the
map as surely as any, where the drone is no more: at 3 m/s it is told to be 3 m aside after a
second. No two images of a sensor are alike to the last bit, for it has noise; a simulator's are,
of a drone that stands still.
"""

from __future__ import annotations

import logging
from collections.abc import Awaitable, Callable

import numpy as np
from numpy.typing import NDArray

from vcl_companion.cameras.source import Frame
from vcl_companion.geometry.rotation import Array, angle_between
from vcl_companion.localization.filter_state import FilterState

_log = logging.getLogger(__name__)

# What an attitude's noise does not turn, and a drone in the air does within seconds: ten pixels.
_TURNED_RAD = np.deg2rad(1.0)
# Who has not turned for so long stands on something, and has come to stand all at once.
_STANDS_NS = 2_000_000_000
# 95 % of chi^2 with 3 degrees of freedom: whose images have noise never stands so still.
_MOVES = 7.8
# Two images that differ do so here as well, but for chance; then all of them is compared.
_SPARSE = 16


class FrozenCamera:
    """Tells new images from those that are there again while the drone goes on.

    Args:
        attitude_at: (3, 3) ned_from_body at an instant, or None.
        predicted: what is believed of an instant, by that attitude, or None.
    """

    def __init__(
        self,
        attitude_at: Callable[[int], Awaitable[Array | None]],
        predicted: Callable[[int, Array | None], FilterState | None],
    ) -> None:
        self._attitude_at = attitude_at
        self._predicted = predicted
        self._image: NDArray[np.uint8] | None = None
        self._image_at_ns = 0
        self._began: Array | None = None
        self._unturned_from_ns = 0
        self._repeats = False
        self._is_frozen = False

    async def has_given(self, frame: Frame) -> bool:
        """Whether a frame, each asked about once and in their order, shows nothing of its instant.

        That is the last one's image where the drone has moved or turned since: as far as attitude
        and speed tell.
        """
        if self._image is None or not _are_equal(self._image, frame.image):
            if self._is_frozen:
                _log.info("the camera gives new images again")
            self._image, self._image_at_ns = frame.image, frame.captured_at_ns
            self._repeats = self._is_frozen = False
            return False
        at_ns = frame.captured_at_ns
        ned_from_body = await self._attitude_at(at_ns)
        if not self._repeats:
            self._repeats = True
            self._began = await self._attitude_at(self._image_at_ns)
            self._unturned_from_ns = at_ns
            if _moves(self._predicted(at_ns, ned_from_body)):
                self._freeze()
        if ned_from_body is None:
            return self._is_frozen
        if self._began is None or angle_between(self._began, ned_from_body) > _TURNED_RAD:
            if self._began is not None:
                self._freeze()
            self._began, self._unturned_from_ns = ned_from_body, at_ns
        elif self._is_frozen and at_ns - self._unturned_from_ns >= _STANDS_NS:
            _log.info("the drone stands still: its images are believed")
            self._is_frozen = False
        return self._is_frozen

    def _freeze(self) -> None:
        if not self._is_frozen:
            _log.warning("the camera gives the same image again while the drone moves")
        self._is_frozen = True


def _are_equal(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> bool:
    sparse = np.array_equal(a[::_SPARSE, ::_SPARSE], b[::_SPARSE, ::_SPARSE])
    return sparse and np.array_equal(a, b)


def _moves(state: FilterState | None) -> bool:
    """Whether a drone moves, beyond what it may have braked."""
    if state is None:
        return False
    speed, covariance = state.velocity_world, state.velocity_covariance()
    return float(speed @ np.linalg.solve(covariance, speed)) > _MOVES
