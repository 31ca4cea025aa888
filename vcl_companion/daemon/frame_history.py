"""The last few frames, for peers who ask for the one of a certain instant."""

from __future__ import annotations

from collections import deque

from vcl_companion.cameras.source import Frame


class FrameHistory:
    """Keeps frames as they arrive; old ones fall out."""

    def __init__(self, n_frames: int = 8) -> None:
        self._frames: deque[Frame] = deque(maxlen=n_frames)

    def add(self, frame: Frame) -> None:
        """Keep one more."""
        self._frames.append(frame)

    @property
    def newest(self) -> Frame | None:
        """The last one, or None."""
        return self._frames[-1] if self._frames else None

    def nearest(self, at_ns: int) -> Frame | None:
        """Return the frame captured nearest to an instant, or None without any."""
        return min(self._frames, key=lambda f: abs(f.captured_at_ns - at_ns), default=None)
