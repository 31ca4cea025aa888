"""Frames that were lost beyond what a map showed, followed on the next one, up to the newest.

A map is made in seconds; who turns fast is out of its sight by then. What lies between the last
fix and now is kept for a while (``FrameHistory``): frame after frame is followed from where the
one before was, as it would have been had the map been there. The last one that is found is what
the next map is made of (``FrameChoice``), and so on, until the turn is over or the newest frame is
reached.

Where a keyframe of the map is ours, and later than the last fix, its pose is known. A drone that no
frame has given a fix yet, or that is lost, goes on from there, whether features are recognised or
not.
"""

from __future__ import annotations

import asyncio
import logging

from vcl_companion.cameras.source import Frame
from vcl_companion.daemon.estimator import Estimator
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.map_store import MapStore, StoredMap
from vcl_companion.daemon.own_fixes import OwnFixes
from vcl_companion.localization.fix import Localized, Prior
from vcl_companion.mapping.templates import Templates

_log = logging.getLogger(__name__)

# So many frames in a row that are not found have left what the map shows.
_N_MISSED = 4
# A frame that waited for its map is looked at by then.
_LOOKED_S = 0.5


class CatchingUp:
    """Follows what was lost, whenever a map has come.

    Args:
        system_id: this drone.
        frames: our own of the last seconds.
        maps: the map in use.
        estimator: which of them had a fix, and where the drone was believed at the others.
        own_fixes: looks at them.
    """

    def __init__(
        self,
        system_id: int,
        frames: FrameHistory,
        maps: MapStore,
        estimator: Estimator,
        own_fixes: OwnFixes,
    ) -> None:
        self._system_id = system_id
        self._frames = frames
        self._maps = maps
        self._estimator = estimator
        self._own_fixes = own_fixes
        self._over = asyncio.Event()
        self._over.set()

    @property
    def is_under_way(self) -> bool:
        """Whether a map has just come on which frames are followed."""
        return not self._over.is_set()

    async def ended(self) -> None:
        """Wait until no frames are followed."""
        await self._over.wait()

    async def run(self) -> None:
        """Follow until cancelled."""
        while True:
            stored = await self._maps.decided()
            if stored is None:
                continue
            self._over.clear()
            try:
                await self._follow(stored)
            finally:
                self._over.set()
            await self._maps.newer_than(stored)

    async def _follow(self, stored: StoredMap) -> None:
        """Follow the frames since the last fix, if there are any, on a map."""
        if stored.templates is None:
            return
        in_sight = self._estimator.in_sight
        await self._begin_at_keyframe(stored, stored.templates)
        shown_at_ns = in_sight.shown_at_ns
        if shown_at_ns is None:
            return
        behind = self._frames.after(shown_at_ns)
        n_looked = n_found = n_missed = 0
        for frame in behind:
            # What has not been looked at yet is not behind.
            is_behind = in_sight.has_looked_at(frame.captured_at_ns)
            if not (is_behind and self._maps.is_in_use(stored)) or n_missed >= _N_MISSED:
                break
            is_found = await self._is_found(frame)
            n_looked, n_found = n_looked + 1, n_found + is_found
            n_missed = 0 if is_found else n_missed + 1
        if n_looked == 0 or not self._maps.is_in_use(stored):
            return
        in_sight.seen_on = stored.revision
        if n_found and n_missed:
            in_sight.beyond = stored.revision
        _log.info("of %d frames since the last fix %d are found", len(behind), n_found)

    async def _begin_at_keyframe(self, stored: StoredMap, templates: Templates) -> None:
        """Take in where our newest keyframe of a map was taken, if no later frame had a fix."""
        in_sight = self._estimator.in_sight
        since_ns = max(in_sight.shown_at_ns or -1, in_sight.forgotten_until_ns)
        ours = [
            (keyframe.captured_at_ns, number)
            for number, keyframe in enumerate(stored.index.landmark_map.keyframes)
            if keyframe.drone_id == self._system_id and keyframe.captured_at_ns > since_ns
        ]
        if not ours:
            return
        at_ns, number = max(ours)
        frame = self._frames.nearest(at_ns)
        # What a map has of us from before this computer was started is of no frame that is here.
        if frame is None or frame.captured_at_ns != at_ns:
            return
        await in_sight.looked_at(at_ns, _LOOKED_S)
        if (in_sight.shown_at_ns or -1) >= at_ns or not in_sight.has_looked_at(at_ns):
            return
        own = slice(6 * number, 6 * number + 6)
        prior = Prior(
            stored.index.landmark_map.keyframes[number].world_from_body,
            templates.uncertainty.keyframe_covariance[own, own],
        )
        if await self._is_found(frame, prior):
            _log.info("going on from a keyframe of ours")

    async def _is_found(self, frame: Frame, prior: Prior | None = None) -> bool:
        """Look at a frame from where it is believed to have been taken, and take in what it gives.

        Nobody is told: it is past.
        """
        at_ns = frame.captured_at_ns
        look = await self._own_fixes.look_by_patches(frame, prior)
        if look is not None and isinstance(look.fix, Localized):
            self._own_fixes.take(frame, look.fix, look.ned_from_body)
        return self._estimator.own_fix_at(at_ns) is not None
