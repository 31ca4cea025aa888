"""Where an image shows a map's landmarks, as bytes; part of a frame answer."""

from __future__ import annotations

import struct

import numpy as np

from vcl_companion.errors import WireError
from vcl_companion.mapping.seen_landmarks import MAX_ASIDE_PX, MAX_SEEN, SeenLandmarks
from vcl_companion.wire.landmark_coder import Stream
from vcl_companion.wire.landmark_grid import STEPS_PER_PX
from vcl_companion.wire.map_codec import MAX_LANDMARKS, REVISION_BYTES
from vcl_companion.wire.reader import Reader

# | 0  | 8 bytes | revision of the map                                      |
# | 8  | u16     | flags: as many as its landmarks up to the last one seen  |
# | 10 | u16     | bytes of the stream n                                    |
# | 12 | n       | the stream: the flags, then of each landmark seen 2      |
# |    |         | signed numbers, u and v, steps of 2^-5 px                |
_HEAD = struct.Struct(f"<{REVISION_BYTES}s2H")
_MAX_STEPS = round(MAX_ASIDE_PX * STEPS_PER_PX)


def encode_seen(seen: SeenLandmarks) -> bytes:
    """Return the bytes of what is seen; pixels are rounded to 2^-5.

    Raises:
        ValueError: nothing is seen, or landmarks that no map has.
    """
    n_flags = int(seen.landmarks[-1]) + 1 if len(seen.landmarks) else 0
    if not 0 < n_flags <= MAX_LANDMARKS or len(seen.revision) != REVISION_BYTES:
        raise ValueError(f"of {n_flags} landmarks some are seen, 1 to {MAX_LANDMARKS} allowed")
    flags = np.zeros(n_flags, dtype=np.int64)
    flags[seen.landmarks] = 1
    steps = np.rint(seen.aside_px * STEPS_PER_PX).astype(np.int64)

    def write(stream: Stream) -> None:
        stream.code_listed(flags)
        stream.code_seen(steps)

    data = Stream.written_by(write, 64 + n_flags + 4 * len(steps))
    return _HEAD.pack(seen.revision, n_flags, len(data)) + data


def take_seen(reader: Reader) -> SeenLandmarks:
    """Return what is seen that comes next, or raise WireError."""
    revision, n_flags, n_bytes = reader.unpack(_HEAD)
    if not 0 < n_flags <= MAX_LANDMARKS:
        raise WireError(f"seen landmarks: of {n_flags}, 1 to {MAX_LANDMARKS} allowed")
    stream = Stream.reading(reader.take(n_bytes))
    flags = np.zeros(n_flags, dtype=np.int64)
    stream.code_listed(flags)
    landmarks = np.flatnonzero(flags)
    if stream.failed or not flags[-1] or len(landmarks) > MAX_SEEN:
        raise WireError(f"seen landmarks: {len(landmarks)} of {n_flags}, at most {MAX_SEEN}")
    steps = np.zeros((len(landmarks), 2), dtype=np.int64)
    stream.code_seen(steps)
    if not stream.is_all_read or np.abs(steps).max() > _MAX_STEPS:
        raise WireError("seen landmarks: pixels that nobody tells")
    return SeenLandmarks(revision, landmarks, steps / STEPS_PER_PX)
