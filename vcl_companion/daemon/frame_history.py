"""The last few frames, for peers who ask for the one of a certain instant."""

from __future__ import annotations

from collections import deque

from vcl_companion.cameras.source import Frame

# A request that was lost comes again a second later, and its frame must still be here.
# At thirty frames a second not every one has to be: drones move little in between.
_SPACING_NS = 90_000_000
_N_FRAMES = 24
# A frame from further off shows another moment of the flight: no frame is better.
_FURTHEST_NS = 1_000_000_000


class FrameHistory:
    """Keeps about the last two seconds; old frames fall out."""

    def __init__(self) -> None:
        self._kept: deque[Frame] = deque(maxlen=_N_FRAMES)
        self._newest: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Keep one more: always until the next one comes, longer unless frames come fast."""
        self._newest = frame
        if self._kept and abs(frame.captured_at_ns - self._kept[-1].captured_at_ns) < _SPACING_NS:
            return
        self._kept.append(frame)

    @property
    def newest(self) -> Frame | None:
        """The last one, or None."""
        return self._newest

    def nearest(self, at_ns: int) -> Frame | None:
        """Return the frame captured nearest to an instant; None when it is over a second off."""
        return next(iter(self.near(at_ns)), None)

    def near(self, at_ns: int) -> list[Frame]:
        """Return the frames captured within a second of an instant, the nearest first."""
        frames = [*self._kept, *([self._newest] if self._newest else [])]
        near = (f for f in frames if abs(f.captured_at_ns - at_ns) <= _FURTHEST_NS)
        return sorted(near, key=lambda f: abs(f.captured_at_ns - at_ns))
