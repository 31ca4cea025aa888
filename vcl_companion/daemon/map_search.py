"""The search of the map for a frame that patches do not place: one at a time, beside the others."""

from __future__ import annotations

import asyncio
import math
import weakref
from dataclasses import dataclass

import numpy as np

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.mailbox import Mailbox
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.map_work import MapWork
from vcl_companion.daemon.mishaps import fix_or_none
from vcl_companion.geometry.rotation import Array
from vcl_companion.localization.fix import Localized, NotLocalized
from vcl_companion.localization.pipeline import Effort

# How often a second detector looks for a drone that is lost: it takes as long as ten frames.
_FALL_BACK_EVERY_S = 1.0
# A search in vain that took longer than frames are apart is not begun again before as long, and
# twice as long after each further one of the same map, up to this: the processor is needed for
# the map that will show where we are.
_LONGEST_PAUSE_S = 1.0


@dataclass(frozen=True, eq=False)
class Sought:
    """A frame that features are asked about, because patches gave no pose.

    Attributes:
        frame: which.
        ned_from_body: (3, 3) its attitude, or None.
        stored: the map that is searched.
        may_fall_back: whether by all detectors.
    """

    frame: Frame
    ned_from_body: Array | None
    stored: StoredMap
    may_fall_back: bool


class MapSearch:
    """Looks for one frame by its features, and says when the next may be looked for.

    Args:
        mailbox: knows of newer frames.
        maps: the current map.
        estimator: where the drone is believed to be; told while it is looked for.
        work: does the search.
    """

    def __init__(
        self, mailbox: Mailbox, maps: MapStore, estimator: Estimator, work: MapWork
    ) -> None:
        self._mailbox = mailbox
        self._maps = maps
        self._estimator = estimator
        self._work = work
        # A map that may have been left since, which is not to be kept in memory for that.
        self._searched: weakref.ref[StoredMap] | None = None
        self._pause_s = 0.0
        self._fell_back_at_s = self._again_at_s = -math.inf
        self._over = asyncio.Event()
        self._over.set()
        self._sought_at_ns = -1

    @property
    def is_under_way(self) -> bool:
        """Whether a frame is being looked for."""
        return not self._over.is_set()

    def is_behind(self, frame: Frame) -> bool:
        """Whether a frame is later than one that is searched for."""
        return self.is_under_way and frame.captured_at_ns > self._sought_at_ns

    def is_due(self, stored: StoredMap, now_s: float) -> bool:
        """Whether a map may be searched: not soon again after a search in vain that took long."""
        return not self._was_searched(stored) or now_s >= self._again_at_s

    def begin(
        self, frame: Frame, ned_from_body: Array | None, stored: StoredMap, now_s: float
    ) -> Sought:
        """Have a frame looked for, by ``found``; call ``end`` when what follows from it is done.

        Args:
            frame: which.
            ned_from_body: (3, 3) its attitude, or None.
            stored: the map to search.
            now_s: when it was begun to be localized, by the loop's time.
        """
        self._over.clear()
        if not self._was_searched(stored):
            self._estimator.in_sight.sought_since_s = asyncio.get_running_loop().time()
        self._sought_at_ns = frame.captured_at_ns
        may_fall_back = now_s >= self._fell_back_at_s + _FALL_BACK_EVERY_S
        return Sought(frame, ned_from_body, stored, may_fall_back)

    def end(self) -> None:
        """Note that what was begun is over."""
        self._over.set()
        self._estimator.in_sight.sought_since_s = None

    async def ended(self) -> None:
        """Wait until no frame is being looked for."""
        await self._over.wait()

    async def found(self, sought: Sought) -> tuple[StoredMap, Localized | NotLocalized]:
        """Return what the features of a frame say, and of which map: of a newer one if that came.

        A map that was made because the last one ended here comes while that is searched in vain;
        one of another world, however the search ends.
        """
        frame, stored = sought.frame, sought.stored
        effort = Effort(
            may_track=False,
            may_fall_back=sought.may_fall_back,
            has_heading=self._estimator.has_heading,
        )
        while True:
            began_s, n_forgotten = asyncio.get_running_loop().time(), self._estimator.n_forgotten
            predicted = self._estimator.predicted(frame.captured_at_ns, sought.ned_from_body)
            prior = predicted.prior() if predicted else None
            fix = await fix_or_none(
                self._work.find(
                    np.asarray(frame.image), stored, prior, sought.ned_from_body, effort
                )
            )
            if self._estimator.n_forgotten != n_forgotten:
                stored = self._maps.current or stored
                continue  # it may have been led there
            if not self._maps.has_left_world(stored.world):
                if isinstance(fix, Localized):
                    self._pause_s = 0.0
                    return stored, fix
                self._searched_in_vain(frame, stored, began_s)
                if sought.may_fall_back and stored.index.fallback is not None:
                    self._fell_back_at_s = began_s
            if self._maps.current is None or self._maps.current is stored:
                return stored, fix
            stored = self._maps.current

    def _searched_in_vain(self, frame: Frame, stored: StoredMap, began_at_s: float) -> None:
        """Note a search that found nothing, and whether it took longer than frames are apart."""
        ended_at_s = asyncio.get_running_loop().time()
        took_s = ended_at_s - began_at_s
        twice_s = 2.0 * self._pause_s if self._was_searched(stored) else 0.0
        self._pause_s = max(took_s, min(twice_s, _LONGEST_PAUSE_S))
        self._searched = weakref.ref(stored)
        self._maps.want_more()
        if self._mailbox.has_had_newer(frame):
            self._again_at_s = ended_at_s + self._pause_s

    def _was_searched(self, stored: StoredMap) -> bool:
        """Whether it is this map that was searched in vain last."""
        return self._searched is not None and self._searched() is stored
