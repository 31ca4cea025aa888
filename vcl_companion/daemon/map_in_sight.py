"""What the frames show of the map, and which of them have been looked at yet."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from vcl_companion.localization.fix import Localized

# For so long what a frame shows counts as unknown while it is looked for by its features: a small
# map is looked through by then.
_SOUGHT_S = 0.5


class MapInSight:
    """The map as the last frame showed it; everything happens in the event loop's thread.

    Attributes:
        tracked: landmarks of the map that the last frame showed; 0 when it was refused.
        covered: share of the last frame that they filled; 0 when it was refused.
        novelty_deg: how differently they looked there from how they are remembered, degrees.
        shown_at_ns: when the last frame was taken that showed it; None where none has.
        shown_well_at_ns: the same of one by which it can be extended.
        seen_on: revision of the map that the last frame was looked at on.
        beyond: revision of the map that was followed as far as it shows, the last frame being
            beyond that.
        forgotten_until_ns: no frame up to this instant says any more where the drone is.
        sought_since_s: since when a frame is looked for by its features, by the loop's time;
            None where none is, or where the map was looked through in vain before.
    """

    def __init__(self) -> None:
        self.tracked = 0
        self.covered = 0.0
        self.novelty_deg = 0.0
        self.shown_at_ns: int | None = None
        self.shown_well_at_ns: int | None = None
        self.seen_on = b""
        self.beyond = b""
        self.forgotten_until_ns = -1
        self.sought_since_s: float | None = None
        self._looked_at_ns = -1
        self._looked = asyncio.Event()

    def note(self, at_ns: int, fix: Localized | None) -> None:
        """Note what the frame of an instant has shown; None for one that was refused."""
        if fix is None:
            self.tracked, self.covered, self.novelty_deg = 0, 0.0, 0.0
        else:
            self.tracked, self.covered = fix.n_seen, fix.covered
            self.novelty_deg = fix.novelty_deg
            self.note_shown(at_ns, fix)
        self._looked_at_ns = max(at_ns, self._looked_at_ns)
        self._looked.set()

    def note_shown(self, at_ns: int, fix: Localized) -> None:
        """Note what the frame of an instant showed of the map; an older one changes nothing."""
        self.shown_at_ns = max(at_ns, self.shown_at_ns or 0)
        if fix.shows_well:
            self.shown_well_at_ns = max(at_ns, self.shown_well_at_ns or 0)

    def forget_shown(self) -> None:
        """Note that what showed the map says nothing of where it shows anything now."""
        self.shown_at_ns = self.shown_well_at_ns = None
        self.forgotten_until_ns = self._looked_at_ns

    def is_being_sought(self, now_s: float) -> bool:
        """Whether what the frames show will be known in a moment.

        One is looked for by its features, has been for no long time, and none after it gave a pose.
        """
        if self.beyond and self.beyond == self.seen_on:
            return False
        since_s = self.sought_since_s
        return since_s is not None and now_s < since_s + _SOUGHT_S and not self.tracked

    def has_looked_at(self, at_ns: int) -> bool:
        """Whether the frame of an instant, or a later one, has been looked at."""
        return self._looked_at_ns >= at_ns

    async def looked_at(self, at_ns: int, within_s: float) -> None:
        """Wait until the frame of an instant has been looked at, or the time is over."""
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while not self.has_looked_at(at_ns):
                    self._looked.clear()
                    await self._looked.wait()
