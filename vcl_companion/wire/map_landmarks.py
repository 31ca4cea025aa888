"""The landmarks of a map as bytes: where its keyframes saw them, and how far away they are.

They go in one order, whatever order a map has them in: by anchor, and by v and u in its image
(``landmark_grid``). So the next one is never far, v and inverse depth take few bits, and a map
that comes back from its bytes has that order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import WireError
from vcl_companion.geometry.rotation import Array
from vcl_companion.wire.landmark_coder import Rows, Stream
from vcl_companion.wire.landmark_grid import Flags, Places, Views
from vcl_companion.wire.landmark_kernels import SEEN, Integers

Indices = NDArray[np.intp]

# A landmark takes at least two bits: those of its pixel that are as good as random.
_MOST_LANDMARKS_PER_BYTE = 4
# Of 10 bytes for most landmarks and 2 for most sightings: enough for nearly every map.
_ROOM_BYTES, _ROOM_LANDMARK_BYTES, _ROOM_SIGHTING_BYTES = 1024, 40, 8


def encode_landmarks(points: Array, pixels: Integers, views: Views) -> bytes:
    """Return the bytes of landmarks; points are rounded to their grids.

    Args:
        points: (n, 3) where they lie, world frame, m.
        pixels: (n, V, 2) steps where the keyframes saw them, see ``steps_of_pixels``.
        views: the keyframes.

    Raises:
        ValueError: an observation lies outside of its image.
    """
    rows, counts = rows_of_new(points, pixels, views)
    return Stream.written_by(lambda stream: code_new(stream, rows, counts, views), room_of(pixels))


def decode_landmarks(data: bytes, n: int, views: Views) -> tuple[Array, Integers]:
    """Return the (n, 3) points and (n, V, 2) pixels of bytes.

    Raises:
        WireError: the bytes are none, or not those that ``encode_landmarks`` writes of them.
    """
    if n > _MOST_LANDMARKS_PER_BYTE * len(data):
        raise WireError(f"map: {n} landmarks in {len(data)} bytes")
    stream = Stream.reading(data)
    rows = Rows.blank(n, len(views.largest))
    code_new(stream, rows, np.zeros(len(views.largest), dtype=np.int64), views)
    if not stream.is_all_read:
        raise WireError("map: its landmarks do not end where it does")
    points, pixels = landmarks_of_new(rows, views)
    if not _is_own_form(rows, points, pixels, views):
        raise WireError("map: its landmarks are not in their own form")
    return points, pixels


def room_of(pixels: Integers) -> int:
    """Return the bytes that landmarks seen at (n, V, 2) pixels take at the most, nearly always."""
    n_seen = int((pixels[:, :, 0] >= 0).sum())
    return _ROOM_BYTES + _ROOM_LANDMARK_BYTES * len(pixels) + _ROOM_SIGHTING_BYTES * n_seen


def code_new(stream: Stream, rows: Rows, counts: Integers, views: Views) -> None:
    """Write or read landmarks that nothing is known of; see ``Stream.code_new``."""
    bits = np.array([int(u).bit_length() for u in views.largest[:, 0]], dtype=np.int64)
    stream.code_new(rows, counts, views.exponents, bits)


def rows_of_new(points: Array, pixels: Integers, views: Views) -> tuple[Rows, Integers]:
    """Return what is told of landmarks that nothing is known of, in their order.

    Args:
        points: (n, 3) where they lie, world frame, m.
        pixels: (n, V, 2) steps where the keyframes saw them.
        views: the keyframes.

    Returns:
        The rows, and (V,) how many each keyframe is the anchor of.

    Raises:
        ValueError: an observation lies outside of its image.
    """
    check_inside(pixels, views)
    seen = pixels[:, :, 0] >= 0
    anchors, _ = views.anchors(seen)
    at = views.places(points, seen)
    first = _at_anchors(pixels, anchors)
    order = _order(at, first, anchors)
    seen, pixels, first = seen[order], pixels[order], first[order]
    at = Places(at.away[order], at.xyz[order], at.pixel[order], at.depth[order])
    residual = residuals(at, pixels, seen, views)
    somewhere = np.flatnonzero(seen.any(axis=1))
    residual[somewhere, anchors[order][somewhere]] = 0  # that is ``first``
    rows = Rows(
        state=np.where(seen, SEEN, 0),
        away=at.away.astype(np.int64),
        place=at.xyz,
        aside=np.where(at.away[:, None], 0, at.pixel - first),
        depth=at.depth,
        residual=residual,
        first=first,
    )
    n_keyframes = seen.shape[1]
    return rows, np.bincount(anchors, minlength=n_keyframes)[:n_keyframes].astype(np.int64)


def landmarks_of_new(rows: Rows, views: Views) -> tuple[Array, Integers]:
    """Return points and pixels of such rows.

    Raises:
        WireError: a landmark lies nowhere, or an observation outside of its image.
    """
    seen = rows.state == SEEN
    at = Places(rows.away > 0, rows.place, rows.first + rows.aside, rows.depth)
    points = views.points(at, seen)
    if not np.isfinite(points).all():
        raise WireError("map: a landmark lies nowhere")
    pixels = views.expected(points, seen) + rows.residual
    anchors, _ = views.anchors(seen)
    somewhere = np.flatnonzero(anchors < seen.shape[1])
    pixels[somewhere, anchors[somewhere]] = rows.first[somewhere]
    pixels = seen_only(pixels, seen, views)
    return points, pixels


def residuals(at: Places, pixels: Integers, seen: Flags, views: Views) -> Integers:
    """Return (n, V, 2) what pixels are off from where the places would be seen; 0 if not seen."""
    off = pixels - views.expected(views.points(at, seen), seen)
    return np.where(seen[..., None], off, 0)


def seen_only(pixels: Integers, seen: Flags, views: Views) -> Integers:
    """Return (n, V, 2) pixels, -1 where not seen.

    Raises:
        WireError: an observation lies outside of its image.
    """
    if (((pixels < 0) | (pixels > views.largest)) & seen[..., None]).any():
        raise WireError("map: an observation lies outside of its image")
    return np.where(seen[..., None], pixels, -1)


def check_inside(pixels: Integers, views: Views) -> None:
    """Raise ValueError for (n, V, 2) pixels of which one lies outside of its image."""
    if (pixels > views.largest).any():
        raise ValueError("an observation lies outside of its image")


def _order(at: Places, first: Integers, anchors: Integers) -> Indices:
    """Return the order of landmarks: those seen at the same pixel go by where they lie."""
    return np.lexsort((*at.xyz.T, at.depth, *at.pixel.T, first[:, 0], first[:, 1], anchors))


def _is_own_form(rows: Rows, points: Array, pixels: Integers, views: Views) -> bool:
    """Return whether a map of these landmarks would be told by these rows.

    That a number has one code only, the coder sees to: see ``Stream.is_all_read``.
    """
    seen = pixels[:, :, 0] >= 0
    at, (anchors, _) = views.places(points, seen), views.anchors(seen)
    is_in_order = (np.diff(_order(at, rows.first, anchors)) > 0).all()
    pixel = np.where(at.away[:, None], 0, rows.first + rows.aside)
    told = ((at.away, rows.away > 0), (at.xyz, rows.place), (at.pixel, pixel))
    same = all(np.array_equal(*both) for both in told) and np.array_equal(at.depth, rows.depth)
    return bool(is_in_order and same)


def _at_anchors(pixels: Integers, anchors: Integers) -> Integers:
    """Return (n, 2) the pixels of landmarks in their anchors; 0 of those that have none."""
    n, n_keyframes = pixels.shape[:2]
    first = pixels[np.arange(n), np.minimum(anchors, n_keyframes - 1)]
    return np.where((anchors < n_keyframes)[:, None], first, 0)
