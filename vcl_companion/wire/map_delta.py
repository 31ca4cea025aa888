"""The landmarks of a map for one who has its parent: only what has changed (IV-G).

A landmark of the parent is known again by where it was seen: keyframes stay, and so
do the observations in them. What is left to tell of it is how far it has moved and where the
new keyframes see it. After version, kind, revision and the head of the map (``map_codec``):

| u32                | landmarks of the parent P; N bits: which of the map's were among them;  |
|                    | P bits: which of the parent's those are, in the same order; M of each    |
| 3 residuals of M   | x, y, z of those, less what they were in the parent, steps of 2^-12 m   |
| 3 columns of N - M | x, y, z of the others                                                   |
| V times            | of a keyframe that the parent has: one bit for each of the M that the   |
|                    | parent saw there, whether that stays                                    |
|                    | u8, a sum: 1 others of the M are seen there, 2 some of the N - M are    |
|                    | M bits if so, N - M bits if so: which; residuals u, v of all of these   |
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import WireError
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.wire.columns import (
    Integers,
    encode_bits,
    encode_column,
    encode_residuals,
    take_bits,
    take_column,
    take_residuals,
)
from vcl_companion.wire.map_codec import (
    MapHead,
    encode_pixels,
    steps_of_pixels,
    steps_of_points,
    take_pixels,
)
from vcl_companion.wire.reader import Reader

Places = Sequence[int | None]
Rows = NDArray[np.intp]

_COUNT = struct.Struct("<I")
_OF = struct.Struct("<B")
_MORE, _NEW = 1, 2
# Where a landmark was seen, as one number: place, u and v.
_BITS = 20
# What moved farther than this, 16 m, is told as a new one.
_FAR_STEPS = 1 << 16


def encode_landmarks(child: LandmarkMap, parent: LandmarkMap, places: Places) -> bytes:
    """Return the landmarks of a map for one who has its parent.

    Args:
        child: the map.
        parent: the one that it was made from.
        places: of every keyframe of the map, which of the parent's it is; None for a new one.

    Raises:
        ValueError: an observation lies outside of its image.
    """
    points, points_then = steps_of_points(child.points_world), steps_of_points(parent.points_world)
    pixels, pixels_then = steps_of_pixels(child.observed_px), steps_of_pixels(parent.observed_px)
    now, then = _same(pixels, pixels_then, places)
    near = np.abs(points[now] - points_then[then]).max(axis=1, initial=0) < _FAR_STEPS
    now, then = now[near], then[near]
    new = np.setdiff1d(np.arange(len(points)), now)
    parts = [
        _COUNT.pack(len(points_then)),
        encode_bits(_mask(now, len(points))),
        encode_bits(_mask(then, len(points_then))),
        *(encode_residuals(axis) for axis in (points[now] - points_then[then]).T),
        *(encode_column(axis) for axis in points[new].T),
    ]
    for i, place in enumerate(places):
        more = pixels[now, i, 0] >= 0
        if place is not None:
            there = pixels_then[then, place, 0] >= 0
            stays = (pixels[now, i] == pixels_then[then, place]).all(axis=1)
            parts.append(encode_bits(stays[there]))
            more &= ~(there & stays)
        fresh = pixels[new, i, 0] >= 0
        parts.append(_OF.pack(_MORE * bool(more.any()) + _NEW * bool(fresh.any())))
        parts += [encode_bits(mask) for mask in (more, fresh) if mask.any()]
        seen = np.concatenate([now[more], new[fresh]])
        parts.append(encode_pixels(pixels[seen, i], points[seen], child.keyframes[i]))
    return b"".join(parts)


def take_landmarks(
    reader: Reader, head: MapHead, parent: LandmarkMap, places: Places
) -> LandmarkMap:
    """Return the map whose landmarks come next.

    Args:
        reader: behind the head of the map.
        head: of the map.
        parent: the map that it was made from.
        places: of every keyframe, which of the parent's it is; None for a new one.

    Raises:
        WireError: the bytes are no landmarks, or not of this parent.
        ValueError: they are of no map.
    """
    points_then, pixels_then = (
        steps_of_points(parent.points_world),
        steps_of_pixels(parent.observed_px),
    )
    if reader.unpack(_COUNT) != (len(points_then),):
        raise WireError("map update: its parent is another one")
    n = head.n_landmarks
    is_known = take_bits(reader, n)
    now, new = np.flatnonzero(is_known), np.flatnonzero(~is_known)
    then = np.flatnonzero(take_bits(reader, len(points_then)))
    if len(now) != len(then):
        raise WireError(f"map update: {len(now)} landmarks are {len(then)} of its parent's")
    points = np.empty((n, 3), dtype=np.int64)
    points[now] = points_then[then] + _stacked(take_residuals, reader, len(now))
    points[new] = _stacked(take_column, reader, len(new))
    pixels = np.full((n, len(head.keyframes), 2), -1, dtype=np.int64)
    for i, (keyframe, place) in enumerate(zip(head.keyframes, places, strict=True)):
        if place is not None:
            there = np.flatnonzero(pixels_then[then, place, 0] >= 0)
            stays = there[take_bits(reader, len(there))]
            pixels[now[stays], i] = pixels_then[then[stays], place]
        (of,) = reader.unpack(_OF)
        if of > _MORE + _NEW:
            raise WireError(f"map update: unknown contents {of}")
        rows = [
            known[take_bits(reader, len(known))]
            for known, is_there in ((now, of & _MORE), (new, of & _NEW))
            if is_there
        ]
        seen = np.concatenate([np.zeros(0, dtype=np.intp), *rows])
        pixels[seen, i] = take_pixels(reader, points[seen], keyframe)
    return head.map_with(points, pixels)


def _stacked(take: Callable[[Reader, int], Integers], reader: Reader, n: int) -> Integers:
    return np.stack([take(reader, n) for _ in range(3)], axis=1)


def _mask(rows: Rows, n: int) -> NDArray[np.bool_]:
    mask = np.zeros(n, dtype=np.bool_)
    mask[rows] = True
    return mask


def _same(pixels: Integers, pixels_then: Integers, places: Places) -> tuple[Rows, Rows]:
    """Return (M,) rows of a map and of its parent that are one landmark, both ascending."""
    known = [i for i, place in enumerate(places) if place is not None]
    stayed = [place for place in places if place is not None]
    names, rows = _sightings(pixels[:, known], stayed)
    names_then, rows_then = _sightings(pixels_then[:, stayed], stayed)
    _, at, at_then = np.intersect1d(names, names_then, assume_unique=False, return_indices=True)
    pairs, votes = np.unique(
        np.stack([rows_then[at_then], rows[at]], axis=1), axis=0, return_counts=True
    )
    # One partner each, the one that most sightings speak for, and none out of turn.
    pairs = pairs[np.argsort(-votes, kind="stable")]
    for column in (0, 1):
        pairs = pairs[np.sort(np.unique(pairs[:, column], return_index=True)[1])]
    pairs = pairs[np.argsort(pairs[:, 0])]
    highest = np.maximum.accumulate(pairs[:, 1], axis=0) if len(pairs) else pairs[:, 1]
    pairs = pairs[np.concatenate([[True], pairs[1:, 1] > highest[:-1]])[: len(pairs)]]
    return pairs[:, 1], pairs[:, 0]


def _sightings(pixels: Integers, places: Sequence[int]) -> tuple[Integers, Rows]:
    """Return a number for every sighting, the same for the same one, and whose it is."""
    rows, columns = np.nonzero(pixels[:, :, 0] >= 0)
    u, v = pixels[rows, columns].T
    place = np.asarray(places, dtype=np.int64)[columns]
    return (((place << _BITS) | u) << _BITS) | v, rows
