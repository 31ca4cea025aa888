"""The landmarks of a map for one who has its parent: only what has changed (IV-G).

A landmark of the parent is known again by where it was seen: keyframes stay, and so
do the observations in them. What is left to tell of it is how far it has moved and where the
new keyframes see it. After version, kind, revision and the head of the map (``map_codec``):

| u32    | landmarks of the parent, P                                                      |
| stream | which of the P are the map's; what has changed of these, in the parent's order; |
|        | the others, as in a map                                                         |
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vcl_companion.errors import WireError
from vcl_companion.geometry.rotation import Array
from vcl_companion.mapping.landmark_map import LandmarkMap
from vcl_companion.wire.landmark_coder import Rows, Stream
from vcl_companion.wire.landmark_grid import Places, Views, steps_of_pixels
from vcl_companion.wire.landmark_kernels import AS_BEFORE, NOT_SEEN, SEEN, Integers
from vcl_companion.wire.map_codec import MapHead
from vcl_companion.wire.map_landmarks import (
    check_inside,
    code_new,
    landmarks_of_new,
    residuals,
    room_of,
    rows_of_new,
    seen_only,
)
from vcl_companion.wire.reader import Reader

Known = Sequence[int | None]
Indices = NDArray[np.intp]

_COUNT = struct.Struct("<I")
# Where a landmark was seen, as one number: place, u and v.
_BITS = 20


def encode_changes(child: LandmarkMap, parent: LandmarkMap, known: Known) -> bytes:
    """Return the landmarks of a map for one who has its parent.

    Args:
        child: the map.
        parent: the one that it was made from.
        known: of every keyframe of the map, which of the parent's it is; None for a new one.

    Raises:
        ValueError: an observation lies outside of its image.
    """
    views = Views(child.keyframes)
    pixels, pixels_then = steps_of_pixels(child.observed_px), steps_of_pixels(parent.observed_px)
    check_inside(pixels, views)
    now, then = _same(pixels, pixels_then, known)
    listed = np.zeros(len(pixels_then), dtype=np.int64)
    listed[then] = 1
    before = _before(pixels_then[then], known)
    changed = _rows_of_known(
        child.points_world[now], pixels[now], parent.points_world[then], before, views
    )
    fresh = np.setdiff1d(np.arange(len(pixels)), now)
    new, counts = rows_of_new(child.points_world[fresh], pixels[fresh], views)

    def write(stream: Stream) -> None:
        stream.code_listed(listed)
        stream.code_known(changed, (before[:, :, 0] >= 0).astype(np.int64))
        code_new(stream, new, counts, views)

    data = Stream.written_by(write, room_of(pixels) + len(listed))
    return _COUNT.pack(len(listed)) + data


def n_of_parent(reader: Reader) -> int:
    """Return how many landmarks the parent has that what follows was told for; 0: for none.

    Raises:
        WireError: the bytes end here.
    """
    (n_landmarks,) = reader.unpack(_COUNT)
    return int(n_landmarks)


def take_changes(reader: Reader, head: MapHead, parent: LandmarkMap, known: Known) -> LandmarkMap:
    """Return the map whose landmarks are the rest of the bytes.

    Args:
        reader: behind the head of the map.
        head: of the map.
        parent: the map that it was made from.
        known: of every keyframe, which of the parent's it is; None for a new one.

    Raises:
        WireError: the bytes are no landmarks, or not of this parent.
        ValueError: they are of no map.
    """
    views = Views(head.keyframes)
    pixels_then = steps_of_pixels(parent.observed_px)
    if n_of_parent(reader) != len(pixels_then):
        raise WireError("map update: its parent is another one")
    stream = Stream.reading(reader.rest())
    listed = np.zeros(len(pixels_then), dtype=np.int64)
    stream.code_listed(listed)
    then = np.flatnonzero(listed)
    if stream.failed or len(then) > head.n_landmarks:
        raise WireError(f"map update: {len(then)} of {head.n_landmarks} landmarks are its parent's")
    before = _before(pixels_then[then], known)
    changed = Rows.blank(len(then), len(known))
    stream.code_known(changed, (before[:, :, 0] >= 0).astype(np.int64))
    new = Rows.blank(head.n_landmarks - len(then), len(known))
    code_new(stream, new, np.zeros(len(known), dtype=np.int64), views)
    if not stream.is_all_read:
        raise WireError("map update: its landmarks do not end where it does")
    there = _landmarks_of_known(changed, parent.points_world[then], before, views)
    fresh = landmarks_of_new(new, views)
    points, pixels = (np.concatenate(both) for both in zip(there, fresh, strict=True))
    return head.map_with(points, pixels)


def _rows_of_known(
    points: Array, pixels: Integers, points_then: Array, before: Integers, views: Views
) -> Rows:
    """Return what has changed of landmarks; ``before``: where these keyframes saw them then."""
    seen, stays = pixels[:, :, 0] >= 0, (pixels == before).all(axis=2)
    at, guess = views.places(points, seen), views.guesses(points_then, seen)
    state = np.where(seen, np.where(stays, AS_BEFORE, SEEN), NOT_SEEN)
    return Rows(
        state=state,
        away=at.away.astype(np.int64),
        place=at.xyz,
        aside=np.where(at.away[:, None], 0, at.pixel - guess.pixel),
        depth=np.where(at.away, 0, at.depth - guess.depth),
        residual=residuals(at, pixels, seen, views),
        first=np.zeros((len(points), 2), dtype=np.int64),
    )


def _landmarks_of_known(
    rows: Rows, points_then: Array, before: Integers, views: Views
) -> tuple[Array, Integers]:
    """Return points and pixels of such rows."""
    seen = rows.state != NOT_SEEN
    away, guess = rows.away > 0, views.guesses(points_then, seen)
    depth = np.where(away, 0, guess.depth + rows.depth)
    points = views.points(Places(away, rows.place, guess.pixel + rows.aside, depth), seen)
    told = views.expected(points, seen) + rows.residual
    pixels = np.where((rows.state == AS_BEFORE)[..., None], before, told)
    return points, seen_only(pixels, seen, views)


def _before(pixels_then: Integers, known: Known) -> Integers:
    """Return (M, V, 2) where the map's keyframes saw the parent's landmarks; -1 if new."""
    out = np.full((len(pixels_then), len(known), 2), -1, dtype=np.int64)
    for i, place in enumerate(known):
        if place is not None:
            out[:, i] = pixels_then[:, place]
    return out


def _same(pixels: Integers, pixels_then: Integers, known: Known) -> tuple[Indices, Indices]:
    """Return (M,) rows of a map and of its parent that are one landmark, in the parent's order."""
    kept = [i for i, place in enumerate(known) if place is not None]
    stayed = [place for place in known if place is not None]
    names, rows = _sightings(pixels[:, kept], stayed)
    names_then, rows_then = _sightings(pixels_then[:, stayed], stayed)
    _, at, at_then = np.intersect1d(names, names_then, assume_unique=False, return_indices=True)
    pairs, votes = np.unique(
        np.stack([rows_then[at_then], rows[at]], axis=1), axis=0, return_counts=True
    )
    # One partner each, the one that most sightings speak for.
    pairs = pairs[np.argsort(-votes, kind="stable")]
    for column in (0, 1):
        pairs = pairs[np.sort(np.unique(pairs[:, column], return_index=True)[1])]
    pairs = pairs[np.argsort(pairs[:, 0])]
    return pairs[:, 1], pairs[:, 0]


def _sightings(pixels: Integers, places: Sequence[int]) -> tuple[Integers, Indices]:
    """Return a number for every sighting, the same for the same one, and whose it is."""
    rows, columns = np.nonzero(pixels[:, :, 0] >= 0)
    u, v = pixels[rows, columns].T
    place = np.asarray(places, dtype=np.int64)[columns]
    return (((place << _BITS) | u) << _BITS) | v, rows
