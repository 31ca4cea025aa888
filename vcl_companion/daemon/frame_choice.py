"""Which of our frames a map is extended by: that of an instant, or the last one that shows it.

Who turns away, or flies on, faster than maps are made is lost beyond what the map shows. A frame
from there joins nothing, nor does one in which hardly anything of it is left; the last one that
showed it well joins at once, and what is made of it reaches further (``CatchingUp``).
"""

from __future__ import annotations

from vcl_companion.cameras.source import Frame
from vcl_companion.clock import Clock
from vcl_companion.daemon.estimator import LOST_S, Estimator
from vcl_companion.daemon.frame_history import FrameHistory
from vcl_companion.daemon.map_store import MapStore
from vcl_companion.mapping.landmark_map import LandmarkMap

FURTHEST_BACK_NS = round(LOST_S * 1e9)
"""How much older than asked for a frame may be that says where it was taken."""

# What was taken so soon after a keyframe shows no more than that.
_LATER_NS = 50_000_000


class FrameChoice:
    """Chooses frames of ours.

    Args:
        system_id: this drone.
        frames: our own.
        maps: what they extend.
        estimator: which of them had a fix.
        clock: time base of frames.
    """

    def __init__(
        self,
        system_id: int,
        frames: FrameHistory,
        maps: MapStore,
        estimator: Estimator,
        clock: Clock,
    ) -> None:
        self._system_id = system_id
        self._frames = frames
        self._maps = maps
        self._estimator = estimator
        self._clock = clock

    def gave(self, frame: Frame) -> None:
        """Note that a map may be made of a frame."""
        self._frames.gave(frame)

    async def of(self, at_ns: int) -> Frame | None:
        """Return the frame nearest to an instant, or the last one before it that joins the map.

        That only if the nearest may not join it, and if it shows more than our keyframes in the
        map do: where nobody moves on, it is the nearest that the map lacks.

        Args:
            at_ns: the instant, our clock.

        Returns:
            None where there is no frame within a second of it.
        """
        nearest = self._frames.nearest(at_ns)
        if nearest is None or self._maps.current is None:
            return nearest
        until_ns = nearest.captured_at_ns
        await self._estimator.settled(until_ns, self._clock.now_ns())
        stored = self._maps.current
        shown_ns = self._shown_until_ns(stored.index.landmark_map, until_ns)
        since_ns = max(until_ns - FURTHEST_BACK_NS, shown_ns)
        fixed: Frame | None = None
        for frame in reversed(self._frames.after(since_ns)):
            fix = self._estimator.fix_at(frame.captured_at_ns)
            if fix is None or frame.captured_at_ns > until_ns:
                continue
            if fix.shows_well:
                return frame
            fixed = fixed or frame
        return fixed or nearest

    def _shown_until_ns(self, landmark_map: LandmarkMap, before_ns: int) -> int:
        """Return when our newest keyframe before an instant was taken, and a moment; -1 for none.

        What a map has of us from before this computer was started has a later instant than any
        of now: its clock began anew.
        """
        ours = [
            k.captured_at_ns
            for k in landmark_map.keyframes
            if k.drone_id == self._system_id and k.captured_at_ns <= before_ns
        ]
        return max(ours) + _LATER_NS if ours else -1
