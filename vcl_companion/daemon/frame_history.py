"""The last few frames, for peers who ask for the one of a certain instant."""

from __future__ import annotations

from collections import deque

from vcl_companion.cameras.source import Frame

# A request that was lost comes again a second later, and its frame must still be here.
# At thirty frames a second not every one has to be: drones move little in between.
_SPACING_NS = 90_000_000
_N_FRAMES = 24
# Who joins late is asked for frames from several places; a second apart is near enough.
_SPARSE_SPACING_NS = 900_000_000
_N_SPARSE = 10
# A frame from further off shows another moment of the flight: no frame is better.
FURTHEST_NS = 1_000_000_000


class FrameHistory:
    """Keeps about the last two seconds, and of the ten before them one a second."""

    def __init__(self) -> None:
        self._kept: deque[Frame] = deque(maxlen=_N_FRAMES)
        self._sparse: deque[Frame] = deque(maxlen=_N_SPARSE)
        self._newest: Frame | None = None

    def add(self, frame: Frame) -> None:
        """Keep one more: always until the next one comes, longer unless frames come fast."""
        self._newest = frame
        if self._kept and abs(frame.captured_at_ns - self._kept[-1].captured_at_ns) < _SPACING_NS:
            return
        if len(self._kept) == _N_FRAMES:
            self._thin_out(self._kept[0])
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
        frames = [*self._sparse, *self._kept, *([self._newest] if self._newest else [])]
        near = (f for f in frames if abs(f.captured_at_ns - at_ns) <= FURTHEST_NS)
        return sorted(near, key=lambda f: abs(f.captured_at_ns - at_ns))

    def _thin_out(self, frame: Frame) -> None:
        """Keep a frame that leaves the dense part if the last one kept so is long ago."""
        sparse = self._sparse
        if sparse and abs(frame.captured_at_ns - sparse[-1].captured_at_ns) < _SPARSE_SPACING_NS:
            return
        sparse.append(frame)
