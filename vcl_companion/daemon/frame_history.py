"""The last few frames, for peers who ask for the one of a certain instant, and for who is lost."""

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
# Who is lost is followed from frame to frame when a map has come that shows them.
_LOST_SPACING_NS = 180_000_000
_N_LOST = 60
# A frame from further off shows another moment of the flight: no frame is better.
FURTHEST_NS = 1_000_000_000


class FrameHistory:
    """Keeps about the last two seconds, and of the ten before them one a second.

    Of who is beyond the map five a second, since the last one that showed it well; of who has
    none yet, since the last one that one may be made of.
    """

    def __init__(self) -> None:
        self._kept: deque[Frame] = deque(maxlen=_N_FRAMES)
        self._sparse: list[Frame] = []
        self._newest: Frame | None = None
        self._given: Frame | None = None

    def add(self, frame: Frame, shown_at_ns: int | None = None) -> None:
        """Keep one more: always until the next one comes, longer unless frames come fast.

        Args:
            frame: not before the last one.
            shown_at_ns: of the last frame that showed the map well; None where none did.
        """
        self._newest = frame
        if shown_at_ns is None and self._given is not None:
            shown_at_ns = self._given.captured_at_ns
        if self._kept and abs(frame.captured_at_ns - self._kept[-1].captured_at_ns) < _SPACING_NS:
            return
        if len(self._kept) == _N_FRAMES:
            self._thin_out(self._kept[0], shown_at_ns)
        self._kept.append(frame)

    def gave(self, frame: Frame) -> None:
        """Note which one a map may be made of: it is kept until the next one is."""
        self._given = frame

    @property
    def newest(self) -> Frame | None:
        """The last one, or None."""
        return self._newest

    def nearest(self, at_ns: int) -> Frame | None:
        """Return the frame captured nearest to an instant; None when it is over a second off."""
        return next(iter(self.near(at_ns)), None)

    def near(self, at_ns: int) -> list[Frame]:
        """Return the frames captured within a second of an instant, the nearest first."""
        near = (f for f in self._all() if abs(f.captured_at_ns - at_ns) <= FURTHEST_NS)
        return sorted(near, key=lambda f: abs(f.captured_at_ns - at_ns))

    def after(self, at_ns: int) -> list[Frame]:
        """Return the frames captured after an instant, in the order of their time."""
        later = (f for f in self._all() if f.captured_at_ns > at_ns)
        return sorted(later, key=lambda f: f.captured_at_ns)

    def _all(self) -> list[Frame]:
        frames = [*self._sparse, *self._kept]
        others = (frame for frame in (self._given, self._newest) if frame is not None)
        return frames + [other for other in others if all(other is not f for f in frames)]

    def has(self, at_ns: int) -> bool:
        """Return whether the frame of an instant is here."""
        return any(frame.captured_at_ns == at_ns for frame in self._all())

    def _thin_out(self, leaving: Frame, shown_at_ns: int | None) -> None:
        """Keep of the frames that left the dense part those that are far enough apart."""
        found: list[Frame] = []
        lost: list[Frame] = []
        for frame in (*self._sparse, leaving):
            at_ns = frame.captured_at_ns
            is_lost = shown_at_ns is not None and at_ns >= shown_at_ns
            before = next(reversed(lost or found), None)
            apart_ns = _LOST_SPACING_NS if is_lost else _SPARSE_SPACING_NS
            if before is None or at_ns - before.captured_at_ns >= apart_ns:
                (lost if is_lost else found).append(frame)
        self._sparse = found[-_N_SPARSE:] + lost[-_N_LOST:]
